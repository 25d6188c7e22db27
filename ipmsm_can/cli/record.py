"""`ipmsm-can record`: everything on a bus into a log."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext

from ipmsm_can.cli import bus, recording

HELP = """\
Record a CAN bus: every frame, error frames too, with the kernel's time stamps, into a log of any usual format.
It only listens: nothing is ever transmitted.
"""
EPILOG = """\
FILE's suffix chooses the format: .blf (best: small, exact), .log (text, as candump -L), .asc .csv .db .mf4 .trc;
.log.gz and so on are packed. A file that exists is never overwritten.

What has come is written twice a second: a program that is killed leaves a file that is whole up to a second before.
Where the bus goes away (interface down, adapter unplugged) the recording waits for it, and the gap is marked in the
log; `ipmsm-can bus FILE` and `replay` tell of the marks. A full disk ends the recording, and nothing else.

examples:
  ipmsm-can record run.blf -i socketcan -c can0 -b 500000
  ipmsm-can record run.blf -i socketcan -c can0 --rotate-size 100MB --rotate-time 10min     run_001.blf, run_002.blf
  ipmsm-can record run.blf -i socketcan -c can0 --drive drive.toml --measure run.mf4        and the estimates
  ipmsm-can run drive.toml -i socketcan -c can0 --transmit --record run.blf                 while it answers

exit codes: 0 everything is in the files, 1 something is not, or there was no bus at the end; 2 bad input
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("record", metavar="FILE", help="the log to write")
    recording.add_rotation_arguments(parser)
    parser.add_argument("--drive", action="append", default=[], metavar="drive.toml",
                        help="follow this drive, too: its status on the screen, and what --measure needs")
    parser.add_argument("--measure", "--mf4", metavar="FILE.mf4",
                        help="with --drive: decoded signals and the estimates into this measurement file")
    parser.add_argument("--duration", type=bus.seconds, metavar="S", help="end after so many seconds")
    parser.add_argument("--quiet", action="store_true", help="no status while it runs, only the summary")
    parser.add_argument("--no-reconnect", action="store_true", help="end when the bus goes away")
    bus.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Record until told to end; returns the exit code."""
    if args.measure and not args.drive:
        raise ValueError("--measure needs to know whose signals and estimates are meant: --drive drive.toml")
    if args.drive:
        from ipmsm_can.cli import run

        args.configs, args.transmit, args.map, args.node = args.drive, False, None, None
        return run.main(args)
    return _listen(args)


def _listen(args: argparse.Namespace) -> int:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.bus.port import BusError, bus_configuration
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.cli.health import build_health, health_status
    from ipmsm_can.cli.screen import Screen

    recording.check(args)
    socketcan = bus_configuration(args)[0]["interface"] == "socketcan"
    args.dbc = []
    health = build_health(args, error_classes=socketcan)
    gone = ""
    with (bus.stop_on_signals(args.duration) as stop, bus.open_bus(args) as port,
          Link(port, lambda: bus.open_bus(args)) as link, recording.recordings(args, link) as tap):
        listener = Listener(link, health, isinstance(port, SocketCanPort), not args.no_reconnect, tap.observe)
        status = health_status("ipmsm-can record", listener.report, tap.status)
        with nullcontext() if args.quiet else Screen(status):
            try:
                listener.run(stop)
            except BusError as error:
                gone = str(error)
        report = listener.report()
        code = max(recording.code_of(tap), int(link.down))
    said = [f"{report.frames} frames in {report.duration:.1f} s, load {100.0 * report.mean_load:.1f} % on average"]
    if report.kernel_drops > 0:
        said.append(f"{report.kernel_drops} frames dropped by the kernel: they are in no file")
    if report.outages:
        said.append(f"the bus went away {report.outages} times, for {report.outage_time:.1f} s in all"
                    + (f"; {report.no_bus}" if report.no_bus else ""))
    print("; ".join(said))
    if gone:
        print(f"ipmsm-can record: the bus went away: {gone}", file=sys.stderr)
    return 1 if gone or report.kernel_drops > 0 else code
