"""Curves in a terminal: braille dots where there is Unicode, else one character a point.

Standard library only, as everything that the drawing process loads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a braille cell: four rows, left and right."""
_LABEL = 7


def scale(low: float, high: float, least: float, steps: int = 4) -> tuple[float, float]:
    """A range of round numbers around low..high, at least `least` wide; NaN stands for no data."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return 0.0, least
    span = max(high - low, least)
    unit = 10.0 ** math.floor(math.log10(span / steps))
    step = next(unit * m for m in (1.0, 2.0, 5.0, 10.0) if unit * m >= span / steps * (1.0 - 1e-9))
    bottom = math.floor(low / step + 1e-9) * step
    top = math.ceil(high / step - 1e-9) * step
    if top - bottom < least:
        top = bottom + math.ceil(least / step - 1e-9) * step
    return bottom, top


def points(width: int, ascii_only: bool) -> int:
    """How many columns of data a chart of `width` characters shows."""
    return max(0, width - _LABEL - 1) * (1 if ascii_only else 2)


def chart(low: Sequence[float], high: Sequence[float], width: int, rows: int, least: float, ascii_only: bool,
          zero: bool = False) -> list[str]:
    """A chart of `rows` lines of `width` characters.

    low, high: range of each column, oldest first; NaN where there is nothing.  The last columns are shown.
    least: smallest range of the axis; zero: the axis begins at 0.
    """
    count = points(width, ascii_only)
    low, high = low[-count:] if count else [], high[-count:] if count else []
    seen = [(a, b) for a, b in zip(low, high, strict=True) if math.isfinite(a) and math.isfinite(b)]
    least_seen = min((a for a, _ in seen), default=math.nan)
    bottom, top = scale(min(0.0, least_seen) if zero and seen else least_seen,
                        max((b for _, b in seen), default=math.nan), least)
    fine = rows * (1 if ascii_only else 4)

    def level(value: float) -> int:
        return min(fine - 1, max(0, int((value - bottom) / (top - bottom) * fine)))

    def mark(column: int, y: int) -> None:
        up = fine - 1 - y
        if ascii_only:
            grid[up][column] = 1
        else:
            cell, side = divmod(column, 2)
            grid[up // 4][cell] |= _DOTS[up % 4][side]

    grid = [[0] * (max(0, width - _LABEL - 1)) for _ in range(rows)]
    first = count - len(low)
    before: tuple[int, int] | None = None
    for k, (a, b) in enumerate(zip(low, high, strict=True), first):
        if not (math.isfinite(a) and math.isfinite(b)):
            before = None
            continue
        bottom_y, top_y = level(a), level(b)
        # no hole between a column and the one before it
        begin, end = bottom_y, top_y
        if before is not None:
            begin, end = min(begin, before[1] + 1), max(end, before[0] - 1)
        for y in range(begin, end + 1):
            mark(k, y)
        before = bottom_y, top_y
    bar, ink = ("|", "*") if ascii_only else ("│", "")
    lines = []
    for row, cells in enumerate(grid):
        label = top if row == 0 else bottom if row == rows - 1 else None
        drawn = "".join((ink if c else " ") if ascii_only else (chr(0x2800 + c) if c else " ") for c in cells)
        lines.append(f"{'' if label is None else _number(label):>{_LABEL}}{bar}{drawn}"[:width])
    return lines


def _number(value: float) -> str:
    text = f"{value:.4g}"
    return text if len(text) <= _LABEL else f"{value:.1e}"
