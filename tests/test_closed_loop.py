"""The loop closed over CAN, through companion and bus: slices of the table of `python -m tools.closed_loop`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.angle_source import AngleState
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol
from tools.closed_loop import RUNNING, START, WAITS, Case, Run, from_rest, run

T = M2.rated_torque
STEP = Profile(((0.0, 1000.0 * RPM), (1.0, 1000.0 * RPM)), ((0.0, 0.0), (0.55, 0.0), (0.55, T)), 0.9)
THROUGH_ZERO = Profile(((0.0, 300.0 * RPM), (0.55, 300.0 * RPM), (1.15, -300.0 * RPM), (1.3, -300.0 * RPM)),
                       ((0.0, 0.0), (0.3, 0.0), (0.3, T)), 1.3)


def slice_of(track: Profile, drive: dict[str, Any], source: str, **more: Any) -> Run:
    return run(Case("slice", track, drive, **more), source)


@pytest.fixture(scope="module")
def encoder() -> Run:
    return slice_of(STEP, {}, "encoder")


@pytest.mark.parametrize("source", ["ges", "riccati"])
def test_a_rated_load_step_without_encoder(source: str, encoder: Run) -> None:
    result = slice_of(STEP, RUNNING, source)
    assert [state for _, state in result.states] == [AngleState.ENCODER, AngleState.COMPANION]
    assert result.states[1][0] == 0.5
    assert 0.0 < encoder.dip() < 60.0
    assert result.dip() < 2.0 * encoder.dip()
    assert result.kept() and np.abs(result.angle_error).max() < 5.0


@pytest.mark.parametrize("source", ["ges", "riccati"])
def test_rated_load_through_zero_without_encoder(source: str) -> None:
    result = slice_of(THROUGH_ZERO, RUNNING, source)
    assert result.kept() and np.abs(result.angle_error).max() < 5.0
    assert result.truth.omega_e[-1] / M2.pole_pairs == pytest.approx(-300.0 * RPM, rel=0.05)


def test_a_start_open_loop_from_the_wrong_side() -> None:
    track = Profile(((0.0, 0.0), (0.1, 0.0), (0.9, 600.0 * RPM), (1.3, 600.0 * RPM)), duration=1.3)
    result = slice_of(track, START, "riccati", theta_0=3.1)
    assert [s for _, s in result.states] == [AngleState.HOLD, AngleState.OPEN_LOOP, AngleState.COMPANION]
    assert result.kept()


def test_a_dead_companion_stops_the_drive_within_the_time_to_live() -> None:
    result = slice_of(STEP, RUNNING, "ges", mute_at=0.6)
    stopped, state = result.states[-1]
    assert state is AngleState.STOPPED
    assert 0.6 < stopped < 0.6 + 0.0105
    after = result.truth.sample > stopped * 5000.0
    assert np.abs(result.truth.torque[after]).max() < 1e-9


def test_no_frame_acts_on_a_sample_taken_before_it_arrives() -> None:
    class Listener(DriveNode):
        heard = 0

        def receive(self, block: FrameBlock) -> None:
            assert (block.t_ns <= self.simulation.next_sample / 5000.0 * 1e9).all()
            self.heard += len(block)
            super().receive(block)

    config = config_from({"motor": {"preset": "m2"}})
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(600.0 * RPM))
    drive = Listener(Protocol(), 0, simulation, DriveNodeSettings())
    companion = Companion([config], Protocol(), transmit=True)
    faults = BusFaults(delay_ns=300_000, jitter_ns=900_000, reordering=0.1)
    CoSimulation([drive], companion, faults, period_s=1e-3).run(0.1)
    assert drive.heard > 80


@pytest.mark.parametrize("firmware", [False, True], ids=["package", "C library"])
def test_a_rated_load_step_through_the_c_library(firmware: bool, encoder: Run) -> None:
    """What the library makes of the estimates controls the drive as what the package makes of them."""
    result = slice_of(STEP, RUNNING, "riccati", firmware=firmware)
    assert result.kept() and np.abs(result.angle_error).max() < 5.0
    assert result.dip() / encoder.dip() == pytest.approx(1.42, abs=0.08)


@pytest.mark.parametrize(("motor", "saturation", "theta_0", "firmware"), [
    ("m1", 0.2, 2.9, False), ("m2", 0.2, -2.0, True), ("m2", 0.1, 1.0, False)])
def test_from_an_unknown_angle_to_speed(motor: str, saturation: float, theta_0: float, firmware: bool) -> None:
    """Axis, pulses, valid; the drive closes its loop as soon as it listens (1024 samples) and turns."""
    track = Profile(((0.0, 0.0), (0.4, 0.0), (0.7, 500.0 * RPM), (0.8, 500.0 * RPM)), ((0.0, 0.0),), 0.8)
    case = from_rest(motor, saturation, theta_0=theta_0, firmware=firmware)
    result = run(replace(case, profile=track), "riccati")
    assert [state for _, state in result.states] == [AngleState.HOLD, AngleState.COMPANION]
    assert result.states[1][0] < 0.35
    assert result.kept() and np.abs(result.angle_error).max() < 15.0


def test_a_brake_holds_the_load_until_the_loop_is_closed() -> None:
    track = Profile(((0.0, 0.0), (0.4, 0.0), (0.5, 200.0 * RPM), (0.6, 200.0 * RPM)), ((0.0, 0.5 * T),), 0.6)
    result = slice_of(track, {**WAITS, "brake": True}, "riccati", rough={"saturation": 0.2})
    assert [state for _, state in result.states] == [AngleState.HOLD, AngleState.COMPANION]
    released = int(result.states[1][0] * 5000.0)
    assert not result.truth.omega_e[:released].any() and np.ptp(result.truth.theta_e[:released]) == 0.0
    assert result.truth.omega_e[released + 5] < 0.0  # the load pulls, and the speed control catches it
    assert result.kept()


@pytest.mark.parametrize("source", ["ges", "riccati"])
def test_at_standstill_a_linear_machine_is_waited_for(source: str) -> None:
    result = slice_of(Profile(((0.0, 0.0),), ((0.0, 0.0),), 0.6), {"angle_source": "companion"}, source)
    assert [state for _, state in result.states] == [AngleState.HOLD]
