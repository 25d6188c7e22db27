"""A diagnosis from operating points alone, where a drive's reports are too slow for the observer."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.diagnosis import limits, steady_findings
from ipmsm_can.diagnosis.finding import Checked, Plot, Report, Series, ranked
from ipmsm_can.diagnosis.steady_fit import Equation, SteadyFit, chosen, clearly_better
from ipmsm_can.diagnosis.steady_points import Points, Turning, points, turning
from ipmsm_can.drive.profile import RPM
from ipmsm_can.mapping.steady import LEAST_EMF

if TYPE_CHECKING:
    from ipmsm_can.analysis.steady import SteadySamples
    from ipmsm_can.config.model import DriveConfig

_POINTS = 800
_FAST_ONLY = ("offset and gain of the current sensors, delay and offset of the voltage, the encoder's slips and "
              "eccentricity, excitation, the position estimate")


class SteadyCase:
    """Samples of a drive that are too slow for the observer, and what the checks need of them, worked out once."""

    def __init__(self, samples: SteadySamples, config: DriveConfig) -> None:
        self.s = samples
        self.config = config
        self.motor = config.build_motor()
        self.volts = max(config.observer.voltage_uncertainty, 1e-3)

    @cached_property
    def turning(self) -> Turning:
        """The reported angle against the reported speed."""
        return turning(self.s, self.motor)

    @cached_property
    def disagree(self) -> bool:
        """Angle and speed turn differently."""
        return math.isfinite(self.turning.ratio) and self.turning.ratio != 1.0

    @cached_property
    def angle_reversed(self) -> bool:
        """What the map turned by the angle was turned the wrong way."""
        return self.turning.ratio == -1.0 and self.turning.angle_is_wrong is True

    @cached_property
    def points(self) -> Points:
        """The operating points, with a reversed angle undone."""
        return points(self.s, self.motor, angle_reversed=self.angle_reversed)

    @cached_property
    def why_no_fit(self) -> str:
        """Why there is nothing to fit the equation to, "" where there is."""
        if self.turning.angle_is_wrong and not self.angle_reversed:
            return "the currents were turned by the angle, whose pole pairs are wrong"
        if not len(self.points):
            return ("at no time did currents, voltages and speed hold still for a tenth of a second"
                    if self.s.good.any() else
                    "no sample has currents, voltages and speed reported near enough in time")
        if not self.points.fast(self.motor).any():
            return (f"the rotor was never fast enough: the magnets must give {LEAST_EMF:g} V, and more than the "
                    "resistance takes")
        return ""

    @cached_property
    def equation(self) -> Equation:
        """The equation for the operating points."""
        return Equation(self.points, self.motor, self.config, self.s.i_by_angle != self.s.v_by_angle,
                        self.angle_reversed)

    @cached_property
    def speed_is_wrong(self) -> bool | None:
        """Where angle and speed disagree: the speed is; None where that cannot be told."""
        if not self.disagree:
            return False
        if self.turning.angle_is_wrong is not None:
            return not self.turning.angle_is_wrong
        if self.why_no_fit:
            return None
        as_told, by_angle = self.equation.fit(), self.equation.fit(factor=self.turning.ratio)
        # What is told of the magnets counts here: with the wrong speed they come out wrong by the same factor.
        costs = [f.cost + ((f["psi_m"] / self.motor.psi_m - 1.0) / limits.PSI_M)**2 for f in (as_told, by_angle)]
        if abs(costs[0] - costs[1]) < limits.SURE**2:
            return None
        return costs[1] < costs[0]

    @cached_property
    def factor(self) -> float:
        """What the reported speed is to be multiplied by, going by the angle."""
        return self.turning.ratio if self.speed_is_wrong else 1.0

    @cached_property
    def fits(self) -> list[SteadyFit]:
        """Everything the right way round; the current reversed; the field turning the other way."""
        e = self.equation
        return [e.fit(factor=self.factor), e.fit(True, self.factor), e.fit(factor=-self.factor)]

    @cached_property
    def fit(self) -> SteadyFit:
        """The hypothesis that stands."""
        return chosen(self.fits)[0]

    @cached_property
    def as_reported(self) -> SteadyFit:
        """The equation with everything taken as it is reported."""
        return self.fits[0] if self.factor == 1.0 else self.equation.fit()

    @cached_property
    def signs_known(self) -> bool:
        """The other ways round are ruled out."""
        return all(f is self.fit or clearly_better(self.fit, f) for f in self.fits)

    @property
    def against_both(self) -> bool:
        """The field turns against the speed, and against the angle that goes with it."""
        return self.fit.speed_factor == -self.factor

    @property
    def voltage_reversed(self) -> bool:
        """A reversed current with the rotor half a turn off is a reversed voltage."""
        return self.fit.current_reversed and abs(self.fit["delta"]) > 0.5 * math.pi

    @property
    def zero(self) -> float:
        """The frame that is reported minus the rotor [rad electrical]."""
        half = math.pi if self.voltage_reversed else 0.0
        return math.remainder(self.fit["delta"] + half, 2.0 * math.pi)


def diagnose_steady(samples: SteadySamples, config: DriveConfig) -> Report:
    """What is wrong with the drive of `config`, going by operating points.

    The same samples give the same report.
    """
    case = SteadyCase(samples, config)
    findings, checked = steady_findings.samples(case)
    more, also = steady_findings.turning(case)
    findings += more
    looked = also
    if case.why_no_fit:
        looked.append(Checked("signs, the angle's zero and the motor", "untold", case.why_no_fit))
    else:
        for part in (steady_findings.signs, steady_findings.zero, steady_findings.motor, steady_findings.torque):
            found, also = part(case)
            findings += found
            looked += also
    slow = Checked(_FAST_ONLY, "untold", f"no fast observer: {samples.why_not_fast}")
    return Report(samples.source, ranked(findings), (*looked, *checked, slow), _facts(case), _plots(case))


def _facts(case: SteadyCase) -> dict[str, str]:
    s, p = case.s, case.points
    facts = {"length": f"{s.duration:.2f} s" if len(s) else "nothing", "samples": f"{len(s)}",
             "steady": f"{int(p.cells.sum())} stretches at {len(p)} operating point{'s' if len(p) != 1 else ''}"}
    i = np.abs(s.i)
    i = i[np.isfinite(i)]
    if i.size:
        rated = case.motor.rated_current
        facts["current"] = f"up to {float(np.quantile(i, 0.999)):.3g} A peak ({rated:.3g} A are rated)"
    omega = s.omega[np.isfinite(s.omega)]
    if omega.size:
        low, high = (float(q) / case.motor.pole_pairs / RPM for q in np.quantile(omega, (0.001, 0.999)))
        facts["speed"] = f"{low:.0f} to {high:.0f} rpm as reported"
    v_dc = s.v_dc[np.isfinite(s.v_dc)]
    if v_dc.size:
        facts["dc link"] = f"{float(np.median(v_dc)):.4g} V"
    if s.problem:
        facts["log"] = s.problem
    return facts


def _plots(case: SteadyCase) -> tuple[Plot, ...]:
    """Speed, current and voltage of all samples."""
    s = case.s
    rows = np.flatnonzero(np.isfinite(s.omega) & np.isfinite(s.i + s.v))
    if rows.size < 2:
        return ()
    parts = np.array_split(rows, min(_POINTS, rows.size))
    t = np.array([s.time[p].mean() for p in parts])
    per_rpm = case.motor.pole_pairs * RPM
    return tuple(Plot(title, "time [s]", unit, (Series(label, t, np.array([x[p].mean() for p in parts]), role),))
                 for title, unit, label, x, role in (
                     ("Speed", "rpm of the shaft", "as reported", s.omega / per_rpm, "encoder"),
                     ("Current", "A peak", "length of the current", np.abs(s.i), "current"),
                     ("Voltage", "V peak", "length of the voltage", np.abs(s.v), "probe")))
