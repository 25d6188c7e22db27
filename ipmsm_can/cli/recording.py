"""What the commands that record share: their options, the recordings they begin, and what is told at the end."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ipmsm_can.cli import bus

if TYPE_CHECKING:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.record.rotation import Rotation
    from ipmsm_can.record.tap import Sink, Tap
    from ipmsm_can.wire.protocol import Protocol


def add_rotation_arguments(parser: argparse.ArgumentParser) -> None:
    """--rotate-size and --rotate-time."""
    parser.add_argument("--rotate-size", metavar="SIZE",
                        help="go on in a new, numbered file after so much: 100MB, 1GB")
    parser.add_argument("--rotate-time", metavar="TIME",
                        help="go on in a new, numbered file after so long: 30s, 10min, 1h")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """--record with its rotation, and --measure."""
    parser.add_argument("--record", metavar="FILE",
                        help="write every frame, sent ones, too, to this log (.blf .log .asc .csv .db .mf4 .trc)")
    add_rotation_arguments(parser)
    parser.add_argument("--measure", "--mf4", metavar="FILE.mf4",
                        help="write decoded signals and the estimates to this measurement file (needs asammdf)")


def rotation(args: argparse.Namespace) -> Rotation:
    """The rotation asked for.  Raises ValueError for a size or time that is none."""
    from ipmsm_can.record.rotation import DURATION, SIZE, Rotation

    def read(option: str, unit: Any) -> float | None:
        given = getattr(args, option, None)
        if given is None:
            return None
        try:
            value: float = unit.read(given)
        except ValueError:
            example = "100MB" if unit is SIZE else "10min"
            raise ValueError(f"--{option.replace('_', '-')} is {given!r}; allowed is a number with a unit of "
                             f"{', '.join(unit.spellings)}, as {example}") from None
        return value

    return Rotation(read("rotate_size", SIZE), read("rotate_time", DURATION))


def check(args: argparse.Namespace) -> None:
    """Raise ValueError, before work is done for it, where a recording that was asked for cannot be made."""
    given = rotation(args)
    if given.on and not args.record:
        raise ValueError("--rotate-size and --rotate-time belong to a recording, and there is none (--record FILE)")
    if args.record:
        from pathlib import Path

        from ipmsm_can.logs.writer import check_log_path, warm_up
        from ipmsm_can.record.rotation import Names

        check_log_path(Path(args.record))
        Names(Path(args.record), given)
        with bus.patience():
            warm_up()
    if args.measure:
        from ipmsm_can.record.measure import check_measure_path

        check_measure_path(args.measure)


@contextmanager
def recordings(args: argparse.Namespace, link: Link, configs: Sequence[DriveConfig] = (),
               protocol: Protocol | None = None) -> Iterator[Tap]:
    """The recordings that the options ask for; closed at the end, and what was recorded is printed.

    Raises LogError where a file cannot be made.
    """
    from ipmsm_can.bus.port import bus_configuration
    from ipmsm_can.record.tap import Tap

    sinks: list[Sink] = []
    try:
        if args.record:
            from ipmsm_can.record.recorder import Recorder

            channel = str(bus_configuration(args)[0].get("channel", "can0"))
            sinks.append(Recorder(args.record, channel, rotation(args)))
        if args.measure and protocol is not None:
            from ipmsm_can.record.measure import MeasureRecorder

            sinks.append(MeasureRecorder(args.measure, [c.wire.node for c in configs], protocol))
        tap = Tap(link, sinks)
        yield tap
    finally:
        for sink in sinks:
            sink.close()
            status = sink.status()
            print(status.summary, file=sys.stdout if status.whole else sys.stderr)


def code_of(tap: Tap) -> int:
    """Exit code of the recordings: 1 where one is not whole."""
    return 0 if all(status.whole for status in tap.status()) else 1
