"""A machine turning with given dq currents, in closed form: the tests' independent source of samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.motor import Motor


@dataclass(frozen=True)
class Rotating:
    """Constant electrical speed w [rad/s], constant i_d, i_q [A peak], angle theta_0 at t = 0."""

    motor: Motor
    w: float
    i_d: float = 0.0
    i_q: float = 1.0
    theta_0: float = 0.3

    def theta(self, t: NDArray[np.float64] | float) -> NDArray[np.float64]:
        return np.asarray(self.w * np.asarray(t) + self.theta_0)

    def current(self, t: NDArray[np.float64] | float) -> NDArray[np.complex128]:
        return np.asarray((self.i_d + 1j * self.i_q) * np.exp(1j * self.theta(t)))

    def flux(self, t: NDArray[np.float64] | float) -> NDArray[np.complex128]:
        m = self.motor
        return np.asarray((m.L_d * self.i_d + m.psi_m + 1j * m.L_q * self.i_q) * np.exp(1j * self.theta(t)))

    def active_flux(self, t: NDArray[np.float64] | float) -> NDArray[np.complex128]:
        return np.asarray(self.flux(t) - self.motor.L_q * self.current(t))

    def voltage(self, t: float) -> complex:
        return complex(1j * self.w * self.flux(t) + self.motor.R * self.current(t))

    def samples(self, sample_rate: float, n: int) -> NDArray[np.float64]:
        """float64 (4, n): currents at t_k = k/sample_rate, exact mean voltage of the interval before."""
        t = np.arange(n) / sample_rate
        flux, i = self.flux(t), self.current(t)
        mean_i = np.diff(i) / (1j * self.w) * sample_rate
        v = np.concatenate([[0.0], np.diff(flux) * sample_rate + self.motor.R * mean_i])
        return np.ascontiguousarray([i.real, i.imag, v.real, v.imag])


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """a - b [rad] as the shortest way round, in degrees."""
    return np.degrees((a - b + np.pi) % (2.0 * np.pi) - np.pi)
