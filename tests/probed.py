"""A salient machine at an imposed speed that is probed, integrated finely: samples for the injection observers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]


def locked_rotor(motor: Motor, theta: float, v: NDArray[np.complex128], rate: float) -> Floats:
    """float64 (4, n) of a rotor held at theta [rad], from no current, for voltages v (n,) held over each interval.

    d and q axis are an R-L circuit each, solved exactly.
    """
    v_dq = v * np.exp(-1j * theta)
    decay_d, decay_q = np.exp(-motor.R / motor.L_d / rate), np.exp(-motor.R / motor.L_q / rate)
    i_dq = np.zeros(v.size + 1, complex)
    for k in range(v.size):
        i_dq[k + 1] = complex(decay_d * i_dq[k].real + (1 - decay_d) / motor.R * v_dq[k].real,
                              decay_q * i_dq[k].imag + (1 - decay_q) / motor.R * v_dq[k].imag)
    i = i_dq[1:] * np.exp(1j * theta)
    return np.ascontiguousarray([i.real, i.imag, v.real, v.imag])


def injection(kind: str, amplitude: float, frequency: float, rate: float, n: int) -> NDArray[np.complex128]:
    """Held voltages (n,) of a probing signal: "rotating" or "alpha" (sin(w_h t) on the alpha axis)."""
    phase = 2 * np.pi * frequency * (np.arange(n) + 0.5) / rate
    return np.asarray(amplitude * (np.exp(1j * phase) if kind == "rotating" else np.sin(phase) + 0j))


def turning(motor: Motor, w: float, i_q: float, probing: NDArray[np.complex128], rate: float,
            theta_0: float = 0.3) -> tuple[Floats, Floats]:
    """Samples (4, n) and angle (n,) of a rotor turning at w [rad/s electrical], fed for i_q [A] and probed.

    By DOP853 from interval to interval; the feeding voltage is that of the steady state, held at its mean.
    """
    n = probing.size
    flux_dq = motor.psi_m + 1j * motor.L_q * i_q
    lam = complex(flux_dq * np.exp(1j * theta_0))
    out = np.zeros((4, n))
    theta: Floats = np.asarray(w * np.arange(n) / rate + theta_0, np.float64)

    def current(flux: complex, angle: float) -> complex:
        x = flux * np.exp(-1j * angle)
        return complex(((x.real - motor.psi_m) / motor.L_d + 1j * x.imag / motor.L_q) * np.exp(1j * angle))

    i = current(lam, theta_0)
    out[:2, 0] = i.real, i.imag
    for k in range(1, n):
        middle = 0.5 * (theta[k - 1] + theta[k])
        fed = (1j * w * flux_dq + motor.R * 1j * i_q) * np.exp(1j * middle) * np.sinc(w / rate / 2 / np.pi)
        v = complex(fed + probing[k])

        def derivative(t: float, s: Floats, v: complex = v, begin: float = theta[k - 1]) -> list[float]:
            slope = v - motor.R * current(complex(s[0], s[1]), begin + w * t)
            return [slope.real, slope.imag]

        solution = solve_ivp(derivative, (0.0, 1.0 / rate), [lam.real, lam.imag], method="DOP853", rtol=1e-8,
                             atol=1e-11)
        lam = complex(solution.y[0, -1], solution.y[1, -1])
        i = current(lam, theta[k])
        out[:, k] = i.real, i.imag, v.real, v.imag
    return np.ascontiguousarray(out), theta


def axis_error(theta_hat: Floats, theta: Floats | float) -> Floats:
    """theta_hat - theta modulo half a turn, in degrees."""
    return np.asarray(np.degrees((theta_hat - theta + np.pi / 2) % np.pi - np.pi / 2))
