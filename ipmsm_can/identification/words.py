"""An identification in plain words and numbers: a table for a person, a dictionary for a script."""

from __future__ import annotations

import math
from typing import Any

from ipmsm_can.identification.result import MOTOR_PARAMETERS, UNITS, Identification, Parameter

_SHOWN = {"H": ("mH", 1e3), "Wb": ("mWb", 1e3), "rad electrical": ("deg el.", 180.0 / math.pi)}
_TITLES = {"dead_time_voltage": "dead time", "dead_time_zone": "dead time zone",
           "encoder_zero": "encoder's zero", "voltage_delay": "voltage late by", "v_offset_alpha": "v offset alpha",
           "v_offset_beta": "v offset beta", "i_offset_alpha": "i offset alpha", "i_offset_beta": "i offset beta"}
_COPPER = 0.00393
"""Rise of a copper winding's resistance per kelvin, as a share of that at 20 degC."""
_SMALL = 0.01
"""Difference from the name plate, as a share, that is not worth a word."""


def table(found: Identification) -> list[str]:
    """Lines: parameter, value, interval of 95 %, name plate, difference, word."""
    rows = [("parameter", "value", "95 % interval", "", "name plate", "off by")]
    rows += [_row(found.parameters[n]) for n in MOTOR_PARAMETERS if n in found.parameters]
    drive = [p for n, p in found.parameters.items() if n not in MOTOR_PARAMETERS and p.told]
    rows += [_row(p) for p in drive]
    widths = [max(len(r[k]) for r in rows) for k in range(6)]
    return ["  ".join(c.ljust(w) if k in (0, 3) else c.rjust(w)
                      for k, (c, w) in enumerate(zip(r, widths, strict=True))).rstrip() for r in rows]


def _row(p: Parameter) -> tuple[str, str, str, str, str, str]:
    unit, factor = _SHOWN.get(p.unit, (p.unit, 1.0))
    title = _TITLES.get(p.name, p.name)
    motor = p.name in MOTOR_PARAMETERS
    plate = f"{p.name_plate * factor:.5g}" if motor else ""
    if not p.told:
        return title, "-", p.word, unit, plate, ""
    digits = decimals(p.standard_error * factor)
    return (title, f"{p.value * factor:.{digits}f}", f"{p.low * factor:.{digits}f} to {p.high * factor:.{digits}f}",
            unit, plate, f"{100.0 * p.difference:+.1f} %" if motor and p.name_plate else "")


def decimals(error: float) -> int:
    """Decimals that show two digits of an error, 0..12."""
    return min(12, max(0, 1 - math.floor(math.log10(error)))) if error > 0.0 else 6


def sentences(found: Identification) -> list[str]:
    """What the numbers mean, and what they do not tell."""
    out = []
    told = found.parameters
    r, psi = told.get("R"), told.get("psi_m")
    if r is not None and _off(r):
        kelvin = r.difference / _COPPER
        out.append(f"R is {100.0 * abs(r.difference):.1f} % {_side(r)} the name plate"
                   + (f", as of a winding about {kelvin:.0f} K warmer" if 0.0 < kelvin < 200.0 else ""))
    if psi is not None and _off(psi):
        share = 100.0 * abs(psi.difference)
        out.append(f"psi_m is {share:.1f} % {_side(psi)} the name plate"
                   + (", as of hot or demagnetised magnets" if psi.difference < 0.0 else ""))
    out += [f"{n} is {100.0 * abs(told[n].difference):.1f} % {_side(told[n])} the name plate"
            for n in ("L_d", "L_q") if n in told and _off(told[n])]
    delay = told.get("voltage_delay")
    if delay is not None and delay.told and delay.contradicts and abs(delay.value) > 0.05:
        out.append(f"the voltage is reported {delay.value:.2f} samples late: observer.voltage_delay = "
                   f"{delay.value:.2f} in the drive.toml")
    return [*out, *found.notes]


def _off(p: Parameter) -> bool:
    return p.contradicts and abs(p.difference) > _SMALL


def _side(p: Parameter) -> str:
    return "above" if p.difference > 0.0 else "below"


def basis(found: Identification) -> str:
    """What it rests on, in one line."""
    if not found.samples:
        return "nothing to go by"
    how = "with the encoder" if found.method == "encoder" else "without an encoder"
    return (f"{how}, from {found.samples} samples ({found.seconds:.1f} s): i_d {_span(found.i_d)} A, "
            f"i_q {_span(found.i_q)} A, speed {_span(found.speed)} rad/s electrical")


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}"


def as_dict(found: Identification) -> dict[str, Any]:
    """For JSON: SI, peak, electrical; what is not known is None."""
    def number(x: float) -> float | None:
        return x if math.isfinite(x) else None

    return {
        "method": found.method, "fits": found.fits, "samples": found.samples, "seconds": found.seconds,
        "residual_A": list(found.residual), "i_d_A": [number(x) for x in found.i_d],
        "i_q_A": [number(x) for x in found.i_q], "speed_rad_s": [number(x) for x in found.speed],
        "parameters": {n: {"unit": UNITS[n], "told": p.told, "value": number(p.value),
                           "standard_error": number(p.standard_error), "low": number(p.low),
                           "high": number(p.high), "name_plate": number(p.name_plate), "word": p.word}
                       for n, p in found.parameters.items()},
        "sentences": sentences(found)}
