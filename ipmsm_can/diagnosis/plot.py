"""Plots as HTML: an SVG whose data stand in data units, and labels as text beside it that no zoom shrinks.

Without scripts they are still pictures; `zoom.js` changes the part that is shown and writes the labels anew.
"""

from __future__ import annotations

import math
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis.finding import Plot, Series

Floats = NDArray[np.float64]

_DIGITS = 5
_TICKS = 5


def draw(plot: Plot, number: int) -> str:
    """The plot as a `figure` element; "" where there is nothing to draw."""
    box = _box(plot)
    if box is None:
        return ""
    x0, x1, y0, y1 = box
    paths = "".join(_path(s, k) for k, s in enumerate(plot.series))
    grid = "".join(f'<path class="grid" d="M{x0:.6g} {-y:.6g}H{x1:.6g}"/>' for y in _ticks(y0, y1))
    if y0 < 0.0 < y1:
        grid += f'<path class="zero" d="M{x0:.6g} 0H{x1:.6g}"/>'
    keys = "".join(f'<li><i class="{s.role}{" dot" if s.dots else ""}"></i>{escape(s.label)}</li>'
                   for s in plot.series)
    across = "".join(f'<span style="left:{100 * (t - x0) / (x1 - x0):.2f}%">{t:.6g}</span>' for t in _ticks(x0, x1))
    up = "".join(f'<span style="top:{100 * (y1 - t) / (y1 - y0):.2f}%">{t:.6g}</span>' for t in _ticks(y0, y1))
    note = f'<p class="note">{escape(plot.note)}</p>' if plot.note else ""
    return (
        f'<figure class="plot" id="plot{number}"><figcaption><h3>{escape(plot.title)}</h3>{note}'
        f'<ul class="key">{keys}</ul></figcaption>'
        f'<div class="unit">{escape(plot.y_label)}</div><div class="frame"><div class="up">{up}</div>'
        f'<div class="area"><svg viewBox="{x0:.6g} {-y1:.6g} {x1 - x0:.6g} {y1 - y0:.6g}" '
        f'preserveAspectRatio="none" role="img" aria-label="{escape(plot.title)}"><g class="lines">{grid}</g>'
        f"{paths}</svg></div></div>"
        f'<div class="across">{across}</div><div class="xlabel">{escape(plot.x_label)}</div></figure>')


def _box(plot: Plot) -> tuple[float, float, float, float] | None:
    x = np.concatenate([s.x[np.isfinite(s.y)] for s in plot.series]) if plot.series else np.zeros(0)
    y = np.concatenate([s.y[np.isfinite(s.y)] for s in plot.series]) if plot.series else np.zeros(0)
    if not x.size:
        return None
    x0, x1, y0, y1 = float(x.min()), float(x.max()), float(y.min()), float(y.max())
    margin = 0.06 * (y1 - y0) or max(abs(y1), 1.0) * 0.1
    side = 0.0 if x1 > x0 else 1.0
    return x0 - side, x1 + side, y0 - margin, y1 + margin


def _ticks(low: float, high: float) -> list[float]:
    """Round values within low..high, about _TICKS of them."""
    raw = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, last + 1)]


def _path(s: Series, number: int) -> str:
    """Data in data units, upside down as SVG has it."""
    good = np.isfinite(s.y)
    points = [f"{x:.{_DIGITS}g} {-y:.{_DIGITS}g}" if ok else "" for x, y, ok in zip(
        s.x.tolist(), s.y.tolist(), good.tolist(), strict=True)]
    if s.dots:
        d = "".join(f"M{p}h0" for p in points if p)
    else:
        # A point alone between breaks would draw nothing.
        d = "".join(f"{'L' if before else 'M'}{p}" for before, p in pairwise(["", *points]) if p)
    return f'<path class="{s.role}{" dots" if s.dots else ""}" data-series="{number}" d="{d}"/>' if d else ""
