"""The simulated inverter and its current sensors: what lies between the control and the machine.

The control sees the *commanded* voltage and the *measured* current; the machine sees neither exactly.
Three-phase quantities are a, b, c with the amplitude-invariant Clarke transformation and no zero sequence.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

_HALF_SQRT3 = 0.5 * math.sqrt(3.0)


@kernel
def limit_voltage(v_alpha: float, v_beta: float, v_max: float) -> tuple[float, float]:
    """The voltage [V peak] shortened to |v| <= v_max, direction kept."""
    magnitude = math.hypot(v_alpha, v_beta)
    if magnitude <= v_max:
        return v_alpha, v_beta
    scale = v_max / magnitude
    return v_alpha * scale, v_beta * scale


@kernel
def soft_sign(x: float) -> float:
    """-1 below -1, +1 above +1, and the smooth cubic (3x - x^3)/2 between."""
    if x >= 1.0:
        return 1.0
    if x <= -1.0:
        return -1.0
    return 0.5 * x * (3.0 - x * x)


@kernel
def dead_time_error(
    i_alpha: float, i_beta: float, voltage: float, zone: float
) -> tuple[float, float]:
    """Voltage error (alpha, beta) [V] that dead time adds to the commanded voltage: against the current.

    Each phase loses voltage * sign(i_phase), with the sign softened for |i_phase| < zone [A]; the
    space vector of three full phase errors has the length 4/3 voltage.
    """
    i_b = -0.5 * i_alpha + _HALF_SQRT3 * i_beta
    i_c = -0.5 * i_alpha - _HALF_SQRT3 * i_beta
    s_a = soft_sign(i_alpha / zone)
    s_b = soft_sign(i_b / zone)
    s_c = soft_sign(i_c / zone)
    return -voltage * (2.0 * s_a - s_b - s_c) / 3.0, -voltage * (s_b - s_c) * _HALF_SQRT3 / 1.5


def sensor_gain(gains: tuple[float, float, float]) -> NDArray[np.float64]:
    """What sensors of these gains in the phases a, b, c make of the current: float64 (4,), the matrix from
    (alpha, beta) to (alpha, beta) by rows; with equal gains it is that gain and no cross term."""
    a, b, c = gains
    cross = (c - b) / (4.0 * _HALF_SQRT3)
    return np.array([a - (2.0 * a - b - c) / 6.0, cross, cross, 0.5 * (b + c)])


@kernel
def measure_current(current: float, noise: float, offset: float, adc_step: float) -> float:
    """What the sensor says [A]: current, noise and offset, rounded to whole steps of the ADC (0: none)."""
    value = current + noise + offset
    if adc_step > 0.0:
        value = adc_step * math.floor(value / adc_step + 0.5)
    return value
