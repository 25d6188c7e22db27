"""The machine's one magnetic law: dq current of dq flux, linear or saturating.

Everything follows from one stored energy, of u = lambda_d - psi_m and q = lambda_q:

    W(u, q) = u^2/(2 L_d) + q^2/(2 L_q) + g (F(z) - F(0) - F'(0) z - F''(0) u^2/2),    z = u + q^2/(2 rho)
    i_d = dW/du = u/L_d + g (F'(z) - F'(0) - F''(0) u)
    i_q = dW/dq = q/L_q + g (F'(z) - F'(0)) q/rho
    F'(z) = ((z - k) + sqrt((z - k)^2 + k^2))/2

z is to first order by how much the length of the flux in the common iron exceeds the magnet's own; F' is a
smooth bend at the knee k, so iron that the magnet and a positive i_d drive beyond the knee gives way, and iron
that a negative i_d relieves hardly changes: north and south answer unequally.  q^2 in z is the cross-saturation.

Reciprocal: di_d/dlambda_q = di_q/dlambda_d, both being g F''(z) q/rho.  Passive: F is convex and rises, z is
convex, and 1/L_d > g F''(0), 1/L_q > g F'(0)/rho are checked, so W is strictly convex with its minimum, 0, at
zero current.  At zero current the inductances are L_d and L_q.

Chosen shape: the knee lies at half the flux of the rated current along d, and the rated current along q
saturates as much as the rated current along d.  Peak, amplitude-invariant, per phase; the co-energy of the
three phases is 1.5 times what W gives.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.motor import Motor

# Where the magnetic parameters stand in the machine's, float64
M_PSI = 1  # Wb
M_L_D = 2  # H
M_L_Q = 3  # H
M_GAIN = 7  # 1/H, 0 = linear
M_KNEE = 8  # Wb
M_RHO = 9  # Wb

_KNEE_SHARE = 0.5
_SLOPE_AT_ZERO = 0.5 * (1.0 - math.sqrt(0.5))
"""F''(0)."""
MOST_SATURATION = 0.5
"""Largest share by which L_d may fall at rated positive d current."""


def saturation_parameters(motor: Motor, saturation: float) -> tuple[float, float, float]:
    """(gain [1/H], knee [Wb], rho [Wb]) of a machine whose L_d falls by `saturation` at rated positive i_d.

    saturation: 0..0.5, of the incremental inductance dlambda_d/di_d at i_d = rated current, i_q = 0.
    Raises ValueError where it is out of range, or the machine would not be passive (L_d far above L_q).
    """
    if not 0.0 <= saturation <= MOST_SATURATION:
        raise ValueError(f"saturation is {saturation!r}; allowed is 0 to {MOST_SATURATION:g}")
    rated = motor.L_d * motor.rated_current
    knee = _KNEE_SHARE * rated
    rho = (motor.L_q * motor.rated_current) ** 2 / (2.0 * rated)
    if saturation == 0.0:
        return 0.0, knee, rho
    wanted = saturation / (1.0 - saturation)

    def relative_gain(u: float) -> float:
        return wanted / (_bend_slope(u, knee) - _SLOPE_AT_ZERO)

    def excess(u: float) -> float:
        bent = _bend(u, knee) - _bend(0.0, knee) - _SLOPE_AT_ZERO * u
        return float(u + relative_gain(u) * bent - rated)

    from scipy.optimize import brentq  # a third of what a command takes to start, and seldom needed

    gain = relative_gain(float(brentq(excess, 1e-9 * rated, rated, xtol=1e-15 * rated))) / motor.L_d
    if gain * _SLOPE_AT_ZERO * motor.L_d >= 1.0 or gain * _bend(0.0, knee) * motor.L_q >= rho:
        raise ValueError(f"saturation is {saturation!r}; allowed is less for a motor with L_d = {motor.L_d:g} H "
                         f"and L_q = {motor.L_q:g} H, which would not be passive")
    return gain, knee, rho


@kernel
def _bend(z: float, knee: float) -> float:
    """F'(z) [Wb]."""
    w = z - knee
    return 0.5 * (w + math.sqrt(w * w + knee * knee))


@kernel
def _bend_slope(z: float, knee: float) -> float:
    """F''(z), 0..1."""
    w = z - knee
    return 0.5 * (1.0 + w / math.sqrt(w * w + knee * knee))


@kernel
def current_from_flux(lambda_d: float, lambda_q: float, machine: NDArray[np.float64]) -> tuple[float, float]:
    """dq current [A] of the dq stator flux [Wb], magnet included."""
    u = lambda_d - machine[M_PSI]
    i_d = u / machine[M_L_D]
    i_q = lambda_q / machine[M_L_Q]
    gain = machine[M_GAIN]
    if gain > 0.0:
        knee = machine[M_KNEE]
        share = lambda_q / machine[M_RHO]
        more = _bend(u + 0.5 * share * lambda_q, knee) - _bend(0.0, knee)
        i_d += gain * (more - _SLOPE_AT_ZERO * u)
        i_q += gain * more * share
    return i_d, i_q


@kernel
def inverse_inductance(
    lambda_d: float, lambda_q: float, machine: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Incremental (di_d/dlambda_d, di_d/dlambda_q = di_q/dlambda_d, di_q/dlambda_q) [1/H] at a flux [Wb]."""
    dd = 1.0 / machine[M_L_D]
    dq = 0.0
    qq = 1.0 / machine[M_L_Q]
    gain = machine[M_GAIN]
    if gain > 0.0:
        knee = machine[M_KNEE]
        rho = machine[M_RHO]
        share = lambda_q / rho
        z = lambda_d - machine[M_PSI] + 0.5 * share * lambda_q
        slope = _bend_slope(z, knee)
        dd += gain * (slope - _SLOPE_AT_ZERO)
        dq = gain * slope * share
        qq += gain * (slope * share * share + (_bend(z, knee) - _bend(0.0, knee)) / rho)
    return dd, dq, qq


@kernel
def flux_from_current(i_d: float, i_q: float, machine: NDArray[np.float64]) -> tuple[float, float]:
    """dq stator flux [Wb] of the dq current [A]: the inverse of `current_from_flux`, by Newton's method.

    W is strictly convex, so there is exactly one; a step that does not lessen the error in current is halved.
    """
    lambda_d = machine[M_PSI] + machine[M_L_D] * i_d
    lambda_q = machine[M_L_Q] * i_q
    small = 1e-12 * (abs(i_d) + abs(i_q)) + 1e-15
    for _ in range(100):
        a, b = current_from_flux(lambda_d, lambda_q, machine)
        e_d = i_d - a
        e_q = i_q - b
        error = math.hypot(e_d, e_q)
        if error <= small:
            break
        dd, dq, qq = inverse_inductance(lambda_d, lambda_q, machine)
        determinant = dd * qq - dq * dq
        step_d = (qq * e_d - dq * e_q) / determinant
        step_q = (dd * e_q - dq * e_d) / determinant
        share = 1.0
        for _ in range(40):
            a, b = current_from_flux(lambda_d + share * step_d, lambda_q + share * step_q, machine)
            if math.hypot(i_d - a, i_q - b) < error:
                break
            share *= 0.5
        lambda_d += share * step_d
        lambda_q += share * step_q
    return lambda_d, lambda_q


def inductances(i_d: float, i_q: float, machine: NDArray[np.float64]) -> tuple[float, float, float]:
    """Incremental (L_dd, L_dq = L_qd, L_qq) [H] at the dq current [A]."""
    dd, dq, qq = inverse_inductance(*flux_from_current(i_d, i_q, machine), machine)
    determinant = dd * qq - dq * dq
    return qq / determinant, -dq / determinant, dd / determinant


def stored_energy(lambda_d: float, lambda_q: float, machine: NDArray[np.float64]) -> float:
    """W [J per phase, times 2/3 of the machine's] of the dq flux [Wb], 0 at zero current."""
    u = lambda_d - machine[M_PSI]
    knee, rho = float(machine[M_KNEE]), float(machine[M_RHO])
    z = u + lambda_q**2 / (2.0 * rho)

    def primitive(x: float) -> float:
        w = x - knee
        return 0.25 * (w * w + w * math.hypot(w, knee) + knee * knee * math.asinh(w / knee))

    bent = primitive(z) - primitive(0.0) - _bend(0.0, knee) * z - 0.5 * _SLOPE_AT_ZERO * u * u
    return float(u * u / (2.0 * machine[M_L_D]) + lambda_q**2 / (2.0 * machine[M_L_Q]) + machine[M_GAIN] * bent)
