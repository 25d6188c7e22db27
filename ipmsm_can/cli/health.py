"""`ipmsm-can bus`: is the bus well?  Of a log, or listening to a live one."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus

if TYPE_CHECKING:
    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.bus.health_report import HealthReport
    from ipmsm_can.cli.status import HealthStatus
    from ipmsm_can.logs import Mark
    from ipmsm_can.record.status import RecordStatus
    from ipmsm_can.wire.protocol import Protocol

HELP = """\
Health of a CAN bus: load from exact bit counts, identifiers with rate and jitter, losses by place, error frames,
the drive's clock against this computer's. What matters comes first, in plain words.

With LOG of a recording; without, on a live bus. It only listens: nothing is ever transmitted.
"""
EPILOG = """\
examples:
  ipmsm-can bus run.blf -b 500000                       a recording; its bit rate, for the load
  ipmsm-can bus -i socketcan -c can0 -b 500000          live, until Ctrl-C
  ipmsm-can bus -i socketcan -c can0 --duration 10 --json > health.json
  ipmsm-can bus run.log.gz --dbc vehicle.dbc            names, and which identifiers are not in that database

With LOG, -c names a channel of the log. Without -b, 1 Mbit/s is assumed, and it is said so.
A bus that goes away is waited for, unless --no-reconnect is given.
exit codes: 0 nothing grave, 1 a finding of severity "error", 2 bad input
"""
_BITRATE, _DATA_BITRATE = 1_000_000, 5_000_000
_BLOCK_FRAMES = 65536
_MARKS_SHOWN = 50


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", nargs="?", metavar="LOG", help="a recording, of any format that replay takes")
    parser.add_argument("--dbc", action="append", default=[], metavar="FILE",
                        help="database that names the identifiers; may be given several times (default: "
                             "ipmsm_can.dbc)")
    parser.add_argument("--json", action="store_true", help="print only the report, as JSON, at the end")
    parser.add_argument("--duration", type=bus.seconds, metavar="S", help="live: end after so many seconds")
    parser.add_argument("--quiet", action="store_true", help="live: no status while it runs, only the report")
    parser.add_argument("--no-reconnect", action="store_true", help="live: end when the bus goes away")
    bus.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Look at the bus; returns the exit code."""
    if args.log is None:
        try:
            bus.check_named(args)
        except ValueError as error:
            raise ValueError(f"neither a LOG was named nor a bus: {error}") from None
        return _live(args)
    if getattr(args, "interface", None) is not None:
        raise ValueError(f"both the log {args.log} and a bus ({args.interface}) are named; allowed is one of them")
    return _recorded(args)


def _recorded(args: argparse.Namespace) -> int:
    from ipmsm_can.logs import gaps, read_log

    path = Path(args.log)
    reader = read_log(path, block_frames=_BLOCK_FRAMES, channel=getattr(args, "channel", None))
    # candump writes what SocketCAN said; other formats also hold error frames of other origin
    kind = [s.lower() for s in path.suffixes if s.lower() != ".gz"][-1:]
    health = build_health(args, error_classes=kind == [".log"])
    for block in reader:
        health.update(block)
    found = gaps(reader.marks)
    health.note_outages(len(found), sum(gap.seconds for gap in found), "")
    code = _tell(health.report(str(path)), args.json)
    if reader.marks and not args.json:
        print(_marked(reader.marks))
    if reader.problem or reader.bad_lines:
        told = reader.problem or f"{path} is damaged: {reader.bad_lines} of its lines cannot be read"
        print(f"ipmsm-can bus: {told}; what was readable is in the report", file=sys.stderr)
        return 2
    return code


def _marked(marks: Sequence[Mark]) -> str:
    """The remarks of a recording, by this computer's clock."""
    import time

    lines = [f"  {time.strftime('%H:%M:%S', time.localtime(1e-9 * mark.t_ns))}.{mark.t_ns // 10**6 % 1000:03d}  "
             f"{mark.text}" for mark in marks[:_MARKS_SHOWN]]
    more = len(marks) - len(lines)
    return "\n".join(["marked in the recording:", *lines, *([f"  ... and {more} more"] if more else [])])


def _live(args: argparse.Namespace) -> int:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.bus.port import BusError, bus_configuration
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.cli.screen import Screen

    socketcan = bus_configuration(args)[0]["interface"] == "socketcan"
    health = build_health(args, error_classes=socketcan)
    with (bus.stop_on_signals(args.duration) as stop, bus.open_bus(args) as port,
          Link(port, lambda: bus.open_bus(args)) as link):
        listener = Listener(link, health, isinstance(port, SocketCanPort), not args.no_reconnect)
        status = health_status("ipmsm-can bus", listener.report)
        gone = ""
        with nullcontext() if args.quiet or args.json else Screen(status):
            try:
                listener.run(stop)
            except BusError as error:
                gone = str(error)
        code = _tell(listener.report(), args.json)
    if gone:
        print(f"ipmsm-can bus: the bus went away: {gone}", file=sys.stderr)
    return 1 if gone else code


def health_status(title: str, report: Callable[[], HealthReport],
                  records: Callable[[], tuple[RecordStatus, ...]] = tuple) -> Callable[[], HealthStatus]:
    """What takes the status of a listener, and of what it records."""
    import time

    from ipmsm_can.cli.status import HealthStatus

    begin = time.monotonic()
    return lambda: HealthStatus(title, time.monotonic() - begin, report(), records())


def build_health(args: argparse.Namespace, error_classes: bool) -> BusHealth:
    """A `BusHealth` with the bit rates and databases of the options, its kernels compiled."""
    from ipmsm_can.bus.health import BusHealth, warm_up
    from ipmsm_can.wire.protocol import Protocol

    bitrate = getattr(args, "bitrate", None)
    data_bitrate = getattr(args, "data_bitrate", None)
    nominal = bitrate or _BITRATE
    name, database, protocol = _names(args.dbc)
    with bus.patience():
        warm_up(protocol or Protocol())
    return BusHealth(nominal, data_bitrate or max(nominal, _DATA_BITRATE), assumed_rates=bitrate is None, name=name,
                     database=database, protocol=protocol, error_classes=error_classes)


def _names(paths: list[str]) -> tuple[Callable[[int, bool, tuple[int, int]], str], str, Protocol | None]:
    """How identifiers are named, from what, and the protocol of the drives if that database has it."""
    from ipmsm_can.wire.dbc import Database, DbcError
    from ipmsm_can.wire.protocol import NODES, UNKNOWN, MessageKind, Protocol

    databases = [Database.load(path, strict=False) for path in paths]
    protocol = None
    if not databases:
        protocol = Protocol()
    for database in databases:
        with suppress(DbcError):  # the database of another kind of bus
            protocol = Protocol(database)

    def name(can_id: int, extended: bool, lengths: tuple[int, int]) -> str:
        for one in databases:
            codec = one.by_id(can_id, extended)
            if codec is not None:
                return codec.name
        if protocol is not None and not extended and protocol.id_lut[can_id] != UNKNOWN:
            kind, node = divmod(int(protocol.id_lut[can_id]), NODES)
            # of another length it is another device's, which has the identifier by chance
            if protocol.codecs[MessageKind(kind)].length in lengths:
                return f"{MessageKind(kind).message} {node}"
        return ""

    return name, " and ".join(Path(p).name for p in paths) or "ipmsm_can.dbc", protocol


def _tell(report: HealthReport, as_json: bool) -> int:
    from ipmsm_can.bus import health_words

    print(json.dumps(report.to_dict(), indent=2) if as_json else health_words.text(report))
    return 1 if any(f.severity == "error" for f in report.findings) else 0
