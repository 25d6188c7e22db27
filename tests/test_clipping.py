"""Samples cut off at the end of their range: found on the wire, and never the ground of a valid angle."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import clipping, confidence
from ipmsm_can.estimation.observers.kinds import GES
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.dbc import Database, default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol
from ipmsm_can.wire.receive import AXES, SampleReceiver
from ipmsm_can.wire.sequence_kernel import CLIPPED

PROTOCOL = Protocol()
RATE = 5000.0
ALL = confidence.LOCKED | confidence.POLARITY_KNOWN | confidence.VALID
WITHOUT = ALL ^ confidence.VALID | confidence.WITHHELD


def database(axes: str, ends: str, kind: str = "1-") -> Protocol:
    """Ours, with another range (and kind, 1- or 1+) for an axis, or more with | between, in all samples."""
    signal = rf"( SG_ (?:{axes})(?:_\d)? : \d+\|\d+@)1-( \([^)]*\)) \[[^]]*\]"
    text, n = re.subn(signal, rf"\g<1>{kind}\g<2> [{ends}]", default_dbc_path().read_text(encoding="utf-8"))
    assert n == 8 * len(axes.split("|"))
    return Protocol(Database.loads(text))


def marks(protocol: Protocol, values: dict[str, NDArray[np.float64]], fd: bool) -> list[int]:
    """Which of these samples are marked as cut off; the counter of cut off ones agrees."""
    n = next(iter(values.values())).size
    if fd:
        kind = MessageKind.DRIVE_SAMPLE_BLOCK
        raw = protocol.encode(kind, 0, {**{f"{axis}_{j}": 1.0 for axis in AXES for j in range(7)},
                                        **{f"{axis}_2": v for axis, v in values.items()},
                                        "first_sample": 7.0 * np.arange(n), "sample_count": np.full(n, 3.0)},
                              np.arange(n))
    else:
        kind = MessageKind.DRIVE_SAMPLE
        raw = protocol.encode(kind, 0, {**values, "sample_counter": np.arange(n) & 15})
    receiver = SampleReceiver(protocol, 0, 8, RATE)
    rows = [np.arange(n) if kind == k else np.zeros(0, np.intp) for k in (
        MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_TIMING, MessageKind.DRIVE_SAMPLE_BLOCK)]
    (run,) = receiver.push(FrameBlock(raw, np.arange(n) * 200_000), *rows)
    marked = run.counter[(run.filled == 0) & (run.doubt & CLIPPED != 0)]
    assert receiver.sequencer.count("clipped") == marked.size
    assert not fd or (marked % 7 == 2).all()
    return [int(c) // (7 if fd else 1) for c in marked]


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("axis", AXES)
def test_the_ends_of_a_range(axis: str, fd: bool) -> None:
    step = 0.005 if axis[0] == "i" else 0.025
    bits = 16 if fd else 15
    # beyond both ends, at them, one step inside (a sender that limits to +-max), two steps inside, zero, half way
    raw = np.array([1e6, -1e6, 2**(bits - 1) - 1, -2**(bits - 1), -2**(bits - 1) + 1, 2**(bits - 1) - 3,
                    -2**(bits - 1) + 2, 0, 2**(bits - 2)])
    assert marks(PROTOCOL, {axis: raw * step}, fd) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("fd", [False, True])
def test_a_range_that_the_database_narrows(fd: bool) -> None:
    """The sender may stop at the declared range, or at what the bits hold; between the two is no end."""
    narrow = database("v_beta", "-60|60")
    assert marks(narrow, {"v_beta": np.array([100.0, -100.0, 60.0, 59.9, -59.9, 0.0])}, fd) == [0, 1, 2]
    none = database("v_beta", "0|0")  # the way of many files to say nothing
    assert marks(none, {"v_beta": np.array([1e6, 60.0, 0.0])}, fd) == [0]
    unsigned = database("i_alpha", "0|0", "1+")
    assert marks(unsigned, {"i_alpha": np.array([0.0, 0.005, 0.01, 1e6, 81.92])}, fd) == [0, 1, 3]


def test_a_filled_sample_that_leads_to_one_is_marked() -> None:
    raw = PROTOCOL.encode(MessageKind.DRIVE_SAMPLE, 0, {"i_alpha": np.array([0.0, 1e6, 0.0]),
                                                        "sample_counter": np.array([0, 3, 5])})
    none = np.zeros(0, np.intp)
    (run,) = SampleReceiver(PROTOCOL, 0, 8, RATE).push(
        FrameBlock(raw, np.array([0, 3, 5]) * 200_000), np.arange(3), none, none)
    assert (run.doubt & CLIPPED != 0).tolist() == [False, True, True, True, False, False]


def follow(protocol: Protocol, frames: FrameBlock, alpha: float = 20.0, edges: tuple[int, ...] = (),
           kind: str = "ges") -> tuple[Companion, list[Tracked]]:
    config = config_from({"motor": {"preset": "m2"}, "observer": {"kind": kind, "alpha": alpha}})
    companion = Companion([config], protocol, False)
    parts: list[Tracked] = []
    for a, b in pairwise([0, *edges, len(frames)]):
        parts += companion.feed(frames.take(slice(a, b)))
    return companion, parts


def flags_of(tracked: list[Tracked]) -> NDArray[np.uint8]:
    return np.concatenate([t.estimate.flags for t in tracked])


def error_of(tracked: list[Tracked], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    found = np.concatenate([t.estimate.angle[0] for t in tracked])
    return np.abs(np.degrees((found - theta[:found.size] + np.pi) % (2 * np.pi) - np.pi))


def overdriven(fd: bool, v_max: float = 76.0) -> tuple[Protocol, FrameBlock, NDArray[np.float64]]:
    """300, 1000, 300 rpm with voltages that at 1000 rpm are cut off, at 40 % of their peak."""
    protocol = database("v_alpha|v_beta", f"-{v_max}|{v_max}")
    speed = ((0.0, 300 * RPM), (1.0, 300 * RPM), (1.2, 1000 * RPM), (1.6, 1000 * RPM), (1.8, 300 * RPM))
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, current_noise=0.02),
                                 Profile(speed, ((0.0, 1.0),), 3.2))
    step = DriveNode(protocol, 0, simulation, DriveNodeSettings(fd=fd)).step(int(3.2 * RATE))
    return protocol, step.frames, step.samples.theta_e


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize(("kind", "alpha"), [("ges", 5.0), ("ges", 20.0), ("riccati", 100.0), ("riccati", 20.0)])
def test_an_angle_built_on_cut_off_voltages_is_never_valid(fd: bool, kind: str, alpha: float) -> None:
    protocol, frames, theta = overdriven(fd)
    companion, tracked = follow(protocol, frames, alpha, kind=kind)
    flags = flags_of(tracked)
    clipped = np.concatenate([t.run.doubt for t in tracked]) & CLIPPED != 0
    error = error_of(tracked, theta)
    valid = flags & confidence.VALID != 0
    first, last = np.flatnonzero(clipped)[[0, -1]]
    assert RATE < first < last < 1.8 * RATE and clipped.sum() > 500
    assert valid[first - 100:first].all()
    assert not valid[first:last + int(5.0 / alpha * RATE)].any()
    assert error[first:last].max() > 5.0  # else nothing was at stake
    assert error[valid & (np.arange(error.size) > last)].max() < 1.0
    assert valid[-1] and not companion.nodes[0].distrusting
    assert companion.nodes[0].receiver.sequencer.count("clipped") == clipped.sum()


def test_at_low_speed_the_filters_forget_before_the_observer_does() -> None:
    """One wild current at 20 rpm: the filters forget in 0.25 s, the observer needs three times as long."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE), constant(20.0 * RPM, 1.0, 4.0))
    step = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings()).step(int(4.0 * RATE))
    frames = step.frames
    at = np.flatnonzero(frames.can_id == 0x100)[10_000]
    frames.raw[at, 8:10] = 0xFF, 0x3F  # i_alpha: the largest of 15 bits
    _, tracked = follow(PROTOCOL, frames)
    valid = flags_of(tracked) & confidence.VALID != 0
    back = 10_000 + int(np.argmax(valid[10_000:]))
    assert valid[9_999] and valid[back:].all()
    assert 0.6 < (back - 10_000) / RATE < 1.5
    assert error_of(tracked, step.samples.theta_e)[back:].max() < 1.0


def test_blocks_change_nothing() -> None:
    protocol, frames, _ = overdriven(fd=False)
    frames = frames.take(np.flatnonzero(np.random.default_rng(1).random(len(frames)) > 0.02))
    whole = flags_of(follow(protocol, frames)[1])
    cuts = np.unique(np.random.default_rng(2).integers(1, len(frames), 400))
    parts = flags_of(follow(protocol, frames, edges=tuple(cuts.tolist()))[1])
    assert np.array_equal(whole, parts)


@pytest.mark.parametrize("gain", [0, 20, 50, 300])
def test_the_hold_by_hand(gain: int) -> None:
    """Against the definition, worked out for each sample from its past; in blocks of any size."""
    n = 600
    rng = np.random.default_rng(gain)
    cut_off = rng.random(n) < 0.05
    cuts = rng.integers(1, n, 40).tolist()
    alpha, T_s = 50.0, 0.01
    regression, flux, angle = rng.normal(size=(7, n)), np.full((6, n), gain * 1e-3), rng.normal(100, 1, (3, n))
    clipped = cut_off.astype(np.uint8)
    expected = np.full(n, ALL, np.uint8)
    for k in range(n):
        past = np.flatnonzero(clipped[:k + 1])
        if past.size:
            since = range(past[-1] + 1, k + 1)
            rates = [flux[5, j] * (regression[1, j]**2 + regression[2, j]**2) / T_s for j in since]
            slower = [min(r / 2, angle[2, j]**2 / r) if r > 0 else 0.0 for j, r in zip(since, rates, strict=True)]
            contracted = T_s * sum(slower)
            margin = min(alpha * T_s * len(since) - 5.0, contracted - 3.0)
            if margin < -1e-9:
                expected[k] = WITHOUT
    found = np.full(n, ALL, np.uint8)
    state = clipping.new_state()
    for a, b in pairwise([0, *sorted(set(cuts)), n]):
        clipping.hold_block(clipped[a:b], np.ascontiguousarray(regression[:, a:b]),
                            np.ascontiguousarray(flux[:, a:b]), np.ascontiguousarray(angle[:, a:b]), alpha, T_s,
                            GES, state, found[a:b])
    # once over, it is over until the next one
    for k in range(1, n):
        if not clipped[k] and expected[k - 1] == ALL:
            expected[k] = ALL
    assert np.array_equal(found, expected)
    assert (found == WITHOUT).any() and (gain < 50 or (found[np.argmax(cut_off):] == ALL).any())
