"""The voltage: late, lost to dead time, off by a constant."""

from __future__ import annotations

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot
from ipmsm_can.diagnosis.parts import evidence, explained, seen, told


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Delay, dead time and offset of the voltage."""
    if case.fit is None:
        return [], [Checked("voltage", "untold", "too few samples of a running drive")]
    findings: list[Finding] = []
    checked: list[Checked] = []
    for part in (_delay, _dead_time, _offset):
        found, looked = part(case)
        findings += found
        checked.append(looked)
    return findings, checked


def _delay(case: Case) -> tuple[list[Finding], Checked]:
    fit = case.fit
    assert fit is not None
    if not case.by_encoder:
        return [], Checked("delay of the voltage", "untold", "without an encoder a late voltage looks like an "
                           "angle that is off")
    delay, sigma = fit.delay, fit.solution.sigma("delay")
    if not (seen(sigma, limits.DELAY) or told(delay, sigma, limits.DELAY)):
        return [], Checked("delay of the voltage", "untold", "speed and current changed too little")
    if not told(delay, sigma, limits.DELAY):
        return [], Checked("delay of the voltage", "fine", f"{delay:+.2f} samples")
    side, size = ("late", delay) if delay > 0.0 else ("early", -delay)
    turned = case.m.voltage_delay + delay
    return [Finding(
        "voltage.delay", "warning", f"the voltage is {side}",
        f"The reported voltage is {size:.2f} samples ({1e6 * size / case.m.sample_rate:.0f} us) too {side} against "
        "the current. The angle is off by that time times the speed.",
        f"Set observer.voltage_delay = {turned:.2f} in drive.toml, or report with each current the mean voltage of "
        "the interval that ended at it.",
        (evidence("delay", delay, sigma, "samples"),
         Evidence("delay", 1e6 * delay / case.m.sample_rate, "us")),
        explained(case, fit, ("delay",), "the delay"), size=size / limits.DELAY, order=3)], Checked(
            "delay of the voltage", "found", f"{delay:+.2f} samples")


def _dead_time(case: Case) -> tuple[list[Finding], Checked]:
    fit = case.fit
    assert fit is not None
    volts, sigma = fit.solution["dead_time"], fit.solution.sigma("dead_time")
    limit = limits.VOLTAGE * case.volts
    if not (seen(sigma, limit) or told(volts, sigma, limit)):
        return [], Checked("dead time", "untold", "the current hardly changed its size")
    if not told(volts, sigma, limit) or volts < 0.0:
        return [], Checked("dead time", "fine", f"{volts:.2f} V a phase")
    plot = explained(case, fit, ("dead_time",), "dead time")
    return [dead_time_finding(volts, sigma, case.volts, plot)], Checked("dead time", "found",
                                                                        f"{volts:.2f} V a phase")


def dead_time_finding(volts: float, sigma: float, allowed: float, plot: Plot | None) -> Finding:
    """That each phase loses so much [V].  allowed: what drive.toml says, as 1-sigma [V]."""
    limit = limits.VOLTAGE * allowed
    return Finding(
        "voltage.dead_time", "warning", "dead time takes much voltage",
        f"Each phase loses {volts:.2f} V against its current, more than the {allowed:g} V that drive.toml "
        "allows as 1-sigma. At low speed the angle suffers, and the torque ripples six times a turn.",
        "Compensate the dead time in the drive and report the voltage that is really applied, or raise "
        "observer.voltage_uncertainty.",
        (evidence("voltage lost by each phase", volts, sigma, "V"),
         Evidence("limit", limit, "V", expected=f"{limits.VOLTAGE:g} times observer.voltage_uncertainty")),
        plot, size=volts / limit, order=3)


def _offset(case: Case) -> tuple[list[Finding], Checked]:
    fit = case.fit
    assert fit is not None
    s = fit.solution
    volts = abs(s.pair("u"))
    sigma, limit = s.pair_sigma("u"), limits.VOLTAGE * case.volts
    if not (seen(sigma, limit) or told(volts, sigma, limit)):
        return [], Checked("offset of the voltage", "untold", "the rotor did not turn far enough")
    if not told(volts, sigma, limit):
        return [], Checked("offset of the voltage", "fine", f"{volts:.2f} V")
    return [Finding(
        "voltage.offset", "warning", "the voltage has an offset",
        f"The reported voltage is off by a constant {volts:.2f} V in the stationary frame.",
        "Check the scaling and the zero of the reported voltage, and the inverter for one phase that differs.",
        (evidence("offset", volts, sigma, "V"),), explained(case, fit, ("u.x", "u.y"), "a constant voltage"),
        size=volts / limit, order=3)], Checked("offset of the voltage", "found", f"{volts:.2f} V")
