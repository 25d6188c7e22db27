"""A measurement as integrals over short windows: what the voltage equation says without any derivative.

    integral of v dt = R integral of i dt + lambda(t_1) - lambda(t_0)

holds exactly for samples of i and mean voltages, whatever happens within the window.  A window is long enough for
the flux to change by much more than the noise of two current samples makes of it, and short enough that the vector
does not come round to where it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

if TYPE_CHECKING:
    from ipmsm_can.analysis.measurement import Measurement

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TURNED = 1.0
"""Angle [rad electrical] that the fastest rotor turns in a window."""
SHORTEST, LONGEST_S = 4, 5e-3
"""Length of a window: samples at least, seconds at most."""
ENCODER_SILENCE_S = 0.05
"""Between two reports of the encoder further apart than this [s], its angle is not known."""


@dataclass(frozen=True, slots=True)
class Track:
    """The encoder at every sample.  theta: unwrapped [rad electrical], as reported; NaN where it is not known."""

    theta: Floats
    omega: Floats

    @property
    def known(self) -> Bools:
        """Where the angle is known."""
        return np.isfinite(self.theta)


@dataclass(frozen=True, slots=True)
class Windows:
    """W windows of `length` samples.

    begin, end: rows of the measurement, (W,).  group: number of the stretch of time a window belongs to, for errors
    that are alike within such a stretch.  v: integral of the voltage [V s]; i: of the current [A s];
    period: length [s].
    """

    begin: Ints
    end: Ints
    group: Ints
    v: Complexes
    i: Complexes
    period: float

    def __len__(self) -> int:
        return len(self.begin)

    def change(self, values: Complexes) -> Complexes:
        """By how much a quantity given at every sample (N,) changes over each window."""
        return np.asarray(values[self.end] - values[self.begin])

    def samples(self, values: Complexes) -> Complexes:
        """A quantity given at every sample (N,), of each window's samples (W, length + 1)."""
        length = int(self.end[0] - self.begin[0]) if len(self) else 0
        return np.asarray(values[self.begin[:, None] + np.arange(length + 1)])


def encoder_track(m: Measurement) -> Track:
    """The encoder's reports at the samples, carried from one report to the next by its own speed."""
    n = len(m.sample)
    theta, omega = np.full(n, np.nan), np.full(n, np.nan)
    good = np.isfinite(m.encoder_theta)
    at, first = np.unique(m.encoder_sample[good], return_index=True)
    if at.size < 2 or n < 2:
        return Track(theta, omega)
    angle, speed = m.encoder_theta[good][first], m.encoder_omega[good][first]
    t = at / m.sample_rate
    step = np.diff(t)
    if np.isfinite(speed).all():
        ahead = 0.5 * (speed[1:] + speed[:-1]) * step
        # A speed that is not the angle's own (another unit, another sign) must not count turns.
        left = np.angle(np.exp(1j * (np.diff(angle) - ahead)))
        if np.median(np.abs(left)) > 0.5:
            ahead, speed = np.zeros(step.size), np.full(at.size, np.nan)
    else:
        ahead, speed = np.zeros(step.size), np.full(at.size, np.nan)
    turned = ahead + np.angle(np.exp(1j * (np.diff(angle) - ahead)))
    unwrapped = angle[0] + np.concatenate([[0.0], np.cumsum(turned)])
    slope = speed if np.isfinite(speed).all() else np.gradient(unwrapped, t)
    # Not beyond the reports, and not across a silence.
    inside = (m.sample >= at[0]) & (m.sample <= at[-1])
    where = np.clip(np.searchsorted(at, m.sample, side="right") - 1, 0, at.size - 2)
    inside &= step[where] <= ENCODER_SILENCE_S
    curve = CubicHermiteSpline(t, unwrapped, slope)
    time = m.sample[inside] / m.sample_rate
    theta[inside], omega[inside] = curve(time), curve(time, 1)
    return Track(theta, omega)


def stretches(usable: Bools, sample: Ints) -> list[tuple[int, int]]:
    """Rows [begin, end) of samples that follow each other and may all be used."""
    joined = usable[1:] & usable[:-1] & (np.diff(sample) == 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], joined.view(np.int8), [0]])))
    return [(int(a), int(b) + 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def window_length(m: Measurement, omega: float) -> int:
    """Samples in a window where the rotor turns with up to omega [rad/s electrical]."""
    longest = max(SHORTEST, int(LONGEST_S * m.sample_rate))
    if not math.isfinite(omega) or abs(omega) * LONGEST_S <= TURNED:
        return longest
    return int(np.clip(TURNED / abs(omega) * m.sample_rate, SHORTEST, longest))


def make_windows(m: Measurement, usable: Bools, length: int, group_s: float = 0.1) -> Windows:
    """Windows one after the other, wherever `length` + 1 usable samples follow each other."""
    starts = [np.arange(a, b - length, length) for a, b in stretches(usable, m.sample)]
    begin = np.concatenate([np.zeros(0, np.int64), *starts]).astype(np.int64)
    end = begin + length
    T_s = 1.0 / m.sample_rate
    current = m.i_alpha + 1j * m.i_beta
    voltage = np.cumsum(np.where(usable, m.v_alpha + 1j * m.v_beta, 0.0))
    charge = np.cumsum(np.where(usable, current, 0.0))
    ends = np.where(usable, current, 0.0)
    # The trapezoid: half of the first and the last current.
    i = charge[end] - charge[begin] + 0.5 * (ends[begin] - ends[end])
    group = ((m.sample[begin] - m.sample[0]) * T_s / group_s).astype(np.int64) if len(begin) else begin
    return Windows(begin, end, group, T_s * (voltage[end] - voltage[begin]), T_s * i, length * T_s)
