"""Every observer: against its own differential equation, where it tracks, and where theory says it must not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ipmsm_can.config import OBSERVER_KINDS, config_from
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.estimation import confidence, regression
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator, EstimatorSettings
from ipmsm_can.estimation.observers.kinds import KINDS
from ipmsm_can.motor import M1, M2, Motor
from ipmsm_can.wire.protocol import ObserverKind
from tests.probed import injection, locked_rotor
from tests.rotating import Rotating, degrees_between

RATE = 5000.0
SURFACE = replace(M2, L_d=M2.L_s, L_q=M2.L_s, name="surface")
SPMSM = ["spmsm_gradient", "spmsm_gradient_max", "spmsm_regression"]
FLUX = ["ges", "riccati", *SPMSM, "active_flux_regression", "chonam"]
MODULO_PI = ["injection_extraction", "injection_demodulation"]


def settings(kind: str, motor: Motor, **keys: Any) -> EstimatorSettings:
    """As [observer] of a drive.toml would give them; valid up to 10 deg, as some kinds state wide sigmas."""
    names = ("pole_pairs", "psi_m", "L_d", "L_q", "R", "rated_torque")
    return estimator_settings(config_from({"motor": {n: getattr(motor, n) for n in names},
                                           "observer": {"kind": kind, **keys}, "estimate": {"valid_sigma": 10.0}}))


def run(kind: str, machine: Rotating, n: int = 10_000, rate: float = RATE, **keys: Any) -> EstimateBlock:
    return Estimator(machine.motor, rate, settings(kind, machine.motor, **keys)).process(machine.samples(rate, n))


def error(out: EstimateBlock, machine: Rotating) -> np.ndarray:
    return degrees_between(out.angle[0], machine.theta(np.arange(out.sigma.size) / RATE))


def test_one_list_of_kinds() -> None:
    assert tuple(KINDS) == OBSERVER_KINDS
    for name, number in KINDS.items():
        assert ObserverKind[name.upper()] == number


# Against the differential equations

def continuous(kind: str, machine: Rotating, alpha: float, gamma: float, initial: complex,
               times: np.ndarray) -> np.ndarray:
    """lambda_hat(t) of the observer's equation as the paper prints it, filters and all, by DOP853."""
    m = machine.motor
    L_0, L, ell = (0.0, m.L_s, 0.0) if kind in SPMSM else (m.L_0, m.L_q, m.ell)

    def part(a: complex, b: complex) -> float:
        return (a.conjugate() * b).real

    def gradient(i: complex, x: complex) -> complex:
        # (|x|^2 I - x x^T) i / |x|^3
        return (abs(x) ** 2 * i - x * part(x, i)) / abs(x) ** 3

    def derivative(t: float, s: np.ndarray) -> list[float]:
        f_e, f_i, g, lam, f_s, f_u = (complex(s[0], s[1]), complex(s[2], s[3]), s[4], complex(s[5], s[6]), s[7],
                                      complex(s[8], s[9]))
        i = complex(machine.current(t))
        e = machine.voltage(t) - m.R * i
        om1 = f_e - L * alpha * (i - f_i)
        om2 = om1 - L_0 * alpha * (i - f_i)
        phi = om1 + om2
        y = L_0 * part(f_i, om1) + abs(om1) ** 2 / alpha + g
        x = lam - L * i
        along, u = part(i, x) / abs(x), gradient(i, x)
        too_long = abs(x) ** 2 - m.psi_m**2
        d_hat = -ell * alpha * (along - f_s)
        if kind == "spmsm_gradient":
            step = -gamma * too_long * x
        elif kind == "spmsm_gradient_max":
            step = -gamma * max(0.0, too_long) * x
        elif kind == "chonam":
            step = gamma * (phi - ell * alpha * (u - f_u)) * (y - part(phi, x) - d_hat)
        else:
            step = gamma * phi * (y - part(phi, x))
        d_lam, d_e, d_i, d_u = e + step, alpha * (e - f_e), alpha * (i - f_i), alpha * (u - f_u)
        return [d_e.real, d_e.imag, d_i.real, d_i.imag, -alpha * g + part(om2, om1), d_lam.real, d_lam.imag,
                alpha * (along - f_s), d_u.real, d_u.imag]

    i_0 = complex(machine.current(0.0))
    x_0 = initial - L * i_0
    u_0 = gradient(i_0, x_0)
    start = [0, 0, i_0.real, i_0.imag, 0, initial.real, initial.imag, part(i_0, x_0) / abs(x_0), u_0.real, u_0.imag]
    solution = solve_ivp(derivative, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-10,
                         atol=1e-12)
    return np.asarray(solution.y[5] + 1j * solution.y[6])


@pytest.mark.parametrize(("kind", "gamma"), [
    ("spmsm_gradient", 200.0), ("spmsm_gradient_max", 200.0), ("spmsm_regression", 0.5),
    ("active_flux_regression", 0.5), ("chonam", 0.5), ("chonam", 5.0)])
@pytest.mark.parametrize("motor", [M1, M2, SURFACE], ids=lambda m: m.name)
def test_second_order_towards_its_differential_equation(kind: str, gamma: float, motor: Motor) -> None:
    machine = Rotating(motor, 60.0, -1.0, 2.3)
    if motor is M1 and not kind.startswith("spmsm_gradient"):
        gamma *= 30.0
    initial = 0.5 * motor.psi_m * (1 + 2j)
    errors = []
    for rate in (1250.0, 2500.0, 5000.0, 10_000.0):
        n = int(0.4 * rate)
        out = run(kind, machine, n, rate, alpha=20.0, gamma=gamma, initial_flux=[initial.real, initial.imag],
                  epsilon=0.01 * motor.psi_m)
        exact = continuous(kind, machine, 20.0, gamma, initial, np.arange(n) / rate)
        errors.append(np.abs(out.flux[0] + 1j * out.flux[1] - exact).max())
    assert errors[-1] < 1e-3 * motor.psi_m
    # max{0, .} switches inside an interval, so its error need not fall evenly.
    assert errors[0] / errors[-1] > 8**1.85, errors


@pytest.mark.parametrize("kind", FLUX[2:])  # ges: tests/test_ges.py
@pytest.mark.parametrize("gamma", [1e-3, 50.0, 1e6, 1e12])
@pytest.mark.parametrize("alpha", [5.0, 200.0])
@pytest.mark.parametrize("w", [0.5, 314.0])
def test_bounded_for_any_gain(kind: str, gamma: float, alpha: float, w: float) -> None:
    out = run(kind, Rotating(M2, w, -1.0, 3.0), gamma=gamma, alpha=alpha, initial_flux=[0.5, 2.0])
    assert np.isfinite(out.flux).all()
    assert np.abs(out.flux[:2]).max() < 4.0


# Where each tracks, and where it must not

@pytest.mark.parametrize("w", [60.0, -314.0])
@pytest.mark.parametrize(("kind", "motor"), [
    *((kind, SURFACE) for kind in FLUX), *((kind, m) for m in (M1, M2) for kind in (
        "ges", "riccati", "active_flux_regression", "chonam"))], ids=str)
def test_tracks_its_machine(kind: str, motor: Motor, w: float) -> None:
    machine = Rotating(motor, w, -0.5, 2.0)
    out = run(kind, machine, initial_flux=[motor.psi_m, -motor.psi_m])
    # riccati has taken some of the start for an error of R, and constant currents tell it nothing better.
    assert np.abs(error(out, machine)[-1000:]).max() < (0.05 if kind == "riccati" else 0.02)
    assert out.angle[2, -1] == pytest.approx(w, rel=1e-3)
    assert out.flags[-1] & confidence.VALID
    assert np.abs(out.flux[0, -1] + 1j * out.flux[1, -1]) == pytest.approx(
        abs(complex(machine.flux(0.0))), rel=3e-3 if kind == "riccati" else 1e-3)


@pytest.mark.parametrize("kind", SPMSM)
@pytest.mark.parametrize(("i_d", "i_q"), [(0.0, 2.3), (-2.0, -2.0)])
def test_a_salient_machine_biases_the_spmsm_kinds(kind: str, i_d: float, i_q: float) -> None:
    """lambda - L_s i points off the rotor; the gradient adds k/w of what its length is off by. Sigma knows."""
    machine = Rotating(M2, 314.0, i_d, i_q)
    out = run(kind, machine, voltage_uncertainty=0.05)  # so that nothing else makes sigma large
    x = complex(M2.psi_m + 0.5 * M2.L_0 * i_d, -0.5 * M2.L_0 * i_q)
    bias = math.atan2(x.imag, x.real)
    if kind != "spmsm_regression":
        bias += 70.0 / 314.0 * (abs(x) - M2.psi_m) / M2.psi_m
    tail = error(out, machine)[-1000:]
    assert np.mean(tail) == pytest.approx(math.degrees(bias), abs=0.05)
    assert abs(math.degrees(bias)) > 0.3
    assert np.degrees(out.sigma[-1000:]).min() > np.abs(tail).max()


def moving_d_current(w: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples and angle of M2 whose i_d swings by 2 A at 5 Hz; mean voltages by Simpson's rule on the current."""
    fine = 16
    t = np.arange((n - 1) * fine + 1) / (RATE * fine)
    theta, i_d = w * t + 0.3, 2.0 * np.sin(2 * np.pi * 5.0 * t)
    i = (i_d + 2.0j) * np.exp(1j * theta)
    flux = (M2.L_d * i_d + M2.psi_m + 2.0j * M2.L_q) * np.exp(1j * theta)
    weights = np.array([1] + [4, 2] * (fine // 2 - 1) + [4]) / (3 * fine)
    inner = np.add.reduceat(i[:-1] * np.tile(weights, n - 1), np.arange(0, (n - 1) * fine, fine))
    mean_i = inner + i[fine::fine] / (3 * fine)
    v = np.concatenate([[0.0], np.diff(flux[::fine]) * RATE + M2.R * mean_i])
    i = i[::fine]
    return np.ascontiguousarray([i.real, i.imag, v.real, v.imag]), theta[::fine]


def test_what_neglecting_d_costs() -> None:
    """In a steady state nothing; with a d-current that moves, an error that ges and chonam do not have."""
    samples, theta = moving_d_current(40.0, 20_000)
    worst = {}
    for kind in ("ges", "active_flux_regression", "chonam"):
        chosen = settings(kind, M2, voltage_uncertainty=0.005, current_noise=0.001)
        out = Estimator(M2, RATE, chosen).process(samples)
        worst[kind] = np.abs(degrees_between(out.angle[0], theta)[-5000:])
        assert (worst[kind] < 3.0 * np.degrees(out.sigma[-5000:])).all()
    assert worst["ges"].max() < 0.02
    assert worst["chonam"].max() < 0.02
    assert worst["active_flux_regression"].max() > 0.2


def test_lambda_of_chonam_is_the_gradient_that_ges_leaves_out() -> None:
    """Without saliency the two are the same observer; with it they take different ways to the same angle."""
    keys: dict[str, Any] = {"initial_flux": [0.5, 2.0], "gamma": 0.5}
    same = [run(kind, Rotating(SURFACE, 60.0, 0.0, 2.3), **keys).flux[:4] for kind in ("ges", "chonam")]
    assert np.abs(same[0] - same[1]).max() < 1e-12
    machine = Rotating(M2, 60.0, 0.0, 2.3)
    ges, chonam = (run(kind, machine, **keys) for kind in ("ges", "chonam"))
    assert np.abs(ges.flux[:2] - chonam.flux[:2]).max() > 1e-3 * M2.psi_m
    assert np.abs(error(ges, machine)[-500:] - error(chonam, machine)[-500:]).max() < 1e-3


def test_the_max_variant_leaves_a_flux_alone_that_is_too_short() -> None:
    """At standstill without current: the one grows to psi_m, the other stays; both shrink what is too long."""
    nothing = np.zeros((4, 20_000))
    for start, grown in ((0.3, M2.psi_m), (1.5, M2.psi_m)):
        first, second = (Estimator(M2, RATE, settings(kind, M2, initial_flux=[0.0, start])).process(nothing)
                         for kind in ("spmsm_gradient", "spmsm_gradient_max"))
        assert first.flux[1, -1] == pytest.approx(grown, rel=1e-3)
        assert second.flux[1, -1] == pytest.approx(min(start, grown), rel=1e-3)
        assert not first.flux[0].any()


def test_a_gradient_that_slips_is_not_believed() -> None:
    """Much gain and a salient machine: held to the circle, the angle has no rest and slips round."""
    machine = Rotating(M2, 62.0, 1.5, -0.6)
    out = run("spmsm_gradient", machine, 20_000, gamma=1000.0, initial_flux=[-1.0, -1.1],
              voltage_uncertainty=0.05)
    assert np.abs(error(out, machine)[-10_000:]).max() > 90.0
    assert not (out.flags & confidence.VALID).any()


# What holds for all of them

def noisy(n: int, seed: int = 1) -> np.ndarray:
    """A machine turning slowly, probed, with noise: something to do for every kind."""
    rng = np.random.default_rng(seed)
    samples = Rotating(M2, 90.0, -0.5, 2.0).samples(RATE, n)
    samples += locked_rotor(M2, 0.5, injection("rotating", 6.0, 400.0, RATE, n), RATE)
    return np.ascontiguousarray(samples + rng.normal(0.0, [[0.02], [0.02], [0.3], [0.3]], samples.shape))


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
@given(sizes=st.lists(st.integers(1, 300), min_size=1, max_size=12), gaps=st.integers(0, 3))
@hypothesis_settings(max_examples=25)
def test_any_partition_gives_the_same_bits(kind: str, sizes: list[int], gaps: int) -> None:
    n = sum(sizes)
    samples = noisy(n)
    gap = np.zeros(n, np.int64)
    gap[[(j + 1) * n // 5 for j in range(gaps)]] = 50
    whole = Estimator(M2, RATE, settings(kind, M2)).process(samples, gap)
    estimator = Estimator(M2, RATE, settings(kind, M2))
    parts, begin = [], 0
    for size in sizes:
        span = slice(begin, begin + size)
        parts.append(estimator.process(np.ascontiguousarray(samples[:, span]), gap[span]))
        begin += size
    for name in ("regression", "flux", "angle", "excitation", "sigma", "flags"):
        joined = np.concatenate([getattr(p, name) for p in parts], axis=-1)
        assert np.array_equal(joined, getattr(whole, name)), name


@pytest.mark.parametrize("kind", FLUX)
def test_carries_the_angle_over_a_gap(kind: str) -> None:
    n = 10_000
    machine = Rotating(SURFACE, 314.0, 0.0, 2.0)
    keep = np.ones(n, bool)
    keep[6000:6050] = False
    gap = np.zeros(n, np.int64)
    gap[6050] = 50
    out = Estimator(SURFACE, RATE, settings(kind, SURFACE)).process(
        np.ascontiguousarray(machine.samples(RATE, n)[:, keep]), gap[keep])
    off = np.abs(degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE)[keep]))
    assert off[5000:6000].max() < 0.02
    assert off[6000:].max() < 2.0
    assert off[-200:].max() < 0.05
    assert out.flags[-1] & confidence.VALID


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
def test_a_long_gap_forgets_everything(kind: str) -> None:
    samples = noisy(3000)
    estimator = Estimator(M2, RATE, settings(kind, M2, initial_flux=[0.1, 0.2]))
    estimator.process(samples)
    gap = np.zeros(3000, np.int64)
    gap[0] = int(RATE)
    after = estimator.process(samples, gap)
    fresh = Estimator(M2, RATE, settings(kind, M2, initial_flux=[0.1, 0.2])).process(samples)
    assert np.array_equal(after.flux, fresh.flux)
    assert np.array_equal(after.flags, fresh.flags)


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
@pytest.mark.parametrize("waveform", ["rotating", "alpha"])
def test_standstill_is_never_valid(kind: str, waveform: str) -> None:
    samples = locked_rotor(M2, 0.4, injection(waveform, 6.0, 400.0, RATE, 10_000), RATE)
    for start in ((M2.psi_m, 0.0), (-M2.psi_m, 0.0), (0.0, M2.psi_m), (0.0, 0.0)):
        for more in (1.0, 100.0):
            chosen = settings(kind, M2, initial_flux=start)
            out = Estimator(M2, RATE, replace(chosen, gamma=more * chosen.gamma)).process(samples)
            assert not (out.flags & (confidence.VALID | confidence.POLARITY_KNOWN)).any()


@pytest.mark.parametrize("kind", FLUX)
def test_valid_means_close(kind: str) -> None:
    """From any start, at any speed, on the machine it is made for and on a salient one."""
    rng = np.random.default_rng(5)
    seen = 0
    for trial in range(60):
        motor = (M1, M2, SURFACE)[trial % 3]
        w = float(rng.choice([-1, 1]) * 10 ** rng.uniform(0.8, 2.8))
        machine = Rotating(motor, w, float(rng.uniform(-2, 2)), float(rng.uniform(-2.3, 2.3)),
                           float(rng.uniform(0, 6.28)))
        start = motor.psi_m * np.exp(1j * rng.uniform(0, 6.28)) * rng.uniform(0, 3)
        n = int(RATE * min(4.0, 1.0 + 20.0 / abs(w)))
        samples = machine.samples(RATE, n)
        samples[2:, 1:] += np.array([[0.2], [-0.2]])  # an offset, as dead time and sensors leave it
        samples += rng.normal(0, [[0.02]] * 2 + [[0.1]] * 2, (4, n))
        out = Estimator(motor, RATE, settings(kind, motor, initial_flux=[start.real, start.imag])).process(samples)
        off = np.abs(degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE)))
        valid = out.flags & confidence.VALID > 0
        seen += bool(valid[-1])
        assert (off[valid] < 15.0).all(), (motor.name, w, off[valid].max())
    assert seen >= 25


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
@pytest.mark.parametrize("spike", [1e30, 1e200])
def test_an_absurd_sample_leaves_nothing_that_looks_like_knowledge(kind: str, spike: float) -> None:
    samples = noisy(6000)
    samples[0, 4000] = spike
    with np.errstate(all="ignore"):
        out = Estimator(M2, RATE, settings(kind, M2)).process(samples)
    assert (out.sigma <= math.pi).all()
    assert not (out.flags[4010:4100] & confidence.VALID).any()


def test_the_spmsm_kinds_regress_on_a_machine_without_saliency() -> None:
    """Their Phi is 2 Omega with L_s, whatever L_d and L_q are."""
    machine = Rotating(M2, 90.0, -0.5, 2.0)
    for kind in SPMSM:
        out = run(kind, machine, 2000)
        surface = Estimator(SURFACE, RATE, settings("ges", SURFACE)).process(machine.samples(RATE, 2000))
        assert np.array_equal(out.regression[:regression.ROWS], surface.regression)
