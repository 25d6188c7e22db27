"""What a window of samples at standstill says of the rotor: its axis, and which end of the axis is north.

Over a window the flux behind the resistance, lambda = sum T_s (v - R i) from the window's start, and the current
are fitted to each other by least squares.  Nothing else about the probing signal has to be known, neither its
waveform nor its frequency, and it may rise and fall meanwhile; tau, time, takes up what a constant voltage error
makes of lambda.

Axis, with complex space vectors as in `observers.probing`, a = L_s/(L_d L_q) from the motor's data:

    i - a lambda = c_0 + c_1 tau + b conj(lambda),    b = -(L_0/2) exp(2j theta)/(L_d L_q),    theta modulo pi

L_s and L_0 are not known exactly.  An error da of a adds da times the share of the flux that swings along one
line, M = sum lambda^2/sum |lambda|^2, to b: nothing while the probing signal rotates, but pulses beside the axis,
as they are where the rotor turns meanwhile, turn the axis seen by as much again.  How long b is tells da, as far as
L_0 is known better; what is left of da is part of the 1-sigma.

North, with the parts of current and flux along that axis: flux along +d adds to the magnet's and drives the iron
into saturation, flux along -d relieves it, so the d current is a bent function of the d flux,

    i = c_0 + c_1 tau + c_2 f + c_3 f^2

and a positive c_3 says that the axis points north.  Resistance, inductance and dead time err odd in f and leave
c_3 alone; a shift of f or i leaves it alone as well.  The windows' c_3 are averaged by their variances, from the
residual or the sensor's noise, whichever is more, times the scatter of the windows where that is more than it
should be.  As a number without a unit:

    asymmetry A = 2 c_3 L_d (L_d I)        the change of 1/L_d from no flux to that of the current I, in shares

Decision: |A| beyond SIGNIFICANT standard deviations and beyond LEAST_ASYMMETRY, below which wrong samples rather
than iron may be at work.  Equal once the standard deviation is so small (RESOLVED) that an asymmetry worth the
name would have shown: a machine with linear magnetics answers equally, and nothing at standstill can tell its
north from its south.
"""

from __future__ import annotations

import cmath
import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.motor import Motor

SIGNIFICANT = 6.0
"""Standard deviations: one wrong decision in 5e8 on Gaussian noise."""
LEAST_ASYMMETRY = 0.03
RESOLVED = 0.005
LEAST_WINDOWS = 4
MOST_WINDOWS = 24
"""An asymmetry that only more windows than these bring out of the noise is as likely one of the samples."""
_TERMS = 4
_ALIEN = 2.5
"""How far the saliency seen may be off the motor's, either way, for the axis to be believed."""
_ASTRAY = 0.3
"""Swing of the flux across the axis, as a share of that along it, beyond which a window does not count: with the
other waveforms the flux across saturates the axis most where that along it is least."""

STATE = np.dtype([
    ("T_s", "f8"), ("R", "f8"), ("mean", "f8"), ("difference", "f8"), ("mean_spread", "f8"), ("unit", "f8"),
    ("n", "i8"),
    # pulse axis as a unit vector
    ("axis", "c16"),
    ("count", "i8"), ("broken", "i8"), ("started", "i8"),
    ("i", "c16"), ("first", "c16"), ("flux", "c16"), ("sum", "c16"),
    # normal equations of the axis and of the bend
    ("axis_normal", "c16", (3, 3)), ("axis_right", "c16", (3,)), ("axis_square", "f8"),
    ("line_square", "c16"), ("line_sum", "c16"),
    ("normal", "f8", (_TERMS, _TERMS)), ("right", "f8", (_TERMS,)), ("square", "f8"),
    # swing of the flux along and across, largest current and voltage
    ("along_low", "f8"), ("along_high", "f8"), ("across_low", "f8"), ("across_high", "f8"),
    ("peak", "f8"), ("voltage", "f8"),
])
_OF_A_WINDOW = STATE.names[STATE.names.index("flux"):] if STATE.names else ()


class Verdict(IntEnum):
    """What the answer to the pulses says so far: the sign is that of the axis against the north pole."""

    SOUTH = -1
    OPEN = 0
    NORTH = 1
    EQUAL = 2


def new_state(motor: Motor, sample_rate: float, unit: float, n: int, spread: float = 0.0) -> NDArray[np.void]:
    """Record array (1,) of STATE; sample_rate [Hz]; unit: flux [Wb] that f is counted in; n: of a window; spread:
    1-sigma of L_d and of L_q as a share of them."""
    state = np.zeros(1, STATE)
    product = motor.L_d * motor.L_q
    for name, value in {"T_s": 1.0 / sample_rate, "R": motor.R, "mean": motor.L_s / product,
                        "difference": 0.5 * motor.L_0 / product, "unit": unit, "n": n, "axis": 1.0,
                        "mean_spread": 0.5 * spread * math.hypot(1.0 / motor.L_d, 1.0 / motor.L_q),
                        }.items():
        state[name] = value
    return state


def begin_window(state: NDArray[np.void]) -> None:
    """Empty the sums: the next sample is the first of a window."""
    for name in ("count", "broken", *_OF_A_WINDOW):
        state[name] = 0


@kernel
def window_block(samples: NDArray[np.float64], filled: NDArray[np.uint8], state: NDArray[np.void]) -> None:
    """Add samples to the window; the caller sees to it that there are never more than are missing in it.

    samples: float64 (4, N), as for the regression.  filled: uint8 (N,), 1 where a sample is only interpolated: the
    window then says nothing, for nobody knows what the voltage was.
    """
    st = state[0]
    row = np.empty(_TERMS)
    axis_row = np.empty(3, np.complex128)
    row[0] = 1.0
    axis_row[0] = 1.0
    back = st.axis.conjugate()
    for k in range(samples.shape[1]):
        i = complex(samples[0, k], samples[1, k])
        v = complex(samples[2, k], samples[3, k])
        if st.count == 0:
            st.first = i
        else:
            st.flux += st.T_s * (v - 0.5 * st.R * (st.i + i)) / st.unit
        st.i = i
        st.sum += i
        st.broken |= filled[k]
        st.peak = max(st.peak, abs(i))
        st.voltage = max(st.voltage, abs(v))
        tau = st.count / st.n - 0.5
        st.count += 1

        y = i - st.mean * st.unit * st.flux
        axis_row[1] = tau
        axis_row[2] = st.flux.conjugate()
        for r in range(3):
            for c in range(3):
                st.axis_normal[r, c] += axis_row[r].conjugate() * axis_row[c]
            st.axis_right[r] += axis_row[r].conjugate() * y
        st.line_square += st.flux * st.flux
        st.line_sum += st.flux
        st.axis_square += y.real * y.real + y.imag * y.imag

        along = (st.flux * back).real
        across = (st.flux * back).imag
        st.along_low = min(st.along_low, along)
        st.along_high = max(st.along_high, along)
        st.across_low = min(st.across_low, across)
        st.across_high = max(st.across_high, across)
        current = (i * back).real
        row[1] = tau
        row[2] = along
        row[3] = along * along
        for r in range(_TERMS):
            for c in range(_TERMS):
                st.normal[r, c] += row[r] * row[c]
            st.right[r] += row[r] * current
        st.square += current * current


def axis(state: NDArray[np.void], noise: float) -> tuple[float, float]:
    """(angle modulo pi, its 1-sigma) [rad electrical] of a full window; noise [A rms], of the sensor.

    (0, inf) where the window has nothing to say, or shows a saliency that is not the motor's.
    """
    st = state[0]
    n, model = int(st["count"]), abs(float(st["difference"])) * float(st["unit"])
    if st["broken"] or n <= _TERMS or model == 0.0:
        return 0.0, math.inf
    try:
        inverse = np.linalg.inv(st["axis_normal"])
    except np.linalg.LinAlgError:
        return 0.0, math.inf
    fit = inverse @ st["axis_right"]
    left_over = (float(st["axis_square"]) - float((np.conj(st["axis_right"]) @ fit).real)) / (2 * (n - 3))
    variance = max(noise * noise, left_over) * float(inverse[2, 2].real)
    b = complex(fit[2])
    if not (math.isfinite(variance) and variance > 0.0 and 1.0 / _ALIEN < abs(b) / model < _ALIEN):
        return 0.0, math.inf
    b, doubt = _cleared(b, model, st)
    sigma = 0.5 * math.hypot(math.sqrt(variance) / model, doubt)
    return 0.5 * cmath.phase(b if st["difference"] < 0.0 else -b), sigma


def _cleared(b: complex, model: float, st: Any) -> tuple[complex, float]:
    """b without what a wrong L_s makes of a flux that swings along one line, and the 1-sigma of twice the angle
    [rad] that this leaves.  a and |b| are wrong by the same 1-sigma, as 1/L_d and 1/L_q are (half of their sum and
    of their difference)."""
    spread = float(st["mean_spread"]) * float(st["unit"])
    count, mean = float(st["axis_normal"][0, 0].real), complex(st["line_sum"])
    swing = float(st["axis_normal"][2, 2].real) - abs(mean) ** 2 / count
    if not (spread > 0.0 and swing > 0.0):
        return b, 0.0
    line = (complex(st["line_square"]) - mean * mean / count) / swing
    line *= min(1.0, 1.0 / max(abs(line), 1e-12))
    seen = (line * b.conjugate()).real / abs(b)
    cleared = b - seen * (abs(b) - model) / (1.0 + seen * seen) * line
    across = abs((line * cleared.conjugate()).imag) / max(abs(cleared), 1e-12)
    return cleared, across * spread / (math.sqrt(1.0 + seen * seen) * max(abs(cleared), 0.5 * model))


def load(state: NDArray[np.void]) -> float:
    """Mean current [A peak] of a full window, over whole periods of the pulses: what the drive's control holds."""
    st = state[0]
    return abs(complex(st["sum"])) / max(int(st["count"]), 1)


def back_emf(state: NDArray[np.void], theta: float, motor: Motor) -> complex:
    """Mean voltage [V] of a full window that neither resistance nor inductance explains, with the axis at theta."""
    st = state[0]
    di = complex(st["i"] - st["first"])
    own = motor.L_s * di + 0.5 * motor.L_0 * cmath.exp(2j * theta) * di.conjugate()
    return complex((st["unit"] * st["flux"] - own) / (st["T_s"] * (st["count"] - 1)))


def curvature(state: NDArray[np.void], noise: float) -> tuple[float, float]:
    """(c_3, its variance) of a full window, per square of the flux unit [A, A^2]; noise [A rms], of the sensor.

    (0, inf) where the window has nothing to say.
    """
    st = state[0]
    n = int(st["count"])
    if st["broken"] or n <= _TERMS:
        return 0.0, math.inf
    if st["across_high"] - st["across_low"] > _ASTRAY * (st["along_high"] - st["along_low"]):
        return 0.0, math.inf
    normal, right = st["normal"], st["right"]
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return 0.0, math.inf
    fit = inverse @ right
    left_over = float(st["square"] - right @ fit) / (n - _TERMS)
    variance = max(noise * noise, left_over) * float(inverse[3, 3])
    if not (math.isfinite(float(fit[3])) and math.isfinite(variance) and variance > 0.0):
        return 0.0, math.inf
    return float(fit[3]), variance


class Evidence:
    """The windows' curvatures, averaged by their variances.

    motor: its L_d, R; current: the current I [A peak] that the asymmetry is counted for.
    """

    def __init__(self, motor: Motor, current: float) -> None:
        self.unit = motor.L_d * current
        """Flux [Wb] that the curvatures must be counted in."""
        self._scale = 2.0 / current
        self.forget()

    def forget(self) -> None:
        """Start from nothing."""
        self.windows = 0
        self._weight = self._sum = self._squares = 0.0

    def add(self, curvature: float, variance: float) -> None:
        """Take in a window, as `curvature` gives it."""
        if not math.isfinite(variance):
            return
        self.windows += 1
        self._weight += 1.0 / variance
        self._sum += curvature / variance
        self._squares += curvature * curvature / variance

    @property
    def asymmetry(self) -> float:
        """a, without a unit; 0 before the first window."""
        return self._scale * self._sum / self._weight if self._weight else 0.0

    @property
    def sigma(self) -> float:
        """Standard deviation of the asymmetry; inf before the second window."""
        if self.windows < 2:
            return math.inf
        scatter = (self._squares - self._sum**2 / self._weight) / (self.windows - 1)
        return self._scale * math.sqrt(max(scatter, 1.0) / self._weight)

    @property
    def verdict(self) -> Verdict:
        """What can be said by now."""
        if self.windows < LEAST_WINDOWS:
            return Verdict.OPEN
        a, sigma = self.asymmetry, self.sigma
        if abs(a) > max(SIGNIFICANT * sigma, LEAST_ASYMMETRY):
            if self.windows > MOST_WINDOWS:
                return Verdict.OPEN
            return Verdict.NORTH if a > 0.0 else Verdict.SOUTH
        return Verdict.EQUAL if sigma < RESOLVED else Verdict.OPEN
