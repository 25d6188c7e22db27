"""Diagrams of the report as SVG: small multiples of one width, which a phone shows one below the other.

Colours are CSS classes (`c0` to `c3` for curves that are compared, `truth` for what is estimated), so that a page
can have themes; curves differ by dash as well as by colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.report.reduce import envelope

Floats = NDArray[np.float64]

WIDTH, HEIGHT, SQUARE = 380, 176, 262
"""Size of a drawing and of its plot area [CSS px at scale 1]; SQUARE: height of a plot with equal axes."""
LEFT, RIGHT, TOP, BOTTOM = 46, 12, 22, 36
_INNER = WIDTH - LEFT - RIGHT
_FEW = 4
_LETTER = 6.6
"""Width of a character [px], on the safe side."""
_MOST_POINTS = 2600
"""Points of a curve in a plane, where no envelope can be taken."""
_FEW_DOTS = 50
_ANGLE_POINTS = 1200
"""Points of an angle that wraps."""


@dataclass(frozen=True)
class Curve:
    """y over x; NaN breaks it.  role: truth, c0..c3, limit.  label: for the key, "" for none.  dots: marks only."""

    x: Floats
    y: Floats
    role: str
    label: str = ""
    dots: bool = False


@dataclass(frozen=True)
class Plot:
    """One diagram.  title; x_label, y_label with units; x, y: ranges (None: from the data).

    equal: a plane with equal axes; its curves need not run from left to right.  log_x, log_y: logarithmic.
    """

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    equal: bool = False
    log_x: bool = False
    log_y: bool = False


def angle_curves(time: Floats, truth: Floats, estimates: list[tuple[Floats, str]]) -> tuple[Curve, ...]:
    """The rotor's angle and estimates of it [rad] as curves in degrees, broken where they wrap."""
    curves = [Curve(*unjoined(time, _degrees(truth)), "truth", "rotor")]
    curves += [Curve(*unjoined(time, _degrees(theta)), f"c{k}", label) for k,
               (theta, label) in enumerate(estimates)]
    return tuple(curves)


def _degrees(theta: Floats) -> Floats:
    return np.asarray(np.degrees(np.remainder(theta + np.pi, 2.0 * np.pi) - np.pi))


def unjoined(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """x and an angle y [deg] with a break where it wraps.

    Thinned where there are breaks, for the envelope that `draw` takes of many points would join them again.
    """
    if not (np.abs(np.diff(y)) > 180.0).any():
        return x, y
    every = slice(None, None, max(1, -(-x.size // _ANGLE_POINTS)))
    x, y = x[every], y[every].copy()
    y[1:][np.abs(np.diff(y)) > 180.0] = np.nan
    return x, y


def draw(plot: Plot, name: str) -> str:
    """The plot as one `svg` element; name: unique on the page."""
    frame = _Frame.of(plot)
    clip = f'clip-path="url(#{name})"'
    parts = [f'<clipPath id="{name}"><rect x="{LEFT}" y="{TOP}" width="{_INNER}" '
             f'height="{frame.height}"/></clipPath>']
    for value, label in frame.y_ticks:
        y = float(frame.py(np.array([value]))[0])
        parts.append(f'<path class="{"zero" if value == 0 else "grid"}" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(_text(LEFT - 5, y + 4, label, "end"))
    bottom = TOP + frame.height
    for value, label in frame.x_ticks:
        x = float(frame.px(np.array([value]))[0])
        parts.append(f'<path class="axis" d="M{x:.1f} {bottom}v4"/>')
        half = 0.5 * _LETTER * len(label)
        parts.append(_text(min(x, WIDTH - half), bottom + 16, label, "middle"))
    parts.append(f'<path class="axis" d="M{LEFT} {bottom}H{WIDTH - RIGHT}"/>')
    parts.append(_text(2, 12, plot.y_label, "start", "unit"))
    parts.append(_text(WIDTH - RIGHT, bottom + 32, plot.x_label, "end", "unit"))
    parts += [_curve(plot, frame, c, clip) for c in plot.curves]
    return (f'<svg viewBox="0 0 {WIDTH} {bottom + BOTTOM}" role="img" aria-label="{escape(plot.title)}">'
            f'{"".join(parts)}</svg>')


def key(plot: Plot) -> str:
    """The key of the plot's curves as an HTML list, empty where there is nothing to tell apart."""
    items = []
    for c in plot.curves:
        if c.label:
            d = "M3 5h0M13 5h0M23 5h0" if c.dots else "M1 5H25"
            items.append(f'<li><svg viewBox="0 0 26 10" aria-hidden="true"><path class="{_classes(c)}" d="{d}"/>'
                         f"</svg>{escape(c.label)}</li>")
    return f'<ul class="key">{"".join(items)}</ul>' if items else ""


def _classes(curve: Curve) -> str:
    if not curve.dots:
        return curve.role
    return f"{curve.role} dots" if curve.x.size <= _FEW_DOTS else f"{curve.role} dots fine"


def _text(x: float, y: float, words: str, anchor: str, role: str = "tick") -> str:
    return f'<text class="{role}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def _curve(plot: Plot, frame: _Frame, curve: Curve, clip: str) -> str:
    x, y = np.asarray(curve.x, np.float64), np.asarray(curve.y, np.float64)
    if plot.equal or curve.dots:
        every = max(1, -(-x.size // _MOST_POINTS))
        x, y = x[::every], y[::every]
    elif not plot.log_x:
        x, y = envelope(x, y, frame.x[0], frame.x[1], _INNER, _FEW)
    px, py = frame.px(x), np.clip(frame.py(y), -4 * HEIGHT, 6 * HEIGHT)
    parts = []
    pen_up = True
    for a, b in zip(px.tolist(), py.tolist(), strict=True):
        if not (math.isfinite(a) and math.isfinite(b)):
            pen_up = True
        elif curve.dots:
            parts.append(f"M{a:.1f} {b:.1f}h0")
        else:
            parts.append(f"{'M' if pen_up else 'L'}{a:.1f} {b:.1f}")
            pen_up = False
    return f'<path class="{_classes(curve)}" {clip} d="{"".join(parts)}"/>' if parts else ""


@dataclass(frozen=True)
class _Frame:
    """Ranges, ticks, and where values lie in pixels."""

    x: tuple[float, float]
    y: tuple[float, float]
    height: int
    log_x: bool
    log_y: bool

    @classmethod
    def of(cls, plot: Plot) -> _Frame:
        x = plot.x or _span([c.x for c in plot.curves], plot.log_x, 0.0)
        inside = [c.y[(c.x >= x[0]) & (c.x <= x[1])] for c in plot.curves]
        y = plot.y or _span(inside, plot.log_y, 0.06)
        if plot.equal:
            middle_x, middle_y = 0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])
            per_px = max((x[1] - x[0]) / _INNER, (y[1] - y[0]) / SQUARE) * 1.06
            x = (middle_x - 0.5 * per_px * _INNER, middle_x + 0.5 * per_px * _INNER)
            y = (middle_y - 0.5 * per_px * SQUARE, middle_y + 0.5 * per_px * SQUARE)
        return cls(x, y, SQUARE if plot.equal else HEIGHT, plot.log_x, plot.log_y)

    @property
    def x_ticks(self) -> list[tuple[float, str]]:
        return _ticks(self.x, self.log_x, 6)

    @property
    def y_ticks(self) -> list[tuple[float, str]]:
        return _ticks(self.y, self.log_y, 5)

    def px(self, values: Floats) -> Floats:
        """Pixels from the left."""
        return LEFT + _share(values, self.x, self.log_x) * _INNER

    def py(self, values: Floats) -> Floats:
        """Pixels from the top."""
        return TOP + (1.0 - _share(values, self.y, self.log_y)) * self.height


def _share(values: Floats, span: tuple[float, float], log: bool) -> Floats:
    low, high = span
    if log:
        values = np.log10(np.maximum(values, 1e-300))
        low, high = math.log10(low), math.log10(high)
    # Where all values are one, they stand in the middle.
    return np.asarray((values - low) / (high - low) if high > low else np.full(np.shape(values), 0.5))


def _span(parts: list[Floats], log: bool, room: float) -> tuple[float, float]:
    values = np.concatenate([np.asarray(p, np.float64).ravel() for p in parts])
    values = values[np.isfinite(values) & ((values > 0.0) | (not log))]
    if not values.size:
        return (1.0, 10.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        # Whole decades, so that at least two ticks are there.
        return 10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high) + 1e-9)
    if high - low < 1e-12 * max(1.0, abs(high)):
        return low - 1.0, high + 1.0
    return low - room * (high - low), high + room * (high - low)


def _ticks(span: tuple[float, float], log: bool, most: int) -> list[tuple[float, str]]:
    low, high = span
    if log:
        powers = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
        step = max(1, -(-len(powers) // most))
        return [(10.0**p, _power(p)) for p in powers[::step]]
    if high - low > 300.0 and low >= -200.0 and high <= 200.0:
        return [(v, _number(v)) for v in (-180.0, -90.0, 0.0, 90.0, 180.0)]
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step_size = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= 0.999 * rough)
    first, last = math.ceil(low / step_size - 1e-9), math.floor(high / step_size + 1e-9)
    return [(k * step_size, _number(k * step_size)) for k in range(first, last + 1)]


def _number(value: float) -> str:
    return f"{round(value, 9) + 0.0:g}".replace("-", "−")


def _power(p: int) -> str:
    if -2 <= p <= 3:
        return f"{10.0**p:g}"
    return "10" + str(p).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
