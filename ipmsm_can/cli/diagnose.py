"""`ipmsm-can diagnose`: what is wrong with a drive, from a log or listening to a live bus."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus

if TYPE_CHECKING:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.diagnosis import Report
    from ipmsm_can.diagnosis.live import LiveDiagnosis
    from ipmsm_can.diagnosis.live_mapped import MappedDiagnosis
    from ipmsm_can.frames import FrameBlock

HELP = """\
What is wrong with a drive: signs and phase order, current sensors, voltage, encoder, motor, excitation, position
estimate. Each finding in plain words, the one that explains the others first, with its evidence and what to do.

With LOG of a recording; without, on a live bus. It only listens: nothing is ever transmitted.
"""
EPILOG = """\
examples:
  ipmsm-can diagnose run.blf --drive drive.toml
  ipmsm-can diagnose run.blf --drive drive.toml --out diagnosis.html    a page, and diagnosis.json beside it
  ipmsm-can diagnose car.blf --drive drive.toml --map cascadia_pm_dq    another inverter, through its map
  ipmsm-can diagnose --drive drive.toml -i socketcan -c can0 --duration 10
  ipmsm-can diagnose --drive drive.toml -i socketcan -c can0 --duration 10 --map cascadia_pm_dq

With LOG, -c names a channel of the log. The more the drive does meanwhile (both directions, several speeds and
loads), the more can be told; what cannot is said. docs/diagnose.md explains each finding.
exit codes: 0 nothing worse than "info", 1 a fault was found, 2 bad input; a log that is cut off is bad input, too:
what was readable of it is diagnosed, and one sentence says what was wrong
"""
LAST_S = 600.0
"""Seconds of a log that count where nobody says: the memory they take is some 100 bytes a sample."""
_LIVE_S = 60.0
_WAIT_S = 0.1
_SHOW_S = 0.25
_WIDEST = 110


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", nargs="?", metavar="LOG", help="a recording, of any format that replay takes")
    parser.add_argument("--drive", required=True, metavar="drive.toml", help="configuration of the drive")
    parser.add_argument("--map", metavar="MAP", help="another inverter: its map, or the name of a shipped one")
    parser.add_argument("--node", type=int, metavar="N", help="with --map: number of the drive, if not the map's")
    parser.add_argument("--last", type=bus.seconds, metavar="S",
                        help=f"only the last so many seconds (default: {LAST_S:g} of a log, {_LIVE_S:g} live)")
    parser.add_argument("--out", metavar="FILE.html", help="write a page; the same as JSON goes beside it")
    parser.add_argument("--json", metavar="FILE", help="write the report as JSON; - prints it instead of the words")
    parser.add_argument("--duration", type=bus.seconds, metavar="S", help="live: end after so many seconds")
    parser.add_argument("--no-reconnect", action="store_true", help="live: end when the bus goes away")
    bus.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Diagnose; returns the exit code."""
    if args.log is None:
        if args.node is not None and args.map is None:
            raise ValueError("--node goes with --map; without a map the drive.toml has wire.node")
        try:
            bus.check_named(args)
        except ValueError as error:
            raise ValueError(f"neither a LOG was named nor a bus: {error}") from None
    elif getattr(args, "interface", None) is not None:
        raise ValueError(f"both the log {args.log} and a bus ({args.interface}) are named; allowed is one of them")
    page, data = _outputs(args)
    from ipmsm_can.config import load_configs

    config = load_configs([args.drive])[0]
    report, problem = _recorded(args, config) if args.log is not None else _live(args, config)
    if page is not None:
        from ipmsm_can.diagnosis.page import build

        page.write_text(build(report), encoding="utf-8")
    text = json.dumps(report.to_dict(), indent=2) + "\n"
    for path in data:
        path.write_text(text, encoding="utf-8")
    if args.json == "-":
        print(text, end="")
    else:
        _tell(report, [p for p in (page, *data) if p is not None])
    if problem:
        print(f"ipmsm-can diagnose: {problem}", file=sys.stderr)
        return 2
    return report.exit_code


def _outputs(args: argparse.Namespace) -> tuple[Path | None, list[Path]]:
    """The page and the JSON files to write; raises ValueError where one is an input or has the wrong name."""
    page = None if args.out is None else Path(args.out)
    if page is not None and page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out is {args.out}; allowed is a file that ends in .html")
    data = [Path(args.json)] if args.json not in (None, "-") else []
    if page is not None and not data:
        data = [page.with_suffix(".json")]
    inputs = [Path(p) for p in (args.log, args.drive, args.map) if p is not None]
    for path in (*data, *([page] if page is not None else [])):
        if any(path.exists() and given.exists() and path.samefile(given) for given in inputs):
            raise ValueError(f"{path} is one of the input files; allowed is another file")
        if not path.parent.is_dir():
            raise ValueError(f"the folder {path.parent} of {path.name} does not exist")
    return page, data


def _recorded(args: argparse.Namespace, config: DriveConfig) -> tuple[Report, str]:
    from ipmsm_can.analysis.measurement import Measurement, read_measurement
    from ipmsm_can.analysis.steady import SteadySamples, read_mapped
    from ipmsm_can.diagnosis import diagnose

    measurement: Measurement | SteadySamples
    with bus.patience():
        log, channel, shown = Path(args.log), getattr(args, "channel", None), _progress("reading")
        window_s = args.last or LAST_S
        if args.map is None:
            measurement = read_measurement(log, config, node=args.node, channel=channel, progress=shown,
                                           window_s=window_s)
        else:
            measurement = read_mapped(log, config, args.map, node=args.node, channel=channel, progress=shown,
                                      window_s=window_s)
        _clear()
        report = diagnose(measurement, config)
    problem = f"{measurement.problem}; what was readable is in the report" if measurement.problem else ""
    _check_length(measurement.duration, args)
    return report, problem


def _check_length(duration: float, args: argparse.Namespace) -> None:
    if args.last is None and duration > 0.99 * LAST_S:
        print(f"note: only the last {LAST_S:g} s of the log count; --last says otherwise", file=sys.stderr)


def _live(args: argparse.Namespace, config: DriveConfig) -> tuple[Report, str]:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.port import BusError

    live, at_end = _mapped_sink(args, config) if args.map is not None else _sink(args, config)
    gone = ""
    with (bus.stop_on_signals(args.duration) as stop, bus.open_bus(args) as port,
          Link(port, lambda: bus.open_bus(args)) as link):
        name = port.description
        try:
            _listen(link, live.feed, stop, not args.no_reconnect)
        except BusError as error:
            gone = f"the bus went away: {error}"
    _clear()
    with bus.patience():
        try:
            return at_end(name), gone
        except ValueError as error:
            raise ValueError(f"{error} ({gone})" if gone else str(error)) from None


def _sink(args: argparse.Namespace, config: DriveConfig) -> tuple[LiveDiagnosis, Callable[[str], Report]]:
    """Takes in the frames of our own wire, and what makes a report of them."""
    from ipmsm_can.config.build import build_protocol
    from ipmsm_can.diagnosis.live import LiveDiagnosis

    live = LiveDiagnosis(config, build_protocol([config]), window_s=args.last or _LIVE_S)

    def report(name: str) -> Report:
        if not live.samples:
            raise ValueError(f"no sample of drive {config.wire.node} came on {name}; `ipmsm-can bus` shows what is "
                             "on the bus")
        return live.report(name)

    return live, report


def _mapped_sink(args: argparse.Namespace, config: DriveConfig) -> tuple[MappedDiagnosis, Callable[[str], Report]]:
    """The same of another inverter."""
    from ipmsm_can.diagnosis.live_mapped import MappedDiagnosis
    from ipmsm_can.mapping import load_map, make_plan

    plan = make_plan(load_map(args.map), node=args.node, pole_pairs=config.build_motor().pole_pairs)
    live = MappedDiagnosis(config, plan, window_s=args.last or _LIVE_S)

    def report(name: str) -> Report:
        live.finish()
        if live.diagnosis is None:
            raise ValueError(live.why_none(name))
        return live.diagnosis.report(f"{name} with the map {args.map}")

    return live, report


def _listen(link: Link, feed: Callable[[FrameBlock], None], stop: Callable[[], bool], reconnect: bool) -> None:
    from ipmsm_can.bus.port import BusError

    begin, shown = time.monotonic(), 0.0
    frames = 0
    terminal = sys.stderr.isatty()
    while not stop():
        try:
            block = link.port.receive(_WAIT_S)
        except BusError as error:
            feed(link.lose(error))
            if not reconnect:
                raise
            while not stop():
                link.pause()
                feed(link.take())
                if link.retry():
                    break
            continue
        feed(block)
        frames += len(block)
        now = time.monotonic()
        if terminal and now - shown > _SHOW_S:
            shown = now
            print(f"\r\x1b[Klistening only: {now - begin:.0f} s, {frames} frames", end="", file=sys.stderr,
                  flush=True)


def _progress(what: str) -> Callable[[float], None] | None:
    if not sys.stderr.isatty():
        return None
    shown = [0.0]

    def show(done: float) -> None:
        now = time.monotonic()
        if now - shown[0] > _SHOW_S:
            shown[0] = now
            print(f"\r\x1b[K{what}: {100.0 * done:.0f} %", end="", file=sys.stderr, flush=True)

    return show


def _clear() -> None:
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _tell(report: Report, written: list[Path]) -> None:
    import textwrap

    from rich.console import Console
    from rich.text import Text

    from ipmsm_can.diagnosis.words import lines

    styles = {"head": "bold", "error": "bold red", "warning": "bold yellow", "info": "bold blue", "plain": "",
              "advice": "", "muted": "dim"}
    console = Console(highlight=False, soft_wrap=True)
    width = min(console.width, _WIDEST)
    for text, indent, style in lines(report):
        margin = " " * indent
        for line in textwrap.wrap(text, width, initial_indent=margin, subsequent_indent=margin) or [""]:
            console.print(Text(line, style=styles[style]))
    for path in written:
        console.print(f"wrote {path}", markup=False, soft_wrap=True)
