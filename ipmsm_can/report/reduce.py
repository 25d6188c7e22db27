"""Fewer points for the same picture: per column of pixels the lowest and the highest value."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_FEW = 8
"""Points a column that need no reduction."""


def envelope(x: Floats, y: Floats, begin: float, end: float, columns: int,
             few: int = _FEW) -> tuple[Floats, Floats]:
    """x and y cut to begin..end and reduced to at most two points a column, extremes kept.

    x rises; NaN in y is a break: a column whose values are all NaN gives one NaN.  Series with at most
    `few` points a column come back as they are.
    """
    inside = slice(int(np.searchsorted(x, begin)), int(np.searchsorted(x, end, side="right")))
    x, y = x[inside], y[inside]
    if x.size <= few * columns:
        return x, y
    column = np.minimum(((x - begin) * (columns / (end - begin))).astype(np.int64), columns - 1)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    low, high = np.fmin.reduceat(y, starts), np.fmax.reduceat(y, starts)
    middle = begin + (column[starts] + 0.5) * ((end - begin) / columns)
    out = np.empty(2 * starts.size)
    # Alternating the order keeps a rising line from turning into a saw.
    out[0::2] = np.where(np.arange(starts.size) % 2 == 0, low, high)
    out[1::2] = np.where(np.arange(starts.size) % 2 == 0, high, low)
    return np.repeat(middle, 2), out
