"""From a measurement to a report."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.checks import currents, encoder, estimator, excitation, motor, samples, voltage, wiring
from ipmsm_can.diagnosis.finding import Checked, Finding, Plot, Report, Series, ranked
from ipmsm_can.diagnosis.steady import diagnose_steady
from ipmsm_can.drive.profile import RPM

if TYPE_CHECKING:
    from ipmsm_can.analysis.measurement import Measurement
    from ipmsm_can.analysis.steady import SteadySamples
    from ipmsm_can.config.model import DriveConfig

CHECKS = (wiring, encoder, currents, voltage, motor, estimator, excitation, samples)
"""What is looked at, causes first."""
_LEAST_S = 0.05
_POINTS = 800


def diagnose(measurement: Measurement | SteadySamples, config: DriveConfig, *, thorough: bool = True) -> Report:
    """What is wrong with the drive of `config`, going by a measurement, or by samples that are too slow for one.

    Nothing found is said as plainly: `Report.checked` tells what was looked at, and what could not be, and why.
    thorough: identify the motor's parameters exactly, which takes a second or so; else quickly.
    The same samples give the same report.
    """
    from ipmsm_can.analysis.steady import SteadySamples

    if isinstance(measurement, SteadySamples):
        return diagnose_steady(measurement, config)
    case = Case(measurement, config, thorough)
    facts = _facts(case)
    if case.seconds < _LEAST_S and not (measurement.usable & ~measurement.running).any():
        why = f"only {case.seconds:.3f} s of usable samples of a running drive"
        found, looked = samples.check(case)
        rest = Checked("everything else", "untold", why)
        return Report(measurement.source, ranked(found), (*looked, rest), facts)
    findings: list[Finding] = []
    checked: list[Checked] = []
    for part in CHECKS:
        found, looked = part.check(case)
        findings += found
        checked += looked
    return Report(measurement.source, ranked(findings), tuple(checked), facts, _plots(case))


def _facts(case: Case) -> dict[str, str]:
    m = case.m
    facts = {"length": f"{m.duration:.2f} s" if len(m) else "nothing",
             "samples": f"{len(m)} at {m.sample_rate:g} Hz, {int(np.count_nonzero(m.usable))} usable"}
    i = np.hypot(m.i_alpha, m.i_beta)[case.usable]
    if i.size:
        rated = case.motor.rated_current
        facts["current"] = f"up to {float(np.quantile(i, 0.999)):.3g} A peak ({rated:.3g} A are rated)"
    omega = case.track.omega[case.usable] if case.has_encoder else np.zeros(0)
    omega = omega[np.isfinite(omega)]
    if omega.size:
        low, high = (float(q) / case.motor.pole_pairs / RPM for q in np.quantile(omega, (0.001, 0.999)))
        facts["speed"] = f"{low:.0f} to {high:.0f} rpm by the encoder"
    facts["encoder"] = f"{len(m.encoder_sample)} reports" if len(m.encoder_sample) else "none"
    v_dc = m.status_v_dc[np.isfinite(m.status_v_dc)]
    if v_dc.size:
        facts["dc link"] = f"{float(np.median(v_dc)):.4g} V"
    if m.problem:
        facts["log"] = m.problem
    return facts


def _plots(case: Case) -> tuple[Plot, ...]:
    """Speed and current of the whole measurement."""
    rows = np.flatnonzero(case.usable)
    if rows.size < 2:
        return ()
    parts = np.array_split(rows, min(_POINTS, rows.size))
    t = np.array([case.m.time[p].mean() for p in parts])
    plots = []
    lines = []
    per_rpm = case.motor.pole_pairs * RPM
    for label, omega, role in (("by the encoder", case.track.omega, "encoder"),
                               ("by the observer", case.observed_as_reported.omega, "estimate")):
        values = np.array([_mean(omega[p]) for p in parts]) / per_rpm
        if np.isfinite(values).any():
            lines.append(Series(label, t, values, role))
    if lines:
        plots.append(Plot("Speed", "time [s]", "rpm of the shaft", tuple(lines)))
    i = np.hypot(case.m.i_alpha, case.m.i_beta)
    v = np.hypot(case.m.v_alpha, case.m.v_beta)
    plots.append(Plot("Current", "time [s]", "A peak", (
        Series("length of the current", t, np.array([i[p].mean() for p in parts]), "current"),)))
    plots.append(Plot("Voltage", "time [s]", "V peak", (
        Series("length of the voltage", t, np.array([v[p].mean() for p in parts]), "probe"),)))
    return tuple(plots)


def _mean(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    good = values[np.isfinite(values)]
    return float(good.mean()) if good.size else math.nan
