"""What a fit works on: stretches of unbroken samples, with the encoder's angle at each of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from ipmsm_can.analysis.measurement import Measurement

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SHORTEST_S = 0.05
"""Shortest unbroken stretch [s] that is worth a filter's start."""
LONGEST_BETWEEN_S = 0.0125
"""Longest time [s] between two reports of the encoder over which its angle is interpolated."""
_MOST_TURN = 0.5 * math.pi


@dataclass(frozen=True, slots=True)
class Stretch:
    """N samples one after the other.  i [A peak], v [V peak]: alpha + j beta.

    theta: encoder's angle [rad electrical, without wraps], NaN where there is none.  rows: those whose current is a
    measurement; others are filled and serve the integrals only.  first: number of the first sample.
    """

    first: int
    i: Complexes
    v: Complexes
    theta: Floats
    rows: Bools

    def __len__(self) -> int:
        return len(self.i)

    def part(self, begin: int, end: int) -> Stretch:
        """Samples begin to end - 1 of it."""
        here = slice(begin, end)
        return Stretch(self.first + begin, self.i[here], self.v[here], self.theta[here], self.rows[here])


def encoder_angle(m: Measurement) -> Floats:
    """Encoder's angle at every sample [rad electrical], NaN away from its reports; continuous between NaNs.

    Between two reports a cubic with the speed at both; the speed is the reports' own slope.
    """
    theta = np.full(len(m), np.nan)
    at, reported = m.encoder_sample, m.encoder_theta
    if at.size < 4:
        return theta
    dt = np.diff(at) / m.sample_rate
    step = np.diff(reported)
    # The whole turns between two reports come from the speed, reported or as the last ones turned.
    omega = m.encoder_omega
    expected = np.where(np.isfinite(omega[:-1] + omega[1:]), 0.5 * (omega[:-1] + omega[1:]) * dt, 0.0)
    step = expected + (step - expected + math.pi) % (2.0 * math.pi) - math.pi
    near = (dt <= LONGEST_BETWEEN_S) & (np.isfinite(omega[:-1] + omega[1:]) | (np.abs(step) < _MOST_TURN))
    unwrapped = reported[0] + np.concatenate([[0.0], np.cumsum(step)])
    edges = np.flatnonzero(~near) + 1
    for begin, end in zip([0, *edges], [*edges, at.size], strict=True):
        if end - begin < 4:
            continue
        x = at[begin:end] / m.sample_rate
        spline = CubicHermiteSpline(x, unwrapped[begin:end], np.gradient(unwrapped[begin:end], x))
        k0, k1 = np.searchsorted(m.sample, (at[begin], at[end - 1] + 1))
        theta[k0:k1] = spline(m.sample[k0:k1] / m.sample_rate)
    return theta


def stretches(m: Measurement, theta: Floats | None) -> list[Stretch]:
    """The unbroken stretches of a measurement; theta: angle at every sample, where it is needed for all of them."""
    if not len(m):
        return []
    i, v = m.i_alpha + 1j * m.i_beta, m.v_alpha + 1j * m.v_beta
    good = np.isfinite(i) & np.isfinite(v) & ~m.clipped & m.running
    if theta is not None:
        good &= np.isfinite(theta)
    follows = np.zeros(len(m), np.bool_)
    follows[1:] = good[1:] & good[:-1] & (np.diff(m.sample) == 1)
    begins = np.flatnonzero(good & ~follows)
    ends = np.flatnonzero(good & ~np.append(follows[1:], False)) + 1
    least = max(8, round(SHORTEST_S * m.sample_rate))
    angle = np.full(len(m), np.nan) if theta is None else theta
    return [Stretch(int(m.sample[a]), i[a:b], v[a:b], angle[a:b], m.usable[a:b])
            for a, b in zip(begins.tolist(), ends.tolist(), strict=True) if b - a >= least]
