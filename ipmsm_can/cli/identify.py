"""`ipmsm-can identify`: the motor's parameters from a log."""

from __future__ import annotations

import argparse
import json
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

HELP = """\
Find the motor's parameters in a recorded log, with intervals of 95 %: R, L_d, L_q and psi_m where the drive reports
an encoder, R and psi_m from currents and voltages alone. What the log does not tell is left out, and said why.
"""
EPILOG = """\
A few seconds of ordinary running with changing speed and load are enough; docs/identify.md says what each parameter
needs. Nothing is transmitted.

examples:
  ipmsm-can identify run.blf --drive drive.toml
  ipmsm-can identify run.blf --drive drive.toml --out drive.identified.toml
  ipmsm-can identify car.blf --drive drive.toml --map mine.toml --json

exit codes: 0 at least one parameter is told, 1 none is, 2 bad input; a log that is cut off or damaged is bad input,
too: what was readable of it is used, and one sentence says what was wrong
"""


_WIDTH = 79


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", metavar="LOG", help="the recorded log")
    parser.add_argument("--drive", required=True, metavar="drive.toml", help="configuration with the name plate")
    parser.add_argument("--out", metavar="FILE", help="write the drive.toml with what was found to this file")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--map", metavar="MAP", help="the log is of another inverter: a map, or the name of one "
                        "(docs/mapping.md, ipmsm-can map list)")
    parser.add_argument("--node", type=int, metavar="N", help="with --map: number of the drive, if not the map's")
    parser.add_argument("--channel", metavar="NAME", help="take only the frames of this channel of the log")


def main(args: argparse.Namespace) -> int:
    """Identify; returns the exit code."""
    from ipmsm_can.config import load_config

    log, drive = Path(args.log), Path(args.drive)
    config = load_config(drive)
    out = None if args.out is None else _checked(Path(args.out), (log, drive))

    from ipmsm_can.analysis.measurement import read_measurement
    from ipmsm_can.identification import identify
    from ipmsm_can.identification.words import as_dict, basis, sentences, table

    shown = _progress()
    m = read_measurement(log, config, map_name=args.map, node=args.node, channel=args.channel, progress=shown)
    if shown is not None:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    found = identify(m, config.build_motor())
    if args.json:
        print(json.dumps({"log": str(log), "drive": str(drive), **as_dict(found)}, indent=1))
    else:
        lines = [*_wrapped(f"{log}: {basis(found)}"), ""]
        lines += [*table(found), ""] if found.told else []
        print("\n".join([*lines, *(line for s in sentences(found) for line in _wrapped(s))]).rstrip())
    motor_told = found.told & {"R", "L_d", "L_q", "psi_m"}
    if out is not None and motor_told:
        from ipmsm_can.identification.write import write_identified

        write_identified(drive, out, found, log.name)
        print(f"wrote {out}", file=sys.stderr if args.json else sys.stdout)
    elif out is not None:
        print(f"ipmsm-can identify: nothing of the motor is told, so {out} is not written", file=sys.stderr)
    if m.problem:
        print(f"ipmsm-can identify: {m.problem}; what was readable is used", file=sys.stderr)
        return 2
    return 0 if motor_told else 1


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _checked(out: Path, inputs: tuple[Path, ...]) -> Path:
    """Raises ValueError where the file cannot be written, or is an input."""
    if out.suffix != ".toml":
        raise ValueError(f"--out is {out}; allowed is a .toml file")
    if not out.parent.is_dir():
        raise ValueError(f"--out is {out}; its folder {out.parent} does not exist")
    if any(out.exists() and given.exists() and out.samefile(given) for given in inputs):
        raise ValueError(f"--out {out} is one of the input files; allowed is another file")
    return out


def _progress() -> Callable[[float], None] | None:
    if not sys.stderr.isatty():
        return None

    def show(share: float) -> None:
        print(f"\r\x1b[Kreading: {100.0 * share:.0f} %", end="", file=sys.stderr, flush=True)

    return show
