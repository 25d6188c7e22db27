"""What the plot shows, as data: panels of lines, bands and shaded stretches, for any renderer.

The panels tell the story of a run in plain words; how they become pixels is the business of `svg` and `png`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.estimation import confidence
from ipmsm_can.motor import Motor
from ipmsm_can.report.recorder import Record
from ipmsm_can.report.summary import Comparison, Summary, compare, number

Floats = NDArray[np.float64]
STATES = ("unknown", "locked", "valid")
"""What the companion says about its angle, in the order of growing trust."""
STATE_WORDS = {"unknown": "angle unknown", "locked": "following, not yet claimed", "valid": "valid"}
_ZOOM_BEFORE, _ZOOM_AFTER = 0.5, 0.7


@dataclass(frozen=True, slots=True)
class Scale:
    """A vertical axis: kind linear, asinh (linear below `knee`, logarithmic beyond) or log; labelled ticks."""

    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    kind: str = "linear"
    knee: float = 1.0

    def place(self, values: Floats | float) -> Floats:
        """Where values lie, 0 at the bottom to 1 at the top; what is outside is clipped to the edge."""
        low, high = self._bend(np.array([self.low, self.high]))
        share: Floats = (self._bend(np.asarray(values, np.float64)) - low) / (high - low)
        return np.clip(share, 0.0, 1.0)

    def _bend(self, values: Floats) -> Floats:
        if self.kind == "log":
            return np.log10(np.maximum(values, 1e-300))
        if self.kind == "asinh":
            return np.arcsinh(values / self.knee)
        return values


@dataclass(frozen=True, slots=True)
class Line:
    """A curve (x [s], y); NaN breaks it.  role: what it is, which decides its colour.  dots: points only."""

    x: Floats
    y: Floats
    role: str
    label: str = ""
    dots: bool = False


@dataclass(frozen=True, slots=True)
class Band:
    """The area between two curves."""

    x: Floats
    low: Floats
    high: Floats
    role: str
    label: str = ""


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of time; role: one of STATES."""

    begin: float
    end: float
    role: str


@dataclass(frozen=True, slots=True)
class Mark:
    """A stretch of time with a short label, drawn on the edge of a panel."""

    begin: float
    end: float
    label: str
    short: str


@dataclass(frozen=True, slots=True)
class Panel:
    """One diagram over time.  title: what one sees; note: how to read it; unit: of the vertical axis."""

    name: str
    title: str
    note: str
    unit: str
    scale: Scale
    begin: float
    end: float
    height: float
    lines: tuple[Line, ...] = ()
    bands: tuple[Band, ...] = ()
    spans: tuple[Span, ...] = ()
    phases: tuple[Mark, ...] = ()
    loads: tuple[Mark, ...] = ()


def panels(record: Record, summary: Summary, motor: Motor, profile: Profile | None) -> list[Panel]:
    """The story of a run, top to bottom; empty where nothing was recorded."""
    if record.time.size < 2:
        return []
    c = compare(record)
    end = max(round(summary.duration, 2), 0.01)
    spans = states(record)
    loads = load_steps(profile, end) if profile else ()
    phases = speed_phases(profile, end) if profile else ()
    parts = [_speed(record, c, motor, end, phases, loads), _error(record, c, summary, end, spans, loads)]
    if math.isfinite(summary.lock_time):
        parts.append(_zoom(c, summary, end, spans))
    parts += [_probing(record, end, loads), _current(record, end, loads), _excitation(record, end, loads)]
    return parts


def states(record: Record) -> tuple[Span, ...]:
    """Stretches of time by what the companion claimed; shorter ones than 10 ms go with what was before."""
    valid = record.flags & confidence.VALID != 0
    locked = record.flags & confidence.LOCKED != 0
    level = np.where(valid, 2, np.where(locked, 1, 0))
    edges = [0, *(np.flatnonzero(np.diff(level)) + 1).tolist(), level.size]
    spans: list[Span] = []
    for begin, end in pairwise(edges):
        role = STATES[int(level[begin])]
        since, until = float(record.time[begin]), float(record.time[min(end, level.size - 1)])
        if spans and (until - since < 0.01 or spans[-1].role == role):
            spans[-1] = Span(spans[-1].begin, until, spans[-1].role)
        else:
            spans.append(Span(since, until, role))
    return tuple(spans)


def load_steps(profile: Profile, end: float) -> tuple[Mark, ...]:
    """Stretches of constant load torque other than 0."""
    marks = []
    for (t_0, value), (t_1, after) in pairwise(profile.load):
        if value == after != 0.0 and t_1 > t_0 and t_0 < end:
            marks.append(Mark(t_0, min(t_1, end), f"{value:g} N m".replace("-", "−"),
                              f"{value:g}".replace("-", "−")))
    return tuple(marks)


def speed_phases(profile: Profile, end: float) -> tuple[Mark, ...]:
    """Stretches of constant speed, and reversals."""
    marks = []
    points = [*profile.speed, (max(end, profile.speed[-1][0]), profile.speed[-1][1])]
    for (t_0, value), (t_1, after) in pairwise(points):
        if t_0 >= end or t_1 <= t_0:
            continue
        t_1 = min(t_1, end)
        rpm = f"{value / RPM:.0f}".replace("-", "−")
        if value == after:
            marks.append(Mark(t_0, t_1, "standstill" if value == 0.0 else f"{rpm} rpm",
                              "still" if value == 0.0 else rpm))
        elif value * after < 0.0:
            marks.append(Mark(t_0, t_1, "reversal", "reversal"))
    return tuple(marks)


def _from_zero(high: float) -> Scale:
    """A linear scale from 0 to a little above high, with round ticks."""
    rough = max(high, 1e-9) / 3.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= 0.999 * rough)
    ticks = tuple((k * step, f"{k * step:g}") for k in range(math.floor(high / step * 1.05) + 1))
    return Scale(0.0, 1.05 * high, ticks)


def _symmetric(values: tuple[float, ...], knee: float) -> Scale:
    """An asinh scale with ticks at 0 and at +-values, which end with the last of them."""
    marks = [*(-v for v in reversed(values)), 0.0, *values]
    return Scale(-values[-1], values[-1],
                 tuple((v, f"{v:g}".replace("-", "−")) for v in marks), "asinh", knee)


def _speed(record: Record, c: Comparison, motor: Motor, end: float, phases: tuple[Mark, ...],
           loads: tuple[Mark, ...]) -> Panel:
    rpm = 1.0 / (motor.pole_pairs * RPM)
    lines = (Line(c.time, c.omega_encoder * rpm, "encoder", "encoder"),
             Line(record.time, record.omega * rpm, "estimate", "estimate from currents and voltages"))
    top = float(np.abs(c.omega_encoder * rpm).max(initial=20.0))
    scale = _symmetric(tuple(v for v in (20.0, 100.0, 1000.0, 10_000.0) if v <= 1.05 * top), 15.0)
    scale = replace(scale, low=-9.0 * top, high=1.3 * top)  # room for the load bars
    return Panel("speed", "What the motor did",
                 "Speed of the shaft, on a scale that is fine around 0, so that 20 rpm shows beside 1000. "
                 "The bars at the bottom are load torque stepped on and off.",
                 "rpm", scale, 0.0, end, 1.0, lines,
                 phases=phases, loads=loads)


def _split(c: Comparison, spans: tuple[Span, ...], y: Floats) -> tuple[Floats, Floats]:
    """y where the angle is claimed or followed, and y where it is unknown; NaN elsewhere."""
    unknown = np.zeros(c.time.size, np.bool_)
    for s in spans:
        if s.role == "unknown":
            unknown |= (c.time >= s.begin) & (c.time < s.end)
    return np.where(unknown, np.nan, y), np.where(unknown, y, np.nan)


def _error(record: Record, c: Comparison, s: Summary, end: float, spans: tuple[Span, ...],
           loads: tuple[Mark, ...]) -> Panel:
    known, unknown = _split(c, spans, c.error)
    lines = (Line(c.time, unknown, "error-unknown", "while unknown", dots=True),
             Line(c.time, known, "error", "estimate minus encoder"))
    sigma = np.minimum(np.degrees(record.sigma), 180.0)
    bands = (Band(record.time, -sigma, sigma, "sigma", "±1 sigma that the companion states"),)
    scale = _symmetric((1.0, 5.0, 30.0, 180.0), 0.5)
    title = (f"Once valid, the angle is right to {number(s.rms_valid, '.2f', '°')} rms, "
             f"{number(s.worst_valid, '.2f', '°')} at worst" if math.isfinite(s.rms_valid)
             else "The angle never became valid")
    return Panel("error", title,
                 "Error of the angle in electrical degrees; the scale is fine around 0 and coarse far out. "
                 "Until the rotor first turns the observer cannot know the angle, and the companion says so.",
                 "° electrical", scale, 0.0, end, 1.25, lines, bands, spans, loads=loads)


def _broken(theta: Floats) -> Floats:
    """Angle in degrees -180..180, with a break where it wraps."""
    y = np.degrees(np.remainder(theta + np.pi, 2.0 * np.pi) - np.pi)
    out = y.copy()
    out[1:][np.abs(np.diff(y)) > 180.0] = np.nan
    return out


def _zoom(c: Comparison, s: Summary, end: float, spans: tuple[Span, ...]) -> Panel:
    start = s.motion_time if math.isfinite(s.motion_time) and s.motion_time < s.lock_time else s.lock_time
    since, until = max(0.0, start - _ZOOM_BEFORE), min(end, s.lock_time + _ZOOM_AFTER)
    known, unknown = _split(c, spans, _broken(c.theta_estimate))
    lines = (Line(c.time, _broken(c.theta_encoder), "encoder", "encoder"),
             Line(c.time, unknown, "estimate-unknown", "estimate while unknown", dots=True),
             Line(c.time, known, "estimate", "estimate"))
    scale = Scale(-180.0, 180.0, tuple((v, f"{v:g}".replace("-", "−")) for v in (-180, -90, 0, 90, 180)))
    title = "The first lock, close up"
    if math.isfinite(s.lock_after_motion):
        title += f": valid {s.lock_after_motion:.2f} s after the rotor first moved"
    return Panel("lock", title,
                 "Rotor angle. The estimate finds the rotor while it makes its first turns; only then is it "
                 "claimed.",
                 "° electrical", scale, since, until, 1.0, lines, (), spans)


def _probing(record: Record, end: float, loads: tuple[Mark, ...]) -> Panel:
    # A command holds until the next one, so it is drawn as steps.
    t, amplitude = record.command_time, record.command_amplitude
    x = np.repeat(np.append(t, end), 2)[1:] if t.size else np.array([0.0, end])
    y = np.append(np.repeat(amplitude, 2), amplitude[-1]) if t.size else np.zeros(2)
    silent = np.flatnonzero(np.diff(t) > 0.2)
    for k in silent[::-1]:  # silence is no command at all
        x = np.insert(x, 2 * k + 2, [t[k] + 0.1, t[k] + 0.1, t[k + 1]])
        y = np.insert(y, 2 * k + 2, [amplitude[k], 0.0, 0.0])
    x, order = np.sort(x, kind="stable"), np.argsort(x, kind="stable")
    y = y[order]
    obeyed = np.where(record.injecting, 0.0, np.nan)
    lines = (Line(x, y, "probe", "asked by the companion"),
             Line(record.time, obeyed, "obeyed", "the drive says that it injects"))
    bands = (Band(x, np.zeros_like(y), y, "probe"),)
    return Panel("probing", "The probing voltage is on at low speed and off at speed",
                 "Amplitude that the companion asks the drive to add to its voltage, at a sixth of the sample rate "
                 "unless configured otherwise; cut back where it would drive too much current.",
                 "V peak", _from_zero(max(1.0, float(y.max(initial=0.0)))), 0.0, end, 0.55, lines, bands,
                 loads=loads)


def _current(record: Record, end: float, loads: tuple[Mark, ...]) -> Panel:
    lines = (Line(record.time, record.current, "current", "length of the measured current vector"),)
    return Panel("current", "The current the motor draws",
                 "Every sample that came over the bus; the ripple at low speed is the probing signal.",
                 "A peak", _from_zero(max(0.5, float(record.current.max(initial=0.0)))), 0.0, end, 0.7, lines,
                 loads=loads)


def _excitation(record: Record, end: float, loads: tuple[Mark, ...]) -> Panel:
    floor = 1e-6
    y = np.maximum(record.excitation, floor)
    powers = range(-6, max(1, math.ceil(math.log10(float(y.max(initial=1.0))))) + 1)
    sup = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    ticks = tuple((10.0**p, "1" if p == 0 else "10" + str(p).translate(sup)) for p in powers if p % 2 == 0)
    lines = (Line(record.time, y, "excitation", "excitation"),)
    return Panel("excitation", "How much the signals tell about the angle",
                 "Excitation: smallest eigenvalue of the windowed integral of Phi Phiᵀ. A turning rotor gives a "
                 "hundred thousand times more than one that stands still.",
                 "V² s", Scale(floor, 10.0 ** powers[-1], ticks, "log"), 0.0, end, 0.7, lines, loads=loads)
