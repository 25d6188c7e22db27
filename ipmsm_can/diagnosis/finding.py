"""What a diagnosis says: findings, what they rest on, and what was looked at.

Nothing here imports more than NumPy: a display gets these objects, whatever process it runs in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Severity = Literal["error", "warning", "info"]
State = Literal["found", "fine", "untold"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
"""The worst first: error where a drive would be damaged or the angle is wrong."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """A number that a finding rests on.

    value, and its 95 % interval low..high (NaN without one), in `unit`; expected: what it was compared with, in
    words, "" for nothing.
    """

    label: str
    value: float
    unit: str = ""
    low: float = math.nan
    high: float = math.nan
    expected: str = ""

    @property
    def words(self) -> str:
        """In words: "1.32 ohm (95 % 1.29 to 1.35), name plate 1.06 ohm"."""
        unit = f" {self.unit}" if self.unit else ""
        text = f"{_figures(self.value)}{unit}"
        if math.isfinite(self.low) and math.isfinite(self.high):
            places = _places(self.high - self.low)
            text += f" (95 %: {_figures(self.low, places)} to {_figures(self.high, places)})"
        return f"{text}, {self.expected}" if self.expected else text


def _places(width: float) -> int | None:
    """Decimal places at which an interval of this width shows."""
    return None if not width > 0.0 else max(0, 1 - math.floor(math.log10(width)))


def _figures(value: float, places: int | None = None) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.3g}" if places is None or abs(value) >= 1e5 else f"{value:.{min(places, 9)}f}"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A line (or dots) of a plot: x, y (N,); role: a colour of `report.palette`."""

    label: str
    x: Floats
    y: Floats
    role: str = "estimate"
    dots: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """Data of a plot.  bands: (from, to, label) along y, such as what is allowed."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is the matter.

    code: for programs, such as "encoder.zero"; never changes.  title: a few words.  sentence: what is the matter,
    in plain words.  advice: what to do.  size: how far beyond what is allowed, 1 at the limit; it orders findings
    of one kind.  order: which findings may be the cause of others; the lower explains the higher.
    """

    code: str
    severity: Severity
    title: str
    sentence: str
    advice: str
    evidence: tuple[Evidence, ...] = ()
    plot: Plot | None = field(default=None, compare=False)
    size: float = 1.0
    order: int = 5

    def to_dict(self) -> dict[str, Any]:
        """For JSON: plain types, NaN as None; without the plot's data."""
        return {"code": self.code, "severity": self.severity, "title": self.title, "sentence": self.sentence,
                "advice": self.advice, "size": _plain(self.size),
                "evidence": [{"label": e.label, "value": _plain(e.value), "unit": e.unit, "low": _plain(e.low),
                              "high": _plain(e.high), "expected": e.expected} for e in self.evidence]}


@dataclass(frozen=True, slots=True)
class Checked:
    """One thing that was looked at.

    state: "found" where there is a finding, "fine", or "untold" where the measurement does not say.
    words: what was seen, or why nothing can be said.
    """

    name: str
    state: State
    words: str


@dataclass(frozen=True, slots=True)
class Report:
    """A whole diagnosis.

    findings: the one that explains the others first.  checked: everything looked at.  facts: what the measurement
    holds, by name, for the head of a page.  plots: of the measurement as a whole.
    """

    source: str
    findings: tuple[Finding, ...]
    checked: tuple[Checked, ...]
    facts: Mapping[str, str]
    plots: tuple[Plot, ...] = field(default=(), compare=False)

    @property
    def worst(self) -> Severity | None:
        """The gravest severity there is, None without a finding."""
        return next((s for s in SEVERITIES if any(f.severity == s for f in self.findings)), None)

    @property
    def exit_code(self) -> int:
        """0 where nothing is worse than info, 1 where a fault was found."""
        return 1 if self.worst in ("error", "warning") else 0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"source": self.source, "worst": self.worst, "findings": [f.to_dict() for f in self.findings],
                "checked": [{"name": c.name, "state": c.state, "words": c.words} for c in self.checked],
                "facts": dict(self.facts)}


def ranked(findings: list[Finding]) -> tuple[Finding, ...]:
    """The one that explains the others first: causes before consequences, then the graver, then the larger."""
    return tuple(sorted(findings, key=lambda f: (f.order, SEVERITIES.index(f.severity), -f.size)))


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
