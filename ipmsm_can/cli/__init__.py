"""The command line, `ipmsm-can`.

Each command lives in a module of its own with `HELP`, `EPILOG`, `add_arguments(parser)` and
`main(args) -> exit code`; only the one that is called is loaded, so `ipmsm-can --help` is quick.

Exit codes: 0 all well; 1 ran, and found a fault; 2 bad input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import NoReturn

from ipmsm_can import __version__

COMMANDS = {
    "demo": "a simulated drive and the companion on one bus, with a live status and a plot",
    "run": "the companion on a CAN bus",
    "monitor": "everything of a drive on one screen, live or of a recording, with keys to record and to mark",
    "record": "every frame of a CAN bus into a log, and a measurement file with the estimates",
    "drive": "the simulated drive on a CAN bus",
    "replay": "run the companion over a recorded log",
    "map": "maps of other inverters: list, show, check against a log",
    "diagnose": "what is wrong with a drive, from a log or a live bus",
    "identify": "the motor's parameters from a log, as a drive.toml",
    "bus": "health of a bus, live or recorded: load, losses, errors, clocks",
    "paper": "run the paper's experiments again, with a verdict on each claim",
    "campaign": "thousands of random runs: is an angle called valid ever wrong",
    "config": "explain or check a drive.toml",
    "completion": "print a completion script for your shell",
}
"""Commands and what they do, in the order of the help."""

_MODULES = {"bus": "health", "monitor": "live_view"}
"""Modules that are not named as their command is: `cli.bus` is what all commands on a bus share, and `cli.monitor`
takes the status of any."""

_DESCRIPTION = """\
Rotor position of interior permanent magnet motors from sampled currents and voltages on CAN.
Nothing is transmitted unless you ask for it.
"""

_EPILOG = """\
examples:
  ipmsm-can demo                                   see it work, on vcan0 or a bus inside the program
  ipmsm-can config --explain > drive.toml          a commented configuration to start from
  ipmsm-can run drive.toml -i socketcan -c can0    listen to a drive; add --transmit to answer it
  ipmsm-can bus -i socketcan -c can0               is the bus well? listens only
  ipmsm-can replay run.blf --drive drive.toml --out estimates.csv

exit codes: 0 all well, 1 ran and found a fault, 2 bad input
`ipmsm-can COMMAND --help` says more about each command.
"""


def _module(command: str) -> ModuleType:
    return import_module(f"ipmsm_can.cli.{_MODULES.get(command, command)}")


class _Parser(argparse.ArgumentParser):
    """Answers wrong arguments with one sentence; ten lines of usage would bury it."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (`{self.prog} --help` explains)\n")


def build_parser(commands: Sequence[str]) -> argparse.ArgumentParser:
    """The parser; only the commands named get their arguments, the others just their line in the help."""
    parser = _Parser(prog="ipmsm-can", description=_DESCRIPTION, epilog=_EPILOG,
                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--version", action="version", version=f"ipmsm-can {__version__}")
    sub = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, text in COMMANDS.items():
        if name in commands:
            module = _module(name)
            child = sub.add_parser(name, help=text, description=module.HELP, epilog=module.EPILOG,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)
            module.add_arguments(child)
        else:
            sub.add_parser(name, help=text)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (argparse itself leaves with 2 for bad arguments)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    named = next((word for word in argv if not word.startswith("-")), "")
    parser = build_parser([named])
    args = parser.parse_args(argv)
    module = _module(args.command)
    try:
        code: int = module.main(args)
        return code
    except (ValueError, OSError) as error:
        print(f"ipmsm-can {args.command}: {_sentence(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _sentence(error: ValueError | OSError) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)
