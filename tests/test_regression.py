"""Lemma 1 against the machine it speaks about, and against its own differential equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ipmsm_can.estimation import regression
from ipmsm_can.motor import M1, M2, Motor
from tests.rotating import Rotating


def run(motor: Motor, alpha: float, rate: float, samples: np.ndarray) -> np.ndarray:
    out = np.empty((regression.ROWS, samples.shape[1]))
    regression.regression_block(samples, regression.parameters(motor, alpha, rate),
                                np.zeros(1, regression.STATE), out)
    return out


@pytest.mark.parametrize("motor", [M1, M2])
@pytest.mark.parametrize("alpha", [5.0, 200.0])
@pytest.mark.parametrize(("w", "i_d", "i_q"), [(60.0, 0.0, 2.0), (314.0, -1.5, 2.0), (-20.0, 1.0, -1.0)])
def test_identity_holds_from_the_first_sample(motor: Motor, alpha: float, w: float, i_d: float,
                                              i_q: float) -> None:
    """y = Phi^T x + d with the true x and d; i_d is constant, so d = 0 for ever after a clean start."""
    rate = 10_000.0
    machine = Rotating(motor, w, i_d, i_q)
    n = 3000
    out = run(motor, alpha, rate, machine.samples(rate, n))
    x = machine.active_flux(np.arange(n) / rate)
    phi = out[regression.PHI_A] + 1j * out[regression.PHI_B]
    residual = out[regression.Y] - (phi * x.conj()).real
    # Second order in T_s: of the size of (w T_s)^2 of the largest term, and nothing of the start-up.
    scale = np.abs(phi).max() * motor.psi_m
    assert np.abs(residual).max() < 2.0 * scale * (abs(w) + alpha) ** 2 / rate**2


def test_disturbance_is_minus_l_h_of_id() -> None:
    """With i_d in motion the residual of the identity is d = -l H[i_d], from an ODE solver."""
    motor, alpha, rate, n = M2, 50.0, 20_000.0, 4000
    t = np.arange(n) / rate
    theta = 100.0 * t + 0.1
    i_dq = 1.5 * (1 - np.cos(40.0 * t)) + 1j * 2.0 * np.sin(25.0 * t)
    turn = np.exp(1j * theta)
    i = i_dq * turn
    flux = (motor.L_d * i_dq.real + motor.psi_m + 1j * motor.L_q * i_dq.imag) * turn
    # Mean of R i over each interval by Simpson's rule on a grid twice as fine.
    tm = t[1:] - 0.5 / rate
    i_mid = (1.5 * (1 - np.cos(40.0 * tm)) + 1j * 2.0 * np.sin(25.0 * tm)) * np.exp(1j * (100.0 * tm + 0.1))
    mean_i = (i[1:] + 4 * i_mid + i[:-1]) / 6
    v = np.concatenate([[0], np.diff(flux) * rate + motor.R * mean_i])
    out = run(motor, alpha, rate, np.ascontiguousarray([i.real, i.imag, v.real, v.imag]))
    x = flux - motor.L_q * i
    phi = out[regression.PHI_A] + 1j * out[regression.PHI_B]
    d = out[regression.Y] - (phi * x.conj()).real
    filtered = solve_ivp(lambda s, f: alpha * (1.5 * (1 - np.cos(40.0 * s)) - f), (0, t[-1]), [0.0], t_eval=t,
                         rtol=1e-10, atol=1e-12, method="DOP853").y[0]
    expected = -motor.ell * alpha * (i_dq.real - filtered)
    assert np.abs(expected).max() > 0.05
    assert np.abs(d - expected).max() < 2e-3 * np.abs(expected).max()


def test_increment_is_the_flux() -> None:
    """The flux increments add up to lambda itself, to the curvature of i."""
    machine = Rotating(M2, 200.0)
    n, rate = 2000, 5000.0
    out = run(M2, 10.0, rate, machine.samples(rate, n))
    flux = machine.flux(np.arange(n) / rate)
    rebuilt = flux[0] + np.cumsum(out[regression.DL_A] + 1j * out[regression.DL_B])
    ripple = M2.R * 1.0 / 200.0 * (200.0 / rate) ** 2 / 12
    assert np.abs(rebuilt - flux).max() < 3 * ripple


def test_clean_start_ignores_the_first_voltage() -> None:
    """The voltage of the first sample belongs to an interval nobody saw."""
    samples = Rotating(M2, 60.0).samples(5000.0, 50)
    other = samples.copy()
    other[2:, 0] = 300.0
    assert np.array_equal(run(M2, 10.0, 5000.0, samples), run(M2, 10.0, 5000.0, other))
