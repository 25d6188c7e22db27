"""The Riccati-gain observer: its algebra against NumPy, its sigma against its errors, what it does when lost."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from ipmsm_can.config import parse_config
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence, regression
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.estimation.observers import common, covariance, handover, kinds, riccati, voltage_errors
from ipmsm_can.estimation.observers.voltage_errors import Uncertainty
from ipmsm_can.motor import M1, M2, Motor
from tests.probed import injection, locked_rotor
from tests.rotating import Rotating, degrees_between
from tests.test_observers import SURFACE, settings

RATE = 5000.0
VALID, POLARITY, LOCKED = confidence.VALID, confidence.POLARITY_KNOWN, confidence.LOCKED


def riccati_on(samples: np.ndarray, motor: Motor, **keys: Any) -> tuple[EstimateBlock, Estimator]:
    estimator = Estimator(motor, RATE, settings("riccati", motor, **keys))
    return estimator.process(np.ascontiguousarray(samples)), estimator


def regressed(samples: np.ndarray, motor: Motor, alpha: float) -> np.ndarray:
    out = np.empty((regression.ROWS, samples.shape[1]))
    p = regression.parameters(motor, alpha, RATE)
    regression.regression_block(samples, p, np.zeros(1, regression.STATE), out)
    return out


# The algebra

def test_prediction_is_f_p_ft_plus_q() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(9, 9))
    P = root @ root.T
    B = rng.normal(size=(7, 2))
    keep, prior = np.array([0.9, 0.8, 0.7, 0.95, 0.6, 0.5, 0.4]), np.arange(1.0, 8.0)
    F = np.eye(9)
    F[:2, 2:] = 0.01 * B.T
    F[2:, 2:] = np.diag(keep)
    expected = F @ P @ F.T + np.diag([0.5, 0.5, *((1.0 - keep**2) * prior)])
    voltage_errors.predict(P, B, 0.01, keep, prior, 0.5)
    assert np.allclose(P, expected, rtol=1e-13)
    assert np.array_equal(P, P.T)


@pytest.mark.parametrize("noise", [1e-9, 1.0, 1e9])
def test_correction_is_josephs(noise: float) -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(9, 9))
    P, h, gain = root @ root.T, rng.normal(size=9), np.empty(9)
    before = P.copy()
    seen = covariance.correct(P, h, gain, noise)
    k = before @ h / (h @ before @ h + noise)
    left = np.eye(9) - np.outer(k, h)
    assert seen == pytest.approx(h @ before @ h)
    assert np.allclose(gain, k, rtol=1e-12)
    assert np.allclose(P, left @ before @ left.T + noise * np.outer(k, k), atol=1e-12 * before.max())


def test_two_states_are_the_textbook_filter() -> None:
    """Without saliency there is no d, without adaptation no voltage state: NumPy does the same.

    But for the length of x_hat, which counts for some ms, until the loop has found the speed.
    """
    n, alpha = 800, 100.0
    machine = Rotating(SURFACE, 120.0, 0.0, 2.0)
    rng = np.random.default_rng(3)
    samples = np.ascontiguousarray(machine.samples(RATE, n) + rng.normal(0, [[0.02]] * 2 + [[0.2]] * 2, (4, n)))
    out, _ = riccati_on(samples, SURFACE, adapt_voltage=False, adapt_resistance=False, saturation_uncertainty=0.0)
    y, phi, step, h = (lambda r: (r[0], r[1:3], r[3:5], r[5:7]))(regressed(samples, SURFACE, alpha))
    lam, P, T_s, psi = np.zeros(2), 4.0 * SURFACE.psi_m**2 * np.eye(2), 1.0 / RATE, SURFACE.psi_m
    found, trust = [], []
    for k in range(n):
        i = samples[:2, k]
        volts2 = 0.5**2 + (0.12 * SURFACE.R) ** 2 * i @ i
        if k:
            lam = lam + step[:, k]
            P = P + 2 * 0.01 * volts2 * T_s * np.eye(2)
        r = ((2 * alpha * psi * SURFACE.L_q * 0.02) ** 2 + 4 * psi**2 * volts2 * 2 * 0.01 / T_s
             + (2 * psi * 0.06 * SURFACE.L_q) ** 2 * h[:, k] @ h[:, k])
        gain = P @ phi[:, k] / (phi[:, k] @ P @ phi[:, k] + r)
        lam = lam + gain * (y[k] - phi[:, k] @ (lam - SURFACE.L_q * i))
        P = (np.eye(2) - np.outer(gain, phi[:, k])) @ P
        x = lam - SURFACE.L_q * i
        across = np.array([-x[1], x[0]]) / np.linalg.norm(x)
        found.append(lam)
        extra = SURFACE.L_q**2 * (0.02**2 + 0.06**2 * (across @ i) ** 2)
        trust.append(math.sqrt(across @ P @ across + extra) / np.linalg.norm(x))
    assert np.abs(out.flux[:2] - np.array(found).T).max() < 1e-5
    known = np.array(trust) < 1.0
    assert known.sum() > 700
    assert np.allclose(out.sigma[known], np.array(trust)[known], rtol=1e-3)


@pytest.mark.parametrize(("state", "size"), [(0, 1.5), (1, -2.0), (2, 0.8), (3, 0.4), (4, 0.8)])
def test_a_voltage_error_stands_in_the_regression_as_said(state: int, size: float) -> None:
    """Told the error of the voltage and the flux, the innovation is nothing; not told, it is not."""
    n = 2000
    machine = Rotating(M2, 50.0, -0.5, 1.6)
    samples = machine.samples(RATE, n)
    i = samples[0] + 1j * samples[1]
    mean = 0.5 * (i[1:] + i[:-1])
    if state < 2:
        error = np.full(n - 1, size * (1.0, 1j)[state])
    elif state == 3:
        error = -size * mean
    else:
        phases = [(mean * np.exp(-2j * math.pi * k / 3)).real for k in range(3)]

        def lost(zone: float) -> np.ndarray:
            parts = (np.clip(p / zone, -1, 1) * np.exp(2j * math.pi * k / 3) for k, p in enumerate(phases))
            return np.asarray(2 / 3 * sum(parts))

        smallest, largest_corner = lost(Uncertainty().dead_zone(M2)), lost(Uncertainty().corner(M2))
        error = -size * (smallest if state == 2 else largest_corner - smallest)
    samples[2, 1:] -= error.real
    samples[3, 1:] -= error.imag
    alpha = 100.0
    innovation = {}
    for told in (0.0, size):
        p = common.parameters(kinds.RICCATI, M2, alpha, 0.0, 0.059, RATE)
        p["prior"], p["keep"] = 0.0, 1.0
        flux = complex(machine.flux(0.0))
        state_ = common.new_state(flux.real, flux.imag, 0.0)
        state_["P"][0] = np.diag([1e-12, 1e-12, *[0.0] * 7])
        state_["bias"][0, state] = told
        out = np.empty((common.ROWS, n))
        riccati.riccati_block(samples, regressed(samples, M2, alpha), p, state_, out)
        innovation[told] = np.abs(out[common.INNOVATION, 10:]).max()
    # The square of the error, |F[dv]|^2/alpha twice over, is held in it; what is left is what sampling makes.
    largest = np.abs(error).max()
    assert innovation[size] < 0.5 * largest**2 / alpha
    assert innovation[0.0] > 50.0 * innovation[size]


# How sure it is

def test_sigma_is_the_error_over_draws_of_what_is_uncertain() -> None:
    rng = np.random.default_rng(4)
    inside, ratios = [], []
    for trial in range(40):
        told = (M1, M2)[trial % 2]
        true = replace(told, R=told.R * rng.uniform(0.8, 1.2), L_d=told.L_d * rng.uniform(0.9, 1.1),
                       L_q=told.L_q * rng.uniform(0.9, 1.1), psi_m=told.psi_m * rng.uniform(0.95, 1.05))
        w = float(rng.choice([-1, 1]) * rng.uniform(40, 400))
        machine = Rotating(true, w, 0.0, float(rng.uniform(-2.3, 2.3)), float(rng.uniform(0, 6.28)))
        n = 5000
        samples = machine.samples(RATE, n) + rng.normal(0, [[0.02]] * 2 + [[0.05]] * 2, (4, n))
        samples[2:, 1:] += rng.normal(0, 0.1, (2, 1))
        out, _ = riccati_on(samples, told)
        off = degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE))
        valid = out.flags & VALID != 0
        assert valid[-1], (told.name, w)
        inside.append(np.mean(np.abs(off[valid]) < 2.0 * np.degrees(out.sigma[valid])))
        ratios.append(np.median(np.degrees(out.sigma[valid])) / math.sqrt(np.mean(off[valid] ** 2)))
    assert np.mean(inside) > 0.95
    assert np.median(ratios) < 3.0
    assert np.median(ratios) > 0.7


def test_what_the_samples_do_not_tell_stays_put() -> None:
    """No current and no rotation: nothing is adapted, and no variance leaves its prior."""
    out, estimator = riccati_on(np.zeros((4, 50_000)), M2, initial_flux=[0.59, 0.0])
    P = estimator.records[3]["P"][0]
    prior = Uncertainty().priors(M2)
    assert not estimator.records[3]["bias"].any()
    assert np.all(np.diag(P)[2:] <= np.array(prior) * (1 + 1e-12))
    assert np.all(np.diag(P)[:2] <= 4.0 * M2.psi_m**2 * (1 + 1e-12))
    assert not (out.flags & (VALID | POLARITY | LOCKED)).any()


def reversal(n_seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """M2 turning over at 30 rpm under load with 0.5 V dead time: samples and true angle."""
    speed = ((0.0, 30.0), (1.0, 30.0), (1.6, -30.0), (3.0, -30.0))
    load = ((0.0, 1.0), (0.6, 1.0), (0.6, 4.0), (2.2, 4.0), (2.2, -2.0))
    track = Profile(tuple((t, v * RPM) for t, v in speed), load, n_seconds, "reversal")
    drive = DriveParameters(sample_rate=RATE, dead_time_voltage=0.5, current_noise=0.02)
    s = DriveSimulation(M2, drive, track).run(int(n_seconds * RATE))
    return np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta]), s.theta_e


def test_adaptation_helps_and_finds_what_is_wrong() -> None:
    samples, theta = reversal()
    told = replace(M2, R=1.2 * M2.R)
    worst = {}
    for volts in (True, False):
        out, estimator = riccati_on(samples, told, adapt_voltage=volts, adapt_resistance=volts)
        off = degrees_between(out.angle[0], theta)
        worst[volts] = math.sqrt(np.mean(off[5000:] ** 2))
        bias = estimator.records[3]["bias"][0]
        if volts:
            # Dead time against the current and R too large act alike where the current hardly changes.
            i = np.hypot(samples[0], samples[1])[5000:].mean()
            true = 0.5 * 4 / 3 - 0.2 * M2.R * i
            assert bias[2] * 4 / 3 + bias[3] * i == pytest.approx(true, abs=0.15)
            assert 0.2 < bias[2] < 0.8
            assert bias[3] < 0.0
        else:
            assert not bias.any()
    assert worst[True] < 0.5 * worst[False]


# Lock

@pytest.mark.parametrize("motor", [M1, M2], ids=lambda m: m.name)
@pytest.mark.parametrize("w", [30.0, 100.0, -400.0])
def test_locks_from_every_angle_within_three_over_w_and_five_times_sooner(motor: Motor, w: float) -> None:
    n = int(RATE * 1.5)
    machine = Rotating(motor, w, 0.0, 1.0)
    rng = np.random.default_rng(6)
    samples = np.ascontiguousarray(machine.samples(RATE, n) + rng.normal(0, [[0.02]] * 2 + [[0.0]] * 2, (4, n)))
    gains = {"m1": {"alpha": 20.0, "gamma": 10.0}, "m2": {"alpha": 10.0, "gamma": 50.0}}[motor.name]
    slowest = [0.0, 0.0]
    for off in range(30, 360, 30):
        start = motor.psi_m * np.exp(1j * (0.3 + math.radians(off)))
        for which, (kind, keys) in enumerate((("riccati", {}), ("ges", gains))):
            chosen: dict[str, Any] = {**keys, "initial_flux": [start.real, start.imag]}
            out = Estimator(motor, RATE, settings(kind, motor, **chosen)).process(samples)
            wrong = np.flatnonzero(np.abs(degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE))) > 5.0)
            slowest[which] = max(slowest[which], (wrong[-1] + 1) / RATE if wrong.size else 0.0)
    assert slowest[0] < 3.0 / abs(w)
    assert slowest[1] > 5.0 * slowest[0], slowest


def jumped(motor: Motor, w: float, degrees: float, scale: float, n: int,
           until: int) -> tuple[np.ndarray, np.ndarray]:
    """From n // 2 on the rotor stands `degrees` further; until `until` the reported voltage is scaled."""
    before, after = (Rotating(motor, w, 0.0, 1.0, 0.3 + math.radians(a)) for a in (0.0, degrees))
    samples, theta = before.samples(RATE, n), before.theta(np.arange(n) / RATE).copy()
    if degrees:
        samples[:, n // 2:] = after.samples(RATE, n)[:, n // 2:]
        theta[n // 2:] += math.radians(degrees)
    samples[2:, n // 2:until] *= scale
    rng = np.random.default_rng(7)
    return samples + rng.normal(0, [[0.02]] * 2 + [[0.0]] * 2, (4, n)), theta


@pytest.mark.parametrize(("motor", "w"), [(M1, 31.0), (M1, -314.0), (M2, 6.3), (M2, 31.0), (M2, 314.0)])
@pytest.mark.parametrize("degrees", [20.0, 90.0, 180.0, -130.0])
def test_a_slipped_rotor_is_reported_within_20_ms_and_found_again(motor: Motor, w: float, degrees: float) -> None:
    n = int(RATE * (2.0 + 20.0 / abs(w)))
    samples, theta = jumped(motor, w, degrees, 1.0, n, n)
    out, _ = riccati_on(samples, motor)
    valid = out.flags & VALID != 0
    off = np.abs(degrees_between(out.angle[0], theta))
    assert valid[n // 2 - 1]
    late = n // 2 + int(0.02 * RATE)
    assert not valid[n // 2:late].all()
    assert off[late:][valid[late:]].max() < 10.0
    back = n // 2 + int(RATE * (0.15 + 1.0 / abs(w)))
    assert (off[back:] < 2.0).all()
    assert valid[back + int(0.1 * RATE):].all()


@pytest.mark.parametrize("scale", [1.5, 0.5])
def test_a_voltage_that_cannot_be_is_not_believed_until_it_is_right_again(scale: float) -> None:
    n = 20_000
    samples, theta = jumped(M2, 94.0, 0.0, scale, n, 15_000)
    out, estimator = riccati_on(samples, M2)
    valid = out.flags & VALID != 0
    assert valid[9_999]
    assert not valid[10_000 + int(0.02 * RATE):15_000].any()
    assert valid[16_000:].all()
    assert np.abs(degrees_between(out.angle[0], theta))[16_000:].max() < 1.0
    assert estimator.lost_locks >= 1


def test_speed_that_cannot_be_is_not_locked() -> None:
    """An observer that is sure of itself, with an angle that stands while |Phi| says that the rotor turns."""
    state = confidence.new_state(M2, 100.0, 0.059, 0.5, 0.02, 0.17, RATE, kinds.RICCATI)
    n = 1000
    phi = 2.0 * 100.0 * M2.psi_m * 94.0 / math.hypot(94.0, 100.0)
    rows, flux, angle = np.zeros((7, n)), np.zeros((common.ROWS, n)), np.zeros((3, n))
    rows[1] = phi
    flux[2], flux[5], flux[6] = M2.psi_m, 0.01, common.FITS | common.POLARITY
    angle[2, :500] = 94.0
    sigma, flags = np.empty(n), np.empty(n, np.uint8)
    confidence.confidence_block(rows, flux, angle, state, sigma, flags)
    assert flags[499] == LOCKED | POLARITY | VALID
    assert not (flags[500 + int(0.02 * RATE):] & VALID).any()


def test_a_lock_that_was_lost_is_no_lock_to_go_on_with() -> None:
    """One sample that does not fit, between two frames of a drive: until the probation is over sigma is no help."""
    state = confidence.new_state(M2, 100.0, 0.059, 0.5, 0.02, 0.17, RATE, kinds.RICCATI)
    n = 2000
    phi = 2.0 * 100.0 * M2.psi_m * 94.0 / math.hypot(94.0, 100.0)
    rows, flux, angle = np.zeros((7, n)), np.zeros((common.ROWS, n)), np.zeros((3, n))
    rows[1] = phi
    flux[2], flux[5], flux[6] = M2.psi_m, 0.01, common.FITS | common.POLARITY
    flux[6, 1000] = common.POLARITY
    angle[2] = 94.0
    sigma, flags = np.empty(n), np.empty(n, np.uint8)
    confidence.confidence_block(rows, flux, angle, state, sigma, flags)
    assert flags[999] == LOCKED | POLARITY | VALID
    assert not flags[1000] & LOCKED
    probation = slice(1000, 1000 + int(0.1 * RATE) - 1)
    assert (flags[probation] & confidence.WITHHELD).all() and not (flags[probation] & VALID).any()
    assert flags[-1] == LOCKED | POLARITY | VALID


def test_a_burst_in_a_speed_ramp_is_carried_over() -> None:
    speed = ((0.0, 100.0), (0.3, 100.0), (0.55, 1000.0), (1.0, 1000.0))
    track = Profile(tuple((t, v * RPM) for t, v in speed), ((0.0, 1.0),), 1.0, "ramp")
    s = DriveSimulation(M2, DriveParameters(sample_rate=RATE), track).run(5000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    keep, gap = np.ones(5000, bool), np.zeros(5000, np.int64)
    for begin in (2000, 2300, 2600):
        keep[begin:begin + 50] = False
        gap[begin + 50] = 50
    out = Estimator(M2, RATE, settings("riccati", M2)).process(np.ascontiguousarray(samples[:, keep]), gap[keep])
    off = degrees_between(out.angle[0], s.theta_e[keep])
    at = np.flatnonzero(gap[keep])
    # The second and the third lie in the ramp, whose 0.5 a t^2 is 6.5 deg in 10 ms.
    assert np.abs(off[at]).max() < 1.0
    assert np.abs(off[1000:]).max() < 1.0
    assert out.flags[-1] & VALID


# What must never be

@pytest.mark.parametrize("volts", [0.0, 1.2])
def test_standstill_is_never_valid_whatever_the_voltage_is_wrong_by(volts: float) -> None:
    """A locked rotor, loaded or probed, with a lasting error of the voltage along the current."""
    n = 20_000
    probing = locked_rotor(M2, 0.4, injection("rotating", 6.0, 400.0, RATE, n), RATE)
    current = 2.3 * np.exp(1j * (0.4 + math.pi / 2))
    loaded = np.zeros((4, n))
    loaded[0], loaded[1] = current.real, current.imag
    loaded[2], loaded[3] = M2.R * current.real, M2.R * current.imag
    error = volts * current / abs(current)
    for samples in (probing, loaded, probing + loaded):
        samples = samples.copy()
        samples[2, 1:] += error.real
        samples[3, 1:] += error.imag
        for angle in (0.4, 1.97, 3.54):
            out, _ = riccati_on(samples, M2, initial_flux=[0.59 * math.cos(angle), 0.59 * math.sin(angle)])
            assert not (out.flags & (VALID | POLARITY)).any()


def test_a_current_that_turns_while_the_rotor_stands_is_no_rotor() -> None:
    """The voltage error turns with it and looks like a weak magnet's back-EMF, from every direction in turn."""
    n = 20_000
    t = np.arange(n) / RATE
    for hertz in (1.0, 5.0):
        v = (M2.R * 2.0 + 0.6) * np.exp(2j * math.pi * hertz * t)
        samples = locked_rotor(M2, 0.4, v, RATE)
        i = samples[0] + 1j * samples[1]
        reported = v - 0.6 * i / np.maximum(np.abs(i), 1e-3)
        samples[2], samples[3] = reported.real, reported.imag
        out, _ = riccati_on(samples, M2)
        assert not (out.flags & (VALID | POLARITY)).any()


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-300, 1e-6, 1.0, 1e4, 1e30, 1e150, 1e308]),
       uncertainty=st.sampled_from([0.0, 0.5, 1e6]), known=st.booleans())
@hypothesis_settings(max_examples=60, deadline=None)
def test_any_samples_leave_a_covariance(seed: int, scale: float, uncertainty: float, known: bool) -> None:
    rng = np.random.default_rng(seed)
    samples = Rotating(M2, 90.0, -0.5, 2.0).samples(RATE, 600)
    at = slice(200, 200 + int(rng.integers(1, 200)))
    samples[:, at] = scale * rng.uniform(-1, 1, samples[:, at].shape)
    with np.errstate(all="ignore"):
        out, estimator = riccati_on(samples, M2, voltage_uncertainty=uncertainty,
                                    initial_flux=[0.59, 0.0] if known else [0.0, 0.0])
    P = estimator.records[3]["P"][0]
    assert np.isfinite(P).all()
    assert np.array_equal(P, P.T)
    size = np.sqrt(np.maximum(np.diag(P), 1e-30))
    assert np.linalg.eigvalsh(P / np.outer(size, size)).min() > -1e-6
    assert np.diag(P)[:2].max() <= 4.0 * M2.psi_m**2 * (1 + 1e-9)
    assert np.isfinite(out.flux).all()
    assert ((out.sigma > 0.0) & (out.sigma <= math.pi)).all()


# The scheduled gain of ges

def test_the_scheduled_gain_is_the_fastest_at_every_speed() -> None:
    """Both poles at -w: the flux error falls below 1 % within 0.1 s + 12/w; the paper's gains need far longer."""
    for w in (8.0, 40.0, 300.0):
        machine = Rotating(M2, w, 0.0, 1.0)
        n = int(RATE * (0.3 + 30.0 / w))
        start = M2.psi_m * np.exp(1j * (0.3 + math.pi / 2))
        took = {}
        for gamma in ("scheduled", 50.0):
            chosen = settings("ges", M2, alpha=20.0, gamma=gamma, initial_flux=[start.real, start.imag])
            out = Estimator(M2, RATE, chosen).process(machine.samples(RATE, n))
            x = out.flux[2] + 1j * out.flux[3]
            wrong = np.flatnonzero(np.abs(x - machine.active_flux(np.arange(n) / RATE)) > 0.01 * M2.psi_m)
            took[gamma] = (wrong[-1] + 1) / RATE
        assert took["scheduled"] < 0.1 + 12.0 / w, (w, took)
        assert took["scheduled"] < 0.5 * took[50.0], (w, took)


def test_a_scheduled_gain_gives_the_same_bits_in_any_blocks() -> None:
    rng = np.random.default_rng(8)
    samples = Rotating(M2, 90.0, -0.5, 2.0).samples(RATE, 1500) + rng.normal(0, 0.02, (4, 1500))
    gap = np.zeros(1500, np.int64)
    gap[700] = 50
    whole = Estimator(M2, RATE, settings("ges", M2, gamma="scheduled")).process(samples, gap)
    parts = Estimator(M2, RATE, settings("ges", M2, gamma="scheduled"))
    got = [parts.process(np.ascontiguousarray(samples[:, a:a + 13]), gap[a:a + 13]) for a in range(0, 1500, 13)]
    assert np.array_equal(np.concatenate([g.flux for g in got], axis=1), whole.flux)


def test_what_the_configuration_says_of_both() -> None:
    m2 = '[motor]\npreset = "m2"\n[observer]\n'
    assert parse_config(m2 + 'kind = "riccati"\n').alpha == 100.0
    assert parse_config(m2 + "gamma = 3\n").alpha == 10.0
    assert parse_config(m2 + 'kind = "riccati"\nalpha = 40\n').alpha == 40.0
    with pytest.raises(ValueError, match=r"observer.gamma.*only ges has a schedule"):
        parse_config(m2 + 'kind = "chonam"\ngamma = "scheduled"\n')
    assert parse_config(m2).observer.kind == "riccati"
    assert parse_config(m2 + "gamma = 3\n").observer.kind == "ges"
    assert parse_config(m2 + 'kind = "riccati"\ngamma = 3\n').observer.kind == "riccati"
    with pytest.raises(ValueError, match=r'observer.gamma is "fast"; allowed is .*or "scheduled"'):
        parse_config(m2 + 'gamma = "fast"\n')
    with pytest.raises(ValueError, match=r"observer.resistance_uncertainty is 120"):
        parse_config(m2 + "resistance_uncertainty = 120\n")


def test_an_angle_from_outside_is_weighed_as_the_textbook_says() -> None:
    """The information form, P^-1 + h h^T / r, with the angle's row across the measured direction."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(common.FLUX_STATES, common.FLUX_STATES)) * 0.01
    state = common.new_state(0.0, 0.0, 0.0)
    P = root @ root.T + 1e-5 * np.eye(common.FLUX_STATES)  # so that its inverse is good to all digits
    state["P"][0], state["polarity"] = P, 1
    state["bias"] = bias = rng.normal(size=(1, common.FLUX_STATES - 2))
    x, theta, sigma = 0.55 * cmath.exp(0.7j), 0.75, 0.03
    moved = handover.take_angle(state, 0.59, np.ones(voltage_errors.BIASES), x, 0.6 * cmath.exp(1j * theta), sigma)
    h = np.zeros(common.FLUX_STATES)
    h[:2] = -math.sin(theta), math.cos(theta)
    after = np.linalg.inv(np.linalg.inv(P) + np.outer(h, h) / (abs(x) * sigma) ** 2)
    step = after @ h / (abs(x) * sigma) ** 2 * -(h[0] * x.real + h[1] * x.imag)
    np.testing.assert_allclose(state["P"][0], after, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose([moved.real, moved.imag], step[:2], rtol=1e-9)
    np.testing.assert_allclose(state["bias"][0], bias[0] + step[2:], rtol=1e-9)
