"""The covariance of `riccati`, flux first and then the voltage's errors: corrected, limited, looked at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.common import FLUX_STATES
from ipmsm_can.estimation.observers.voltage_errors import BIASES

Floats = NDArray[np.float64]

ANGLE_KNOWN = 0.1
"""Variance of the angle [rad^2] below which d and the voltage errors are taken at the estimate."""


@kernel
def across(P: Floats, x_a: float, x_b: float) -> float:
    """Variance of the flux [Wb^2] across x."""
    total = x_b * x_b * P[0, 0] - 2.0 * x_a * x_b * P[0, 1] + x_a * x_a * P[1, 1]
    return float(max(total, 0.0) / (x_a * x_a + x_b * x_b))


@kernel
def angle_sigma(P: Floats, x_a: float, x_b: float, i_q2: float, p: Any) -> float:
    """1-sigma of the angle of x_hat [rad electrical]; i_q2: the current across it, squared [A^2]."""
    saturated = p.saturated * i_q2 * math.sqrt(i_q2) / (p.rated * p.rated * p.rated)
    spread2 = (p.spread_L * p.spread_L + saturated * saturated) * i_q2
    total = across(P, x_a, x_b) + p.L_q * p.L_q * (p.noise * p.noise + spread2)
    return float(math.sqrt(total / (x_a * x_a + x_b * x_b)))


@kernel
def voltage_variance(P: Floats, unit: Floats) -> float:
    """Variance [V^2], both axes together, of what the voltage's errors make of F[v]."""
    total = 0.0
    for j in range(BIASES):
        for m in range(j + 1):
            total += (1.0 if m == j else 2.0) * P[2 + j, 2 + m] * (
                unit[j, 0] * unit[m, 0] + unit[j, 1] * unit[m, 1])
    return float(max(total, 0.0))


@kernel
def correct(P: Floats, h: Floats, Ph: Floats, noise: float) -> float:
    """Take a measurement with the row h and the variance `noise` into P; Ph becomes the gain; returns h^T P h.

    P - P h h^T P/(h^T P h + r) is Joseph's form multiplied out for the optimal gain; that h^T P h is not taken
    below zero keeps P from being corrected by more than there is.
    """
    seen = 0.0
    for a in range(FLUX_STATES):
        row = 0.0
        for b in range(FLUX_STATES):
            row += P[a, b] * h[b]
        Ph[a] = row
        seen += row * h[a]
    seen = max(seen, 0.0)
    total = seen + noise
    for a in range(FLUX_STATES):
        for b in range(a, FLUX_STATES):
            P[a, b] -= Ph[a] * Ph[b] / total
            P[b, a] = P[a, b]
        P[a, a] = max(P[a, a], 0.0)
    for a in range(FLUX_STATES):
        Ph[a] /= total
    return seen


@kernel
def limit(P: Floats, ceiling: float) -> None:
    """Nothing is known of a direction whose variance reaches the ceiling; without one P would grow for ever."""
    largest = max(P[0, 0], P[1, 1])
    if largest > ceiling:
        shrink = math.sqrt(ceiling / largest)
        for a in range(2):
            for b in range(FLUX_STATES):
                P[a, b] *= shrink
                P[b, a] *= shrink
