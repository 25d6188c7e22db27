"""Signs and order of phases: what has to be undone before anything else makes sense."""

from __future__ import annotations

import numpy as np

from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Series
from ipmsm_can.diagnosis.wiring import SWAPPED

_CYCLIC = {2: "c, a, b", 4: "b, c, a"}
_POINTS = 400


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Reversed and swapped currents and voltages."""
    w = case.wiring
    findings: list[Finding] = []
    for what, mirrored, sixths in (("current", w.current_mirrored, w.current_sixths),
                                   ("voltage", w.voltage_mirrored, w.voltage_sixths)):
        if mirrored or sixths:
            findings.append(_finding(case, what, mirrored, sixths))
    if findings:
        return findings, [Checked("signs and order of phases", "found", findings[0].title)]
    if w.order_known and w.sign_known:
        return [], [Checked("signs and order of phases", "fine", "current, voltage and rotation fit each other")]
    why = ("the rotor hardly turned" if not w.order_known else
           "current and speed hardly changed, so that the sign of the current shows in nothing")
    return [], [Checked("signs and order of phases", "untold", why)]


def _finding(case: Case, what: str, mirrored: bool, sixths: int) -> Finding:
    other = "voltage" if what == "current" else "current"
    doubt = "" if case.by_encoder else f" Without an encoder it may as well be the {other}."
    reversed_too = sixths % 2 == 1
    thirds = (sixths + 3 if reversed_too else sixths) % 6 // 2
    if not mirrored and sixths == 3:
        return sign_finding(what, doubt, _numbers(case), _power(case))
    sign = " and reversed" if reversed_too else ""
    if mirrored:
        pair = SWAPPED[thirds]
        return Finding(
            f"wiring.{what}_phases", "error", f"phases {pair} of the {what} are swapped{sign}",
            f"The reported {what} turns the other way than the {other}: phases {pair} are swapped{sign}.{doubt}",
            f"Swap the phases {pair} of the {what} in the map or the firmware, or at the sensors.",
            _numbers(case), _power(case), order=0)
    return Finding(
        f"wiring.{what}_phases", "error", f"the {what}'s phases are one place further{sign}",
        f"The reported {what} is turned by 120 deg against the {other}: where a, b, c are reported stand the "
        f"phases {_CYCLIC.get(2 * thirds, 'a, b, c')}{sign}.{doubt}",
        f"Put the phases of the {what} in order in the map or the firmware.", _numbers(case), _power(case), order=0)


def sign_finding(what: str, doubt: str, numbers: tuple[Evidence, ...], plot: Plot | None) -> Finding:
    """That `what`, "current" or "voltage", is reversed.  doubt: another sentence, " ..." or ""."""
    return Finding(
        f"wiring.{what}_sign", "error", f"the {what} is reversed",
        f"The reported {what} has the wrong sign: with it the motor would have a negative resistance and "
        f"negative inductances, and energy would flow the wrong way.{doubt}",
        f"Reverse the sign of the {what} in the map or the firmware"
        + (", or turn the current sensors round." if what == "current" else "."), numbers, plot, order=0)


def _numbers(case: Case) -> tuple[Evidence, ...]:
    w = case.wiring
    as_is, undone = _mean_power(case, False), _mean_power(case, True)
    out = [Evidence("mean power into the motor, as reported", as_is, "W"),
           Evidence("the same with this undone", undone, "W")]
    fit = case.fit
    if fit is not None and case.by_encoder:
        out.append(Evidence("voltage left unexplained, as reported", w.rms_as_is / fit.windows.period, "V rms"))
        out.append(Evidence("the same with this undone", fit.solution.rms / fit.windows.period, "V rms"))
    return tuple(out)


def _power_of(case: Case, undone: bool) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    m = case.m
    i, v = m.i_alpha + 1j * m.i_beta, m.v_alpha + 1j * m.v_beta
    if undone:
        i, v = case.vectors.i, case.vectors.v
    return np.asarray(1.5 * (v * i.conj()).real)


def _mean_power(case: Case, undone: bool) -> float:
    return float(_power_of(case, undone)[case.usable].mean())


def _power(case: Case) -> Plot:
    rows = np.flatnonzero(case.usable)
    parts = np.array_split(rows, min(_POINTS, max(1, rows.size)))
    t = np.array([case.m.time[p].mean() for p in parts])
    lines = []
    for label, undone, role in (("as reported", False, "error"), ("with this undone", True, "estimate")):
        power = _power_of(case, undone)
        lines.append(Series(label, t, np.array([power[p].mean() for p in parts]), role))
    return Plot("Power into the motor", "time [s]", "power [W]", tuple(lines),
                "A motor that speeds up or carries a load takes power.")
