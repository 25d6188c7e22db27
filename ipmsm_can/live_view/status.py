"""What the screen of `ipmsm-can monitor` shows, as plain numbers and words.

Nothing here imports more than the standard library: the drawing process, which is to be there at once, gets these
objects through a pipe.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

from ipmsm_can.cli.status import NodeStatus, RunStatus

MAIN, FINDINGS, HELP = "main", "findings", "help"
"""Pages of the screen."""
SEVERITIES = ("error", "warning", "notice")
"""Gravest first."""


def _nothing() -> array[float]:
    return array("f")


@dataclass(frozen=True, slots=True)
class Course:
    """The last seconds as columns, oldest first; NaN where there was nothing.

    column_s: time that a column stands for [s].  speed_low, speed_high: least and largest speed [1/min mechanical].
    sigma: largest 1-sigma of the angle [deg electrical].  current: phase current [A rms].
    """

    column_s: float
    speed_low: array[float] = field(default_factory=_nothing)
    speed_high: array[float] = field(default_factory=_nothing)
    sigma: array[float] = field(default_factory=_nothing)
    current: array[float] = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True)
class DriveView:
    """One drive: `node` as `run` shows it, and what only this screen shows.

    rpm, rpm_sigma: mean speed of the last `Course` window and its 1-sigma [1/min mechanical], NaN where not known.
    i_rms: phase current [A rms]; i_peak: longest current vector of that time, which is the largest phase current
    [A peak]; i_d, i_q: mean along the estimated axes [A peak], NaN without an angle; v_rms: phase voltage [V rms].
    rated: rated phase current [A rms].  order: "on", "off" or "" for automatic: what the operator asked of the
    injection.  reported: speed, i_d and i_q are what the drive itself reports, for there is no estimate.
    figures: what else is known, as (name, words).
    """

    node: NodeStatus
    rpm: float
    rpm_sigma: float
    i_rms: float
    i_peak: float
    i_d: float
    i_q: float
    v_rms: float
    rated: float
    order: str
    course: Course
    reported: bool = False
    figures: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Told:
    """A finding.  severity: one of SEVERITIES.  advice: what to do, or "".  since: when it was first seen."""

    severity: str
    sentence: str
    advice: str = ""
    since: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, with its time of day or of the log, in words."""

    time: str
    words: str
    severity: str = "notice"


@dataclass(frozen=True, slots=True)
class MonitorStatus:
    """The whole screen.

    source: where the frames come from, in words.  recording: what is being written, "" for nothing.
    checked: what findings were looked for, in words; findings: gravest first; events: oldest first.
    selected: index of the drive shown in full.  page: MAIN, FINDINGS or HELP.  notice: an answer to the last key,
    or a question.  keys: there is a keyboard.  injectable: the keys for the injection do something.
    """

    run: RunStatus
    drives: tuple[DriveView, ...]
    source: str
    recording: str = ""
    record_trouble: str = ""
    checked: str = ""
    findings: tuple[Told, ...] = ()
    events: tuple[Event, ...] = ()
    selected: int = 0
    page: str = MAIN
    paused: bool = False
    notice: str = ""
    keys: bool = True
    injectable: bool = False
    ascii: bool = False
