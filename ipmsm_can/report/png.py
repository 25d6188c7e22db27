"""Panels as one PNG, for mails and slides; the same data and colours as the page, drawn by matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.report.figure import STATE_WORDS, Panel
from ipmsm_can.report.palette import LIGHT
from ipmsm_can.report.reduce import envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 900
_INCHES, _DPI = 12.0, 130
_STATE_SHADE = {"unknown": 0.16, "locked": 0.10, "valid": 0.0}
_WIDTHS = {"encoder": 4.0, "obeyed": 4.0, "current": 0.8}


def save(parts: list[Panel], path: Path, headline: str) -> None:
    """Write the picture; needs no display.  Raises OSError if the file cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = [p.height for p in parts] or [1.0]
    figure = Figure(figsize=(_INCHES, 2.2 * sum(heights) + 0.9 * len(heights) + 0.6), dpi=_DPI,
                    facecolor=LIGHT["paper"], layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(headline, fontsize=11, color=LIGHT["muted"], x=0.01, ha="left")
    for axes, panel in zip(np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights)), parts,
                           strict=False):
        _draw(axes, panel)
    canvas.print_figure(str(path), format="png")


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_facecolor(LIGHT["card"])
    axes.set_title(panel.title, loc="left", fontsize=11.5, fontweight="bold", color=LIGHT["ink"],
                   pad=20 if panel.spans or panel.phases else 6)
    axes.set_xlim(panel.begin, panel.end)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks(panel.scale.place(np.array([v for v, _ in panel.scale.ticks])).tolist(),
                    [label for _, label in panel.scale.ticks])
    axes.set_ylabel(panel.unit, color=LIGHT["ink"], fontsize=9)
    axes.set_xlabel("time in s", color=LIGHT["muted"], fontsize=8, labelpad=1)
    axes.tick_params(colors=LIGHT["muted"], labelsize=8, length=3)
    axes.grid(color=LIGHT["grid"], linewidth=0.8)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_color(LIGHT["grid"])
    for s in panel.spans:
        begin, end = max(s.begin, panel.begin), min(s.end, panel.end)
        if end > begin:
            axes.axvspan(begin, end, color=LIGHT[s.role], alpha=_STATE_SHADE[s.role], linewidth=0)
            axes.axvspan(begin, end, 0.985, 1.0, color=LIGHT[s.role], linewidth=0)
            if end - begin > 0.08 * (panel.end - panel.begin):
                _word(axes, 0.5 * (begin + end), STATE_WORDS[s.role], False)
    for m in panel.phases:
        _word(axes, 0.5 * (m.begin + m.end), m.label, True)
    for m in panel.loads:
        if panel.name == "speed":
            axes.axvspan(m.begin, m.end, 0.0, 0.08, color=LIGHT["load"], alpha=0.45, linewidth=0)
            axes.text(0.5 * (m.begin + m.end), 0.1, m.label, ha="center", fontsize=7.5, color=LIGHT["muted"])
        else:
            for edge in (m.begin, m.end):
                axes.axvline(edge, color=LIGHT["load"], linewidth=0.7, linestyle=(0, (2, 3)), alpha=0.7)
    for band in panel.bands:
        t, low = envelope(band.x, band.low, panel.begin, panel.end, _COLUMNS // 2)
        _, high = envelope(band.x, band.high, panel.begin, panel.end, _COLUMNS // 2)
        axes.fill_between(t, panel.scale.place(low), panel.scale.place(high), color=LIGHT[band.role], alpha=0.24,
                          linewidth=0, label=band.label or "_nolegend_")
    for line in panel.lines:
        t, y = envelope(line.x, line.y, panel.begin, panel.end, _COLUMNS)
        placed = np.where(np.isfinite(y), panel.scale.place(y), np.nan)
        role = line.role.removesuffix("-unknown")
        colour = LIGHT["ink"] if role == "obeyed" else LIGHT[role]
        if line.dots:
            axes.plot(t, placed, ".", color=colour, markersize=2, alpha=0.4, label=line.label)
        else:
            axes.plot(t, placed, color=colour, linewidth=_WIDTHS.get(role, 1.4), label=line.label)
    if len(panel.lines) > 1 or panel.bands:
        axes.legend(loc="lower right", fontsize=7.5, framealpha=0.85, edgecolor=LIGHT["grid"], ncols=4,
                    bbox_to_anchor=(1.0, 1.06 if panel.spans or panel.phases else 1.0), borderaxespad=0.2)


def _word(axes: Axes, t: float, words: str, bold: bool) -> None:
    axes.text(t, 1.02, words, ha="center", va="bottom", fontsize=8, color=LIGHT["ink"],
              fontweight="bold" if bold else "normal")
