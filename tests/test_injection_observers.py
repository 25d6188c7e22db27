"""Position from a probing signal: against the formula for v_alpha-only injection, its limits, and its honesty."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ipmsm_can import estimate
from ipmsm_can.config import ConfigError, parse_config
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.estimation import confidence
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.estimation.observers.common import window_length
from ipmsm_can.motor import M1, M2, Motor
from tests.probed import axis_error, injection, locked_rotor, turning
from tests.test_observers import MODULO_PI, SURFACE, settings

RATE, PROBING = 5000.0, 400.0
ANGLES = np.radians([-170.0, -95.0, -60.0, 0.0, 20.0, 45.0, 90.0, 135.0, 178.0])


def run(kind: str, samples: np.ndarray, motor: Motor = M2, **keys: Any) -> EstimateBlock:
    return Estimator(motor, RATE, settings(kind, motor, **keys)).process(samples)


def locked(theta: float, waveform: str, n: int = 3000, noise: float = 0.0, motor: Motor = M2) -> np.ndarray:
    samples = locked_rotor(motor, theta, injection(waveform, 6.0, PROBING, RATE, n), RATE)
    samples[:2] += np.random.default_rng(2).normal(0.0, noise, (2, n)) if noise else 0.0
    return samples


@pytest.mark.parametrize(("kind", "waveform", "within"), [
    ("injection_extraction", "alpha", 0.05), ("injection_extraction", "rotating", 0.05),
    ("injection_demodulation", "rotating", 0.35)])
@pytest.mark.parametrize("motor", [M1, M2, replace(M2, L_d=M2.L_q, L_q=M2.L_d, name="L_d > L_q")],
                         ids=lambda m: m.name)
def test_finds_the_axis_of_a_standing_rotor(kind: str, waveform: str, within: float, motor: Motor) -> None:
    # Demodulation neglects what the negative sequence of the current does in the resistance.
    behind = motor.R * motor.L_s / (4 * math.pi * PROBING * motor.L_d * motor.L_q)
    expected = -math.degrees(behind) if kind == "injection_demodulation" else 0.0
    for theta in ANGLES:
        out = run(kind, locked(theta, waveform, motor=motor), motor)
        assert np.abs(axis_error(out.angle[0], theta)[-500:] - expected).max() < within
        assert out.sigma[-1] < math.radians(3.0)
        assert np.hypot(*out.flux[2:4, -1]) == pytest.approx(motor.psi_m)


def test_agrees_with_the_formula_for_injection_on_alpha() -> None:
    """i = ibar + S y_v with S = -(V/w_h) cos(w_h t), as in the literature: S generated, R neglected."""
    theta, n, two_periods = 0.5, 3000, 25
    lossless = replace(M2, R=1e-6)
    samples = locked(theta, "alpha", n, motor=lossless)
    t = (np.arange(n) + 1) / RATE
    # The inverter holds the sine's value at the middle of each interval: its integral at the sample instants
    # is a cosine that is higher by half the step over its sine.
    half = math.pi * PROBING / RATE
    s = -6.0 / (2 * math.pi * PROBING) * half / math.sin(half) * np.cos(2 * math.pi * PROBING * t)
    s, i = s[-two_periods:], samples[:2, -two_periods:]
    y_v = (i - i.mean(axis=1, keepdims=True)) @ s / (s @ s)
    expected = 0.5 * math.atan2(y_v[1], y_v[0] - M2.L_s / (M2.L_d * M2.L_q))
    out = run("injection_extraction", samples, lossless)
    assert axis_error(np.array(expected), theta) == pytest.approx(0.0, abs=0.05)
    assert axis_error(out.angle[0, -1:], expected)[0] == pytest.approx(0.0, abs=0.05)


def test_the_window_is_what_a_fresh_sum_over_it_would_give() -> None:
    """After many turns of the ring, at every place in it: no sample forgotten, none counted twice."""
    samples = locked(0.5, "alpha", 2100, noise=0.02)
    long = run("injection_extraction", samples)
    for end in (2037, 2050, 2051, 2099):
        short = run("injection_extraction", np.ascontiguousarray(samples[:, end - 25:end + 1]))
        # The increment of a first sample is unknown, so the window begins with the second.
        assert axis_error(short.angle[0, -1:], long.angle[0, end])[0] == pytest.approx(0.0, abs=1e-6)
        assert short.flux[5, -1] == pytest.approx(long.flux[5, end], rel=1e-6)


def test_the_window_forgets_an_absurd_sample() -> None:
    """What adding and taking off 1e15 A leaves of a sum goes with the next turn of the ring."""
    samples = locked(0.5, "alpha", 2000)
    samples[0, 1000] = 1e15
    out = run("injection_extraction", samples)
    assert (out.flux[5, 1000:1025] == math.pi).all()
    assert np.abs(axis_error(out.angle[0], 0.5)[1100:]).max() < 0.05


@pytest.mark.parametrize(("frequency", "rate", "length"), [
    (400.0, 5000.0, 25), (400.0, 10_000.0, 25), (500.0, 5000.0, 10), (317.0, 5000.0, 142), (10.0, 5000.0, 500),
    (9.0, 5000.0, 0), (2500.0, 5000.0, 0), (3000.0, 5000.0, 0)])
def test_window_of_whole_periods(frequency: float, rate: float, length: int) -> None:
    assert window_length(frequency, rate) == length
    if length:
        assert abs(length * frequency / rate - round(length * frequency / rate)) < 2e-3 * length * frequency / rate


@pytest.mark.parametrize(("kind", "waveform", "rms"), [
    ("injection_extraction", "alpha", 5.0), ("injection_extraction", "rotating", 4.0),
    ("injection_demodulation", "rotating", 7.0)])
@pytest.mark.parametrize("w", [6.28, -6.28])
def test_follows_a_slow_rotor_with_current_and_noise(kind: str, waveform: str, rms: float, w: float) -> None:
    """20 rpm of M2, 1 A on q, 0.02 A of noise: continuous through several times half a turn, sigma honest."""
    n = 4000
    samples, theta = turning(M2, w, 1.0, injection(waveform, 6.0, PROBING, RATE, n), RATE)
    samples[:2] += np.random.default_rng(4).normal(0.0, 0.02, (2, n))
    out = run(kind, samples)
    off = axis_error(out.angle[0], theta)[500:]
    assert np.sqrt(np.mean(off**2)) < rms
    assert (np.abs(off) < 4.0 * np.degrees(out.sigma[500:])).all()
    # Continuous: the branch never changes, so the whole angle is off by the same number of half turns.
    whole = np.unwrap(out.angle[0, 500:]) - theta[500:]
    assert np.ptp(np.degrees(whole)) < 40.0
    assert np.mean(out.angle[2, -1000:]) == pytest.approx(w, abs=0.5)
    assert (out.flags[500:] & confidence.LOCKED).mean() > 0.95


@pytest.mark.parametrize("kind", MODULO_PI)
@pytest.mark.parametrize("w", [100.0, 314.0])
def test_fails_at_speed_and_says_so(kind: str, w: float) -> None:
    n = 1500
    samples, theta = turning(M2, w, 1.0, injection("rotating", 6.0, PROBING, RATE, n), RATE)
    out = run(kind, samples)
    off = np.abs(axis_error(out.angle[0], theta)[500:])
    assert np.sqrt(np.mean(off**2)) > 25.0
    assert not (out.flags[500:] & confidence.LOCKED).any()
    known = out.sigma[500:] < math.pi
    assert (off[known] < 3.0 * np.degrees(out.sigma[500:][known])).all()


def test_one_good_fit_by_chance_does_not_lock() -> None:
    """100 rpm and injection on alpha: what leaks in misleads by 25 deg, and at times looks like a good fit."""
    samples, theta = turning(M2, 31.4, 1.0, injection("alpha", 6.0, PROBING, RATE, 1500), RATE)
    samples[:2] += np.random.default_rng(0).normal(0.0, 0.02, (2, 1500))
    out = run("injection_extraction", samples)
    off = np.abs(axis_error(out.angle[0], theta))[500:]
    assert off.max() > 15.0
    assert (np.degrees(out.flux[5, 500:]) < 5.0).any()
    assert not (out.flags[500:] & confidence.LOCKED).any()


@pytest.mark.parametrize("kind", MODULO_PI)
def test_says_unknown_without_injection_and_without_saliency(kind: str) -> None:
    still, _ = turning(M2, 6.28, 1.0, np.zeros(1500, complex), RATE)
    still[:2] += np.random.default_rng(1).normal(0.0, 0.02, (2, 1500))
    for samples, motor in ((still, M2), (locked(0.5, "rotating", motor=SURFACE), SURFACE),
                           (np.zeros((4, 500)), M2)):
        out = run(kind, samples, motor)
        assert (out.sigma == math.pi).all()
        assert not out.flags.any()
        assert np.isfinite(out.flux).all()


def test_injection_along_one_axis_misleads_the_demodulation_and_it_knows() -> None:
    worst = 0.0
    for theta in ANGLES:
        out = run("injection_demodulation", locked(theta, "alpha"))
        off = abs(axis_error(out.angle[0, -1:], theta)[0])
        worst = max(worst, off)
        assert out.sigma[-1] == math.pi or off < 2.0 * math.degrees(out.sigma[-1])
        if off > 10.0:
            assert not out.flags[-1]
    assert worst > 25.0


@pytest.mark.parametrize("kind", MODULO_PI)
def test_keeps_to_the_branch_it_starts_on_and_never_calls_it_valid(kind: str) -> None:
    """Either end of the axis is as good: the initial flux chooses, and nothing here knows which is north."""
    samples = locked(0.4, "rotating")
    for start, expected in ((0.3, 0.4), (0.3 + math.pi, 0.4 - math.pi)):
        flux = [M2.psi_m * math.cos(start), M2.psi_m * math.sin(start)]
        out = run(kind, samples, initial_flux=flux)
        assert out.angle[0, -1] == pytest.approx(expected, abs=0.02)
        assert out.flags[-1] == confidence.LOCKED
        assert not (out.flags & (confidence.VALID | confidence.POLARITY_KNOWN)).any()


@pytest.mark.parametrize("kind", MODULO_PI)
def test_holds_the_angle_over_a_gap_until_the_window_is_full_again(kind: str) -> None:
    n = 6000
    samples, theta = turning(M2, 6.28, 1.0, injection("rotating", 6.0, PROBING, RATE, n), RATE)
    keep = np.ones(n, bool)
    keep[4000:4050] = False
    gap = np.zeros(n, np.int64)
    gap[4050] = 50
    out = Estimator(M2, RATE, settings(kind, M2)).process(np.ascontiguousarray(samples[:, keep]), gap[keep])
    off = np.abs(axis_error(out.angle[0], theta[keep]))
    assert off[3000:].max() < 20.0
    assert off[-300:].max() < 8.0
    assert (out.sigma[4000:4020] == math.pi).all()
    assert out.flags[-1] == confidence.LOCKED


def test_sigma_follows_the_noise() -> None:
    """Ten times the current noise, ten times the error; sigma is no smaller than the error in either case."""
    for noise in (0.002, 0.02):
        out = run("injection_extraction", locked(0.4, "rotating", 8000, noise), current_noise=noise)
        rms = np.sqrt(np.mean(axis_error(out.angle[0], 0.4)[2000:] ** 2))
        sigma = np.median(np.degrees(out.sigma[2000:]))
        assert rms == pytest.approx(1.0 * noise / 0.01, rel=0.3)
        assert rms < sigma < 4.0 * rms


def test_frequency_from_the_call_and_from_the_file() -> None:
    samples = locked_rotor(M2, 0.5, injection("alpha", 6.0, 625.0, RATE, 2000), RATE)
    i, v = samples[:2].T, samples[2:].T
    right = estimate(i, v, RATE, "m2", "injection_extraction", injection_frequency="625 Hz")
    assert axis_error(right.theta[-1:], 0.5)[0] == pytest.approx(0.0, abs=0.05)
    wrong = estimate(i, v, RATE, "m2", "injection_extraction", injection_frequency=400.0)
    assert wrong.sigma_theta[-1] > math.radians(20.0)
    with pytest.raises(ValueError, match=r"injection\.frequency is 9; allowed is a frequency from 9\.76562 Hz to"):
        estimate(i, v, RATE, "m2", "injection_extraction", injection_frequency=9.0)
    with pytest.raises(ValueError, match=r"injection\.frequency is 2500; allowed is a frequency from 0 Hz to"):
        estimate(i, v, RATE, "m2", "injection_demodulation", injection_frequency=2500.0)
    text = '[motor]\npreset = "m2"\n[observer]\nkind = "injection_extraction"\n[wire]\nsample_rate = 10000\n'
    with pytest.raises(ConfigError, match=r"injection\.frequency is 15; allowed is a frequency from 19\.5312 Hz"):
        parse_config(text + "[injection]\nfrequency = 15\nenabled = false\n")
    assert estimator_settings(parse_config(text), 10_000.0).injection_frequency == 400.0
