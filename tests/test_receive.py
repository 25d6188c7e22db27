"""From frames to sample runs: order of arrival, CAN FD blocks and their checks, databases of other shapes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.dbc import Database, default_dbc_path
from ipmsm_can.wire.protocol import BLOCK_SAMPLES, MessageKind, Protocol
from ipmsm_can.wire.receive import SampleReceiver
from ipmsm_can.wire.sequence import SampleRun

PROTOCOL = Protocol()
RATE = 10_000.0
AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")


def wave(counter: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values on the wire's own grid that tell their sample."""
    return np.array([0.005 * (counter % 1000), -0.005 * (counter % 777), 0.025 * (counter % 1500),
                     -0.025 * (counter % 31)])


def timing(counter: int, protocol: Protocol = PROTOCOL) -> NDArray[np.uint8]:
    return protocol.encode(MessageKind.DRIVE_TIMING, 0, {"sample_counter": float(counter), "sample_rate": RATE})


def singles(counter: NDArray[np.int64], protocol: Protocol = PROTOCOL) -> NDArray[np.uint8]:
    return protocol.encode(MessageKind.DRIVE_SAMPLE, 0, {
        **dict(zip(AXES, wave(counter), strict=True)), "sample_counter": counter & 15})


def blocks(first: list[int], count: list[int] | None = None, e2e: list[int] | None = None) -> NDArray[np.uint8]:
    n = len(first)
    values = {f"{axis}_{j}": wave(np.array(first, np.int64) + j)[r]
              for j in range(BLOCK_SAMPLES) for r, axis in enumerate(AXES)}
    return PROTOCOL.encode(MessageKind.DRIVE_SAMPLE_BLOCK, 0, {
        **values, "first_sample": np.array(first, float), "sample_count": np.array(count or [7] * n, float)},
        np.array(e2e if e2e is not None else range(n)))


def push(receiver: SampleReceiver, *frames: NDArray[np.uint8], protocol: Protocol = PROTOCOL) -> list[SampleRun]:
    raw = np.concatenate(frames)
    labels = protocol.classify(raw)
    block = FrameBlock(raw, np.arange(raw.shape[0]) * 100_000)
    rows = [np.flatnonzero(labels == kind * 16) for kind in (
        MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_TIMING, MessageKind.DRIVE_SAMPLE_BLOCK)]
    return receiver.push(block, *rows)


def together(runs: list[SampleRun]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return np.concatenate([r.counter for r in runs]), np.concatenate([r.values for r in runs], axis=1)


def receiver(protocol: Protocol = PROTOCOL, max_gap: int = 8) -> SampleReceiver:
    return SampleReceiver(protocol, 0, max_gap, None)


def test_single_samples() -> None:
    counter = np.arange(500, 900)
    got, values = together(push(receiver(), timing(499), singles(counter)))
    assert np.array_equal(got, counter)
    assert np.allclose(values, wave(counter), atol=1e-9)


def test_blocks_of_seven_and_fewer() -> None:
    r = receiver()
    got, values = together(push(r, timing(99), blocks([100, 107, 110, 117], [7, 3, 7, 1])))
    assert got.tolist() == list(range(100, 118))
    assert np.allclose(values, wave(got), atol=1e-9)
    assert r.bad_frames == 0 and r.sequencer.count("lost") == 0


def test_order_of_arrival_is_kept_between_kinds() -> None:
    """A DriveTiming between two samples must be seen between them: here it announces a restart."""
    r = receiver()
    a, b = singles(np.arange(50, 60)), singles(np.arange(5, 15))
    got, values = together(push(r, timing(49), a, timing(4_000_000), b))
    assert got.tolist() == [*range(50, 60), *range(4_000_005, 4_000_015)]
    assert r.sequencer.count("restarts") == 1
    assert np.allclose(values[:, 10:], wave(np.arange(5, 15)), atol=1e-9)


def test_lost_block_is_filled_and_wrong_checksum_is_a_lost_block() -> None:
    r = receiver()
    frames = blocks([0, 7, 14, 21])
    frames[1, 30] ^= 1
    got, _ = together(push(r, timing(0), frames))
    assert got.tolist() == list(range(28))
    assert r.bad_frames == 1
    assert (r.sequencer.count("lost"), r.sequencer.count("filled")) == (7, 7)


def test_repeated_block_counts_as_duplicate_samples_not_as_bad() -> None:
    r = receiver()
    frames = blocks([0, 7])
    push(r, timing(0), frames[:1], frames[:1], frames[1:])
    assert r.sequencer.count("duplicates") == 7
    assert r.bad_frames == 0


@pytest.mark.parametrize("node", [1, 15])
def test_block_of_another_node_under_this_identifier_fails_its_check(node: int) -> None:
    raw = PROTOCOL.encode(MessageKind.DRIVE_SAMPLE_BLOCK, node, {"first_sample": 5.0, "sample_count": 7.0}, 0)
    raw.view(np.uint32)[:, 0] -= np.uint32(node)
    r = receiver()
    assert push(r, timing(0), raw) == []
    assert r.bad_frames == 1


@pytest.mark.parametrize("count", [0, 8, 100, 255])
def test_impossible_sample_count(count: int) -> None:
    raw = blocks([0])
    raw[0, 8 + 7] = count
    protection = PROTOCOL.protection(MessageKind.DRIVE_SAMPLE_BLOCK, 0)
    assert protection is not None
    protection.protect(raw, np.zeros(1, np.int64))
    r = receiver()
    assert push(r, timing(0), raw) == []
    assert r.bad_frames == 1 and r.sequencer.count("received") == 0


def test_the_counter_of_a_block_wraps_inside_it() -> None:
    top = 1 << 32
    got, _ = together(push(receiver(), timing(top - 5), blocks([top - 4])))
    assert got.tolist() == [top - 4, top - 3, top - 2, top - 1, 0, 1, 2]


def test_a_database_with_signals_in_another_order() -> None:
    """The decoder's rows follow the file; samples must not."""
    text = default_dbc_path().read_text(encoding="utf-8")
    for old, new in (("sample_counter : 60|4@", "sample_counter : 0|4@"), ("i_alpha : 0|15@", "i_alpha : 49|15@"),
                     ("i_beta : 15|15@", "i_beta : 34|15@"), ("v_alpha : 30|15@", "v_alpha : 19|15@"),
                     ("v_beta : 45|15@", "v_beta : 4|15@"), ("sample_rate : 32|32@", "sample_rate : 0|32@"),
                     (" SG_ sample_counter : 0|32@1+ (1,0) [0|4294967295] \"\" Companion\n SG_ sample_rate",
                      " SG_ sample_counter : 32|32@1+ (1,0) [0|4294967295] \"\" Companion\n SG_ sample_rate")):
        assert text.count(old) == 1
        text = text.replace(old, new)
    protocol = Protocol(Database.loads(text))
    names = protocol.codecs[MessageKind.DRIVE_SAMPLE].signals
    assert set(names) == set(PROTOCOL.codecs[MessageKind.DRIVE_SAMPLE].signals)
    assert names != PROTOCOL.codecs[MessageKind.DRIVE_SAMPLE].signals
    counter = np.arange(20, 60)
    got, values = together(push(receiver(protocol), timing(19, protocol), singles(counter, protocol),
                                protocol=protocol))
    assert np.array_equal(got, counter)
    assert np.allclose(values, wave(counter), atol=1e-9)


@given(st.lists(st.sampled_from("stb"), min_size=1, max_size=40), st.sets(st.integers(0, 40)))
def test_any_partition_gives_the_same_runs(kinds: list[str], cuts: set[int]) -> None:
    frames, at = [timing(0)], 1
    for k, kind in enumerate(kinds):
        if kind == "s":
            frames.append(singles(np.array([at])))
            at += 1
        elif kind == "t":
            frames.append(timing(at - 1))
        else:
            frames.append(blocks([at], e2e=[k]))
            at += 7
    raw = np.concatenate(frames)
    whole = FrameBlock(raw, np.arange(raw.shape[0]) * 100_000)
    labels = PROTOCOL.classify(raw)

    def run(edges: list[int]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        r, found = receiver(), []
        for a, b in pairwise(edges):
            part = labels[a:b]
            found += r.push(whole.take(slice(a, b)), *(np.flatnonzero(part == kind * 16) for kind in (
                MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_TIMING, MessageKind.DRIVE_SAMPLE_BLOCK)))
        return together(found) if found else (np.zeros(0, np.int64), np.zeros((4, 0)))

    n = raw.shape[0]
    one, two = run([0, n]), run([0, *sorted(c for c in cuts if 0 < c < n), n])
    assert np.array_equal(one[0], two[0]) and np.array_equal(one[1], two[1])
    assert one[0].tolist() == list(range(1, at))
