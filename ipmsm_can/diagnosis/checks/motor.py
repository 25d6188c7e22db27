"""R, L_d, L_q and psi_m against the name plate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case, Fit
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding
from ipmsm_can.diagnosis.parts import evidence

if TYPE_CHECKING:
    from ipmsm_can.config.model import DriveConfig

_COPPER = 0.00393
"""Rise of the resistance of copper with temperature [1/K]."""
_UNIT = {"psi_m": ("Wb", 1.0), "R": ("ohm", 1.0), "L_d": ("mH", 1e3), "L_q": ("mH", 1e3)}
_SAID = {"psi_m": "flux of the magnets", "R": "resistance", "L_d": "d-axis inductance", "L_q": "q-axis inductance"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter as found.  sigma: of the value.  plate: as drive.toml tells.  limit: share that still counts as
    that."""

    name: str
    value: float
    sigma: float
    plate: float
    limit: float

    @property
    def share(self) -> float:
        """By how much it differs, as a share of the name plate."""
        return self.value / self.plate - 1.0 if self.plate else 0.0

    @property
    def known(self) -> bool:
        """A deviation at the limit would be seen: of the larger of the two, lest one by a factor go unseen."""
        return self.sigma > 0.0 and self.sigma < 0.5 * self.limit * max(self.plate, self.value)

    @property
    def off(self) -> bool:
        """It differs by more than it may, and by much more than its own uncertainty."""
        return self.known and abs(self.share) > self.limit and abs(
            self.value - self.plate) > limits.SURE * self.sigma


def parameters(case: Case) -> list[Parameter]:
    """What the samples tell of the motor; empty where nothing.

    Next to no current along the d-axis leaves L_d to the noise, and to what is not quite right of the angle: then
    it counts as unknown, whatever the fit says.
    """
    fit = case.fit
    motor, limit = case.motor, allowed(case.config)
    along_d = fit is not None and _moves_along_d(fit, limits.ALONG_D * motor.rated_current)
    if case.identified is not None:
        exact = case.identified.parameters
        told = {name: exact[name].told and (name != "L_d" or along_d) for name in limit}
        return [Parameter(name, exact[name].value, (exact[name].high - exact[name].low) / (2.0 * limits.SIGMAS_95)
                          if told[name] else math.inf, getattr(motor, name), most) for name, most in limit.items()]
    if fit is None:
        return []
    s = fit.solution
    psi = abs(s.pair("psi"))
    out = [Parameter("psi_m", psi, s.sigma("psi.x"), motor.psi_m, limits.PSI_M),
           Parameter("R", s["R"], s.sigma("R"), motor.R, limit["R"])]
    if case.by_encoder:
        # An angle of the observer's holds its own L_q.
        out += [Parameter("L_q", s["L_q"], s.sigma("L_q"), motor.L_q, limit["L_q"]),
                Parameter("L_d", s["L_d"], s.sigma("L_d") if along_d else math.inf, motor.L_d,
                          limit["L_d"])]
    return out


def _moves_along_d(fit: Fit, least: float) -> bool:
    i_d = (fit.x.i * np.exp(-1j * fit.x.theta)).real[fit.known]
    low, high = np.quantile(i_d, (0.01, 0.99))
    return bool(high - low > least)


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """The motor's parameters."""
    found = parameters(case)
    if not found:
        return [], [Checked("motor's parameters", "untold", "too few samples of a running drive")]
    findings, checked = judge(found, case.config, lambda name: _why(name, case.by_encoder))
    if not case.by_encoder and case.identified is None:
        checked += [Checked(name, "untold", _why(name, False)) for name in ("L_q", "L_d")]
    return findings, checked


def allowed(config: DriveConfig) -> dict[str, float]:
    """By which share each parameter may differ from drive.toml."""
    o = config.observer
    inductance = limits.TOLERANCE * o.inductance_uncertainty / 100.0
    return {"psi_m": limits.PSI_M, "R": limits.TOLERANCE * o.resistance_uncertainty / 100.0, "L_q": inductance,
            "L_d": inductance}


def judge(found: list[Parameter], config: DriveConfig, why: Callable[[str], str]) -> tuple[list[Finding],
                                                                                         list[Checked]]:
    """Findings of parameters, and what was looked at.  why: what is said of one that is not known."""
    table = tuple(_evidence(p) for p in found if p.known)
    findings = [_finding(config, p, table) for p in found if p.off]
    checked = []
    for p in found:
        unit, factor = _UNIT[p.name]
        if not p.known:
            checked.append(Checked(p.name, "untold", why(p.name)))
        else:
            words = f"{factor * p.value:.4g} {unit}, {100.0 * p.share:+.1f} % against drive.toml"
            # beyond what is allowed, and not surely so: that is not fine
            unsure = not p.off and abs(p.share) > p.limit
            checked.append(Checked(p.name, "found" if p.off else "untold" if unsure else "fine",
                                   f"{words}, but not surely" if unsure else words))
    return findings, checked


def _why(name: str, by_encoder: bool) -> str:
    if not by_encoder and name in ("L_d", "L_q"):
        return "without an encoder a wrong inductance is a wrong angle that nothing contradicts"
    return {"L_d": "there was next to no current along the d-axis (run with mtpa, or probe)",
            "L_q": "the current hardly changed", "R": "there was too little current",
            "psi_m": "the rotor was too slow"}[name]


def _evidence(p: Parameter) -> Evidence:
    unit, factor = _UNIT[p.name]
    return evidence(p.name, p.value, p.sigma, unit, f"drive.toml {factor * p.plate:.4g} {unit}", factor)


def _finding(config: DriveConfig, p: Parameter, table: tuple[Evidence, ...]) -> Finding:
    change = f"{100.0 * abs(p.share):.0f} % {'more' if p.share > 0.0 else 'less'}"
    title, sentence, advice = _words(p, change)
    # Iron that saturates lowers L_q; L_d falls or rises with the sign of i_d, and falls with i_q.  drive.toml tells
    # how far that may go, as 1-sigma.
    iron = config.observer.saturation_uncertainty / 100.0
    saturates = (p.name == "L_d" and abs(p.share) < p.limit + limits.TOLERANCE * iron) or (
        p.name == "L_q" and 0.0 < -p.share < p.limit + iron)
    if saturates:
        advice = "Nothing, if the machine saturates at this current; else correct it in drive.toml."
    return Finding(f"motor.{p.name}", "info" if saturates else "warning", title, sentence, advice, table,
                   size=abs(p.share) / p.limit, order=4 if saturates else 3)


def _words(p: Parameter, change: str) -> tuple[str, str, str]:
    unit, factor = _UNIT[p.name]
    value = f"{factor * p.value:.4g} {unit}"
    if p.name == "psi_m" and p.share < 0.0:
        return ("the magnets are weak", f"The {_SAID['psi_m']} is {value}, {change} than drive.toml says: the "
                "magnets are hot, or demagnetised for good.",
                "Let the motor cool down and measure again; if it stays, the rotor is damaged. Until then torque "
                "per ampere is less by as much. A voltage scaled too small would look alike, in R and L_q as well.")
    if p.name == "psi_m":
        return ("psi_m is larger than told", f"The {_SAID['psi_m']} is {value}, {change} than drive.toml says.",
                "Correct motor.psi_m, or the scaling of the voltage: that would make R and L_q wrong by as much.")
    if p.name == "R" and p.share > 0.0:
        kelvin = p.share / _COPPER
        return ("the winding's resistance is high", f"The {_SAID['R']} is {value}, {change} than drive.toml says: "
                f"a copper winding is that much warmer by about {kelvin:.0f} K, or a contact is bad.",
                "Check the winding's temperature and the motor's terminals; correct motor.R if the value in "
                "drive.toml is of a cold motor.")
    return (f"{p.name} is not as told", f"The {_SAID[p.name]} is {value}, {change} than drive.toml says.",
            f"Correct motor.{p.name} in drive.toml, or let `ipmsm-can identify` do it. A current scaled wrong "
            "makes R, L_d and L_q wrong alike.")
