"""Conditions C1 to C3 of Proposition 2: against closed forms, and holding and failing on the simulated drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can import estimate
from ipmsm_can.drive.profile import Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.experiments.conditions import Verdict, check_c1, check_c2, check_c3, check_phi, window_levels
from ipmsm_can.injection.waveform import PULSATING, ROTATING
from ipmsm_can.motor import M1, M2, Motor
from tests.rotating import Rotating

RATE = 10_000.0
W_H = 2 * math.pi * 400.0
WINDOW = 0.1
DELTA = 0.02
"""[V^2 s]; the weakest signal that counts, far above rounding and far below what M2 gives at 20 rpm."""


class Record:
    """Samples of the simulated drive; waveform None for no injection, 6 V and 400 Hz otherwise."""

    def __init__(self, profile: Profile, waveform: int | None = None, noise: float = 0.0,
                 motor: Motor = M2) -> None:
        parameters = DriveParameters(sample_rate=RATE, current_noise=noise, adc_step=0.0,
                                     rotor_locked=not any(value for _, value in profile.speed),
                                     injection_ramp=1e6)
        drive = DriveSimulation(motor, parameters, profile, 0.7, seed=3)
        n = drive.samples_in_profile
        if waveform is not None:
            drive.command_injection(waveform, 6.0, 400.0, 0.4, n + 2000)
        drive.run(2000)  # the injected current's transient is over after 0.2 s
        s = drive.run(n)
        self.motor = motor
        self.noise = noise
        self.i: NDArray[np.complex128] = s.i_alpha + 1j * s.i_beta
        self.v: NDArray[np.complex128] = s.v_alpha + 1j * s.v_beta
        self.theta = s.theta_e
        self.phi = estimate(self.i, self.v, RATE, motor, alpha=10.0).phi

    def check(self, samples_per_mean: int = 1) -> dict[str, Verdict]:
        def options(each: int) -> dict[str, float]:
            return {"window": WINDOW, "required": DELTA, "current_noise": self.noise}
        asked = options(samples_per_mean)
        found = [
            check_c1(self.i, self.v, RATE, self.motor, samples_per_mean=samples_per_mean, **asked),
            check_c2(self.i, self.theta, RATE, self.motor, samples_per_mean=samples_per_mean, **asked),
            check_c3(self.i, self.theta, RATE, self.motor, samples_per_mean=samples_per_mean, **asked),
            # What a turning part of u keeps of its level in Phi, at the frequency of the injection.
            check_phi(self.phi, RATE, window=WINDOW, required=DELTA * 4 * 10.0**2 / (W_H**2 + 10.0**2),
                      noise=2 * 10.0 * self.motor.L_s * self.noise),
        ]
        return {v.condition: v for v in found}


def holding(verdicts: dict[str, Verdict]) -> set[str]:
    return {name for name, verdict in verdicts.items() if verdict.holds}


def test_levels_are_smallest_eigenvalues() -> None:
    rng = np.random.default_rng(2)
    u = rng.normal(size=300) + 0.3j * rng.normal(size=300) + 0.2
    levels = window_levels(np.asarray(u, np.complex128), 0.01, 40)
    assert levels.shape == (261,)
    for k in (0, 17, 260):
        part = np.array([u[k:k + 40].real, u[k:k + 40].imag])
        assert levels[k] == pytest.approx(np.linalg.eigvalsh(0.01 * part @ part.T)[0], rel=1e-10)


@pytest.mark.parametrize(("w", "i_d", "i_q"), [(314.0, 0.0, 2.0), (40 * math.pi, -1.5, 2.3), (-200.0, 1.0, -1.0)])
def test_turning_rotor_in_closed_form(w: float, i_d: float, i_q: float) -> None:
    """u = j w (psi_m + L_0 i_d - (L_0/2)(i_d + j i_q)) c: a circle, its level |u|^2 T / 2 over whole turns."""
    n = 4000
    machine = Rotating(M2, w, i_d, i_q)
    s = machine.samples(RATE, n)
    turns = 4 * math.pi / abs(w)
    size = abs(w) * abs(M2.psi_m + 0.5 * M2.L_0 * i_d - 0.5j * M2.L_0 * i_q)
    expected = 0.5 * size**2 * turns
    theta = machine.theta(np.arange(n) / RATE)
    c1 = check_c1(s[:2].T, s[2:].T, RATE, M2, window=turns, required=1.0)
    c2 = check_c2(s[:2].T, theta, RATE, M2, window=turns, required=1.0)
    for verdict in (c1, c2):
        # Windows are whole numbers of samples: up to half a sample of the smaller axis more or less.
        assert verdict.level == pytest.approx(expected, rel=3 * abs(w) / RATE)
    assert c1.level == pytest.approx(c2.level, rel=1e-4)
    assert c1.holds
    assert not check_c3(s[:2].T, theta, RATE, M2, window=turns, required=1.0).applies


def test_turning_without_injection_c1_and_c2_hold_and_c3_says_nothing() -> None:
    verdicts = Record(constant(1000 * 2 * math.pi / 60, 3.0, 0.6)).check()
    assert holding(verdicts) == {"C1", "C2", "A3"}
    assert not verdicts["C3"].applies
    assert str(verdicts["C3"]) == "C3 does not apply: the rotor turns"


def test_standstill_without_injection_all_fail() -> None:
    """A constant torque: current flows, nothing changes, nothing is learned."""
    verdicts = Record(constant(0.0, 3.0, 0.6)).check()
    assert holding(verdicts) == set()
    assert verdicts["C3"].applies
    assert max(v.margin for v in verdicts.values()) < 1e-3


def test_standstill_with_rotating_injection_all_hold_with_one_level() -> None:
    record = Record(constant(0.0, 0.0, 0.6), ROTATING)
    verdicts = record.check()
    assert holding(verdicts) == {"C1", "C2", "C3", "A3"}
    c1, c2, c3 = (verdicts[name].level for name in ("C1", "C2", "C3"))
    assert c2 == pytest.approx(c3, rel=1e-9)
    assert c1 == pytest.approx(c3, rel=1e-2)
    # The current's ellipse from its two rotating parts: its smaller semi-axis gives the level.
    turn = np.exp(1j * W_H * np.arange(1000) / RATE)
    forwards, backwards = np.mean(record.i[:1000] / turn), np.mean(record.i[:1000] * turn)
    slope = W_H * (abs(forwards) - abs(backwards)) * np.sinc(0.5 * W_H / RATE / math.pi)
    assert c3 == pytest.approx(0.5 * WINDOW * (0.5 * M2.L_0 * slope) ** 2, rel=1e-3)


def test_standstill_with_pulsating_injection_all_fail() -> None:
    """Along one axis p[i] is a line: as much current as with rotating injection, and nothing across."""
    record = Record(constant(0.0, 0.0, 0.6), PULSATING)
    assert np.abs(record.i).max() > 0.15
    assert holding(record.check()) == set()


def test_without_saliency_an_exciting_current_does_not_help() -> None:
    """L_0 = 0: p[i] is PE, yet Phi is 0.  The paper's C3 leaves out that it needs L_0."""
    round_rotor = replace(M2, L_d=M2.L_q)
    record = Record(constant(0.0, 0.0, 0.6), ROTATING, motor=round_rotor)
    slopes = np.diff(record.i) * RATE
    assert window_levels(slopes, 1 / RATE, 1000).min() > 1e3
    assert holding(record.check()) == set()


def test_a_stop_is_found_where_it_is() -> None:
    """From 500 rpm to a stop: excited at first, and the weakest window lies behind the stop."""
    stop = Profile(((0.0, 52.0), (0.6, 52.0), (0.8, 0.0)), ((0.0, 1.0),), 1.6, "stop")
    verdicts = Record(stop).check()
    assert holding(verdicts) == set()
    assert verdicts["C1"].weakest_at > 0.5
    before = Record(replace(stop, duration=0.35)).check()
    assert holding(before) == {"C1", "C2", "A3"}


def test_noise_is_not_excitation() -> None:
    """0.02 A of noise, differentiated at 10 kHz, looks like volts that move in every direction."""
    silent = Record(constant(0.0, 3.0, 0.6), noise=0.02)
    for verdict in silent.check().values():
        assert verdict.level > verdict.required, verdict
        assert 0.6 * verdict.noise < verdict.level < verdict.noise, verdict
        assert not verdict.holds, verdict
    # Five means in a probing period leave a 25th of the noise, and what is injected shows.
    probed = Record(constant(0.0, 0.0, 0.6), ROTATING, noise=0.02)
    assert holding(probed.check(samples_per_mean=5)) == {"C1", "C2", "C3", "A3"}


def test_means_never_overstate_the_level() -> None:
    record = Record(constant(0.0, 0.0, 0.6), ROTATING)
    levels = [record.check(size)["C1"].level for size in (1, 2, 5, 10)]
    assert levels == sorted(levels, reverse=True)


def test_c1_and_c2_part_when_the_model_is_wrong() -> None:
    """C1 sees the voltage, C2 the position: with L_q wrong they are no longer the same signal."""
    s = Rotating(M1, 300.0, 0.0, 6.0)
    n = 2000
    x = s.samples(RATE, n)
    theta = s.theta(np.arange(n) / RATE)
    wrong = replace(M1, L_q=2 * M1.L_q)
    apart = (check_c1(x[:2].T, x[2:].T, RATE, wrong, window=WINDOW, required=DELTA).level
             / check_c2(x[:2].T, theta, RATE, wrong, window=WINDOW, required=DELTA).level)
    assert abs(apart - 1.0) > 0.01


@pytest.mark.parametrize(("change", "message"), [
    ({"window": 0.0}, "window is 0.0; allowed is a finite number above 0, in s"),
    ({"window": 9.0}, "window is 9.0; allowed is at most the record's length, 0.0099 s"),
    ({"window": 1e-4}, "window is 0.0001; allowed is two intervals of 0.0001 s or more"),
    ({"required": -1.0}, "required is -1.0; allowed is a finite number above 0, in V^2 s"),
    ({"current_noise": -0.1}, "the noise is -0.1; allowed is a finite rms value of 0 or more"),
    ({"samples_per_mean": 0}, "samples_per_mean is 0; allowed is a whole number of 1 or more"),
    ({"v": np.zeros((99, 2))}, "v has shape (99,); allowed is (100, 2) or complex (100,)"),
    ({"v": np.zeros(100)}, "v has shape (100,); allowed is (100, 2) or complex (100,)"),
    ({"i": np.full((100, 2), np.nan)}, "i[0] is (nan+nanj); allowed are finite numbers"),
])
def test_refuses_in_one_sentence(change: dict[str, object], message: str) -> None:
    given: dict[str, object] = {"i": np.zeros((100, 2)), "v": np.zeros((100, 2)), "window": 5e-3, "required": 1.0}
    given.update(change)
    with pytest.raises(ValueError) as problem:
        check_c1(sample_rate=RATE, motor=M2, **given)  # type: ignore[arg-type]
    assert str(problem.value) == message


def test_c2_refuses_an_angle_that_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"theta has shape \(99,\); allowed is \(100,\)"):
        check_c2(np.zeros((100, 2)), np.zeros(99), RATE, M2, window=5e-3, required=1.0)
