"""What operating points tell, as findings: with the codes and words of `checks` where the same is found there."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.checks import motor as motors
from ipmsm_can.diagnosis.checks.encoder import direction_finding, pole_pairs_finding, zero_finding
from ipmsm_can.diagnosis.checks.samples import lost_finding
from ipmsm_can.diagnosis.checks.voltage import dead_time_finding
from ipmsm_can.diagnosis.checks.wiring import sign_finding
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Series
from ipmsm_can.diagnosis.parts import DEGREES, evidence, seen, told
from ipmsm_can.diagnosis.steady_fit import NAMES
from ipmsm_can.drive.profile import RPM

if TYPE_CHECKING:
    from ipmsm_can.diagnosis.steady import SteadyCase

Found = tuple[list[Finding], list[Checked]]

_SOME_TORQUE = 0.1
_TORQUE_POINTS = 3
_SCALES = ((math.sqrt(3.0), "a line voltage taken for one of a phase"),
           (math.sqrt(2.0), "an rms value taken for a peak, or the other way round"),
           (1.5, "another scaling of d and q"),
           (math.sqrt(1.5), "d and q of the power-invariant transformation"))
_NEAR = 0.03
"""How near a factor must be to one of those to be named."""


def samples(case: SteadyCase) -> Found:
    """Samples lost or reported too far apart, signals that are missing or strange."""
    s = case.s
    findings = lost_finding(s.received, s.lost)
    apart = {words: n for words, n in s.apart.items() if n > limits.LOST * max(1, s.received)}
    if apart:
        most = max(apart.values())
        findings.append(Finding(
            "samples.apart", "info", "values are reported too far apart in time",
            f"In {100.0 * most / s.received:.0f} % of the samples the rotor turned too far between reports that "
            "belong together; they were left out.",
            "Let the drive send these messages together and more often, or map values that do not turn: currents "
            "in d and q (timing.limit_angle and limit_time say what is too far).",
            tuple(Evidence(words, n, "samples") for words, n in apart.items()),
            size=most / max(1, s.received) / limits.LOST, order=6))
    if s.notes:
        findings.append(Finding(
            "signals.doubtful", "info", "signals of the map are doubtful", f"{'; '.join(s.notes)}.",
            "`ipmsm-can map --check` lists every signal; correct the map, or what the drive sends.", order=6))
    return findings, [Checked("samples", "found" if findings else "fine", f"{s.received} received, {s.lost} lost")]


def turning(case: SteadyCase) -> Found:
    """The reported angle against the reported speed, and which of them is wrong."""
    name, t = "direction and pole pairs of angle and speed", case.turning
    if t.differ:
        finding = Finding(
            "speed.angle", "error", "angle and speed do not fit each other",
            "The reported angle does not turn as the reported speed says. At this one speed several ratios of "
            "pole pairs and both directions explain it, so that it cannot be told which.",
            "Log the drive at several speeds; see map.angle, map.speed and the pole pairs.",
            (Evidence("what is left between them, over a radian", t.apart_deg, "deg"),), order=1)
        return [finding], [Checked(name, "found", finding.title)]
    if t.several:
        return [], [Checked(name, "untold", "at this one speed other ratios of pole pairs, or another direction, "
                            "fit as well")]
    if not math.isfinite(t.ratio):
        why = ("the speed, the angle or both are not reported, or the rotor hardly turned; or they fit at no ratio "
               "of pole pairs")
        return [], [Checked(name, "untold", why)]
    if not case.disagree:
        return [], [Checked(name, "fine", "the angle turns as the speed says")]
    numbers = (Evidence("the angle's own speed over the reported one", t.ratio),
               Evidence("what is left between them at that ratio, over a radian", t.apart_deg, "deg"))
    plot = None if case.why_no_fit else _equation_plot(case)
    findings = []
    if case.speed_is_wrong:
        if t.ratio < 0.0:
            findings.append(Finding(
                "speed.direction", "error", "the speed has the wrong sign",
                "The reported speed is negative while the angle and the motor's field turn forwards, and positive "
                "while they turn backwards.",
                "Reverse the sign of the speed in the map or the firmware.", numbers, plot, order=1))
        if abs(t.ratio) != 1.0:
            findings.append(Finding(
                "speed.pole_pairs", "error", "the speed's pole pairs are wrong",
                f"The reported speed is {1.0 / abs(t.ratio):.4g} times that of the angle and of the motor's field: "
                "it is made with another number of pole pairs, or is the shaft's where the electrical one was "
                "expected.", "Correct speed.unit in the map, or the number of pole pairs in the drive.", numbers,
                plot, order=1))
    else:
        doubt = "" if case.speed_is_wrong is False else (
            " It may as well be the speed that is wrong: nothing else tells.")
        if t.ratio < 0.0:
            findings.append(direction_finding(numbers, doubt, plot))
        if abs(t.ratio) != 1.0:
            pairs = case.motor.pole_pairs
            findings.append(pole_pairs_finding(abs(t.ratio) * pairs, pairs, numbers, doubt, plot))
    return findings, [Checked(name, "found", findings[0].title)]


def signs(case: SteadyCase) -> Found:
    """Current or voltage reversed; a field that turns against angle and speed."""
    name, fit = "signs of current, voltage and speed", case.fit
    if case.against_both:
        numbers = _costs(case)
        if math.isfinite(case.turning.ratio):
            found = direction_finding(
                numbers, " The speed runs backwards with it; what changes both are two swapped phases or a q axis "
                "of the other sign.", _equation_plot(case))
        else:
            found = Finding(
                "speed.direction", "error", "the speed has the wrong sign",
                "Going by current and voltage, the motor's field turns against the reported speed.",
                "Reverse the sign of the speed in the map or the firmware.", numbers, _equation_plot(case), order=1)
        return [found], [Checked(name, "found", found.title)]
    if fit.current_reversed:
        what = "voltage" if case.voltage_reversed else "current"
        other = "current" if what == "voltage" else "voltage"
        doubt = f" The {other} reversed and the angle off by half a turn would look the same."
        power = 1.5 * (case.points.v * case.points.i.conj()).real
        numbers = (Evidence("mean power into the motor, as reported", float(power.mean()), "W"),
                   Evidence("the same with this undone", -float(power.mean()), "W"), *_costs(case))
        found = sign_finding(what, doubt, numbers, _equation_plot(case))
        return [found], [Checked(name, "found", found.title)]
    if case.signs_known:
        return [], [Checked(name, "fine", "current, voltage and speed fit each other")]
    return [], [Checked(name, "untold", _too_alike(case))]


def zero(case: SteadyCase) -> Found:
    """The reported frame against the rotor, and the reported angle against the frame of d and q."""
    # currents and voltages in the drive's own d and q tell where those stand, and nothing of an angle beside them
    own = not (case.s.i_by_angle or case.s.v_by_angle)
    fit, name = case.fit, "zero of the drive's own d and q" if own else "zero of the reported angle"
    if case.against_both or case.angle_reversed:
        return [], [Checked(name, "untold", "the direction is wrong")]
    findings = []
    sigma = max(fit.sigma("delta"), 1e-4)
    if told(case.zero, sigma, limits.ZERO):
        finding = zero_finding(case.zero, sigma, _magnet_plot(case, True))
        late = "A voltage that is reported for another instant than the angle looks alike at a single speed."
        doubt = "" if case.signs_known else (
            f" Nor are the signs of current, voltage and speed told ({_too_alike(case)}): one of them reversed may "
            "look like this.")
        findings.append(replace(finding, sentence=f"{finding.sentence} {late}{doubt}"))
        checked = [Checked(name, "found", f"{case.zero * DEGREES:+.1f} deg electrical")]
    elif seen(sigma, limits.ZERO):
        checked = [Checked(name, "fine", f"{case.zero * DEGREES:+.2f} deg electrical")]
    else:
        checked = [Checked(name, "untold", f"only to {limits.SIGMAS_95 * sigma * DEGREES:.0f} deg (95 %): "
                           f"{_too_alike(case)}; an L_q that is off, or a voltage that is late, is an angle there")]
    more, also = _frames(case)
    if own and np.isfinite(case.s.theta).any():
        also = [Checked("zero of the reported angle", "untold",
                        "neither current nor voltage goes through it: both are in the drive's own d and q")]
    return findings + more, checked + also


def _frames(case: SteadyCase) -> Found:
    """The reported angle against the frame that the drive's own d and q stand in."""
    if not case.equation.mixed:
        return [], []
    name = "the angle against the drive's own d and q"
    turned, sigma = case.fit["turned"], max(case.fit.sigma("turned"), 1e-4)
    if case.s.v_by_angle:
        turned = -turned
    if told(turned, sigma, limits.ZERO):
        finding = Finding(
            "encoder.frame", "warning", "the angle is not that of the drive's d and q",
            f"The reported angle is {turned * DEGREES:+.1f} deg electrical ahead of the frame in which the drive "
            "reports d and q: angle.zero of the map is wrong, or the angle is of another instant.",
            "Correct angle.zero in the map, or map currents and voltages that are both in d and q.",
            (evidence("angle minus frame of d and q", turned, sigma, "deg electrical", factor=DEGREES),
             evidence("and a time of", case.fit["turned_late"], case.fit.sigma("turned_late"), "us", factor=1e6)),
            size=abs(turned) / limits.ZERO, order=3)
        return [finding], [Checked(name, "found", f"{turned * DEGREES:+.1f} deg electrical")]
    if seen(sigma, limits.ZERO):
        return [], [Checked(name, "fine", f"{turned * DEGREES:+.1f} deg electrical")]
    return [], [Checked(name, "untold", "there was too little current, or always at the same speed")]


def motor(case: SteadyCase) -> Found:
    """psi_m, and R, L_q, L_d and the dead time where they came out better than they were known beforehand."""
    fit, plate = case.fit, case.motor
    limit = motors.allowed(case.config)
    found = []
    for name in ("psi_m", "R", "L_q", "L_d"):
        better = fit.sigma(name) < 0.5 * fit.beforehand(name)
        found.append(motors.Parameter(name, fit[name], fit.sigma(name) if better else math.inf,
                                      getattr(plate, name), limit[name]))
    findings, checked = motors.judge(found, case.config, lambda name: _why(case, name))
    for k, finding in enumerate(findings):
        if finding.code == "motor.psi_m":
            findings[k] = replace(finding, sentence=finding.sentence + _otherwise(case, found[2]),
                                  plot=_magnet_plot(case, False))
    volts, sigma, most = fit["dead_time"], fit.sigma("dead_time"), limits.VOLTAGE * case.volts
    if sigma > 0.5 * case.volts:
        checked.append(Checked("dead time", "untold", "the current hardly changed its size"))
    elif told(volts, sigma, most) and volts > 0.0:
        findings.append(dead_time_finding(volts, sigma, case.volts, None))
        checked.append(Checked("dead time", "found", f"{volts:.2f} V a phase"))
    else:
        checked.append(Checked("dead time", "fine", f"{volts:.2f} V a phase"))
    return findings, checked


def _otherwise(case: SteadyCase, l_q: motors.Parameter) -> str:
    """What else makes such a psi_m, and whether L_q bears it out; "" for nothing."""
    plate = case.motor
    ratio = case.fit["psi_m"] / plate.psi_m
    factor, what = min(_SCALES, key=lambda scale: abs(abs(math.log(ratio)) - math.log(scale[0])))
    out = ""
    if abs(abs(math.log(ratio)) - math.log(factor)) < _NEAR:
        shown = factor if ratio > 1.0 else 1.0 / factor
        out += f" The factor {ratio:.3g} is near {shown:.3g}, too, which {what} makes of a voltage."
    pairs = round(ratio * plate.pole_pairs)
    if case.s.by_pole_pairs and pairs not in (0, plate.pole_pairs) and (
            abs(ratio * plate.pole_pairs / pairs - 1.0) < _NEAR):
        out += (f" A motor of {pairs} pole pairs, not {plate.pole_pairs}, would show it, too: the speed is made of "
                "the shaft's.")
    if out and l_q.known:
        from_it, from_plate = abs((1.0 + l_q.share) / ratio - 1.0), abs(l_q.share)
        if from_it < 0.5 * from_plate:
            out += " L_q is off by as much, as it would be then."
        elif from_plate < 0.5 * from_it:
            out += " But L_q is not off by as much."
    return out


def torque(case: SteadyCase) -> Found:
    """The reported torque against that of the fitted machine.

    A drive makes its torque from currents and parameters of its own.  Where those are drive.toml's, the torque is
    off because the motor is, and that is told of the motor; else beyond limits.PSI_M it is worth knowing, beyond
    twice that a warning.
    """
    p, fit, name = case.points, case.fit, "reported torque"
    turn = (-1.0 if fit.current_reversed else 1.0) * np.exp(1j * (fit["delta"] + fit["turned"]))
    i = p.i * turn
    model = 1.5 * case.motor.pole_pairs * (fit["psi_m"] + (fit["L_d"] - fit["L_q"]) * i.real) * i.imag
    if case.against_both:
        return [], [Checked(name, "untold", "the direction is wrong")]
    rows = np.isfinite(p.torque)
    if not rows.any():
        return [], [Checked(name, "untold", "none is reported")]
    good = rows & (np.abs(model) > _SOME_TORQUE * case.motor.rated_torque)
    if np.count_nonzero(good) < _TORQUE_POINTS:
        return [], [Checked(name, "untold", f"fewer than {_TORQUE_POINTS} operating points with a tenth of rated "
                            "torque")]
    x, y = model[good], p.torque[good]
    k = float(x @ y / (x @ x))
    rest = float(((y - k * x)**2).sum()) / (x.size - 1)
    sigma = math.hypot(math.sqrt(rest / float(x @ x)), k * fit.sigma("psi_m") / fit["psi_m"])
    off, limit = k - 1.0, limits.PSI_M
    words = f"{100.0 * k:.0f} % of that of currents and fitted motor"
    if not told(off, sigma, limit):
        return [], [Checked(name, "fine" if seen(sigma, limit) else "untold", words)]
    much = abs(off) > 2.0 * limit
    plate = case.motor
    named = (1.5 * plate.pole_pairs * (plate.psi_m + plate.L_0 * p.i.real) * p.i.imag)[good]
    if abs(float(named @ y / (named @ named)) - 1.0) < 0.5 * limit:
        return [], [Checked(name, "fine", f"{words}, and that of the currents with drive.toml's motor: the drive "
                            "takes the motor for that one")]
    ends = np.array([min(x.min(), 0.0), max(x.max(), 0.0)])
    plot = Plot("Torque", "of currents and fitted motor [N m]", "as reported [N m]",
                (Series("operating points", x, y, "error", dots=True), Series("alike", ends, ends, "estimate")))
    return [Finding(
        "torque.scale", "warning" if much else "info", "the reported torque is not the motor's",
        f"The reported torque is {words}.",
        "See the findings above it first; else correct the motor's parameters in the drive, the scaling or sign of "
        "the torque in the map, or motor.pole_pairs here.",
        (evidence("reported torque over the motor's", k, sigma, ""),), plot, size=abs(off) / limit, order=4)], [
            Checked(name, "found", words)]


def _too_alike(case: SteadyCase) -> str:
    count = len(case.points)
    return ("there was only one operating point" if count == 1 else
            f"the {count} operating points are too much alike: other loads, speeds and directions tell more")


def _why(case: SteadyCase, name: str) -> str:
    share = 100.0 * case.fit.sigma(name) / max(getattr(case.motor, name), 1e-12)
    if name == "psi_m":
        off = 100.0 * (case.fit[name] / case.motor.psi_m - 1.0)
        return (f"{off:+.0f} % against drive.toml, but only to {limits.SIGMAS_95 * share:.0f} % (95 %): too few "
                "operating points, or too much alike")
    known = f"to {limits.SIGMAS_95 * share:.0f} % (95 %) only, hardly better than drive.toml: "
    if name == "R" and len(case.points) > 1:
        return f"{known}it takes too little of the voltage to be told from dead time"
    return known + _too_alike(case)


def _costs(case: SteadyCase) -> tuple[Evidence, ...]:
    def rms(residual: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> float:
        return float(np.sqrt((np.abs(residual)**2).mean()))

    return (Evidence("voltage left unexplained, as reported", rms(case.as_reported.residual), "V rms"),
            Evidence("the same with this undone", rms(case.fit.residual), "V rms"))


def _equation_plot(case: SteadyCase) -> Plot:
    """Reported voltages over those of the equation, with drive.toml's motor and the fitted angle and magnets."""
    v = case.points.v
    across = []
    for f in (case.as_reported, case.fit):
        x = case.equation.centre.copy()
        for k, known in enumerate(np.isfinite(case.equation.prior)):
            if not known:
                x[k] = f.value[k]
        across.append(case.equation.voltage(x, f.current_reversed, f.speed_factor))
    up = _parts(v)
    ends = np.array([up.min(), up.max()])
    return Plot("Voltage by the equation and as reported", "by the equation, with R and L of drive.toml [V]",
                "as reported [V]", (
                    Series("everything as reported", _parts(across[0]), up, "error", True),
                    Series("with this undone", _parts(across[1]), up, "probe", True),
                    Series("alike", ends, ends, "estimate")),
                "d and q of each operating point; on the line: explained.")


def _parts(x: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.concatenate([x.real, x.imag])


def _magnet_plot(case: SteadyCase, angle: bool) -> Plot:
    """The flux that the magnets are left with at each operating point that turns fast: its length, or its angle."""
    fit, p = case.fit, case.points
    fast = p.fast(case.motor)
    x = fit.value.copy()
    x[NAMES.index("psi_m")] = 0.0
    w = fit.speed_factor * p.omega
    flux = ((p.v - case.equation.voltage(x, fit.current_reversed, fit.speed_factor))
            * np.exp(-1j * w * fit["late"]) / np.where(fast, 1j * w, 1.0))[fast]
    rpm = p.omega[fast] / case.motor.pole_pairs / RPM
    ends = np.array([rpm.min(), rpm.max()])
    if angle:
        # turned back by the fit first, so that half a turn does not show as two levels
        off = case.zero - np.angle(flux * cmath.exp(1j * fit["delta"]))
        up, found, plate, unit = off * DEGREES, case.zero * DEGREES, 0.0, "angle minus rotor [deg electrical]"
        title = "Reported angle minus that of the magnets"
    else:
        up, found, plate, unit = 1e3 * np.abs(flux), 1e3 * fit["psi_m"], 1e3 * case.motor.psi_m, "flux [mWb]"
        title = "Flux of the magnets"
    return Plot(title, "speed [rpm]", unit, (
        Series("operating points", rpm, up, "error", True),
        Series("as fitted", ends, np.full(2, found), "estimate"),
        Series("as it ought to be" if angle else "as drive.toml says", ends, np.full(2, plate), "encoder")),
        "What R, the inductances and the dead time leave of the voltage, over the speed.")
