"""Bits on the wire against an encoder that builds the whole frame as a string of bits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.bus.bits import BusLoad, frame_bits, frame_seconds
from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FrameBlock,
)

FD_LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]


def make_block(frames: list[tuple[int, bytes, int]]) -> FrameBlock:
    """Rows from (can_id with flag bits, payload, FD flags)."""
    block = FrameBlock.zeros(len(frames))
    for row, (can_id, data, flags) in enumerate(frames):
        block.can_id[row] = can_id
        block.raw[row, 4] = len(data)
        block.raw[row, 5] = flags
        block.raw[row, 8:8 + len(data)] = np.frombuffer(data, np.uint8)
    return block


# ---- the slow, independent encoder --------------------------------------------------------------------

def number(value: int, width: int) -> str:
    return format(value, f"0{width}b")


def crc15(bits: str) -> str:
    """Long division of the message polynomial by x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1."""
    divisor = "1100010110011001"
    work = list(bits + "0" * 15)
    for at in range(len(bits)):
        if work[at] == "1":
            for k, bit in enumerate(divisor):
                work[at + k] = str(int(work[at + k]) ^ int(bit))
    return "".join(work[-15:])


def stuff(bits: str, at_end: bool) -> str:
    """A complement after every five equal bits, stuff bits included; at_end: also after the last bit."""
    out = ""
    for k, bit in enumerate(bits):
        out += bit
        if len(out) >= 5 and len(set(out[-5:])) == 1 and (at_end or k < len(bits) - 1):
            out += "1" if bit == "0" else "0"
    return out


def identifier(can_id: int, fd: bool, remote: bool) -> str:
    if can_id & CAN_EFF_FLAG:
        ident = number(can_id & 0x1FFFFFFF, 29)
        return "0" + ident[:11] + "11" + ident[11:] + ("1" if remote else "0")
    return "0" + number(can_id & 0x7FF, 11) + ("1" if remote else "0") + "0"


def classical_string(can_id: int, data: bytes, length: int) -> str:
    remote = bool(can_id & CAN_RTR_FLAG)
    bits = identifier(can_id, False, remote)
    bits += "00" if can_id & CAN_EFF_FLAG else "0"
    bits += number(length, 4)
    if not remote:
        bits += "".join(number(byte, 8) for byte in data)
    return stuff(bits + crc15(bits), True) + "1" + "0" + "1" + "1" * 7 + "1" * 3


def fd_strings(can_id: int, data: bytes, flags: int) -> tuple[str, str]:
    """(nominal, data phase) of an ISO CAN FD frame with bit rate switch; the CRC's value does not matter."""
    arbitration = identifier(can_id, True, False) + "1" + "0" + ("1" if flags & CANFD_BRS else "0")
    rest = ("1" if flags & CANFD_ESI else "0") + number(FD_LENGTHS.index(len(data)), 4)
    rest += "".join(number(byte, 8) for byte in data)
    stuffed = stuff(arbitration + rest, False)
    head = stuff(arbitration, True)
    assert stuffed.startswith(head)
    field = "0" * (4 + (17 if len(data) <= 16 else 21))
    fixed = "".join(("1" if k % 4 == 0 else "") + bit for k, bit in enumerate(field))
    return head + "0" + "1" + "1" * 7 + "1" * 3, stuffed[len(head):] + fixed + "1"


identifiers = st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF).map(lambda i: i | CAN_EFF_FLAG))
# runs of equal bits make stuff bits, plain random bytes hardly do
stuffy = st.sampled_from([0x00, 0xFF, 0x1F, 0x0F, 0x83, 0xF8, 0x07, 0xC1, 0x3E, 0xAA])
payload_bytes = st.one_of(stuffy, st.integers(0, 255))


@given(identifiers, st.lists(payload_bytes, max_size=8))
def test_classical_frames_match_a_bit_string(can_id: int, payload: list[int]) -> None:
    data = bytes(payload)
    nominal, fast = frame_bits(make_block([(can_id, data, 0)]))
    assert (nominal[0], fast[0]) == (len(classical_string(can_id, data, len(data))), 0)


@given(identifiers, st.integers(0, 8))
def test_remote_frames_have_a_length_and_no_data(can_id: int, length: int) -> None:
    block = make_block([(can_id | CAN_RTR_FLAG, b"", 0)])
    block.raw[0, 4] = length
    assert frame_bits(block)[0][0] == len(classical_string(can_id | CAN_RTR_FLAG, b"", length))


@given(identifiers, st.sampled_from(FD_LENGTHS), st.data(), st.booleans(), st.booleans())
def test_fd_frames_match_a_bit_string(can_id: int, length: int, draw: st.DataObject, brs: bool, esi: bool
                                      ) -> None:
    data = bytes(draw.draw(st.lists(payload_bytes, min_size=length, max_size=length)))
    flags = CANFD_FDF | (CANFD_BRS if brs else 0) | (CANFD_ESI if esi else 0)
    nominal, fast = frame_bits(make_block([(can_id, data, flags)]))
    slow_part, fast_part = fd_strings(can_id, data, flags)
    if brs:
        assert (nominal[0], fast[0]) == (len(slow_part), len(fast_part))
    else:
        assert (nominal[0], fast[0]) == (len(slow_part) + len(fast_part), 0)


@pytest.mark.parametrize("length", [1, 2, 16, 20])
def test_fd_stuff_bit_due_after_the_last_data_bit_is_not_sent(length: int) -> None:
    """Every last byte after 0x55, so that some end in exactly five equal bits."""
    frames = [(0x2AA, b"\x55" * (length - 1) + bytes([k]), CANFD_FDF | CANFD_BRS) for k in range(256)]
    nominal, fast = frame_bits(make_block(frames))
    expected = [fd_strings(*frame) for frame in frames]
    assert nominal.tolist() == [len(a) for a, _ in expected]
    assert fast.tolist() == [len(b) for _, b in expected]


def test_every_single_byte_payload() -> None:
    """Exhaustive where it is cheap: every identifier's frame with a byte that follows from it."""
    frames = [(i, bytes([i & 0xFF, i >> 3]), 0) for i in range(0x800)]
    expected = [len(classical_string(i, data, 2)) for i, data, _ in frames]
    assert frame_bits(make_block(frames))[0].tolist() == expected


def test_known_crc15() -> None:
    """The encoder itself: CRC-15/CAN of "123456789" is 0x059E (catalogue of parametrised CRC algorithms)."""
    assert int(crc15("".join(number(b, 8) for b in b"123456789")), 2) == 0x059E


def test_bounds_of_classical_frames() -> None:
    """47+8n to 55+10n bits with an 11-bit identifier: 111 to 135 us for 8 bytes at 1 Mbit/s."""
    rng = np.random.default_rng(3)
    for n in range(9):
        frames = [(int(rng.integers(0x800)), rng.bytes(n), 0) for _ in range(2000)]
        nominal, _ = frame_bits(make_block(frames))
        assert nominal.min() >= 47 + 8 * n
        assert nominal.max() <= 55 + 10 * n
    rng = np.random.default_rng(5)
    frames = [(int(rng.integers(0x800)), rng.bytes(8), 0) for _ in range(20_000)]
    assert 113.5e-6 < frame_seconds(make_block(frames), 1e6).mean() < 114.5e-6


def test_least_and_most_stuff_bits_of_eight_bytes() -> None:
    rng = np.random.default_rng(11)
    least = make_block([(0x555, bytes([0x55] * 7 + [k]), 0) for k in range(256)])
    assert frame_bits(least)[0].min() == 111
    # header stuffed all through (0 00001 1110000 ...), data of runs of four after the first stuff bit
    data = bytes([0x3C, 0x3C, 0x3C, 0x3C, 0x3C, 0x3C])
    most = make_block([(i, data + rng.bytes(2), 0) for i in (0x07C, 0x078) for _ in range(20_000)])
    assert 130 <= frame_bits(most)[0].max() <= 135


def test_fd_sixty_four_bytes_take_139_to_169_us() -> None:
    flags = CANFD_FDF | CANFD_BRS
    times = frame_seconds(make_block([(0x555, b"\x55" * 64, flags), (0, bytes(64), flags)]), 1e6, 5e6)
    # 29 + 550 bits with no stuffing
    assert times[0] == pytest.approx(29e-6 + 550 / 5e6)
    assert 139e-6 <= times[0] < 140e-6 < times[1] <= 169e-6


def test_fd_payload_is_padded_to_a_length_the_wire_knows() -> None:
    flags = CANFD_FDF | CANFD_BRS
    for short, padded in ((9, 12), (13, 16), (23, 24), (25, 32), (33, 48), (49, 64), (63, 64)):
        one = frame_bits(make_block([(0x123, b"\x5a" * short, flags)]))
        other = frame_bits(make_block([(0x123, b"\x5a" * short + bytes(padded - short), flags)]))
        assert [int(x[0]) for x in one] == [int(x[0]) for x in other]


def test_error_rows_take_no_bits() -> None:
    block = make_block([(CAN_ERR_FLAG | 4, bytes(8), 0)])
    assert [int(x[0]) for x in frame_bits(block)] == [0, 0]


def test_impossible_lengths_are_cut_and_never_raise() -> None:
    block = make_block([(1, b"", 0), (1, b"", CANFD_FDF)])
    block.raw[:, 4] = 255
    classical, fd = make_block([(1, bytes(8), 0), (1, bytes(64), CANFD_FDF)]), frame_bits(block)
    assert np.array_equal(frame_bits(classical)[0], fd[0])


def test_wrong_rates_are_named() -> None:
    with pytest.raises(ValueError, match=r"bitrate is 0.*above 0"):
        frame_seconds(FrameBlock.zeros(1), 0)
    with pytest.raises(ValueError, match=r"data_bitrate is -1"):
        BusLoad(1e6, -1)
    with pytest.raises(ValueError, match="window_s"):
        BusLoad(1e6, window_s=0.0)


# ---- load ---------------------------------------------------------------------------------------------

def steady(rate_hz: float, seconds: float, start_ns: int = 0) -> FrameBlock:
    n = round(rate_hz * seconds)
    block = make_block([(0x555, b"\x55" * 8, 0)] * n)
    block.t_ns[:] = start_ns + (np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
    return block


def test_load_of_a_steady_stream() -> None:
    per_frame = frame_seconds(steady(1, 1), 1e6)[0]
    meter = BusLoad(1e6)
    meter.update(steady(5000, 3.0, 1_700_000_000_000_000_000))
    assert meter.load() == pytest.approx(5000 * per_frame, rel=0.01)


def test_load_follows_in_a_window_and_falls_to_zero_in_silence() -> None:
    meter = BusLoad(1e6, window_s=0.5)
    meter.update(steady(4000, 1.0))
    meter.update(steady(1000, 1.0, 10**9))
    per_frame = frame_seconds(steady(1, 1), 1e6)[0]
    assert meter.load() == pytest.approx(1000 * per_frame, rel=0.02)
    assert meter.load(2 * 10**9 + 250_000_000) == pytest.approx(500 * per_frame, rel=0.1)
    assert meter.load(4 * 10**9) == 0.0


def test_load_does_not_depend_on_the_cut_into_blocks() -> None:
    rng = np.random.default_rng(1)
    block = steady(3000, 2.0)
    block.t_ns[:] += rng.integers(-2_000_000, 2_000_000, len(block))
    block.t_ns[:] = np.abs(block.t_ns)
    whole = BusLoad(5e5)
    whole.update(block)
    parts = BusLoad(5e5)
    for rows in np.split(np.arange(len(block)), np.sort(rng.integers(0, len(block), 40))):
        parts.update(block.take(rows))
    assert parts.load() == whole.load() > 0.0


def test_load_of_fd_frames_uses_both_rates() -> None:
    block = make_block([(0x120, b"\x5a" * 64, CANFD_FDF | CANFD_BRS)] * 1400)
    block.t_ns[:] = np.arange(1400) * 714_286
    meter = BusLoad(1e6, 5e6)
    meter.update(block)
    assert 0.19 < meter.load() < 0.24


def test_load_starts_afresh_when_time_jumps_back() -> None:
    meter = BusLoad(1e6)
    meter.update(steady(7000, 1.0, 100 * 10**9))
    meter.update(steady(100, 1.0))
    assert meter.load() < 0.02


def test_load_before_any_frame_is_zero() -> None:
    assert BusLoad(1e6).load() == 0.0
    assert BusLoad(1e6).load(10**18) == 0.0
