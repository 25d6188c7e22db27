"""`ipmsm-can completion`: completion scripts."""

from __future__ import annotations

import argparse

HELP = "Print a completion script for your shell."
EPILOG = """\
examples:
  ipmsm-can completion bash > ~/.local/share/bash-completion/completions/ipmsm-can
  ipmsm-can completion zsh > ~/.zfunc/_ipmsm-can
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell the script is for")


def main(args: argparse.Namespace) -> int:
    """Print the script; returns the exit code."""
    import shtab

    from ipmsm_can.cli import COMMANDS, build_parser

    print(shtab.complete(build_parser(tuple(COMMANDS)), shell=args.shell))
    return 0
