"""What may be wrong with the reported voltage, as signals that `riccati` can weigh: seven states and their priors.

    v_true = v_reported + sum over j < SUMMED of b_j B_j(t)
    B_0, B_1   the alpha and the beta axis: a lasting offset b [V] of the voltage or, through R, of a sensor
    B_2        against the current, phase by phase: dead time, b [V] lost by each phase.  It stands still in the
               rotor's frame for a whole half-period of each phase, so it is no noise: it is one unknown number
    B_3        -i: an error b [ohm] of the resistance
    B_4        B_2 with its corner at the largest current that it may have, less B_2 with it at the smallest: how
               much of the dead time begins later.  A wrong corner makes harmonics of the rotor's frequency, which
               B_2 alone would answer with a wrong dead time
    B_5, B_6   an offset b [A] of the current sensors, alpha and beta: B_2 and B_4 are those of the current less the
               offset, and these the derivative, -d(b_2 B_2 + b_4 B_4)/di.  At rest that looks like B_0 and B_1, but
               it goes once a current flows, and without it the filter would call the dead time at rest nothing

Each b is a Gauss-Markov process: its variance never exceeds its prior, and what nothing tells apart falls back to
zero with the time constant.  So no rule is needed for what to adapt: the filter moves a state as far as the samples
carry information against its prior variance, and a state whose prior is zero stays zero.

An error of the voltage stands in the regression as well.  With e = F[B_j] and F, H of Lemma 1, F' = 1/(p + alpha),

    y - Phi^T x - d = b n + b^2 (|e|^2 + F[|e|^2])/alpha,
    n = 2 e^T (x - (Omega_1 + b e)/alpha) - L_0 F[i]^T e - F'[(Phi + 2 b e)^T e]

which is Lemma 1 with Omega_1 + b e and Omega_2 + b e in place of Omega_1 and Omega_2, b constant: exact, and n its
derivative by b.  With several, b e is their sum.  Near standstill the dead time is as large as the back-EMF, and
the square decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.motor import Motor

BIASES = 7
SUMMED = 5
"""How many of them, from the first on, v_true is the sum of; the others move the current behind B_2 and B_4."""
OFFSET_SHARE = 0.2
"""Lasting offset as a share of `voltage_uncertainty`, which dead time has for itself."""
RESIDUAL_SHARE = 0.1
"""What none of these describes, as a share of `voltage_uncertainty`: dead time has corners that B_2 rounds."""
_KEEPS = (10.0, 10.0, 10.0, 30.0, 10.0, 30.0, 30.0)
"""Time constants [s]: temperature moves all of them."""
TILT = 3.0
"""That angle [rad electrical] over the share by which L_d falls at rated current, as `drive.magnetics` has it."""
CORNER_SHARE = 0.2
"""Phase current, as a share of the rated current, up to which the shape of dead time is uncertain: the output
capacitances turn the step of the ideal inverter into a ramp, and the current ripple blurs it.  At most CORNER_NOISE
times the current noise."""
CORNER_NOISE = 20.0
CORNER_PRIOR = 0.6
"""1-sigma of B_4 as a share of the dead time's."""
OFF = 1.0
"""What a wrong current makes of a phase at zero current, over what the rest of the shape makes elsewhere."""
SENSOR_OFFSET = 0.75
"""1-sigma of a current sensor's offset, per axis, over its noise."""
SATURATED = 0.5
"""1-sigma of the share by which rated current across the axis lowers L_q, the flux over the current, over the share
by which L_d falls at rated current along it; with the cube of the current below, as `drive.magnetics` has it."""
_HALF_SQRT3 = 0.5 * math.sqrt(3.0)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """What is not known exactly, 1-sigma: voltage [V], current noise [A rms], shares of R and of L_d and L_q.

    adapt_voltage, adapt_resistance: whether the error is a state; else it is noise, of CORRELATION_TIME.
    """

    voltage: float = 0.5
    current: float = 0.02
    resistance: float = 0.12
    inductance: float = 0.06
    adapt_voltage: bool = True
    adapt_resistance: bool = True
    saturation: float = 0.2

    @property
    def tilt(self) -> float:
        """1-sigma [rad electrical] of the angle between the rotor and the axis of saliency at rated current."""
        return TILT * self.saturation

    @property
    def saturated(self) -> float:
        """1-sigma of the share by which L_q is lower at rated current than at none."""
        return SATURATED * self.saturation

    def priors(self, motor: Motor) -> tuple[float, ...]:
        """Prior variances of the seven states [V^2, V^2, V^2, ohm^2, V^2, A^2, A^2]."""
        offset = (OFFSET_SHARE * self.voltage) ** 2 if self.adapt_voltage else 0.0
        dead_time = self.voltage**2 if self.adapt_voltage else 0.0
        resistance = (self.resistance * motor.R) ** 2 if self.adapt_resistance else 0.0
        sensor = (SENSOR_OFFSET * self.current) ** 2 if self.adapt_voltage else 0.0
        return offset, offset, dead_time, resistance, CORNER_PRIOR**2 * dead_time, sensor, sensor

    @property
    def residual(self) -> float:
        """1-sigma [V] of the voltage error that is noise and no state."""
        return RESIDUAL_SHARE * self.voltage if self.adapt_voltage else self.voltage

    def residual_resistance(self, motor: Motor) -> float:
        """1-sigma [ohm] of the resistance error that is no state."""
        return 0.0 if self.adapt_resistance else self.resistance * motor.R

    def dead_zone(self, motor: Motor) -> float:
        """Phase current [A] below which a phase's sign is not relied on: the least corner of dead time."""
        return 4.0 * self.current

    def corner(self, motor: Motor) -> float:
        """Phase current [A] up to which the shape of dead time is uncertain.

        A sensor's noise goes with the size of its inverter, and so do the output capacitances.
        """
        return max(self.dead_zone(motor), min(CORNER_SHARE * motor.rated_current, CORNER_NOISE * self.current))


def keeps(sample_rate: float) -> tuple[float, ...]:
    """Factors by which the states fall back to zero in one sample."""
    return tuple(math.exp(-1.0 / (sample_rate * t)) for t in _KEEPS)


@kernel
def _clipped(x: float) -> float:
    return min(1.0, max(-1.0, x))


@kernel
def directions(i_a: float, i_b: float, zone: float, B: NDArray[np.float64]) -> None:
    """Write B_2 and B_3 of an interval with the mean current i [A] into rows 2 and 3 of B (4, 2)."""
    phase_a = _clipped(i_a / zone)
    phase_b = _clipped((-0.5 * i_a + _HALF_SQRT3 * i_b) / zone)
    phase_c = _clipped((-0.5 * i_a - _HALF_SQRT3 * i_b) / zone)
    B[2, 0] = -(2.0 * phase_a - phase_b - phase_c) / 3.0
    B[2, 1] = -(phase_b - phase_c) * _HALF_SQRT3 / 1.5
    B[3, 0] = -i_a
    B[3, 1] = -i_b


@kernel
def rounded(i_a: float, i_b: float, corner: float, B: NDArray[np.float64]) -> None:
    """Write B_4 once B_2 is there: dead time with its corner at `corner` [A], less B_2."""
    phase_a = _clipped(i_a / corner)
    phase_b = _clipped((-0.5 * i_a + _HALF_SQRT3 * i_b) / corner)
    phase_c = _clipped((-0.5 * i_a - _HALF_SQRT3 * i_b) / corner)
    B[4, 0] = -(2.0 * phase_a - phase_b - phase_c) / 3.0 - B[2, 0]
    B[4, 1] = -(phase_b - phase_c) * _HALF_SQRT3 / 1.5 - B[2, 1]


@kernel
def shifted(i_a: float, i_b: float, zone: float, corner: float, dead: float, late: float,
            B: NDArray[np.float64]) -> None:
    """Write B_5 and B_6: -d(dead B_2 + late B_4)/di.

    dead, late: the states of B_2 and B_4 [V]; arguments as for `directions` and `rounded`.
    """
    a = _slope(i_a, zone, corner, dead, late)
    b = _slope(-0.5 * i_a + _HALF_SQRT3 * i_b, zone, corner, dead, late)
    c = _slope(-0.5 * i_a - _HALF_SQRT3 * i_b, zone, corner, dead, late)
    B[5, 0] = (4.0 * a + b + c) / 6.0
    B[5, 1] = (c - b) * _HALF_SQRT3 / 3.0
    B[6, 0] = B[5, 1]
    B[6, 1] = 0.5 * (b + c)


@kernel
def _slope(phase: float, zone: float, corner: float, dead: float, late: float) -> float:
    """By how much [V/A] what a phase loses grows with its current."""
    size = abs(phase)
    return ((dead - late) / zone if size < zone else 0.0) + (late / corner if size < corner else 0.0)


@kernel
def near_zero(i_a: float, i_b: float, zone: float, corner: float) -> tuple[float, float]:
    """Squares of the voltage vector [V^2] that an error of 1 V makes in each phase whose current is near zero.

    What a phase loses is odd in its current: at zero nobody doubts that it is nothing.  So its share rises up to
    `zone`, the corner that B_2 assumes, and falls to 0 at the latest possible one, `corner` [A].  The second: what
    a wrong current makes, as long as it is no state, within `zone`.  The phases' errors are independent.
    """
    shape = 0.0
    off = 0.0
    for phase in (i_a, -0.5 * i_a + _HALF_SQRT3 * i_b, -0.5 * i_a - _HALF_SQRT3 * i_b):
        share = min(abs(phase) / zone, 1.0) * max(0.0, 1.0 - abs(phase) / corner)
        slope = max(0.0, 1.0 - abs(phase) / zone)
        shape += share * share
        off += slope * slope
    return 4.0 / 9.0 * shape, 4.0 / 9.0 * OFF * OFF * off


@kernel
def predict(P: NDArray[np.float64], B: NDArray[np.float64], T_s: float, keep: NDArray[np.float64],
            prior: NDArray[np.float64], process: float) -> None:
    """P (9, 9) of (lambda, b) over one interval: lambda += T_s B b, b *= keep; process: growth of lambda [Wb^2].

    P becomes F P F^T + Q, symmetric to the last bit.
    """
    for a in range(2):
        for j in range(BIASES):
            moved = 0.0
            for m in range(BIASES):
                moved += B[m, a] * P[2 + m, 2 + j]
            # The flux's own part needs the mean of the covariance before and after; column j + 2 holds both.
            P[a, 2 + j] += 0.5 * T_s * moved
            P[2 + j, a] = moved
    for a in range(2):
        for b in range(a, 2):
            grown = 0.0
            for j in range(BIASES):
                grown += P[a, 2 + j] * B[j, b] + P[b, 2 + j] * B[j, a]
            P[a, b] += T_s * grown
            P[b, a] = P[a, b]
        P[a, a] += process
    for a in range(2):
        for j in range(BIASES):
            P[a, 2 + j] = keep[j] * (P[a, 2 + j] + 0.5 * T_s * P[2 + j, a])
    for j in range(BIASES):
        P[2 + j, 0] = P[0, 2 + j]
        P[2 + j, 1] = P[1, 2 + j]
        for m in range(BIASES):
            P[2 + j, 2 + m] *= keep[j] * keep[m]
        P[2 + j, 2 + j] += (1.0 - keep[j] * keep[j]) * prior[j]
