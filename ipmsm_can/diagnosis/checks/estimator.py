"""How the project's own observer fares on these samples."""

from __future__ import annotations

import math

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import CLEAR_EMF, Case
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Series
from ipmsm_can.diagnosis.parts import DEGREES

_POINTS = 600
_START_S = 0.5


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Lock, validity and, beside an encoder, error of the position estimate."""
    o = case.observed_as_reported
    if not case.usable.any():
        return [], [Checked("position estimate", "untold", "the drive did not run")]
    speed = np.abs(case.track.omega if case.by_encoder else o.omega)
    fast = case.usable & (np.nan_to_num(speed) * case.motor.psi_m > CLEAR_EMF * case.volts)
    fast &= case.m.time > _START_S
    valid = o.valid & case.usable
    share = float(valid[fast].mean()) if fast.any() else math.nan
    sigma = float(np.median(o.sigma[valid])) * DEGREES if valid.any() else math.nan
    numbers = (Evidence("valid while the rotor turns", 100.0 * share, "% of the time"),
               Evidence("locked", 100.0 * float(o.locked[case.usable].mean()), "% of the time"),
               Evidence("lock given up", float(o.lost_locks), "times"),
               Evidence("1-sigma while valid, median", sigma, "deg electrical"))
    findings = []
    if np.count_nonzero(fast) > 0.2 * case.m.sample_rate and share < limits.VALID:
        findings.append(Finding(
            "estimator.invalid", "warning", "the observer does not trust its angle",
            f"While the rotor turned fast enough, the position estimate was valid for {100 * share:.0f} % of the "
            f"time only, and gave up its lock {o.lost_locks} times: the samples do not fit the motor that "
            "drive.toml tells.", "See the findings above it first; without any, check the motor's parameters and "
            "the scaling of currents and voltages.", numbers, _plot(case),
            size=limits.VALID / max(share, 0.05), order=5))
    wrong, words = _wrong(case)
    findings += wrong
    told = f"valid {100 * float(valid[case.usable].mean()):.0f} % of the time"
    told += f", 1-sigma {sigma:.1f} deg" if math.isfinite(sigma) else ""
    return findings, [Checked("position estimate", "found" if findings else "fine", told + words)]


def _error(case: Case) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]],
                                np.ndarray[tuple[int], np.dtype[np.intp]]] | None:
    """Estimate minus rotor [rad electrical], as far as the corrected encoder tells, at valid samples."""
    o, fit = case.observed_as_reported, case.fit
    if fit is None or not case.by_encoder or not case.wiring.is_right:
        return None
    rows = np.flatnonzero(o.valid & case.usable & np.isfinite(fit.x.theta))
    if not rows.size:
        return None
    return np.angle(np.exp(1j * (o.angle[rows] - fit.x.theta[rows]))), rows


def _wrong(case: Case) -> tuple[list[Finding], str]:
    found = _error(case)
    if found is None:
        return [], ""
    error = found[0]
    rms, share = float(np.sqrt(np.mean(error**2))), float((np.abs(error) > limits.WRONG).mean())
    words = f", {rms * DEGREES:.1f} deg rms off the rotor"
    if share <= limits.WRONG_SHARE:
        return [], words
    return [Finding(
        "estimator.wrong", "error", "the estimated angle is wrong",
        f"For {100 * share:.0f} % of the time in which the angle was called valid, it was more than "
        f"{limits.WRONG * DEGREES:.0f} deg electrical off the rotor.",
        "Do not run the drive on this angle. See the findings above it first; then check the motor's parameters.",
        (Evidence("error", rms * DEGREES, "deg electrical rms"),), _plot(case), size=share / limits.WRONG_SHARE,
        order=5)], words


def _plot(case: Case) -> Plot | None:
    found = _error(case)
    if found is None:
        return None
    error, rows = found
    step = max(1, rows.size // _POINTS)
    return Plot("Estimate minus rotor", "time [s]", "angle [deg electrical]",
                (Series("valid samples", case.m.time[rows[::step]], error[::step] * DEGREES, "error", dots=True),),
                "The rotor's angle is the encoder's, with its errors taken off.")
