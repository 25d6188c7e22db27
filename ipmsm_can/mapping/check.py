"""What a survey of a log means, in plain words: what is missing, what is doubtful, and what can be done with it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK
from ipmsm_can.mapping.convert import QUALITY
from ipmsm_can.mapping.plan import CONSTANT, COUNTER, OMEGA, RATE, Channel, Plan
from ipmsm_can.mapping.survey import SignalFigures, Survey
from ipmsm_can.wire.sequence_kernel import RATE_MIN

SAMPLES_PER_TURN = 12
"""Samples per electrical turn that the fast observer needs; docs/mapping.md has what was measured."""
JITTER_SHARE = 0.5
"""Without a counter: width of the middle 90 % of the sample period, as a share of it, up to which samples count as
evenly taken."""
_MOST = 0.99
_NEARLY = 0.99
"""A rate found from arrival times is never quite the one that is meant."""
_SHARE_NEEDED = 0.5
_ENOUGH = 100
"""Samples that steady state can be told from, however many others are reported too far apart in time."""
_IDS_SHOWN = 12


@dataclass(frozen=True, slots=True)
class Ability:
    """Whether a log allows a function, and why or why not."""

    name: str
    able: bool
    why: str


def missing(survey: Survey) -> list[str]:
    """A sentence for everything that the map names and the log does not hold."""
    out: list[str] = []
    for source, frames in zip(survey.plan.sources, survey.mapper.frames.tolist(), strict=True):
        keys = ", ".join(c.key for c in source.channels)
        if not frames:
            out.append(f"message {source.codec.name} ({identifier(source.can_id)}) never came; it carries {keys}")
            continue
        out += [f"signal {c.ref} ({c.key}) was in none of the {frames} frames of its message: another multiplexer, "
                "or the frames are too short"
                for c in source.channels if not survey.signals[c.number].count]
    return out


def doubtful(survey: Survey) -> list[str]:
    """A sentence for everything that is there and cannot be quite right."""
    out = strange(survey)
    slope = survey.slope
    if math.isfinite(slope) and abs(slope - 1.0) > 0.2:
        told = ("runs against the speed: one of the two has the wrong direction" if slope < -0.5 else
                f"turns {slope:.2f} times as fast as the speed says: look at electrical, shaft and pole pairs")
        out.append(f"the angle {told}")
    for bit, words in QUALITY.items():
        count = survey.quality[bit]
        if count:
            out.append(f"{words}: in {count} of {survey.rows} samples ({_share(count, survey.rows)})")
    if survey.missing:
        out.append(f"{survey.missing} samples are missing between those that came")
    if survey.mapper.dropped:
        out.append(f"{survey.mapper.dropped} samples were repeated or late by their counter, and left out")
    return out


def strange(survey: Survey) -> list[str]:
    """A sentence for every signal whose values are not those of a drive that runs."""
    out: list[str] = []
    for c in survey.plan.channels:
        s = survey.signals[c.number]
        if c.how != CONSTANT and s.count > 20 and s.low == s.high and c.number <= OMEGA:
            out.append(f"{c.key} ({c.ref}) never changes: it is {_value(c, s.low)} in all {s.count} reports")
    most = survey.over_dc.percentile(_MOST)
    if math.isfinite(most) and most > 1.1 * 2.0 / 3.0:
        out.append(f"the voltage reaches {most:.2f} of the dc voltage, and no inverter gives more than 0.67 (peak, "
                   "per phase): look at voltage.measure and voltage.per")
    return out


def abilities(survey: Survey) -> list[Ability]:
    """What can be done with the log."""
    fast = _fast(survey)
    return [fast, _steady(survey), _encoder(survey, fast), _timing(survey, fast),
            Ability("bus statistics", True, "every log allows them")]


def fast_enough(survey: Survey) -> str:
    """"" if the samples come often and evenly enough for the fast observer, else why not."""
    if not survey.rows:
        return "no sample came"
    rate, turning = survey.rate, survey.turning.percentile(_MOST)
    if not rate >= _NEARLY * RATE_MIN:
        return f"{rate:.3g} samples a second are too few; it needs {RATE_MIN:.0f} at least"
    per_turn = 2.0 * math.pi * rate / turning if turning > 0.0 else math.inf
    if not survey.plan.counter_wrap:
        jitter = survey.signals[survey.plan.lead].jitter * rate
        if jitter > JITTER_SHARE:
            return (f"without a counter the arrival times must tell when samples were taken, and they scatter by "
                    f"{100.0 * jitter:.0f} % of the period")
    if per_turn < SAMPLES_PER_TURN:
        return (f"{rate:.4g} samples a second are {per_turn:.1f} in an electrical turn at {_hertz(turning)}; it "
                f"needs {SAMPLES_PER_TURN}")
    return ""


def _fast(survey: Survey) -> Ability:
    name = "fast observer"
    lacks = [what for what, section in (("the current", survey.plan.map.current), ("the voltage",
                                        survey.plan.map.voltage)) if section is None]
    if lacks:
        return Ability(name, False, f"the map has not {' and not '.join(lacks)} of the motor")
    if survey.plan.map.voltage is not None and not survey.plan.map.voltage.mean:
        return Ability(name, False, "the voltage is a momentary value, not the mean of the interval between "
                       "samples (voltage.mean)")
    slow = fast_enough(survey)
    if slow:
        return Ability(name, False, slow)
    if survey.usable < _SHARE_NEEDED * survey.rows:
        return Ability(name, False, f"{_few(survey.usable, survey.rows)} of the samples have current and "
                       "voltage in the stationary frame")
    apart = max(survey.quality[1], survey.quality[2])
    if apart > _SHARE_NEEDED * survey.rows:
        return Ability(name, False, "current and voltage are reported too far apart in "
                       f"{_share(apart, survey.rows)} of the samples")
    turning = survey.turning.percentile(_MOST)
    turns = f", {2.0 * math.pi * survey.rate / turning:.0f} in an electrical turn" if turning > 0.0 else ""
    return Ability(name, True, f"{survey.rate:.5g} samples a second{turns}")


def _steady(survey: Survey) -> Ability:
    name = "steady-state checks"
    inverter = survey.plan.map
    lacks = [what for what, part in (("the current", inverter.current), ("the voltage", inverter.voltage))
             if part is None]
    forms = [part.form for part in (inverter.current, inverter.voltage) if part]
    if inverter.angle is None and any(form != "dq" for form in forms):
        lacks.append("the angle")
    if inverter.angle is None and inverter.speed is None:
        lacks.append("the speed")
    if lacks:
        rest = "; speed, current and torque can be watched" if survey.rows else ""
        return Ability(name, False, f"the map has not {' and not '.join(lacks)}{rest}")
    if survey.dq < min(_SHARE_NEEDED * survey.rows, _ENOUGH) or not survey.rows:
        turned = any(form != "dq" for form in forms) and survey.rows > 0
        return Ability(name, False, f"{_few(survey.dq, survey.rows)} of the samples have current, voltage "
                       "and speed in the rotor's frame, reported near enough in time"
                       + (": map currents and voltages that are reported in d and q, if there are any" if turned
                          else ""))
    return Ability(name, True, f"{survey.dq} samples with current, voltage and speed in the rotor's frame")


def _encoder(survey: Survey, fast: Ability) -> Ability:
    name = "encoder checks"
    if not survey.encoder:
        return Ability(name, False, "no measured angle came, or none near enough to a sample")
    if not fast.able:
        return Ability(name, False, "there is nothing to compare the angle with without the fast observer")
    return Ability(name, True, f"{survey.encoder} samples with a measured angle")


def _timing(survey: Survey, fast: Ability) -> Ability:
    name = "voltage timing"
    if not fast.able:
        return Ability(name, False, "it needs what the fast observer needs")
    delay = survey.plan.map.voltage.delay if survey.plan.map.voltage else 0.0
    return Ability(name, True, "while the drive injects a probing signal; the map says that the voltage is "
                   f"{delay:g} samples late")


def text(survey: Survey, log: str, name: str) -> str:
    """The whole report."""
    lines = [f"{log} with the map {name} ({survey.plan.map.map.title})",
             f"{survey.found} frames of the map in {survey.duration:.3f} s, {survey.mapper.foreign} of other "
             f"identifiers; {survey.rows} samples", "", "signals"]
    width = max(len(c.key) for c in survey.plan.channels)
    names = max(len(str(c.ref)) for c in survey.plan.channels)
    for c in survey.plan.channels:
        source = survey.plan.source_of(c)
        where = "" if source is None else identifier(source.can_id)
        lines.append(f"  {c.key:{width}}  {c.ref!s:{names}}  {where:>10}  "
                     f"{_figures(c, survey.signals[c.number], survey)}".rstrip())
    for title, sentences in (("missing", missing(survey)), ("doubtful", doubtful(survey))):
        if sentences:
            lines += ["", title, *(f"  {s}" for s in sentences)]
    lines += ["", "what it allows"]
    able = abilities(survey)
    for a in able:
        lines.append(f"  {a.name:20} {'yes' if a.able else 'no':4} {a.why}")
    return "\n".join(lines)


def wrong_bus(survey: Survey, log: str) -> str:
    """Why a log without any frame of the map is of no use, in one sentence."""
    return no_frame(survey.plan, survey.identifiers, log)


def no_frame(plan: Plan, identifiers: Iterable[int], log: str) -> str:
    """The same of identifiers that were seen, with CAN_EFF_FLAG where they have 29 bits."""
    wanted = ", ".join(identifier(s.can_id) for s in plan.sources)
    seen = [identifier(i) for i in sorted(identifiers)]
    more = f" and {len(seen) - _IDS_SHOWN} more" if len(seen) > _IDS_SHOWN else ""
    return (f"{log} holds no frame of the map (identifiers {wanted}); seen were "
            f"{', '.join(seen[:_IDS_SHOWN]) or 'no identifiers at all'}{more}")


def identifier(can_id: int) -> str:
    """An identifier as people write it: three digits, or eight where it has 29 bits."""
    return f"0x{can_id & CAN_EFF_MASK:08X}" if can_id & CAN_EFF_FLAG else f"0x{can_id:03X}"


def _figures(c: Channel, s: SignalFigures, survey: Survey) -> str:
    if c.how == CONSTANT:
        return "stated by the map"
    if not s.count:
        return "NEVER CAME"
    rate = f"{s.rate:.4g}/s, jitter {1e3 * s.jitter:.3g} ms" if s.count > 2 else f"{s.count} times"
    distance = ""
    if c.number not in (COUNTER, RATE) and s.apart.count and c.number != survey.plan.lead:
        distance = f"; {1e3 * s.apart.percentile(0.5):.3g} ms from the current, {1e3 * s.apart.largest:.3g} at most"
    return f"{rate}; {_number(c, s.low)} to {_value(c, s.high)}{distance}"


def _number(c: Channel, value: float) -> str:
    return f"{value * c.scale:.4g}"


def _value(c: Channel, value: float) -> str:
    return f"{_number(c, value)} {c.unit}".rstrip()


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.1f} %" if whole else "none"


def _few(part: int, whole: int) -> str:
    return f"only {_share(part, whole)}" if part else "none"


def _hertz(turning: float) -> str:
    return f"{turning / (2.0 * math.pi):.3g} Hz"
