"""A drive.toml with what was identified in place of the name plate's values; all else stays as it was."""

from __future__ import annotations

import os
from pathlib import Path

import tomlkit

from ipmsm_can.config.load import parse_config
from ipmsm_can.identification.result import MOTOR_PARAMETERS, UNITS, Identification
from ipmsm_can.identification.words import decimals


def identified_toml(text: str, found: Identification, source: str) -> str:
    """The TOML text of a drive with the motor's parameters that are told; comments and order stay.

    text: of a valid drive.toml.  source: what it was identified from, for a comment at each value.
    """
    document = tomlkit.parse(text)
    motor = document["motor"]
    for name in MOTOR_PARAMETERS:
        p = found.parameters.get(name)
        if p is None or not p.told:
            continue
        digits = decimals(p.standard_error)
        value = tomlkit.item(round(p.value, digits))
        old = motor.get(name)
        kept = old.trivia.comment.lstrip("# ") if old is not None else ""
        value.comment(f"identified from {source}: {p.low:.{digits}f} to {p.high:.{digits}f} {UNITS[name]}"
                      + (f"; {kept}" if kept else ""))
        motor[name] = value
    return tomlkit.dumps(document)


def write_identified(drive: Path, out: Path, found: Identification, source: str) -> None:
    """Write `identified_toml` of the file `drive` to `out`; a relative wire.dbc goes on naming the same file.

    Raises ValueError (ConfigError) where the result is no valid drive.toml, which is then not written.
    """
    text = identified_toml(drive.read_bytes().decode("utf-8-sig"), found, source)
    if out.parent.resolve() != drive.parent.resolve():
        document = tomlkit.parse(text)
        wire = document.get("wire", {})
        if "dbc" in wire and not Path(wire["dbc"]).is_absolute():
            wire["dbc"] = os.path.relpath(drive.parent / wire["dbc"], out.parent)
            text = tomlkit.dumps(document)
    parse_config(text, source=str(out), folder=out.parent)
    out.write_text(text, encoding="utf-8")
