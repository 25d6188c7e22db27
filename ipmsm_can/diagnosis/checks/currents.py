"""The current sensors: offset, and gains that differ between the phases."""

from __future__ import annotations

import cmath
import math

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case, Fit
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Series
from ipmsm_can.diagnosis.parts import evidence, explained, seen, told

_AT_REST_S = 0.05
_THIRD = 2.0 * math.pi / 3.0
_DOTS = 400
_HALF_SURE = 2.5
_HIDDEN = "none seen, but without an encoder the observer's angle hides some of it"


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Offset and imbalance of the current."""
    found, looked = _offset(case)
    more, also = _imbalance(case)
    return found + more, looked + also


def _offset_at_rest(case: Case) -> tuple[complex, float] | None:
    """Mean current and its 1-sigma [A] while the drive does not switch; None where it always does."""
    rows = np.flatnonzero(case.m.usable & ~case.m.running)
    if rows.size < _AT_REST_S * case.m.sample_rate:
        return None
    i = case.m.i_alpha[rows] + 1j * case.m.i_beta[rows]
    middle = complex(np.median(i.real), np.median(i.imag))
    near = np.abs(i - middle) < 0.1 * case.motor.rated_current
    if np.count_nonzero(near) < 0.5 * rows.size:
        return None  # the current still falls, or the machine feeds back
    return complex(i[near].mean()), float(i[near].std() / math.sqrt(np.count_nonzero(near)) + 1e-4)


def _offset(case: Case) -> tuple[list[Finding], list[Checked]]:
    limit = limits.OFFSET * case.motor.rated_current
    rest = _offset_at_rest(case)
    plot: Plot | None = None
    if rest is not None:
        offset, sigma, how = *rest, "while the drive does not switch"
        plot = _dots(case)
    elif case.fit is None:
        return [], [Checked("current offset", "untold", "too few samples of a running drive")]
    else:
        offset, sigma = case.fit.offset, case.fit.solution.pair_sigma("o")
        how = "from how it turns with the saliency"
        if _confirmed(case.fit, offset, sigma):
            sigma = min(sigma, abs(offset) / (limits.SURE + 1.0))
        if not (seen(sigma, limit) or told(abs(offset), sigma, limit)):
            return [], [Checked("current offset", "untold", "the rotor turned too little, or the machine is too "
                                "little salient; log it with the drive off, where it shows at once")]
        # Back in the frame that is reported.
        w = case.wiring
        if w.current_mirrored:
            offset = offset.conjugate()
        offset *= cmath.rect(1.0, w.current_sixths * math.pi / 3.0)
        plot = explained(case, case.fit, ("o.x", "o.y"), "the current offset")
    if not told(abs(offset), sigma, limit):
        if rest is None and not case.by_encoder:
            return [], [Checked("current offset", "untold", _HIDDEN)]
        return [], [Checked("current offset", "fine", f"{abs(offset):.3f} A {how}")]
    share = 100.0 * abs(offset) / case.motor.rated_current
    return [Finding(
        "current.offset", "warning", "the current has an offset",
        f"The current sensors read {abs(offset):.3g} A where there is none, {share:.1f} % of rated current. It "
        "makes torque ripple at the electrical frequency, and a real direct current in the winding.",
        "Let the drive find the zero of its current sensors anew with the inverter off; else replace the sensor.",
        (evidence("offset of i_alpha", offset.real, sigma, "A"),
         evidence("offset of i_beta", offset.imag, sigma, "A"),
         Evidence("limit", limit, "A", expected=f"{100 * limits.OFFSET:g} % of rated current")),
        plot, size=abs(offset) / limit, order=3)], [
            Checked("current offset", "found", f"{abs(offset):.3f} A {how}")]


def _confirmed(fit: Fit, offset: complex, sigma: float) -> bool:
    """The voltage confirms the offset: with it undone, no constant voltage is left of what its drop at R made.

    That two things so different agree by chance is far less likely than either is uncertain.
    """
    left, spread = abs(fit.solution.pair("u")), fit.solution.pair_sigma("u")
    drop = abs(fit.solution["R"] * offset)
    return abs(offset) > _HALF_SURE * sigma and left < limits.SURE * spread and drop > 6.0 * max(left, spread)


def _dots(case: Case) -> Plot:
    rows = np.flatnonzero(case.m.usable & ~case.m.running)
    rows = rows[::max(1, rows.size // _DOTS)]
    return Plot("Current while the drive does not switch", "i_alpha [A]", "i_beta [A]",
                (Series("samples", case.m.i_alpha[rows], case.m.i_beta[rows], "error", dots=True),
                 Series("no current", np.zeros(1), np.zeros(1), "estimate", dots=True)), "It ought to be 0.")


def _imbalance(case: Case) -> tuple[list[Finding], list[Checked]]:
    if case.fit is None:
        return [], [Checked("gain of the current sensors", "untold", "too few samples of a running drive")]
    g, sigma = case.fit.gain, case.fit.solution.pair_sigma("g")
    w = case.wiring
    if w.current_mirrored:
        g = g.conjugate()
    g *= cmath.rect(1.0, 2.0 * w.current_sixths * math.pi / 3.0)
    # A gain 1 + e of phase k puts e/3 of the current into the mirrored one, turned by twice the phase's angle.
    gains = [2.0 * (g * cmath.rect(1.0, -2.0 * _THIRD * k)).real for k in range(3)]
    spread, spread_sigma = max(gains) - min(gains), 3.0 * sigma
    if not (seen(spread_sigma, limits.IMBALANCE) or told(spread, spread_sigma, limits.IMBALANCE)):
        return [], [Checked("gain of the current sensors", "untold", "there was too little current, or it hardly "
                            "turned")]
    if not told(spread, spread_sigma, limits.IMBALANCE):
        if not case.by_encoder:
            return [], [Checked("gain of the current sensors", "untold", _HIDDEN)]
        return [], [Checked("gain of the current sensors", "fine", f"phases differ by {100 * spread:.1f} %")]
    worst = max(range(3), key=lambda k: abs(gains[k]))
    name = "abc"[worst]
    side = "high" if gains[worst] > 0.0 else "low"
    # Two phases alike and one off is what a single sensor makes.
    alone = 1.5 * gains[worst]
    return [Finding(
        "current.gain", "warning", "the current sensors' gains differ",
        f"The sensors of the phases differ by {100 * spread:.1f} %: phase {name} reads too {side}. It makes torque "
        "ripple at twice the electrical frequency, and unequal heating.",
        f"Check the current sensor of phase {name} and its scaling ({100 * alone:+.1f} %, if it alone is wrong).",
        tuple(evidence(f"gain of phase {n} against the mean", 100.0 * e, 200.0 * sigma, "%")
              for n, e in zip("abc", gains, strict=True)),
        explained(case, case.fit, ("g.x", "g.y"), "unequal gains"), size=spread / limits.IMBALANCE, order=3)], [
            Checked("gain of the current sensors", "found", f"phases differ by {100 * spread:.1f} %")]
