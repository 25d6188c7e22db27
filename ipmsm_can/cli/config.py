"""`ipmsm-can config`: what can stand in a drive.toml, and whether one is right."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ipmsm_can.config import DriveConfig

HELP = "Explain every key of a drive.toml, or check one."
EPILOG = """\
examples:
  ipmsm-can config --explain > drive.toml     every key with unit, default and range; loads as it is
  ipmsm-can config drive.toml                 check a file
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--explain", action="store_true", help="print every key with unit, default and range")
    what.add_argument("file", nargs="?", metavar="drive.toml", help="the file to check")


def _gain(config: DriveConfig) -> str:
    if config.observer.kind == "riccati":
        return ""
    return f" and gamma {config.observer.gamma if config.observer.gamma == 'scheduled' else f'{config.gamma:.4g}'}"


def main(args: argparse.Namespace) -> int:
    """Print or check; returns the exit code."""
    from ipmsm_can.config import explain, load_config

    if args.explain:
        print(explain(), end="")
        return 0
    config = load_config(args.file)
    motor = config.build_motor()
    print(f"{args.file}: node {config.wire.node}, motor {motor.name} (psi_m {motor.psi_m:g} Wb, "
          f"L_d {1e3 * motor.L_d:g} mH, L_q {1e3 * motor.L_q:g} mH, R {motor.R:g} ohm, "
          f"{motor.pole_pairs} pole pairs), observer {config.observer.kind} with alpha {config.alpha:g} 1/s"
          f"{_gain(config)}")
    return 0
