"""The rotor's axis from a probing signal, shared by `injection_extraction` and `injection_demodulation`.

With i and lambda as complex space vectors, the salient machine's i = L^-1(theta) (lambda - psi_m c(theta)) gives
for the part at the probing frequency, while the rotor hardly turns,

    i_h = a lambda_h + b conj(lambda_h),     a = L_s/(L_d L_q),     b = -(L_0/2) exp(2j theta)/(L_d L_q)

Split into sequences, lambda_h = P exp(j w_h t) + N exp(-j w_h t): i_P = a P + b conj(N), i_N = a N + b conj(P).
The flux comes from its increments T_s (v - R i), which the drive reports, at the same frequency:
D_P = P (1 - exp(-j w_h T_s)), exact between samples.  So neither the amplitude nor the phase nor the axis of the
probing signal has to be known, only its frequency.

theta is known modulo pi; the branch nearest to the last angle is taken, so the angle is continuous.

Its 1-sigma is half the angle of what the currents have beside the model, (i_P, i_N) minus the model with the best
theta, together with the current noise in the averages, as seen from b |lambda_h|.  Above a right angle's half
nothing is known: pi.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

_UNKNOWN_ABOVE = math.pi / 4.0


@kernel
def flux_from_increments(d_p: complex, d_n: complex, half_cot: float) -> tuple[complex, complex]:
    """(P, N) [Wb] of the flux from those of its increments per sample; half_cot = cot(w_h T_s / 2)/2."""
    # 1/(1 - exp(-j x)) = 1/2 - (j/2) cot(x/2)
    to_flux = complex(0.5, -half_cot)
    return d_p * to_flux, d_n * to_flux.conjugate()


@kernel
def axis_sigma(b: complex, i_p: complex, i_n: complex, flux_p: complex, flux_n: complex, mean: float,
               difference: float, noise: float) -> float:
    """1-sigma [rad] of arg(b)/2, pi = unknown; currents [A], fluxes [Wb], mean = a, |difference| = |b| in 1/H,
    noise: 1-sigma of each component of an averaged current [A]."""
    size = abs(b)
    signal = abs(difference) * math.sqrt(abs(flux_p) ** 2 + abs(flux_n) ** 2)
    if not (size > 0.0 and signal > 0.0):
        return math.pi
    model = b * (abs(difference) / size)
    off_p = abs(i_p - mean * flux_p - model * flux_n.conjugate())
    off_n = abs(i_n - mean * flux_n - model * flux_p.conjugate())
    sigma = 0.5 * math.sqrt(off_p * off_p + off_n * off_n + noise * noise) / signal
    if not sigma < _UNKNOWN_ABOVE:
        return math.pi
    return sigma


@kernel
def put_axis(b: complex, sigma: float, i_a: float, i_b: float, p: Any, st: Any,
             out: NDArray[np.float64], k: int) -> None:
    """Write row k: the flux of a magnet along the axis nearest to the last angle; p, st: single records.

    Where nothing is known the last angle stands, and before the first no flux at all.
    """
    theta = st.theta
    if sigma < math.pi:
        axis = 0.5 * cmath.phase(b if p.difference < 0.0 else -b)
        theta = axis + math.pi * math.floor((theta - axis) / math.pi + 0.5)
        # Kept near zero: a whole turn changes neither the output nor the nearest branch.
        theta -= 2.0 * math.pi * math.floor((theta + math.pi) / (2.0 * math.pi))
        st.theta = theta
        st.known = 1
    size = p.psi_m if st.known else 0.0
    x_a = size * math.cos(theta)
    x_b = size * math.sin(theta)
    st.x_a = x_a
    st.x_b = x_b
    out[0, k] = x_a + p.L_q * i_a
    out[1, k] = x_b + p.L_q * i_b
    out[2, k] = x_a
    out[3, k] = x_b
    out[4, k] = 0.0
    out[5, k] = sigma
