"""The observer of Proposition 1 against its own differential equation, and its behaviour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ipmsm_can.estimation.estimator import Estimator, EstimatorSettings
from ipmsm_can.motor import M1, M2, Motor
from tests.rotating import Rotating, degrees_between


def settings(motor: Motor, alpha: float, gamma: float,
             initial_flux: tuple[float, float] = (0.0, 0.0)) -> EstimatorSettings:
    return EstimatorSettings("ges", alpha, gamma, initial_flux, motor.psi_m / 10, 0.1, 20.0, 0.5, 0.02, 10.0)


def continuous(machine: Rotating, alpha: float, gamma: float, initial: complex,
               times: np.ndarray) -> np.ndarray:
    """lambda_hat(t) of equation (observer), filters and all, by DOP853 on the equations as printed."""
    m = machine.motor
    L_0, L_q, ell = m.L_0, m.L_q, m.ell

    def derivative(t: float, s: np.ndarray) -> list[float]:
        f_e, f_i, g, lam, f_s = complex(s[0], s[1]), complex(s[2], s[3]), s[4], complex(s[5], s[6]), s[7]
        i = complex(machine.current(t))
        e = machine.voltage(t) - m.R * i
        om1 = f_e - L_q * alpha * (i - f_i)
        om2 = om1 - L_0 * alpha * (i - f_i)
        phi = om1 + om2
        y = L_0 * (f_i.conjugate() * om1).real + abs(om1) ** 2 / alpha + g
        x = lam - L_q * i
        along = (i.conjugate() * x).real / abs(x) if abs(x) >= m.psi_m / 10 else 0.0
        r = y - (phi.conjugate() * x).real + ell * alpha * (along - f_s)
        d_lam = e + gamma * phi * r
        d_e, d_i = alpha * (e - f_e), alpha * (i - f_i)
        return [d_e.real, d_e.imag, d_i.real, d_i.imag, -alpha * g + (om2.conjugate() * om1).real,
                d_lam.real, d_lam.imag, alpha * (along - f_s)]

    i_0 = complex(machine.current(0.0))
    x_0 = initial - L_q * i_0
    start = [0, 0, i_0.real, i_0.imag, 0, initial.real, initial.imag, (i_0.conjugate() * x_0).real / abs(x_0)]
    solution = solve_ivp(derivative, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-10,
                         atol=1e-12)
    return np.asarray(solution.y[5] + 1j * solution.y[6])


@pytest.mark.parametrize(("motor", "w", "alpha", "gamma", "i_d"), [
    (M1, 60.0, 20.0, 10.0, 0.0), (M2, 314.0, 5.0, 50.0, -2.0), (M2, 40.0, 10.0, 0.5, 1.0)])
def test_second_order_towards_the_differential_equation(motor: Motor, w: float, alpha: float, gamma: float,
                                                        i_d: float) -> None:
    machine = Rotating(motor, w, i_d, 2.0)
    initial = 0.5 * motor.psi_m * (1 + 2j)
    errors = []
    for rate in (2500.0, 5000.0, 10_000.0, 20_000.0):
        n = int(0.4 * rate)
        estimate = Estimator(motor, rate, settings(motor, alpha, gamma, (initial.real, initial.imag))).process(
            machine.samples(rate, n))
        exact = continuous(machine, alpha, gamma, initial, np.arange(n) / rate)
        errors.append(np.abs(estimate.flux[0] + 1j * estimate.flux[1] - exact).max())
    assert errors[-1] < 2e-3 * motor.psi_m
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders.min() > 1.8, errors


@pytest.mark.parametrize("gamma", [0.5, 50.0, 200.0, 1e6])
@pytest.mark.parametrize("alpha", [5.0, 10.0, 200.0])
def test_bounded_for_any_gain(alpha: float, gamma: float) -> None:
    """Explicit Euler diverges for gamma |Phi|^2 T_s > 2; here every gain stays bounded."""
    machine = Rotating(M2, 314.0, 0.0, 2.0)
    out = Estimator(M2, 5000.0, settings(M2, alpha, gamma, (0.5, 2.0))).process(machine.samples(5000.0, 10_000))
    assert np.isfinite(out.flux).all()
    assert np.abs(out.flux[:2]).max() < 3.0


def test_locks_on_either_direction() -> None:
    for w in (60.0, -60.0):
        machine = Rotating(M1, w, 0.0, 1.0)
        out = Estimator(M1, 5000.0, settings(M1, 20.0, 10.0, (0.5, 2.0))).process(
            machine.samples(5000.0, 10_000))
        error = degrees_between(out.angle[0], machine.theta(np.arange(10_000) / 5000.0))
        assert np.abs(error[1800:]).max() < 2.0
        assert np.abs(error[-1000:]).max() < 0.01
        assert out.angle[2, -1] == pytest.approx(w, abs=0.01)


def test_wrong_saliency_sign_is_worse() -> None:
    """l = psi_m L_0 matters: an observer told L_d and L_q the wrong way round misses the angle."""
    machine = Rotating(M2, 60.0, 0.0, 2.3)
    samples = machine.samples(5000.0, 20_000)
    truth = machine.theta(np.arange(20_000) / 5000.0)
    right = Estimator(M2, 5000.0, settings(M2, 10.0, 0.5)).process(samples)
    swapped = replace(M2, L_d=M2.L_q, L_q=M2.L_d)
    wrong = Estimator(swapped, 5000.0, settings(M2, 10.0, 0.5)).process(samples)
    assert np.abs(degrees_between(right.angle[0], truth)[-2000:]).max() < 0.05
    assert np.abs(degrees_between(wrong.angle[0], truth)[-2000:]).min() > 0.5
