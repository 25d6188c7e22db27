"""What a log holds of a drive, against the simulation that made it."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder, read_measurement
from ipmsm_can.config import config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import write_log
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import MessageKind, Protocol

T0 = 1_700_000_000_000_000_000
RATE = 5000.0
CONFIG = config_from({"motor": {"preset": "m2"}})


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return Protocol()


def drive(protocol: Protocol, seconds: float = 1.0, fd: bool = False,
          reference_rate: float = 500.0) -> tuple[FrameBlock, DriveSamples]:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE), profile.torque_pulses(), seed=3)
    step = DriveNode(protocol, 0, simulation, DriveNodeSettings(fd=fd, reference_rate=reference_rate)).step(
        int(seconds * RATE), T0)
    return step.frames, step.samples


def build(frames: FrameBlock, protocol: Protocol, cuts: tuple[int, ...] = ()) -> Measurement:
    builder = MeasurementBuilder(CONFIG, protocol)
    for a, b in pairwise([0, *cuts, len(frames)]):
        builder.feed(frames.take(slice(a, b)))
    builder.finish()
    return builder.measurement()


@pytest.mark.parametrize("fd", [False, True])
def test_samples_encoder_and_state_are_those_of_the_drive(protocol: Protocol, fd: bool) -> None:
    frames, truth = drive(protocol, fd=fd)
    m = build(frames, protocol)
    assert m.sample_rate == RATE
    assert m.usable.all() and m.running.all() and not m.injecting.any()
    assert np.array_equal(np.diff(m.sample), np.ones(len(m) - 1))
    assert len(m) >= len(truth) - 7
    at = m.sample - truth.sample[0]
    for name, step in (("i_alpha", 0.005), ("i_beta", 0.005), ("v_alpha", 0.025), ("v_beta", 0.025)):
        assert np.abs(getattr(m, name) - getattr(truth, name)[at]).max() <= 0.51 * step
    at = m.encoder_sample - truth.sample[0]
    assert m.encoder_sample.size >= 499
    error = np.angle(np.exp(1j * (m.encoder_theta - truth.theta_e[at])))
    assert np.abs(error).max() < 1e-3
    assert np.abs(m.encoder_omega - truth.omega_e[at]).max() <= 0.1251
    assert m.status_v_dc == pytest.approx(540.0)
    assert m.duration == pytest.approx((len(m) - 1) / RATE)


def test_blocks_make_no_difference(protocol: Protocol) -> None:
    frames, _ = drive(protocol)
    whole, cut = build(frames, protocol), build(frames, protocol, (1, 17, 1000, 1001, 4000))
    for name in ("sample", "time", "i_alpha", "v_beta", "usable", "encoder_sample", "encoder_theta",
                 "status_sample", "running"):
        assert np.array_equal(getattr(whole, name), getattr(cut, name)), name


def test_lost_samples_are_not_usable_and_the_encoder_keeps_its_samples(protocol: Protocol) -> None:
    frames, truth = drive(protocol)
    labels = protocol.classify(frames.raw)
    singles = np.flatnonzero(labels == MessageKind.DRIVE_SAMPLE * 16)
    keep = np.ones(len(frames), np.bool_)
    keep[singles[[700, 701]]] = False          # filled
    keep[singles[2000:2100]] = False           # a gap of several wraps of the 4-bit counter
    m = build(frames.take(keep), protocol)
    assert m.counts["lost"] == 102
    missing = np.setdiff1d(truth.sample, m.sample[m.usable])
    assert set(missing) >= {700, 701, *range(2000, 2100)} and missing.size < 300
    good = m.usable
    at = m.sample[good]
    assert np.abs(m.i_alpha[good] - truth.i_alpha[at]).max() <= 0.0026
    assert np.abs(np.angle(np.exp(1j * (m.encoder_theta - truth.theta_e[m.encoder_sample])))).max() < 1e-3


def test_a_restarted_drive_goes_on_behind_a_step(protocol: Protocol) -> None:
    frames, _ = drive(protocol, 0.5)
    again = FrameBlock(frames.raw, frames.t_ns + 2_000_000_000)
    m = build(FrameBlock.concat([frames, again]), protocol)
    step = np.diff(m.sample)
    assert (step > 0).all()
    assert step.max() == pytest.approx(1.5 * RATE, rel=0.01)
    late = m.encoder_sample > m.sample[0] + 0.6 * RATE
    assert 200 < np.count_nonzero(late) <= 250
    assert np.array_equal(m.encoder_theta[late], m.encoder_theta[:late.size][~late][-np.count_nonzero(late):])


def test_a_window_keeps_the_last_seconds_in_bounded_memory(protocol: Protocol) -> None:
    frames, truth = drive(protocol, 2.0)
    builder = MeasurementBuilder(CONFIG, protocol, window_s=0.3)
    most = 0
    for a in range(0, len(frames), 100):
        builder.feed(frames.take(slice(a, a + 100)))
        most = max(most, builder.samples)
    assert most < 0.35 * RATE
    m = builder.measurement(0.2)
    assert m.sample[-1] == truth.sample[-1]
    assert len(m) == int(0.2 * RATE) + 1
    assert m.encoder_sample[0] >= m.sample[0]


def test_a_log_and_what_is_wrong_with_it(protocol: Protocol, tmp_path: Path) -> None:
    frames, _ = drive(protocol, 0.4)
    log = tmp_path / "run.blf"
    write_log(log, [frames])
    m = read_measurement(log, CONFIG)
    assert len(m) == 2000 and m.problem == "" and m.source == str(log)
    other = config_from({"motor": {"preset": "m2"}, "wire": {"node": 5}})
    with pytest.raises(ValueError, match=r"holds no sample frame of node 5 \(identifiers 0x105 and 0x125\); seen"):
        read_measurement(log, other)
    with pytest.raises(ValueError, match="--node goes with --map"):
        read_measurement(log, CONFIG, node=1)
