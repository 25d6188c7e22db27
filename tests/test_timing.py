"""The timing of voltage against current: what the drive can do to it, how it is set right, how it is found."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.cli import plain, render
from ipmsm_can.cli.monitor import _node_status
from ipmsm_can.cli.status import BusStatus, RunStatus
from ipmsm_can.companion import Companion
from ipmsm_can.config import parse_config
from ipmsm_can.config.build import drive_parameters, estimator_settings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, Profile, constant, torque_pulses
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.estimation import confidence, speed, timing
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.estimation.observers.voltage_errors import Uncertainty
from ipmsm_can.experiments.model import Probing, Setup, Watcher
from ipmsm_can.experiments.rig import companion_config, protocol, record
from ipmsm_can.motor import M1, M2, Motor
from tests.rotating import Rotating, degrees_between
from tests.test_observers import settings

Floats = NDArray[np.float64]
RATE = 5000.0
T_S = 1.0 / RATE
DRIVE = DriveParameters(sample_rate=RATE, current_noise=0.02, dead_time_voltage=0.5, speed_imposed=True)
SLOW = constant(20.0 * RPM, 2.0, 2.0)
FAST = constant(1000.0 * RPM, 2.0, 2.0)


def driven(motor: Motor = M2, profile: Profile = SLOW, n: int = 5000, volts: float = 6.0, waveform: int = 1,
           frequency: float = 400.0, seed: int = 1, **changes: Any) -> tuple[Floats, Floats]:
    """Samples (4, n) as a drive reports them and the rotor's angle (n,); probed from the first sample on."""
    simulation = DriveSimulation(motor, replace(DRIVE, **changes), profile, theta_0=0.4, seed=seed)
    if volts:
        simulation.command_injection(waveform, volts, frequency, 0.0, 10**9)
    r = simulation.run(n)
    return np.ascontiguousarray([r.i_alpha, r.i_beta, r.v_alpha, r.v_beta]), r.theta_e


def estimator(motor: Motor = M2, kind: str = "riccati", rate: float = RATE, **keys: Any) -> Estimator:
    return Estimator(motor, rate, settings(kind, motor, **keys))


def times(n: int) -> Floats:
    return np.asarray(np.arange(n) * T_S, np.float64)


def late_samples(machine: Rotating, delay: float, n: int) -> Floats:
    """Samples of a machine in closed form whose voltage is the mean over (t_k - T - d T, t_k - d T]."""
    t = times(n)
    ends: Floats = t - delay * T_S
    begins: Floats = ends - T_S
    i = machine.current(t)
    moved = machine.flux(ends) - machine.flux(begins)
    mean_i = (machine.current(ends) - machine.current(begins)) / (1j * machine.w)
    v = (moved + machine.motor.R * mean_i) / T_S
    return np.ascontiguousarray([i.real, i.imag, v.real, v.imag])


# What the simulated drive does

@pytest.mark.parametrize("delay", [-1.0, -0.25, 0.5, 1.0, 2.75, 4.0])
def test_a_late_voltage_is_that_of_a_drive_in_time_but_later(delay: float) -> None:
    right, late = driven(n=300), driven(n=300, voltage_delay=delay)
    assert np.array_equal(right[0][:2], late[0][:2])
    assert np.array_equal(right[1], late[1])
    # The voltage's integral is a broken line through the steps; its mean over a shifted interval is exact.
    at = np.arange(10, 290)
    for axis in (2, 3):
        integral = np.concatenate([[0.0], np.cumsum(right[0][axis])])
        steps = np.arange(integral.size)
        expected = np.interp(at + 1 - delay, steps, integral) - np.interp(at - delay, steps, integral)
        assert np.allclose(late[0][axis, at], expected, atol=1e-9)


@pytest.mark.parametrize("lead", [0.0, 0.3, 0.5, 0.9])
def test_the_flux_moves_by_the_voltages_that_acted_between_two_currents(lead: float) -> None:
    quiet = replace(DRIVE.noise_free(), dead_time_voltage=0.0, sampling_lead=lead, substeps=20)
    simulation = DriveSimulation(M2, quiet, constant(600.0 * RPM, 1.0, 2.0), theta_0=0.4)
    simulation.command_injection(1, 20.0, 500.0, 0.0, 10_000)
    r = simulation.run(1000)
    flux = (M2.L_d * r.i_d + M2.psi_m + 1j * M2.L_q * r.i_q) * np.exp(1j * r.theta_e)
    i, v = r.i_alpha + 1j * r.i_beta, r.v_alpha + 1j * r.v_beta
    acted = lead * v[:-1] + (1.0 - lead) * v[1:]
    mean_i = 0.5 * (i[1:] + i[:-1])
    miss = np.abs(np.diff(flux) - T_S * (acted - M2.R * mean_i))[20:]
    # The current bends where the voltage steps: R T dv T/(8 L) at most.
    assert miss.max() < M2.R * T_S * np.abs(np.diff(v))[20:].max() * T_S / (8.0 * M2.L_d) + 1e-7
    if lead:
        wrong = np.abs(np.diff(flux) - T_S * (v[1:] - M2.R * mean_i))[20:]
        assert wrong.max() > 10.0 * miss.max()


# Setting right

@pytest.mark.parametrize("kind", ["ges", "riccati"])
@pytest.mark.parametrize("delay", [-2.0, -1.3, -0.5, 0.5, 1.0, 1.6, 2.0])
def test_a_delay_that_is_told_is_gone_and_untold_it_turns_the_angle(kind: str, delay: float) -> None:
    machine = Rotating(M2, 314.0, 0.0, 2.0)
    n = 10_000
    samples, theta = late_samples(machine, delay, n), machine.theta(times(n))
    told = estimator(kind=kind, voltage_delay=delay).process(samples).angle[speed.THETA_HAT]
    untold = estimator(kind=kind, voltage_delay=0.0).process(samples).angle[speed.THETA_HAT]
    assert np.abs(degrees_between(told, theta))[-2000:].max() < 0.03
    expected = -math.degrees(314.0 * T_S * delay)
    assert degrees_between(untold, theta)[-2000:].mean() == pytest.approx(expected, rel=0.1)


@given(st.lists(st.tuples(st.integers(1, 40), st.integers(-20, 20)), min_size=1, max_size=6))
@hypothesis_settings(deadline=None, max_examples=30)
def test_no_volt_second_is_lost_or_counted_twice_when_the_delay_changes(plan: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(3)
    n = sum(length for length, _ in plan)
    samples = rng.normal(size=(4, n))
    state = timing.new_state(M2, None, 400.0, RATE, Uncertainty(), 20.0)
    out, ahead, begin = np.empty((4, n)), np.empty(n, np.int64), 0
    v = np.concatenate([samples[2, :1].repeat(5), samples[2]])
    integral = np.concatenate([[0.0], np.cumsum(v)])
    handed_on = []
    for length, tenths in plan:
        state["pending"] = tenths / 10.0
        part = np.empty((4, length))
        timing.align_block(np.ascontiguousarray(samples[:, begin:begin + length]), state, part,
                           ahead[begin:begin + length])
        out[:, begin:begin + length] = part
        behind = max(math.ceil(tenths / 10.0), 0) - tenths / 10.0
        handed_on += [np.interp(k + 6 - behind, np.arange(integral.size), integral)
                      for k in range(begin, begin + length)]
        for k in range(begin + max(0, 3 - begin), begin + length):
            m = max(math.ceil(tenths / 10.0), 0)
            assert ahead[k] == m
            assert out[0, k] == samples[0, k - m]
        begin += length
    # From where the start no longer counts.
    assert np.allclose(out[2, 4:], np.diff(handed_on)[3:], atol=1e-12)


def test_samples_in_time_go_through_untouched() -> None:
    samples = np.random.default_rng(1).normal(size=(4, 700))
    for delay in (None, 0.0):
        state = timing.new_state(M2, delay, 400.0, RATE, Uncertainty(), 20.0)
        out, ahead = np.empty((4, 700)), np.ones(700, np.int64)
        timing.align_block(samples, state, out, ahead)
        assert out.tobytes() == samples.tobytes()
        assert not ahead.any()


@pytest.mark.parametrize("delay", [-1.0, 0.5, 1.0, 2.0])
def test_a_gap_is_carried_over_with_the_delay(delay: float) -> None:
    machine = Rotating(M2, 314.0, 0.0, 2.0)
    n = 6000
    samples, theta = late_samples(machine, delay, n), machine.theta(times(n))
    keep = np.ones(n, bool)
    keep[4000:4050] = False
    gap = np.zeros(keep.sum(), np.int64)
    gap[4000] = 50
    out = estimator(voltage_delay=delay).process(np.ascontiguousarray(samples[:, keep]), gap)
    error = np.abs(degrees_between(out.angle[speed.THETA_HAT], theta[keep]))
    # The speed loop sees the rotor stand still while the first samples are held back: 3.6 deg a sample.
    assert error[4000:4100].max() < 0.8
    assert error[4000] < 0.01
    assert error[4500:].max() < 0.03


# Finding it

@pytest.mark.parametrize("late, lead", [(1.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-1.0, 0.0), (2.0, 0.0)])
@pytest.mark.parametrize("profile", [SLOW, FAST])
def test_a_delay_is_found_within_two_windows(late: float, lead: float, profile: Profile) -> None:
    samples, theta = driven(profile=profile, n=8000, voltage_delay=late, sampling_lead=lead)
    e = estimator()
    e.process(np.ascontiguousarray(samples[:, :2 * timing.WINDOW]))
    out = e.process(np.ascontiguousarray(samples[:, 2 * timing.WINDOW:]))
    assert e.voltage_delay.applied == pytest.approx(late - lead, abs=0.11)
    assert abs(e.voltage_delay.found - (late - lead)) < 2.5 * e.voltage_delay.sigma
    error = degrees_between(out.angle[speed.THETA_HAT], theta[2 * timing.WINDOW:])
    assert np.abs(error)[-2000:].max() < 1.0


@pytest.mark.parametrize("rate", [2500.0, 10_000.0])
def test_a_delay_is_found_at_other_rates(rate: float) -> None:
    samples, _ = driven(n=6000, sample_rate=rate, voltage_delay=1.0)
    e = estimator(rate=rate)
    e.process(samples)
    assert e.voltage_delay.applied == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("waveform", [1, 2])
@pytest.mark.parametrize("motor", [M1, M2])
def test_saliency_does_not_turn_what_is_measured(motor: Motor, waveform: int) -> None:
    """Without dead time and noise the phase is the delay's alone, at any angle of a salient rotor."""
    for theta_0 in (0.0, 0.7, 1.4):
        quiet = replace(DRIVE.noise_free(), dead_time_voltage=0.0, rotor_locked=True, speed_imposed=False,
                        voltage_delay=0.5)
        simulation = DriveSimulation(motor, quiet, constant(0.0, 1.0), theta_0=theta_0)
        simulation.command_injection(waveform, 6.0, 400.0, 0.0, 10_000)
        r = simulation.run(1024)
        e = estimator(motor)
        e.process(np.ascontiguousarray([r.i_alpha, r.i_beta, r.v_alpha, r.v_beta]))
        # R i belongs to L_d or L_q, not to L_s: 0.03 samples at most.
        assert e.voltage_delay.found == pytest.approx(0.5, abs=0.035)


WRONG = ((("R", 1.2), ("L_d", 1.1), ("L_q", 0.9), ("psi_m", 1.05)), (("R", 0.8), ("L_d", 0.9), ("L_q", 1.1)),
         (("R", 1.2), ("L_d", 1.1), ("L_q", 1.1)), (("R", 0.8), ("L_d", 0.9), ("L_q", 0.9), ("psi_m", 0.95)))


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("case", [
    {"volts": 6.0}, {"volts": 6.0, "waveform": 2}, {"volts": 4.0, "profile": FAST}, {"volts": 0.0},
    {"volts": 0.0, "profile": torque_pulses()}, {"volts": 6.0, "profile": constant(0.0, 2.0)},
    {"volts": 2.5, "profile": constant(0.0, 2.0)}, {"volts": 0.0, "current_noise": 0.2},
    {"volts": 6.0, "current_noise": 0.1}, {"volts": 0.0, "dead_time_voltage": 3.0, "profile": FAST},
    {"volts": 0.0, "motor": M1, "profile": constant(900.0 * RPM, 2.0, 6.0)},
])
def test_a_drive_that_is_in_time_is_left_alone(case: dict[str, Any], wrong: tuple[tuple[str, float], ...]) -> None:
    motor: Motor = case.get("motor", M2)
    told = replace(motor, **{name: factor * getattr(motor, name) for name, factor in wrong})
    samples, _ = driven(**{"current_offset": (0.02, -0.02), **case})
    e, plain = estimator(told), estimator(told, voltage_delay=0.0)
    one, other = e.process(samples), plain.process(samples)
    assert e.voltage_delay.applied == 0.0
    assert one.flux.tobytes() == other.flux.tobytes()
    assert one.angle.tobytes() == other.angle.tobytes()
    if not case["volts"]:
        assert math.isnan(e.voltage_delay.found)


@pytest.mark.parametrize("hertz", [330.0, 370.0, 385.0, 400.0, 412.0])
@pytest.mark.parametrize("i_q", [3.0, 6.3, 14.0, 25.0])
def test_a_rotor_that_turns_at_the_probing_frequency_is_no_probing_signal(hertz: float, i_q: float) -> None:
    samples = late_samples(Rotating(M1, 2.0 * math.pi * hertz, 0.0, i_q), 1.0, 4000)
    e = estimator(M1)
    e.process(samples)
    assert e.voltage_delay.applied == 0.0
    assert math.isnan(e.voltage_delay.found)


def test_without_a_probing_signal_a_delay_stays_unknown() -> None:
    samples, _ = driven(volts=0.0, profile=FAST, voltage_delay=1.0)
    e = estimator()
    e.process(samples)
    assert math.isnan(e.voltage_delay.found)
    assert e.voltage_delay.applied == 0.0
    assert e.voltage_delay.words == ""


def test_a_probing_frequency_out_of_reach_is_not_looked_for() -> None:
    for frequency, rate in ((1400.0, 5000.0), (50.0, 5000.0), (2500.0, 5000.0)):
        state = timing.new_state(M2, None, frequency, rate, Uncertainty(), 20.0)
        assert not timing.known(state).automatic


# The change

PARTITIONED: dict[str, bytes] = {}


def everything(out: EstimateBlock) -> bytes:
    return b"".join(getattr(out, name).tobytes()
                    for name in ("regression", "flux", "angle", "excitation", "sigma", "flags"))


@pytest.mark.parametrize("kind", ["ges", "riccati"])
@given(cuts=st.lists(st.integers(1, 2599), max_size=9, unique=True))
@hypothesis_settings(deadline=None, max_examples=15)
def test_any_partition_gives_the_same_bits_across_a_change(kind: str, cuts: list[int]) -> None:
    samples, _ = driven(n=2600, voltage_delay=1.0)
    gap = np.zeros(2600, np.int64)
    gap[1900] = 12
    if kind not in PARTITIONED:
        whole = estimator(kind=kind)
        PARTITIONED[kind] = everything(whole.process(samples, gap))
        assert whole.voltage_delay.applied == 1.0
    e = estimator(kind=kind)
    edges = sorted({0, 2600, *cuts})
    parts = [e.process(np.ascontiguousarray(samples[:, a:b]), gap[a:b])
             for a, b in pairwise(edges)]
    names = ("regression", "flux", "angle", "excitation", "sigma", "flags")
    joined = b"".join(np.concatenate([getattr(p, name) for p in parts], axis=-1).tobytes() for name in names)
    assert joined == PARTITIONED[kind]


@pytest.mark.parametrize("late, lead", [(1.0, 0.0), (0.5, 0.0), (0.0, 0.5), (2.0, 0.0), (-1.0, 0.0)])
@pytest.mark.parametrize("kind", ["ges", "riccati"])
def test_the_change_makes_no_angle_worse_than_it_was(kind: str, late: float, lead: float) -> None:
    samples, theta = driven(profile=FAST, n=5000, voltage_delay=late, sampling_lead=lead)
    e = estimator(kind=kind)
    out = e.process(samples)
    change = 2 * timing.WINDOW
    error = np.abs(degrees_between(out.angle[speed.THETA_HAT], theta))
    before = error[change - 300:change].max()
    assert before > 1.5
    assert error[change:].max() <= before + 0.2
    settled = round(RATE * (0.02 if kind == "riccati" else 0.15))
    assert error[change + settled:].max() < 0.25 * before
    assert (out.flags[change:] & confidence.LOCKED).all()


# Settings

def test_the_keys_of_a_configuration() -> None:
    text = "[motor]\npreset = 'm2'\n[observer]\nvoltage_delay = {}\n[simulation]\nvoltage_delay = 1\n"
    assert estimator_settings(parse_config(text.format(1))).voltage_delay == 1.0
    assert estimator_settings(parse_config(text.format(-0.5))).voltage_delay == -0.5
    assert estimator_settings(parse_config(text.format("'auto'"))).voltage_delay is None
    assert estimator_settings(parse_config("[motor]\npreset = 'm2'\n")).voltage_delay is None
    assert drive_parameters(parse_config(text.format(0))).voltage_delay == 1.0
    for wrong in ("3", "'soon'", "true"):
        with pytest.raises(ValueError, match=r'observer.voltage_delay is .*allowed is .* from -2 to 2, or "auto"'):
            parse_config(text.format(wrong))


@pytest.mark.parametrize("changes", [{"voltage_delay": 4.5}, {"voltage_delay": -1.5}, {"sampling_lead": 1.0},
                                     {"sampling_lead": -0.1}, {"voltage_delay": math.nan}])
def test_a_drive_refuses_a_timing_it_cannot_make(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(changes))} is"):
        DriveParameters(**changes)  # type: ignore[arg-type]


def test_the_words() -> None:
    nan = math.nan
    assert timing.VoltageDelay(0.0, nan, nan, True).words == ""
    assert timing.VoltageDelay(0.0, 0.04, 0.03, True).words == (
        "voltage in time (found late by +0.04 +/- 0.03 samples)")
    assert timing.VoltageDelay(-0.5, nan, nan, False).words == "voltage early by 0.5 samples, set right"
    assert timing.VoltageDelay(1.0, 1.1, 0.06, True).words == (
        "voltage late by 1 sample, set right (found +1.10 +/- 0.06)")


def test_a_companion_says_what_it_set_right() -> None:
    """From the drive's settings through the frames to what an operator reads."""
    drive = replace(DRIVE, voltage_delay=1.0)
    setup = Setup("m2", constant(20.0 * RPM, 2.0, 0.5), drive, probing=Probing(6.0, 400.0))
    companion = Companion([companion_config(setup, Watcher("riccati", None, None))], protocol(), transmit=False)
    companion.feed(record(setup).frames)
    node = companion.nodes[0]
    status = _node_status(node, 0.0, 0.0, 0)
    assert re.fullmatch(r"voltage late by 1 sample, set right \(found \+1\.\d\d \+/- 0\.\d\d\)", status.timing)
    bus = BusStatus("vcan0", 0.1, 1, 1.0, 0, 0, 0, 0, 0, 0, 0, 0, "none", math.nan, math.nan)
    run = RunStatus("", 1.0, False, bus, (replace(status, live=True),))
    for text in (plain.line(run), plain.summary(run), "\n".join(str(t) for t in render._node(status, 100))):
        assert status.timing in text
    in_time = RunStatus("", 1.0, False, bus, (replace(status, live=True, timing=""),))
    assert "voltage" not in plain.line(in_time) + plain.summary(in_time)
