"""`ipmsm-can map`: maps of inverters, and what a log holds of one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = """\
Maps from the DBC of any inverter to what the estimator needs: list the shipped ones, show one, or check one
against a log: which signals came and how often, how far apart in time, what is missing, and what can be done.
"""
EPILOG = """\
MAP is the path of a .toml file or the name of a shipped map. docs/mapping.md says how to write one.

examples:
  ipmsm-can map list
  ipmsm-can map show cascadia_pm > mine.toml        a map to start from; copy its DBC beside it
  ipmsm-can map --check run.blf mine.toml --pole-pairs 4

exit codes: 0 all that the map asks for is in the log, 1 something is missing, 2 bad input: a map, DBC or log that
cannot be used, or a log without any frame of the map
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("what", nargs="?", choices=["list", "show"], help="list the shipped maps, or show one")
    parser.add_argument("name", nargs="?", metavar="MAP", help="the map to show")
    parser.add_argument("--check", nargs=2, metavar=("LOG", "MAP"), help="hold a map against a log")
    parser.add_argument("--node", type=int, metavar="N", help="number of the drive, instead of the map's")
    parser.add_argument("--pole-pairs", type=int, metavar="P", help="of the motor, where the map counts its turns")
    parser.add_argument("--channel", metavar="NAME", help="take only the frames of this channel of the log")


def main(args: argparse.Namespace) -> int:
    """List, show or check; returns the exit code."""
    if args.check is not None:
        if args.what is not None:
            raise ValueError(f"--check LOG MAP and {args.what} are two things; allowed is one of them")
        log, name = args.check
        return _check(log, name, args)
    if args.what == "list" and args.name is None:
        return _list()
    if args.what == "show" and args.name is not None:
        return _show(args.name)
    raise ValueError("allowed is `map list`, `map show MAP` or `map --check LOG MAP`")


def _list() -> int:
    from ipmsm_can.mapping import load_map, shipped_maps

    for name, path in shipped_maps().items():
        inverter = load_map(path)
        print(f"{name:14} {inverter.map.title}")
    return 0


def _show(name: str) -> int:
    from ipmsm_can.mapping import load_map
    from ipmsm_can.mapping.load import map_path

    path = map_path(name)
    inverter = load_map(path)
    print(f"# {path}\n# its DBC: {inverter.map.dbc}\n{path.read_text(encoding='utf-8')}", end="")
    return 0


def _check(log: str, name: str, args: argparse.Namespace) -> int:
    from ipmsm_can.logs import read_log
    from ipmsm_can.mapping import load_map, make_plan
    from ipmsm_can.mapping.check import missing, text, wrong_bus
    from ipmsm_can.mapping.survey import Survey

    check_pole_pairs(args.pole_pairs)
    plan = make_plan(load_map(name), node=args.node, pole_pairs=args.pole_pairs)
    reader = read_log(Path(log), channel=args.channel)
    survey = Survey(plan)
    survey.run(reader)
    if not survey.found:
        raise ValueError(wrong_bus(survey, log))
    print(text(survey, log, name))
    if reader.problem or reader.bad_lines:
        told = reader.problem or f"{log} is damaged: {reader.bad_lines} of its lines cannot be read"
        print(f"ipmsm-can map: {told}; what was readable is checked", file=sys.stderr)
        return 2
    return 1 if missing(survey) else 0


def check_pole_pairs(pole_pairs: int | None) -> None:
    """Raises ValueError where these are no pole pairs."""
    if pole_pairs is not None and not 1 <= pole_pairs <= 100:
        raise ValueError(f"--pole-pairs is {pole_pairs}; allowed is a whole number from 1 to 100")
