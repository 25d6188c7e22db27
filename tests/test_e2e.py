"""End-to-end protection against cantools, the published vectors and a bitwise CRC; the sequence check."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from cantools.autosar import end_to_end
from hypothesis import given, settings
from hypothesis import strategies as st

from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.e2e import E2EProtection, E2EStatus, SequenceChecker

PROPERTY = settings(max_examples=200, deadline=None, derandomize=True)


def block_of(payload: bytes, n: int = 1) -> FrameBlock:
    block = FrameBlock.zeros(n)
    block.length[:] = len(payload)
    block.data[:, :len(payload)] = np.frombuffer(payload, np.uint8)
    return block


def counters(*values: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.array(values, np.int64)


def test_known_vectors() -> None:
    block = block_of(bytes(8), 3)
    E2EProtection.p02(8, bytes(range(1, 17))).protect(block.raw, counters(1, 2, 3))
    assert [bytes(d[:2]).hex() for d in block.data] == ["1b01", "9802", "3103"]
    block = block_of(bytes(8), 2)
    E2EProtection.p05(8, 0x1234).protect(block.raw, counters(0, 1))
    assert [bytes(d[:3]).hex() for d in block.data] == ["1cca00", "cf8d01"]


def bitwise_crc(data: bytes, width: int, polynomial: int, start: int) -> int:
    crc, top = start, 1 << width - 1
    for byte in data:
        for bit in range(7, -1, -1):
            feedback = bool(crc & top) != bool(byte >> bit & 1)
            crc = (crc << 1 & (1 << width) - 1) ^ (polynomial if feedback else 0)
    return crc


@given(payload=st.binary(min_size=2, max_size=64), ids=st.binary(min_size=16, max_size=16),
       counter=st.integers(0, 1000))
@PROPERTY
def test_profile_2_both_directions(payload: bytes, ids: bytes, counter: int) -> None:
    protection = E2EProtection.p02(len(payload), ids)
    block = block_of(payload)
    protection.protect(block.raw, counters(counter))
    sent = bytes(block.data[0, :len(payload)])
    assert sent[1] == payload[1] & 0xF0 | counter % 16
    assert sent[2:] == payload[2:]
    assert sent[0] == bitwise_crc(sent[1:] + ids[counter % 16:][:1], 8, 0x2F, 0xFF) ^ 0xFF
    assert end_to_end.check_profile2_crc(sent, ids[counter % 16])

    theirs = end_to_end.apply_profile2_crc(payload, ids[payload[1] & 0xF])
    assert theirs is not None
    intact, found = protection.check(block_of(bytes(theirs)).raw)
    assert intact.all() and found[0] == payload[1] & 0xF


@given(payload=st.binary(min_size=4, max_size=64), data_id=st.integers(0, 0xFFFF),
       counter=st.integers(0, 1000))
@PROPERTY
def test_profile_5_both_directions(payload: bytes, data_id: int, counter: int) -> None:
    protection = E2EProtection.p05(len(payload), data_id)
    block = block_of(payload)
    protection.protect(block.raw, counters(counter))
    sent = bytes(block.data[0, :len(payload)])
    assert sent[2] == counter % 256 and sent[3:] == payload[3:]
    assert int.from_bytes(sent[:2], "little") == bitwise_crc(
        sent[2:] + data_id.to_bytes(2, "little"), 16, 0x1021, 0xFFFF)
    assert end_to_end.check_profile5_crc(sent, data_id)

    theirs = end_to_end.apply_profile5_crc(payload, data_id)
    assert theirs is not None
    intact, found = protection.check(block_of(bytes(theirs)).raw)
    assert intact.all() and found[0] == payload[2]


@pytest.mark.parametrize("protection", [E2EProtection.p02(8, bytes(range(40, 56))),
                                        E2EProtection.p05(64, 0x1D20)])
def test_every_flipped_bit_and_a_wrong_length_are_found(protection: E2EProtection) -> None:
    n = protection.length
    block = block_of(bytes(range(n)), 8 * n + 2)
    protection.protect(block.raw, np.full(8 * n + 2, 7, np.int64))
    for bit in range(8 * n):
        block.data[bit, bit // 8] ^= 1 << bit % 8
    block.length[8 * n] = n - 1
    intact, _ = protection.check(block.raw)
    assert intact.tolist() == [False] * (8 * n + 1) + [True]
    assert protection.check(block.raw, np.array([8 * n + 1, 0]))[0].tolist() == [True, False]


def test_a_frame_of_another_node_fails() -> None:
    profiles: list[tuple[dict[str, int | float | str], int]] = [
        ({"E2EProfile": "P02", "E2EDataIDList": " ".join(["F8"] * 16)}, 8),
        ({"E2EProfile": "P05", "E2EDataID": 0x1D20}, 64)]
    for attributes, length in profiles:
        nodes = [E2EProtection.from_attributes(attributes, length, node) for node in range(16)]
        for sender in nodes:
            assert sender is not None
            block = block_of(bytes(length))
            sender.protect(block.raw, counters(3))
            verdicts = [bool(receiver.check(block.raw)[0][0]) for receiver in nodes if receiver is not None]
            assert verdicts == [receiver is sender for receiver in nodes]


def test_node_is_added_to_the_identifiers() -> None:
    listed = {"E2EProfile": "P02", "E2EDataIDList": "FF 00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E"}
    protection = E2EProtection.from_attributes(listed, 8, 5)
    assert protection is not None and protection.data_ids.tolist() == [4, *range(5, 20)]
    protection = E2EProtection.from_attributes({"E2EProfile": "P05", "E2EDataID": 100}, 64, 5)
    assert protection is not None and protection.data_id == 105
    assert E2EProtection.from_attributes({}, 8) is None


@pytest.mark.parametrize(("attributes", "text"), [
    ({"E2EProfile": "P01"}, "E2EProfile is 'P01'; allowed are P02 and P05"),
    ({"E2EProfile": "P02", "E2EDataIDList": "01 02"}, "E2EDataIDList has 2 bytes; profile P02 needs 16"),
    ({"E2EProfile": "P02", "E2EDataIDList": "zz"}, "E2EDataIDList is 'zz'; allowed are 16 bytes in hex"),
    ({"E2EProfile": "P05"}, "E2EDataID is -1; allowed is 0 to 65535"),
])
def test_bad_attributes_are_named(attributes: dict[str, int | float | str], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        E2EProtection.from_attributes(attributes, 8)


def verdicts(modulus: int, max_delta: int, sent: list[int | None]) -> list[E2EStatus]:
    """None is a frame with a wrong CRC."""
    checker = SequenceChecker(modulus, max_delta)
    intact = np.array([c is not None for c in sent])
    status = checker.update(intact, counters(*(c or 0 for c in sent)))
    return [E2EStatus(int(s)) for s in status]


OK, LOST, AGAIN, WRONG, BAD = E2EStatus


def test_sequence_verdicts() -> None:
    assert verdicts(16, 3, [9, 10, 11]) == [OK, OK, OK]
    assert verdicts(16, 3, [14, 15, 0, 1]) == [OK, OK, OK, OK]
    assert verdicts(16, 3, [0, 0, 1]) == [OK, AGAIN, OK]
    assert verdicts(16, 3, [14, 1, 2]) == [OK, LOST, OK]
    assert verdicts(16, 3, [14, 2, 3]) == [OK, WRONG, OK]
    assert verdicts(16, 3, [5, 4, 5]) == [OK, WRONG, OK]
    assert verdicts(16, 3, [None, 5, None, 7]) == [BAD, OK, BAD, LOST]
    assert verdicts(16, 1, [5, 7]) == [OK, WRONG]
    assert verdicts(256, 2, [254, 0, 2, 5]) == [OK, LOST, LOST, WRONG]


def test_lost_frames_are_counted_and_blocks_may_be_cut_anywhere() -> None:
    rng = np.random.default_rng(3)
    sent = np.cumsum(rng.integers(0, 5, 300)) % 16
    intact = rng.random(300) > 0.1
    whole = SequenceChecker(16, 3)
    status = whole.update(intact, sent)
    pieces = SequenceChecker(16, 3)
    cuts = [0, 1, 2, 50, 51, 299, 300]
    parts = [pieces.update(intact[a:b], sent[a:b]) for a, b in itertools.pairwise(cuts)]
    assert np.concatenate(parts).tolist() == status.tolist()
    assert pieces.lost == whole.lost > 0
    good = sent[intact]
    steps = (good[1:] - good[:-1]) % 16
    assert whole.lost == (steps[(steps >= 2) & (steps <= 3)] - 1).sum()


@pytest.mark.parametrize("max_delta", [0, 16])
def test_max_delta_is_checked(max_delta: int) -> None:
    with pytest.raises(ValueError, match="allowed is 1 to 15"):
        SequenceChecker(16, max_delta)
