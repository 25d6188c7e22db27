"""Which end of a known axis is the magnet's north: the unequal answer of saturating iron, and how sure it is.

With the rotor at rest, flux along +d adds to the magnet's and drives the iron into saturation, flux along -d
relieves it, so the d current is a bent function of the d flux.  Over a window of n samples, whole periods of the
probing signal, the current along the axis is fitted by least squares to the flux behind the resistance,

    i = c_0 + c_1 tau + c_2 f + c_3 f^2,    f = sum T_s (v - R i) along the axis from the window's start

tau, time, takes up what a constant voltage error makes of f.  A positive c_3 says that the axis points north.
Resistance, inductance and dead time err odd in f and leave c_3 alone; a shift of f or i leaves it alone as well.
The windows' c_3 are averaged by their variances, from the residual or the sensor's noise, whichever is more, times
the scatter of the windows where that is more than it should be.  As a number without a unit:

    asymmetry a = 2 c_3 L_d (L_d I)        the change of 1/L_d from no flux to that of the current I, in shares

Decision: |a| beyond SIGNIFICANT standard deviations and beyond LEAST_ASYMMETRY, below which wrong samples rather
than iron may be at work.  Refused once the standard deviation is so small (RESOLVED) that an asymmetry worth the
name would have shown: a machine with linear magnetics answers equally, and nothing at standstill can tell its
north from its south.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.motor import Motor

SIGNIFICANT = 6.0
"""Standard deviations: one wrong decision in 5e8 on Gaussian noise."""
LEAST_ASYMMETRY = 0.02
RESOLVED = 0.005
LEAST_WINDOWS = 4
_TERMS = 4
_ASTRAY = 0.3
"""Swing of the flux across the axis, as a share of that along it, beyond which a window does not count: with the
other waveforms the flux across saturates the axis most where that along it is least."""

STATE = np.dtype([
    # axis as a unit vector; flux unit [Wb]; window length
    ("axis_a", "f8"), ("axis_b", "f8"), ("unit", "f8"), ("n", "i8"),
    ("count", "i8"), ("broken", "i8"), ("flux", "f8"),
    ("normal", "f8", (_TERMS, _TERMS)), ("right", "f8", (_TERMS,)), ("square", "f8"),
    # what else the window shows: flux increments, current at its ends, largest current and voltage
    ("along_low", "f8"), ("along_high", "f8"), ("across_low", "f8"), ("across_high", "f8"),
    ("sum_a", "f8"), ("sum_b", "f8"), ("first_a", "f8"), ("first_b", "f8"), ("last_a", "f8"), ("last_b", "f8"),
    ("peak", "f8"), ("voltage", "f8"),
])


class Verdict(IntEnum):
    """What the answer to the pulses says so far: the sign is that of the axis against the north pole."""

    SOUTH = -1
    OPEN = 0
    NORTH = 1
    EQUAL = 2


def new_state(unit: float, n: int) -> NDArray[np.void]:
    """Record array (1,) of STATE; unit: flux [Wb] that f is counted in; n: samples of a window."""
    state = np.zeros(1, STATE)
    state["axis_a"] = 1.0
    state["unit"] = unit
    state["n"] = n
    return state


def set_axis(state: NDArray[np.void], angle: float) -> None:
    """Look along `angle` [rad electrical] from the next window on."""
    state["axis_a"], state["axis_b"] = math.cos(angle), math.sin(angle)
    begin_window(state)


def begin_window(state: NDArray[np.void]) -> None:
    """Empty the sums: the next sample is the first of a window."""
    for name in ("count", "broken", "flux", "normal", "right", "square", "along_low", "along_high", "across_low",
                 "across_high", "sum_a", "sum_b", "peak", "voltage"):
        state[name] = 0


@kernel
def window_block(samples: NDArray[np.float64], regression: NDArray[np.float64], filled: NDArray[np.uint8],
                 state: NDArray[np.void]) -> None:
    """Add samples to the window; never more than are missing in it.

    samples: float64 (4, N).  regression: float64 (7, N), of which the flux increments are read.  filled: uint8 (N,),
    1 where a sample is only interpolated: the window then says nothing, for nobody knows what the voltage was.
    """
    st = state[0]
    row = np.empty(_TERMS)
    row[0] = 1.0
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        if st.count == 0:
            st.first_a = i_a
            st.first_b = i_b
        else:
            d_a = regression[3, k]
            d_b = regression[4, k]
            st.flux += (d_a * st.axis_a + d_b * st.axis_b) / st.unit
            st.sum_a += d_a
            st.sum_b += d_b
            across = (st.sum_b * st.axis_a - st.sum_a * st.axis_b) / st.unit
            st.along_low = min(st.along_low, st.flux)
            st.along_high = max(st.along_high, st.flux)
            st.across_low = min(st.across_low, across)
            st.across_high = max(st.across_high, across)
        st.last_a = i_a
        st.last_b = i_b
        st.broken |= filled[k]
        st.peak = max(st.peak, math.hypot(i_a, i_b))
        st.voltage = max(st.voltage, math.hypot(samples[2, k], samples[3, k]))
        i = i_a * st.axis_a + i_b * st.axis_b
        row[1] = st.count / st.n - 0.5
        row[2] = st.flux
        row[3] = st.flux * st.flux
        for r in range(_TERMS):
            for c in range(_TERMS):
                st.normal[r, c] += row[r] * row[c]
            st.right[r] += row[r] * i
        st.square += i * i
        st.count += 1


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
            return Verdict.NORTH if a > 0.0 else Verdict.SOUTH
        return Verdict.EQUAL if sigma < RESOLVED else Verdict.OPEN
