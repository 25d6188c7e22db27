"""`ipmsm-can run`: the companion on a CAN bus."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus, recording

if TYPE_CHECKING:
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.node import Node, Tracked
    from ipmsm_can.wire.protocol import Protocol

HELP = """\
Follow the drives on a CAN bus: rotor position, speed, and how far to trust them.
Listens only, unless --transmit is given.
"""
EPILOG = """\
examples:
  ipmsm-can run drive.toml -i socketcan -c can0               listen
  ipmsm-can run drive.toml -i socketcan -c can0 --transmit    answer: position, status, probing commands
  ipmsm-can run left.toml right.toml -i pcan -c PCAN_USBBUS1 -b 1000000 --duration 60
  ipmsm-can run drive.toml -i socketcan -c can0 --record run.blf --measure run.mf4
  ipmsm-can run drive.toml -i socketcan -c can0 -b 500000 --map cascadia_pm_dq
  CAN_INTERFACE=socketcan CAN_CHANNEL=can0 ipmsm-can run drive.toml | tee run.txt

On a terminal the status is a picture, elsewhere one line a second.  Ctrl-C or SIGTERM ends it with a summary.
A bus that goes away (interface down, adapter unplugged) is waited for; --no-reconnect ends the run instead.
exit codes: 0 ended by you or by --duration; 1 there was no bus at the end, a drive sent no samples, or a recording
is not whole; 2 bad input
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("configs", nargs="+", metavar="drive.toml", help="configuration of a drive, one file each")
    parser.add_argument("--transmit", action="store_true",
                        help="send estimates, status and injection commands; without it nothing is ever sent")
    parser.add_argument("--map", metavar="MAP", help="the drive is another inverter: a map, or the name of one "
                        "(docs/mapping.md, ipmsm-can map list); it is only listened to")
    parser.add_argument("--node", type=int, metavar="N", help="with --map: number of the drive, if not the map's")
    parser.add_argument("--duration", type=bus.seconds, metavar="S", help="end after so many seconds")
    parser.add_argument("--quiet", action="store_true", help="no status while it runs, only the summary")
    parser.add_argument("--no-reconnect", action="store_true", help="end when the bus goes away")
    recording.add_arguments(parser)
    bus.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Run the companion until it is told to end; returns the exit code."""
    if args.map is not None:
        from ipmsm_can.cli.mapped_run import run_mapped

        return run_mapped(args)
    if args.node is not None:
        raise ValueError("--node goes with --map; without a map the drive.toml has wire.node")
    from ipmsm_can.config import load_configs

    configs = load_configs(args.configs)
    rates = bus.bit_rates(args, configs)
    bus.check_named(args)
    recording.check(args)

    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.bus.warmup import warm_up_companion
    from ipmsm_can.cli.monitor import RunMonitor
    from ipmsm_can.companion import Companion
    from ipmsm_can.config.build import build_protocol

    protocol = build_protocol(configs)
    with bus.patience():
        warm_up_companion(configs, protocol)
    with bus.stop_on_signals(args.duration) as stop, bus.open_bus(args) as port, \
            Link(port, lambda: bus.open_bus(args), transmits=args.transmit) as link, \
            recording.recordings(args, link, configs, protocol) as tap:
        runner = LiveRunner(port, Companion(configs, protocol, args.transmit), *rates,
                            None if args.no_reconnect else link)
        monitor = RunMonitor(runner, records=tap.status)

        def observe(block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock, now_ns: int) -> None:
            monitor.observe(block, tracked, sent, now_ns)
            tap.observe(block, tracked, sent, now_ns)

        code, status = bus.serve("run", lambda: runner.run(stop, observe), monitor.status, args.quiet)
    code = max(code, recording.code_of(tap))
    if link.down:
        print(f"ipmsm-can run: there is {link.words}", file=sys.stderr)
        code = 1
    silent = [runner.companion.nodes[n.node] for n in status.nodes if not n.received]
    if code or not silent:
        return code
    told = "; ".join(_silence(node, protocol) for node in silent)
    print(f"ipmsm-can run: {told}; {status.bus.frames} frames came in {status.elapsed:.1f} s", file=sys.stderr)
    return 1


def _silence(node: Node, protocol: Protocol) -> str:
    """Why there was not one sample of this drive, in half a sentence."""
    from ipmsm_can.wire.protocol import MessageKind

    if node.receiver.sequencer.waiting:
        return (f"drive {node.number} sent samples but no DriveTiming, so their rate is unknown (wire.sample_rate "
                "in its TOML file can say it)")
    ids = " or ".join(f"0x{protocol.base_ids[kind] + node.number:X}"
                      for kind in (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK))
    return f"drive {node.number} sent no samples that could be used (identifier {ids})"
