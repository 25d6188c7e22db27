"""The codec against cantools, against bits put together by hand, and at its edges."""

from __future__ import annotations

import math
import struct
from typing import Any, Literal

import cantools.database
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DataObject

from ipmsm_can.frames import CAN_EFF_FLAG, CANFD_BRS, CANFD_FDF, FrameBlock
from ipmsm_can.wire.codec import MessageCodec, SignalLayout
from ipmsm_can.wire.dbc import Database
from tests.strategies_dbc import RandomMessage, any_message, messages, same

PROPERTY = settings(max_examples=150, deadline=None, derandomize=True)


def theirs_and_ours(message: RandomMessage) -> tuple[Any, MessageCodec]:
    loaded = cantools.database.load_string(message.text, database_format="dbc", strict=True)
    assert isinstance(loaded, cantools.database.can.Database)
    return loaded.messages[0], Database.loads(message.text).messages["Random"]


def frames(payloads: list[bytes]) -> FrameBlock:
    block = FrameBlock.zeros(len(payloads))
    for k, payload in enumerate(payloads):
        block.length[k] = len(payload)
        block.data[k, :len(payload)] = np.frombuffer(payload, np.uint8)
    return block


def payloads_of(raw: np.ndarray[Any, np.dtype[np.uint8]], length: int) -> list[bytes]:
    return [bytes(row[8:8 + length]) for row in raw]


@given(data=st.data(), message=any_message())
@PROPERTY
def test_decode_equals_cantools(data: DataObject, message: RandomMessage) -> None:
    reference, codec = theirs_and_ours(message)
    n = message.length
    payloads = [bytes(n), b"\xff" * n, *data.draw(st.lists(st.binary(min_size=n, max_size=n), max_size=6))]
    block = frames(payloads)
    values = codec.decode(block.words)
    raws = codec.decode_raw(block.words)
    for k, payload in enumerate(payloads):
        try:
            expected = reference.decode(payload, decode_choices=False, scaling=True)
        except cantools.database.DecodeError:
            continue  # no signal under this multiplexer value: cantools refuses the frame, we give NaN
        expected_raw = reference.decode(payload, decode_choices=False, scaling=False)
        for s, name in enumerate(codec.signals):
            if name not in expected:
                assert math.isnan(values[s, k]) and raws[s, k] == 0
                continue
            raw = expected_raw[name]
            if isinstance(raw, int):
                assert int(raws[s, k]) % 2**64 == raw % 2**64
                if abs(raw * codec.layouts[s].scale) < 2**53:
                    assert same(values[s, k], float(expected[name])), name
                else:
                    assert values[s, k] == pytest.approx(float(expected[name]), rel=1e-15)
            else:
                assert same(values[s, k], float(expected[name])), name


@given(data=st.data(), message=any_message())
@PROPERTY
def test_encode_equals_cantools_inside_the_range(data: DataObject, message: RandomMessage) -> None:
    reference, codec = theirs_and_ours(message)
    draws = []
    for layout in codec.layouts:
        if layout.kind == "float":
            value = data.draw(st.floats(-60000, 60000, width=16)) * layout.scale + layout.offset
            assume(abs((value - layout.offset) / layout.scale) <= 65504.0)
        else:
            low = -(2 ** (layout.length - 1)) if layout.kind == "signed" else 0
            bits = min(layout.length, 53)  # beyond that a double cannot name every raw value
            high = low + 2**bits - 1 if layout.length == bits else 2**52
            raw = data.draw(st.integers(max(low, -(2**52)), high))
            # cantools cuts a multiplexer's value off to select and rounds it to write; we round for both
            selects = layout.name in {other.multiplexer for other in codec.layouts}
            fraction = 0.0 if selects else data.draw(st.sampled_from((0.0, 0.0, 0.25, -0.25, 0.5)))
            value = (raw + fraction) * layout.scale + layout.offset
            nearest = round((value - layout.offset) / layout.scale)
            assume(low <= nearest <= low + 2**layout.length - 1)
        draws.append(value)
    values = dict(zip(codec.signals, draws, strict=True))
    try:
        expected = reference.encode(values, strict=False)
    except cantools.database.EncodeError:
        assume(False)
    raw_frames = codec.encode({name: np.array([v, v]) for name, v in values.items()})
    assert payloads_of(raw_frames, message.length) == [expected, expected]
    assert not raw_frames[:, 8 + message.length:].any()
    assert (raw_frames[:, 4] == message.length).all()


@given(data=st.data(), message=messages())
@PROPERTY
def test_truncated_frames_lose_only_what_is_cut_off(data: DataObject, message: RandomMessage) -> None:
    reference, codec = theirs_and_ours(message)
    payload = data.draw(st.binary(min_size=message.length, max_size=message.length))
    cut = data.draw(st.integers(0, message.length))
    expected = reference.decode(payload[:cut], decode_choices=False, allow_truncated=True)
    values = codec.decode(frames([payload, payload[:cut]]).words)[:, 1]
    for s, name in enumerate(codec.signals):
        assert math.isnan(values[s]) if name not in expected else (
            values[s] == pytest.approx(float(expected[name]), rel=1e-15, nan_ok=True)), name


@given(data=st.data(), message=any_message())
@settings(max_examples=25, deadline=None, derandomize=True)
def test_a_block_equals_its_rows_one_by_one(data: DataObject, message: RandomMessage) -> None:
    _, codec = theirs_and_ours(message)
    n = data.draw(st.sampled_from((1, 2, 255, 256, 257, 700)))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    block = FrameBlock.zeros(n)
    block.data[:, :message.length] = rng.integers(0, 256, (n, message.length))
    block.length[:] = message.length
    whole = codec.decode(block.words)
    picks = rng.permutation(n)[:5]
    for k in picks:
        one = codec.decode(block.words[k:k + 1])
        assert one.tobytes() == np.ascontiguousarray(whole[:, k:k + 1]).tobytes()
    rows = np.array(rng.permutation(n), np.intp)
    assert codec.decode_rows(block.words, rows).tobytes() == np.ascontiguousarray(whole[:, rows]).tobytes()
    assert (codec.decode_raw(block.words, rows) == codec.decode_raw(block.words)[:, rows]).all()
    encoded = codec.encode(whole)
    for k in picks:
        assert (codec.encode(np.ascontiguousarray(whole[:, k:k + 1])) == encoded[k]).all()


def test_bits_by_hand() -> None:
    codec = MessageCodec("M", 0x42, 16, [
        SignalLayout("intel", 60, 9),  # crosses the word: 4 bits of byte 7, 5 bits of byte 8
        SignalLayout("motorola", 0x4B, 12, motorola=True, kind="signed"),  # byte 9 bit 3 down, then byte 10
        SignalLayout("crossing", 50, 5, motorola=True),  # byte 6 bits 2..0, then the top of byte 7
    ])
    payload = bytearray(16)
    payload[7] = 0xA0  # intel: low nibble 0xA
    payload[8] = 0x15  # intel: 0x15 above it: 0x15A
    payload[9] = 0x08  # motorola: 1000
    payload[10] = 0x01  # motorola: 00000001 -> 0x801 -> -2047
    payload[6] = 0x05  # crossing: 101
    payload[7] |= 0x00  # crossing: top two bits of byte 7 are also intel's: read as 10
    values = codec.decode(frames([bytes(payload)]).words)[:, 0]
    assert values.tolist() == [0x15A, -2047, 0b10110]


def test_motorola_across_the_word_by_hand() -> None:
    # byte 7 bit 1 down to byte 10 bit 6
    codec = MessageCodec("M", 1, 12, [SignalLayout("x", 57, 20, motorola=True)])
    raw = codec.encode({"x": 0b10_00000001_11111111_01})
    assert raw[0, 8:20].tolist() == [0] * 7 + [0b10, 1, 0xFF, 0b01000000, 0]
    assert codec.decode(raw.view(np.uint64))[0, 0] == 0b10_00000001_11111111_01


@pytest.mark.parametrize("motorola", [False, True])
def test_every_place_in_two_words(motorola: bool) -> None:
    order: Literal["big", "little"] = "big" if motorola else "little"
    pattern = np.random.default_rng(9).integers(0, 256, 16, np.uint8)
    block = frames([bytes(pattern), bytes(~pattern)])  # so that every bit is seen as 0 and as 1
    wholes = [int.from_bytes(p, order) for p in (bytes(pattern), bytes(~pattern))]
    for length in (1, 2, 7, 8, 9, 16, 31, 33, 63, 64):
        for first in range(128 - length + 1):
            down = 128 - first - length if motorola else first  # how far the value stands above the last bit
            expected = [(whole >> down) & ((1 << length) - 1) for whole in wholes]
            start = first ^ 7 if motorola else first
            codec = MessageCodec("M", 1, 16, [SignalLayout("x", start, length, motorola=motorola)])
            assert [int(x) % 2**64 for x in codec.decode_raw(block.words)[0]] == expected, (first, length)
            values = [x >> max(length - 53, 0) << max(length - 53, 0) for x in expected]  # exact as doubles
            for row, value in zip(codec.encode({"x": np.array(values, float)}), values, strict=True):
                assert int.from_bytes(bytes(row[8:24]), order) == value << down, (first, length)


def test_unsigned_64_bits_above_the_signed_half() -> None:
    codec = coder(64)
    for value in (2**63, 2**63 + 2**20, 2**64 - 2**12):
        assert encoded_raw(codec, float(value)) % 2**64 == value


def coder(length: int, kind: Any = "unsigned", **more: Any) -> MessageCodec:
    return MessageCodec("M", 1, 8, [SignalLayout("x", 3 if length < 60 else 0, length, kind=kind, **more)])


def encoded_raw(codec: MessageCodec, value: float) -> int:
    return int(codec.decode_raw(codec.encode({"x": value}).view(np.uint64))[0, 0])


@pytest.mark.parametrize(("length", "kind", "low", "high"), [
    (1, "unsigned", 0, 1), (1, "signed", -1, 0), (12, "unsigned", 0, 4095), (15, "signed", -16384, 16383),
    (53, "unsigned", 0, 2**53 - 1), (64, "signed", -(2**63), 2**63 - 1), (64, "unsigned", 0, -1),
])
def test_saturation_at_the_raw_type(length: int, kind: str, low: int, high: int) -> None:
    codec = coder(length, kind)
    for value in (1e300, math.inf, 2.0**64, 2.0**65):
        assert encoded_raw(codec, value) == high
    for value in (-1e300, -math.inf, -(2.0**64)):
        assert encoded_raw(codec, value) == low


def test_saturation_does_not_touch_neighbours() -> None:
    codec = MessageCodec("M", 1, 8, [SignalLayout("a", 0, 5), SignalLayout("b", 5, 7, kind="signed"),
                                     SignalLayout("c", 12, 3)])
    raw = codec.encode({"b": np.array([1e9, -1e9])})
    assert codec.decode(raw.view(np.uint64)).tolist() == [[0, 0], [63, -64], [0, 0]]


def test_limits_of_the_dbc_hold_but_named_values_pass() -> None:
    codec = coder(8, scale=0.5, minimum=10.0, maximum=100.0, choices={255: "unknown"})
    assert encoded_raw(codec, 101.0) == 200
    assert encoded_raw(codec, 3.0) == 20
    assert encoded_raw(codec, 127.5) == 255
    assert encoded_raw(codec, 127.0) == 200
    negative = coder(8, "signed", scale=-2.0, minimum=-20.0, maximum=50.0)
    assert encoded_raw(negative, 1000.0) == -25
    assert encoded_raw(negative, -1000.0) == 10


@pytest.mark.parametrize(("value", "raw"),
                         [(0.5, 0), (1.5, 2), (2.5, 2), (2.5000001, 3), (-0.5, 0), (-1.5, -2)])
def test_ties_go_to_even(value: float, raw: int) -> None:
    assert encoded_raw(coder(10, "signed"), value) == raw
    assert raw == round(value)


def test_nan_is_raw_zero_in_integers_and_nan_in_floats() -> None:
    assert encoded_raw(coder(8, offset=-40.0), math.nan) == 0
    for bits in (16, 32, 64):
        codec = coder(bits, "float")
        assert math.isnan(codec.decode(codec.encode({"x": math.nan}).view(np.uint64))[0, 0])


@pytest.mark.parametrize(("bits", "code"), [(16, "<e"), (32, "<f"), (64, "<d")])
def test_floats_equal_struct(bits: int, code: str) -> None:
    codec = MessageCodec("M", 1, 8, [SignalLayout("x", 0, bits, kind="float")])
    rng = np.random.default_rng(5)
    values = np.concatenate([rng.normal(0, 10.0 ** rng.integers(-9, 4), 200) for _ in range(20)])
    values = np.concatenate([values, [0.0, -0.0, math.inf, -math.inf, 2.0**-24, 2.0**-25, 1.0 + 2.0**-11,
                                      65504.0, 6.1e-5, 2.0**-14 - 2.0**-26]])
    values = values[(abs(values) <= 65504.0) | np.isinf(values)]
    raw = codec.encode(values[None, :])
    for payload, value in zip(payloads_of(raw, bits // 8), values, strict=True):
        assert payload == struct.pack(code, value), value
    back = codec.decode(raw.view(np.uint64))[0]
    for got, value in zip(back, values, strict=True):
        assert got == struct.unpack(code, struct.pack(code, value))[0]


@pytest.mark.parametrize(("bits", "largest"), [(16, 65504.0), (32, float(np.finfo(np.float32).max))])
def test_a_finite_float_never_becomes_infinite(bits: int, largest: float) -> None:
    codec = coder(bits, "float")
    back = codec.decode(codec.encode({"x": np.array([1e300, -1e300])}).view(np.uint64))
    assert back.tolist() == [[largest, -largest]]


def test_every_half_float_decodes_as_numpy() -> None:
    codec = MessageCodec("M", 1, 2, [SignalLayout("x", 0, 16, kind="float")])
    patterns = np.arange(65536, dtype=np.uint16)
    block = FrameBlock.zeros(65536)
    block.length[:] = 2
    block.data[:, :2] = patterns.view(np.uint8).reshape(-1, 2)
    np.testing.assert_array_equal(codec.decode(block.words)[0], patterns.view(np.float16).astype(np.float64))


def test_header_of_encoded_frames() -> None:
    signal = [SignalLayout("x", 0, 8)]
    classical = FrameBlock(MessageCodec("M", 0x7FF, 8, signal).encode({"x": 1}), np.zeros(1, np.int64))
    assert (classical.can_id[0], classical.length[0], classical.flags[0]) == (0x7FF, 8, 0)
    fd = FrameBlock(MessageCodec("M", 0x1ABCDEF, 64, signal, is_extended=True).encode({"x": 1}),
                    np.zeros(1, np.int64))
    assert (fd.can_id[0], fd.length[0], fd.flags[0]) == (0x1ABCDEF | CAN_EFF_FLAG, 64, CANFD_FDF | CANFD_BRS)
    slow = MessageCodec("M", 1, 64, signal, bit_rate_switch=False).encode({"x": 1})
    assert slow[0, 5] == CANFD_FDF


def test_a_signal_that_is_not_selected_is_not_written() -> None:
    layouts = [SignalLayout("mux", 0, 8),
               SignalLayout("a", 8, 8, multiplexer="mux", multiplexer_ids=(1,)),
               SignalLayout("b", 8, 16, multiplexer="mux", multiplexer_ids=(2, 3, 7))]
    codec = MessageCodec("M", 1, 8, layouts)
    raw = codec.encode({"mux": np.array([1, 2, 7, 9]), "a": 0x11, "b": 0x2233})
    assert [p[:3].hex() for p in payloads_of(raw, 8)] == ["011100", "023322", "073322", "090000"]
    reversed_order = MessageCodec("M", 1, 8, layouts[::-1])
    assert (reversed_order.encode({"mux": np.array([1, 2, 7, 9]), "a": 0x11, "b": 0x2233}) == raw).all()


def test_a_truncated_multiplexer_hides_what_it_selects() -> None:
    codec = MessageCodec("M", 1, 8, [SignalLayout("mux", 56, 8),
                                     SignalLayout("a", 0, 8, multiplexer="mux", multiplexer_ids=(0,))])
    values = codec.decode(frames([bytes([5] * 7 + [0]), bytes([5] * 7)]).words)
    assert values[codec.index["a"]].tolist()[0] == 5.0
    assert math.isnan(values[codec.index["a"], 1])


def test_read_only_and_strided_input() -> None:
    codec = coder(12)
    raw = codec.encode({"x": np.arange(10.0)})
    words = raw.view(np.uint64)
    frozen = words.copy()
    frozen.setflags(write=False)
    assert (codec.decode(frozen) == codec.decode(words)).all()
    assert codec.decode(words[::3])[0].tolist() == [0, 3, 6, 9]
    assert codec.decode(words[:0]).shape == (1, 0)
    assert codec.encode(np.zeros((1, 0))).shape == (0, 72)


@pytest.mark.parametrize(("values", "text"), [
    ({"y": 1.0}, "message M has no signal 'y'; it has x"),
    ({"x": np.zeros((2, 2))}, "allowed are scalars and equal lengths"),
    (np.zeros((3, 4)), r"have shape \(3, 4\); allowed is \(1, N\)"),
])
def test_bad_values_are_named(values: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        coder(8).encode(values)


@pytest.mark.parametrize(("layout", "text"), [
    (SignalLayout("x", 60, 8), "ends at bit 68; the message ends at bit 64"),
    (SignalLayout("x", 0, 65), "65 bits; allowed is 1 to 64"),
    (SignalLayout("x", 0, 24, kind="float"), "24 bits; allowed is 16, 32 or 64"),
    (SignalLayout("x", 0, 8, multiplexer="m", multiplexer_ids=(1,)),
     "selected by 'm'; the message has no such"),
    (SignalLayout("x", 0, 8, multiplexer="x", multiplexer_ids=(1,)), "select each other in a circle"),
])
def test_bad_layouts_are_named(layout: SignalLayout, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        MessageCodec("M", 1, 8, [layout])
