"""The encoder against the motor: direction, pole pairs, slips, zero, eccentricity."""

from __future__ import annotations

import math

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case, Fit
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Series
from ipmsm_can.diagnosis.parts import DEGREES, evidence, seen, told
from ipmsm_can.drive.profile import RPM


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Everything about the encoder."""
    if not case.has_encoder:
        return [], [Checked("encoder", "untold", "the log has no encoder")]
    if not case.turns:
        return [], [Checked("encoder", "untold", "the rotor did not turn fast and far enough to compare with")]
    findings: list[Finding] = []
    checked: list[Checked] = []
    for part in (_direction, _slips, _zero, _eccentricity):
        found, looked = part(case)
        findings += found
        checked += looked
    return findings, checked


def _direction(case: Case) -> tuple[list[Finding], list[Checked]]:
    w, motor = case.wiring, case.motor
    findings: list[Finding] = []
    ratio = abs(w.encoder_ratio)
    numbers = (Evidence("true electrical angle over reported one", w.encoder_ratio),
               Evidence("speed by the encoder, median of the faster half", _speed(case, 1.0) / RPM, "rpm",
                        expected="of the shaft, with the motor's pole pairs"),
               Evidence("by current and voltage", _speed(case, w.encoder_ratio) / RPM, "rpm"))
    if w.encoder_ratio < 0.0:
        findings.append(direction_finding(numbers))
    if ratio != 1.0:
        findings.append(pole_pairs_finding(motor.pole_pairs / ratio, motor.pole_pairs, numbers))
    if findings:
        return findings, [Checked("encoder's direction and pole pairs", "found", findings[0].title)]
    state = "fine" if w.direction_known else "untold"
    words = "as the field turns" if w.direction_known else "another explanation fits as well"
    return [], [Checked("encoder's direction and pole pairs", state, words)]  # type: ignore[arg-type]


def direction_finding(numbers: tuple[Evidence, ...], doubt: str = "", plot: Plot | None = None) -> Finding:
    """That the angle falls while the field turns forwards.  doubt: another sentence, " ..." or ""."""
    return Finding(
        "encoder.direction", "error", "the encoder counts backwards",
        "The encoder's angle falls while the motor's field turns forwards. Either it counts backwards, or two "
        f"phases are swapped in current and voltage alike, as when two motor cables are swapped.{doubt}",
        "Reverse the encoder's direction in the map or the firmware; if the shaft turns against the reference, "
        "swap two motor cables instead.", numbers, plot, order=1)


def pole_pairs_finding(pairs: float, pole_pairs: int, numbers: tuple[Evidence, ...], doubt: str = "",
                       plot: Plot | None = None) -> Finding:
    """That the angle is made with `pairs` pole pairs instead of the motor's.  doubt: another sentence, or ""."""
    return Finding(
        "encoder.pole_pairs", "error", "the encoder's pole pairs are wrong",
        f"The encoder's electrical angle turns {pairs / pole_pairs:.4g} times as fast as the motor's "
        f"field: it is made with {pairs:.4g} pole pairs, and the motor has {pole_pairs}.{doubt}",
        "Correct the number of pole pairs that the encoder's angle is multiplied by; a resolver's own pole "
        "pairs count, too.", numbers, plot, order=1)


def _speed(case: Case, ratio: float) -> float:
    omega = np.abs(case.track.omega[case.usable])
    omega = omega[np.isfinite(omega)]
    return abs(ratio) * float(np.median(omega[omega >= np.median(omega)])) / case.motor.pole_pairs


def _course_plot(case: Case, note: str) -> Plot | None:
    course = case.zero_course
    if course is None or not course.row.size:
        return None
    return Plot("Encoder minus rotor over time", "time [s]", "angle [deg electrical]",
                (Series("each 12 ms or more", case.m.time[course.row], course.angle * DEGREES, "error", True),),
                note)


def _slips(case: Case) -> tuple[list[Finding], list[Checked]]:
    course = case.zero_course
    if course is None or course.row.size < 20:
        return [], [Checked("encoder slips", "untold", "the rotor was not fast for long enough")]
    if not course.slips:
        return [], [Checked("encoder slips", "fine", "its zero stays where it is")]
    first = course.slips[0]
    often = f"{len(course.slips)} times, first" if len(course.slips) > 1 else "once,"
    largest = max(course.slips, key=lambda s: abs(s.angle))
    numbers = tuple(evidence(f"step at {case.m.time[s.row]:.2f} s", s.angle, s.sigma, "deg electrical",
                             factor=DEGREES) for s in course.slips)
    return [Finding(
        "encoder.slip", "error", "the encoder slips",
        f"The encoder's zero moved {often} at {case.m.time[first.row]:.2f} s, by {largest.angle * DEGREES:+.1f} "
        "deg electrical at most. From then on its angle is wrong.",
        "Check the encoder's fastening on the shaft, its cable and its index pulse; then find the zero anew.",
        numbers, _course_plot(case, "An encoder that holds gives one level."),
        size=abs(largest.angle) / limits.SLIP_ERROR, order=1)], [
            Checked("encoder slips", "found", f"by {largest.angle * DEGREES:+.1f} deg electrical")]


def _zero(case: Case) -> tuple[list[Finding], list[Checked]]:
    fit = case.fit
    if fit is None:
        return [], [Checked("encoder's zero", "untold", "too few samples")]
    if abs(case.wiring.encoder_ratio) != 1.0:
        return [], [Checked("encoder's zero", "untold", "its pole pairs are wrong, so that it has many")]
    zero, sigma = fit.zero, max(fit.zero_sigma, 1e-4)
    if not told(zero, sigma, limits.ZERO):
        words = f"{zero * DEGREES:+.2f} deg electrical" if seen(sigma, limits.ZERO) else "cannot be told here"
        return [], [Checked("encoder's zero", "fine" if seen(sigma, limits.ZERO) else "untold", words)]
    plot = _course_plot(case, "Around the level that this finding tells.")
    return [zero_finding(zero, sigma, plot)], [
        Checked("encoder's zero", "found", f"{zero * DEGREES:+.1f} deg electrical")]


def zero_finding(zero: float, sigma: float, plot: Plot | None) -> Finding:
    """That the angle says so much more than the rotor's [rad electrical]."""
    half = abs(abs(zero) - math.pi) < math.radians(20.0)
    both = " Half a turn also comes from current and voltage both reversed." if half else ""
    return Finding(
        "encoder.zero", "error" if abs(zero) > limits.ZERO_ERROR else "warning", "the encoder's zero is off",
        f"The encoder says {zero * DEGREES:+.1f} deg electrical more than the angle of the magnets.{both}",
        "Set the encoder's zero anew: subtract this from its angle.",
        (evidence("encoder minus rotor", zero, sigma, "deg electrical", factor=DEGREES),), plot,
        size=abs(zero) / limits.ZERO, order=3)


def _eccentricity(case: Case) -> tuple[list[Finding], list[Checked]]:
    fit = case.fit
    if fit is None or _shaft_turns(fit, case.motor.pole_pairs) < 2.0:
        return [], [Checked("encoder's eccentricity", "untold", "the shaft did not turn twice")]
    error, sigma = abs(fit.eccentricity), fit.solution.pair_sigma("ecc")
    if not told(error, sigma, limits.ECCENTRICITY):
        if not seen(sigma, limits.ECCENTRICITY):
            return [], [Checked("encoder's eccentricity", "untold", "hidden by the noise")]
        return [], [Checked("encoder's eccentricity", "fine", f"{error * DEGREES:.2f} deg electrical")]
    severity = "error" if error > limits.ECCENTRICITY_ERROR else "warning"
    return [Finding(
        "encoder.eccentricity", severity, "the encoder is eccentric",  # type: ignore[arg-type]
        f"The encoder's error repeats with each turn of the shaft, with an amplitude of {error * DEGREES:.1f} deg "
        "electrical: its disc, or the resolver, does not sit in the middle.",
        "Align the encoder on the shaft. The position estimate does not suffer from it.",
        (evidence("amplitude", error, sigma, "deg electrical", factor=DEGREES),
         Evidence("that is at the shaft", error * DEGREES / case.motor.pole_pairs, "deg mechanical")),
        _shaft_plot(case, fit), size=error / limits.ECCENTRICITY, order=3)], [
            Checked("encoder's eccentricity", "found", f"{error * DEGREES:.1f} deg electrical")]


def _shaft_turns(fit: Fit, pole_pairs: int) -> float:
    theta = fit.x.theta[fit.windows.begin]
    return float(np.ptp(theta)) / (2.0 * math.pi * pole_pairs) if theta.size else 0.0


def _shaft_plot(case: Case, fit: Fit) -> Plot | None:
    course = case.zero_course
    if course is None or not course.row.size:
        return None
    shaft = np.degrees(fit.x.theta[course.row] / case.motor.pole_pairs) % 360.0
    order = np.argsort(shaft)
    at = np.linspace(0.0, 360.0, 121)
    ecc = fit.eccentricity
    # A positive term turns the magnet, thus the encoder the other way.
    curve = -(ecc.real * np.cos(np.radians(at)) + ecc.imag * np.sin(np.radians(at))) * DEGREES
    return Plot("Encoder minus rotor over a turn of the shaft", "shaft [deg mechanical]", "angle [deg electrical]",
                (Series("each 12 ms or more", shaft[order], course.angle[order] * DEGREES, "error", dots=True),
                 Series("as fitted", at, curve, "estimate")), "One wave a turn: the disc is not in the middle.")
