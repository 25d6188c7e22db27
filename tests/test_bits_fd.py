"""CAN FD frames bit by bit with real CRCs, stuff count and fixed stuff bits, read back by a receiver.

ISO 11898-1:2015, clause 10 (fields, stuffing, CRC, stuff count).  The receiver knows only the rules of reception:
it takes stuff bits out, checks every one of them, the count, and the CRC.  What it accepts is a frame, so its
length is that on the wire, and `frame_bits` has to say the same.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.bus.bits import frame_bits
from ipmsm_can.frames import CAN_EFF_FLAG, CANFD_BRS, CANFD_ESI, CANFD_FDF, FrameBlock

Bits = list[int]
LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
GRAY = ["000", "001", "011", "010", "110", "111", "101", "100"]
POLYNOMIALS = {17: 0x1685B, 21: 0x102899}
TAIL = [0, 1, *[1] * 7, *[1] * 3]
"""Acknowledged ACK slot, ACK delimiter, end of frame, intermission."""


def word(value: int, width: int) -> Bits:
    return [(value >> (width - 1 - k)) & 1 for k in range(width)]


def crc(bits: Bits, width: int, start: int) -> int:
    """Shift register as in the standard's figure: the incoming bit against the highest one."""
    register = start
    for bit in bits:
        feedback = bit ^ (register >> (width - 1))
        register = (register << 1) & ((1 << width) - 1)
        if feedback:
            register ^= POLYNOMIALS[width] & ((1 << width) - 1)
    return register


def encode(can_id: int, data: bytes, flags: int) -> tuple[Bits, int, int]:
    """The frame as sent; where BRS ends and where the CRC delimiter ends."""
    if can_id & CAN_EFF_FLAG:
        ident = word(can_id & 0x1FFFFFFF, 29)
        head = [0, *ident[:11], 1, 1, *ident[11:], 0]       # SOF, base, SRR, IDE, extension, RRS
    else:
        head = [0, *word(can_id, 11), 0, 0]                 # SOF, identifier, RRS, IDE
    head += [1, 0, int(bool(flags & CANFD_BRS))]            # FDF, res, BRS
    body = [*head, int(bool(flags & CANFD_ESI)), *word(LENGTHS.index(len(data)), 4)]
    for byte in data:
        body += word(byte, 8)
    sent: Bits = []
    stuffed = run = switch = 0
    for k, bit in enumerate(body):
        run = run + 1 if sent and sent[-1] == bit else 1
        sent.append(bit)
        if run == 5 and k < len(body) - 1:  # after the last one, the fixed stuff bit stands in for it
            sent.append(1 - bit)
            stuffed, run = stuffed + 1, 1
        if k == len(head) - 1:
            switch = len(sent)
    width = 17 if len(data) <= 16 else 21
    count = [int(b) for b in GRAY[stuffed % 8]]
    count.append(sum(count) % 2)
    field = count + word(crc(sent + count, width, 1 << (width - 1)), width)
    for k, bit in enumerate(field):
        if k % 4 == 0:
            sent.append(1 - sent[-1])
        sent.append(bit)
    sent.append(1)  # CRC delimiter
    return sent + TAIL, switch, len(sent)


class Receiver:
    """Reads a frame bit by bit; raises AssertionError at anything a controller would object to."""

    def __init__(self, bits: Bits) -> None:
        self.bits = bits
        self.at = 0
        self.stuffed = 0
        self.run = 0
        self.last = -1

    def plain(self) -> int:
        self.at += 1
        return self.bits[self.at - 1]

    def one(self) -> int:
        """The next bit, a stuff bit before it taken out."""
        if self.run == 5:
            bit = self.plain()
            assert bit != self.last, "stuff error"
            self.stuffed, self.run, self.last = self.stuffed + 1, 1, bit
        bit = self.plain()
        self.run = self.run + 1 if bit == self.last else 1
        self.last = bit
        return bit

    def number(self, width: int) -> int:
        value = 0
        for _ in range(width):
            value = value << 1 | self.one()
        return value

    def frame(self) -> tuple[int, bytes, int]:
        assert self.one() == 0
        can_id = self.number(11)
        if self.one():  # SRR: extended
            assert self.one() == 1
            can_id = (can_id << 18 | self.number(18)) | CAN_EFF_FLAG
            assert self.one() == 0
        else:
            assert self.one() == 0
        assert (self.one(), self.one()) == (1, 0)
        flags = CANFD_FDF | (CANFD_BRS if self.one() else 0) | (CANFD_ESI if self.one() else 0)
        length = LENGTHS[self.number(4)]
        data = bytes(self.number(8) for _ in range(length))
        covered = self.bits[:self.at]
        width = 17 if length <= 16 else 21
        field: Bits = []
        while len(field) < 4 + width:
            if len(field) % 4 == 0:
                assert self.plain() != self.bits[self.at - 2], "fixed stuff bit"
            field.append(self.plain())
        assert "".join(map(str, field[:3])) == GRAY[self.stuffed % 8], "stuff count"
        assert sum(field[:4]) % 2 == 0, "parity of the stuff count"
        assert field[4:] == word(crc(covered + field[:4], width, 1 << (width - 1)), width), "CRC"
        assert self.plain() == 1
        assert self.bits[self.at:] == TAIL
        return can_id, data, flags


def measured(can_id: int, data: bytes, flags: int) -> tuple[int, int]:
    block = FrameBlock.zeros(1)
    block.can_id[0] = can_id
    block.raw[0, 4:6] = len(data), flags
    block.raw[0, 8:8 + len(data)] = np.frombuffer(data, np.uint8)
    nominal, fast = frame_bits(block)
    return int(nominal[0]), int(fast[0])


identifiers = st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF).map(lambda i: i | CAN_EFF_FLAG))
stuffy = st.sampled_from([0x00, 0xFF, 0x1F, 0x0F, 0x83, 0xF8, 0x07, 0xC1, 0x3E, 0xAA])


@st.composite
def payloads(draw: st.DrawFn) -> bytes:
    length = draw(st.sampled_from(LENGTHS))
    return bytes(draw(st.lists(st.one_of(stuffy, st.integers(0, 255)), min_size=length, max_size=length)))


@given(identifiers, payloads(), st.booleans(), st.booleans())
def test_a_frame_that_a_receiver_accepts_is_as_long_as_counted(can_id: int, data: bytes, brs: bool, esi: bool
                                                              ) -> None:
    flags = CANFD_FDF | (CANFD_BRS if brs else 0) | (CANFD_ESI if esi else 0)
    bits, switch, end = encode(can_id, data, flags)
    assert Receiver(bits).frame() == (can_id, data, flags)
    assert measured(can_id, data, flags) == ((len(bits) - (end - switch), end - switch) if brs else (len(bits), 0))


@given(identifiers, payloads(), st.integers(0, 2000))
def test_the_receiver_objects_to_any_wrong_bit(can_id: int, data: bytes, at: int) -> None:
    """The yardstick itself: it would notice a frame built wrong."""
    bits, _, end = encode(can_id, data, CANFD_FDF | CANFD_BRS)
    bits[at % end] ^= 1
    with pytest.raises((AssertionError, IndexError)):
        assert Receiver(bits).frame() == (can_id, data, CANFD_FDF | CANFD_BRS)


def test_known_crcs() -> None:
    """CRC-17/CAN-FD and CRC-21/CAN-FD of "123456789" in the catalogue of parametrised CRC algorithms (start 0)."""
    text = [bit for byte in b"123456789" for bit in word(byte, 8)]
    assert crc(text, 17, 0) == 0x04F03
    assert crc(text, 21, 0) == 0x0ED841
