"""How fast the drive's sample clock runs against this computer's, from when its samples arrive.

A frame can come late, never early.  So of many arrivals the earliest ones lie on a line, the lower envelope, and
its slope is what the two clocks differ by; queues, arbitration and a busy computer only lift points off it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

BINS = 512
"""Stretches of time, one earliest arrival each; where they do not suffice, two become one."""
_FIRST_BIN_S = 0.25
_EARLY_NS = 20e6
"""An arrival so much [ns] before the earliest so far means that a clock was set, not that it drifts."""
_ENOUGH = 8
_ROUNDS = 20
_TUKEY = 4.685
"""Tukey's biweight: points further off than so many scatters count nothing; 95 % efficient for normal noise."""

CLOCK = np.dtype([
    ("begun", "i8"), ("last", "i8"), ("elapsed", "i8"), ("t0", "i8"), ("width", "i8"), ("used", "i8"),
    ("lowest", "f8"), ("restarts", "i8"),
])


@dataclass(frozen=True, slots=True)
class Drift:
    """ppm: how much faster the drive's clock runs than this computer's, 1e-6; sigma_ppm: its 1-sigma.

    span_s: time looked at [s].  points: earliest arrivals that the line goes through.
    """

    ppm: float
    sigma_ppm: float
    span_s: float
    points: int


@kernel
def _begin(st: Any, counter: int, t_ns: int, rate: float, least: NDArray[np.float64]) -> None:
    st.begun = 1
    st.last = counter
    st.elapsed = 0
    st.t0 = t_ns
    st.width = max(1, int(_FIRST_BIN_S * rate))
    st.used = 0
    st.lowest = 0.0
    least[:] = np.inf


@kernel
def _fold(st: Any, least: NDArray[np.float64]) -> None:
    """Two bins become one."""
    for k in range(BINS // 2):
        least[k] = min(least[2 * k], least[2 * k + 1])
    least[BINS // 2:] = np.inf
    st.width *= 2


@kernel
def _gather(counter: NDArray[np.int64], t_ns: NDArray[np.int64], skip: NDArray[np.uint8],
            restarted: NDArray[np.bool_], rate: float, state: Any, least: NDArray[np.float64]) -> None:
    st = state[0]
    for k in range(counter.shape[0]):
        if skip[k]:
            if restarted[k]:
                st.begun = 0
            continue
        step = (counter[k] - st.last) & 0xFFFFFFFF
        if st.begun == 0 or restarted[k] or step > 0x7FFFFFFF:
            st.restarts += st.begun
            _begin(st, counter[k], t_ns[k], rate, least)
            continue
        st.last = counter[k]
        st.elapsed += step
        residual = float(t_ns[k] - st.t0) - st.elapsed * (1e9 / rate)
        if residual < st.lowest - _EARLY_NS - 1e-3 * float(t_ns[k] - st.t0):
            st.restarts += 1
            _begin(st, counter[k], t_ns[k], rate, least)
            continue
        st.lowest = min(st.lowest, residual)
        while st.elapsed // st.width >= BINS:
            _fold(st, least)
        at = st.elapsed // st.width
        least[at] = min(least[at], residual)
        st.used = max(st.used, at + 1)


class ClockDrift:
    """Drift of one drive's clock; fed with samples, has no clock of its own, bounded memory."""

    def __init__(self) -> None:
        self._state = np.zeros(1, CLOCK)
        self._least = np.full(BINS, np.inf)
        self._rate = 0.0

    def update(self, counter: NDArray[np.int64], t_ns: NDArray[np.int64], rate: float,
               skip: NDArray[np.uint8] | None = None, restarted: NDArray[np.bool_] | None = None) -> None:
        """counter (N,): 32-bit sample counters; t_ns (N,): when their frames arrived; rate: as the drive states it
        [Hz], > 0.  skip (N,): not 0 where a counter is not to be believed, or no frame belongs to it.
        restarted (N,): the drive began anew here."""
        n = len(counter)
        if rate != self._rate:
            self._rate = rate
            self._state["begun"] = 0
        _gather(np.ascontiguousarray(counter), np.ascontiguousarray(t_ns),
                np.zeros(n, np.uint8) if skip is None else skip,
                np.zeros(n, np.bool_) if restarted is None else restarted, rate, self._state, self._least)

    def drift(self) -> Drift | None:
        """The drift so far, since the last restart of the drive; None before there is enough to tell."""
        st = self._state[0]
        if not st["begun"] or st["used"] < _ENOUGH:
            return None
        width_s = int(st["width"]) / self._rate
        least = self._least[:int(st["used"])].copy()
        # the first and the last bin are not full, so their earliest arrivals may be late ones
        at = np.flatnonzero(np.isfinite(least))[:-1]
        if at.size < _ENOUGH:
            return None
        slope, sigma = fit_line(width_s * at.astype(np.float64), 1e-9 * least[at])
        return Drift(-1e6 * slope, 1e6 * sigma, width_s * float(at[-1] - at[0] + 1), int(at.size))


def fit_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Slope of a straight line through N >= 3 points that a part of may be far off, and its 1-sigma.

    Biweight regression from the line of Theil's medians on; sigma from the scatter of the points it keeps.
    """
    step = max(1, len(x) // 64)
    half = len(x) // 2
    pairs = np.arange(0, len(x) - half, step)
    slope = float(np.median((y[pairs + half] - y[pairs]) / (x[pairs + half] - x[pairs])))
    offset = float(np.median(y - slope * x))
    weight = np.ones_like(x)
    for _ in range(_ROUNDS):
        off = y - slope * x - offset
        scatter = 1.4826 * float(np.median(np.abs(off)))
        if scatter <= 0.0:
            break
        weight = np.clip(1.0 - (off / (_TUKEY * scatter)) ** 2, 0.0, None) ** 2
        total = weight.sum()
        x_mean, y_mean = float((weight * x).sum() / total), float((weight * y).sum() / total)
        spread = float((weight * (x - x_mean) ** 2).sum())
        before, slope = slope, float((weight * (x - x_mean) * (y - y_mean)).sum()) / spread
        offset = y_mean - slope * x_mean
        if abs(slope - before) <= 1e-15 + 1e-9 * abs(slope):
            break
    kept = weight > 0.0
    off = (y - slope * x - offset)[kept]
    spread = float(((x[kept] - x[kept].mean()) ** 2).sum())
    return slope, math.sqrt(float((off**2).sum()) / max(1, int(kept.sum()) - 2) / spread)
