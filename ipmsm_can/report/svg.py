"""Panels as SVG, one drawing per width; colours are CSS classes, so that a page can have themes."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.report.figure import STATE_WORDS, Band, Line, Panel
from ipmsm_can.report.reduce import envelope

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """Size of a drawing in CSS pixels at scale 1; narrow: for telephones, with short labels."""

    name: str
    width: int
    unit_height: int
    left: int
    right: int
    narrow: bool

    @property
    def inner(self) -> int:
        """Width of the plot itself."""
        return self.width - self.left - self.right


WIDE = Layout("wide", 1040, 210, 58, 14, False)
NARROW = Layout("narrow", 344, 170, 44, 10, True)
_BOTTOM = 24
_LETTER = 6.4
"""Width of a character [px], on the safe side."""


def draw(panel: Panel, layout: Layout) -> str:
    """The panel as one `svg` element."""
    height = round(panel.height * layout.unit_height)
    canvas = _Canvas(panel, layout, height)
    top = canvas.top
    body = "".join([canvas.states(), canvas.grid(), canvas.load_bars(),
                    *(canvas.band(b) for b in panel.bands), *(canvas.line(li) for li in panel.lines),
                    canvas.phase_names(), canvas.axes()])
    return (f'<svg class="{layout.name}" viewBox="0 0 {layout.width} {height + top + _BOTTOM}" role="img" '
            f'aria-label="{escape(panel.title)}"><clipPath id="{panel.name}-{layout.name}">'
            f'<rect x="{layout.left}" y="{top}" width="{layout.inner}" height="{height}"/></clipPath>{body}</svg>')


class _Canvas:
    def __init__(self, panel: Panel, layout: Layout, height: int) -> None:
        self.panel, self.layout, self.height = panel, layout, height
        # Room for the unit, and below it for the names of phases or states.
        self.top = 38 if panel.phases or panel.spans else 24
        self.clip = f'clip-path="url(#{panel.name}-{layout.name})"'

    def x(self, t: Floats | float) -> Floats:
        share = (np.asarray(t) - self.panel.begin) / (self.panel.end - self.panel.begin)
        return self.layout.left + np.clip(share, 0.0, 1.0) * self.layout.inner

    def y(self, values: Floats | float) -> Floats:
        return self.top + (1.0 - self.panel.scale.place(values)) * self.height

    def box(self, begin: float, end: float, y: float, height: float, role: str) -> str:
        left, right = float(self.x(begin)), float(self.x(end))
        return f'<rect class="{role}" x="{left:.1f}" y="{y:.1f}" width="{right - left:.1f}" height="{height:.1f}"/>'

    def text(self, x: float, y: float, words: str, anchor: str = "middle", role: str = "tick") -> str:
        return f'<text class="{role}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'

    def words(self, begin: float, end: float, y: float, choices: tuple[str, ...], role: str) -> str:
        """The first of the wordings that fits between begin and end, in the middle; nothing if none does."""
        left, right = float(self.x(begin)), float(self.x(end))
        for words in choices:
            if len(words) * _LETTER <= right - left:
                return self.text(0.5 * (left + right), y, words, role=role)
        return ""

    def states(self) -> str:
        parts = []
        for s in self.panel.spans:
            if s.end > self.panel.begin and s.begin < self.panel.end:
                parts.append(self.box(s.begin, s.end, self.top, self.height, f"state {s.role}"))
                parts.append(self.box(s.begin, s.end, self.top - 5, 4, f"strip {s.role}"))
                parts.append(self.words(s.begin, s.end, self.top - 9, (STATE_WORDS[s.role], s.role), "state-word"))
        return "".join(parts)

    def grid(self) -> str:
        left, right = self.layout.left, self.layout.width - self.layout.right
        return "".join(f'<path class="{"zero" if v == 0 else "grid"}" d="M{left} {float(self.y(v)):.1f}H{right}"/>'
                       for v, _ in self.panel.scale.ticks)

    def load_bars(self) -> str:
        parts = []
        for m in self.panel.loads:
            if self.panel.name == "speed":
                parts.append(self.box(m.begin, m.end, self.top + self.height - 16, 16, "load"))
                choices = (m.short,) if self.layout.narrow else (m.label, m.short)
                parts.append(self.words(m.begin - 0.2, m.end + 0.2, self.top + self.height - 20, choices,
                                        "load-word"))
            else:
                parts += [f'<path class="step" d="M{float(self.x(t)):.1f} {self.top}v{self.height}"/>'
                          for t in (m.begin, m.end)]
        return "".join(parts)

    def phase_names(self) -> str:
        return "".join(self.words(m.begin - 0.1, m.end + 0.1, self.top - 9, (m.label, m.short), "phase")
                       for m in self.panel.phases)

    def line(self, line: Line) -> str:
        t, values = envelope(line.x, line.y, self.panel.begin, self.panel.end, self.layout.inner)
        x, y = self.x(t), self.y(np.where(np.isfinite(values), values, 0.0))
        good = np.isfinite(values)
        if line.dots:
            # At most one dot per pixel and two per column would still be a blot: take a fair share of them.
            keep = np.flatnonzero(good)[::max(1, int(good.sum() / (2 * self.layout.inner)))]
            d = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x[keep], y[keep], strict=True))
        else:
            d = _path(x, y, good)
        return f'<path class="{line.role}" {self.clip} d="{d}"/>' if d else ""

    def band(self, band: Band) -> str:
        t, low = envelope(band.x, band.low, self.panel.begin, self.panel.end, self.layout.inner // 2)
        t_2, high = envelope(band.x, band.high, self.panel.begin, self.panel.end, self.layout.inner // 2)
        x = np.concatenate([self.x(t), self.x(t_2)[::-1]])
        y = np.concatenate([self.y(low), self.y(high)[::-1]])
        d = _path(x, y, np.isfinite(y))
        return f'<path class="{band.role}-band" {self.clip} d="{d}Z"/>' if d else ""

    def axes(self) -> str:
        layout, panel = self.layout, self.panel
        parts = [self.text(layout.left - 6, float(self.y(v)) + 4, label, "end") for v, label in panel.scale.ticks]
        # The unit stands where the axis label would, above the ticks, so that no text needs to be turned.
        parts.append(self.text(2, 12, panel.unit, "start", "unit"))
        bottom = self.top + self.height
        ticks = _time_ticks(panel.begin, panel.end, layout)
        for t in ticks:
            x = float(self.x(t))
            parts.append(f'<path class="axis" d="M{x:.1f} {bottom}v4"/>')
            words = f"{t:g} s" if t == ticks[-1] else f"{t:g}"
            parts.append(self.text(min(x, layout.width - 0.5 * _LETTER * len(words)), bottom + 17, words))
        parts.append(f'<path class="axis" d="M{layout.left} {bottom}H{layout.width - layout.right}"/>')
        return "".join(parts)


def _time_ticks(begin: float, end: float, layout: Layout) -> list[float]:
    most = layout.inner / (60 if layout.narrow else 56)
    step = next(s for s in (0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 5.0, 10.0, 20.0, 50.0, 100.0)
                if (end - begin) / s <= most or s == 100.0)
    first = int(np.ceil(begin / step - 1e-9))
    return [round(k * step, 6) for k in range(first, int(np.floor(end / step + 1e-6)) + 1)]


def _path(x: Floats, y: Floats, good: NDArray[np.bool_]) -> str:
    """Path data; a new stretch begins after every point that is not good."""
    parts = []
    pen_up = True
    for a, b, ok in zip(x.tolist(), y.tolist(), good.tolist(), strict=True):
        if not ok:
            pen_up = True
            continue
        parts.append(f"{'M' if pen_up else 'L'}{a:.1f} {b:.1f}")
        pen_up = False
    return "".join(parts)
