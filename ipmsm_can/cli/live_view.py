"""`ipmsm-can monitor`: everything of a drive on one screen, with keys."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus, recording
from ipmsm_can.cli import live_view_session as session

if TYPE_CHECKING:
    from ipmsm_can.bus.port import Port
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.drive.profile import Profile
    from ipmsm_can.live_view.judging import Plan
    from ipmsm_can.live_view.status import MonitorStatus
    from ipmsm_can.wire.protocol import Protocol

HELP = """\
Watch a drive on one screen: angle and speed with their uncertainty, currents, injection, losses, bus, findings as
they come; keys to record, to mark a moment, and with --transmit to start and stop the injection.

On a live bus, or with --log a recording as it came, or with --demo a simulated drive. Listens only, unless
--transmit is given.
"""
EPILOG = """\
examples:
  ipmsm-can monitor --demo                                    no hardware, no bus: a simulated drive
  ipmsm-can monitor drive.toml --log run.blf --speed 2        a recording, twice as fast as it came
  ipmsm-can monitor drive.toml -i socketcan -c can0           a live bus, listening
  ipmsm-can monitor drive.toml -i socketcan -c can0 --transmit
  ipmsm-can monitor drive.toml -i socketcan -c can0 -b 500000 --map cascadia_pm_dq   another inverter, live
  ipmsm-can monitor drive.toml --log run.blf --map cascadia_pm_dq                    and as a recording
  ipmsm-can monitor left.toml right.toml -i pcan -c PCAN_USBBUS1 -b 1000000

Press h for the keys. Where standard output is not a terminal there is one line a second, as of `run`. NO_COLOR is
obeyed; --ascii (or a locale without UTF-8) draws with plain characters.
A recording that is over stays on the screen until q; where there is no keyboard the program ends with it.
exit codes: 0 ended by you, by --duration or with the log, 1 there was no bus at the end or a drive sent no samples,
2 bad input
"""
_FASTEST, _SLOWEST = 100.0, 0.01
_DEMO_ROUNDS = 250
"""How often the demo's profile is repeated: over an hour."""
_DEMO_THETA = math.radians(70.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("configs", nargs="*", metavar="drive.toml", help="configuration of a drive, one file each")
    parser.add_argument("--transmit", action="store_true",
                        help="send estimates, status and injection commands; without it nothing is ever sent")
    parser.add_argument("--map", metavar="MAP", help="the drive is another inverter: a map, or the name of one "
                        "(docs/mapping.md, ipmsm-can map list); it is only listened to")
    parser.add_argument("--node", type=int, metavar="N", help="with --map: number of the drive, if not the map's")
    parser.add_argument("--log", metavar="LOG", help="play this recording instead of a live bus")
    parser.add_argument("--speed", type=_speed, metavar="X",
                        help="with --log: times as fast as it came (default: 1)")
    parser.add_argument("--demo", action="store_true", help="a simulated drive inside the program, no bus; with "
                        "--fd it samples at 10 kHz")
    parser.add_argument("--duration", type=bus.seconds, metavar="S", help="end after so many seconds")
    recording.add_arguments(parser)
    parser.add_argument("--no-findings", action="store_true",
                        help="do not judge bus and drive meanwhile (saves a process, and about a tenth of a core)")
    parser.add_argument("--ascii", action="store_true", help="draw with plain characters")
    parser.add_argument("--no-reconnect", action="store_true", help="end when the bus goes away")
    bus.add_arguments(parser)


def _speed(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not _SLOWEST <= value <= _FASTEST:
        raise argparse.ArgumentTypeError(f"it is {text!r}; allowed is a number from {_SLOWEST:g} to {_FASTEST:g}")
    return value


def main(args: argparse.Namespace) -> int:
    """Watch until told to end; returns the exit code."""
    _check(args)
    if args.map is not None:
        from ipmsm_can.cli.live_view_mapped import watch_mapped

        return watch_mapped(args)
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.bus.warmup import warm_up_companion
    from ipmsm_can.companion import Companion
    from ipmsm_can.config import config_from, load_configs
    from ipmsm_can.config.build import build_protocol
    from ipmsm_can.live_view.course import warm_up
    from ipmsm_can.live_view.sight import WireSight

    configs = load_configs(args.configs) if args.configs else (
        config_from({"motor": {"preset": "m2"}}, source="demo"),)
    rates = bus.bit_rates(args, configs)
    recording.check(args)
    if not (args.log or args.demo):
        bus.check_named(args)
    protocol = build_protocol(configs)
    with bus.patience():
        warm_up_companion(configs, protocol)
        warm_up()
    configs, open_port, source = _opener(args, configs, protocol)
    with (session.stop_in_order(args.duration) as stop, session.short_turns(), open_port() as port,
          Link(port, open_port, transmits=args.transmit) as link,
          session.key_recording(args, link, configs, protocol) as (record, tap)):
        runner = LiveRunner(port, Companion(configs, protocol, args.transmit), *rates,
                            None if args.no_reconnect else link)
        view, news = session.build_view(args, WireSight(runner, tap.status), runner.companion, link, record,
                                        _plan(args, configs, rates), stop, source)
        ends = session.ends_with(view, link, stop)
        code, last = session.serve(lambda: runner.run(ends, view.observe), view, news)
    code = max(code, recording.code_of(tap), int(record is not None and not record.whole))
    if link.down:
        print(f"ipmsm-can monitor: there is {link.words}", file=sys.stderr)
        code = 1
    return code or _verdict(args, last)


def _check(args: argparse.Namespace) -> None:
    """Raise ValueError for options that do not go together."""
    named = [name for name, given in (("--log", args.log is not None), ("--demo", args.demo),
                                      ("a bus (-i, -c)", hasattr(args, "interface") or hasattr(args, "channel")))
             if given]
    # with --log, -c names a channel of the log
    if args.log is not None and not args.demo and not hasattr(args, "interface"):
        named = ["--log"]
    if len(named) > 1:
        raise ValueError(f"{' and '.join(named)} are given; allowed is one of them")
    if args.log is not None and args.transmit:
        raise ValueError("--transmit is given with --log; a recording cannot be answered")
    if args.speed is not None and args.log is None:
        raise ValueError("--speed is given without --log; only a recording can be played at another speed")
    if args.log is not None and args.record:
        raise ValueError("--record is given with --log, which is a recording already")
    if args.map is not None and args.demo:
        raise ValueError("--demo does not go with --map: the simulated drive speaks our own messages")
    if args.node is not None and args.map is None:
        raise ValueError("--node goes with --map; without a map the drive.toml has wire.node")
    if not args.configs and not args.demo and args.map is None:
        raise ValueError("no drive.toml is given; allowed is one for each drive (`ipmsm-can config --explain` "
                         "writes one), or --demo")


def _opener(args: argparse.Namespace, configs: tuple[DriveConfig, ...], protocol: Protocol
            ) -> tuple[tuple[DriveConfig, ...], Callable[[], Port], str | None]:
    """Configurations to use, how to open where the frames come from, and that in words (None: as the port says)."""
    if args.log is not None:
        from ipmsm_can.bus.playback import LogPort
        from ipmsm_can.bus.replay import prepare

        args.reader = session.open_log(args)
        chosen, blocks = prepare(configs, protocol, args.reader)
        speed, words = session.played(args)
        played = LogPort(blocks, speed, words)
        return tuple(chosen), lambda: played, words
    if args.demo:
        from ipmsm_can.bus.simulated import SimulatedPort
        from ipmsm_can.bus.warmup import warm_up_drives
        from ipmsm_can.cli.drive import build_drives

        fd = bool(getattr(args, "fd", False)) or any(c.simulation.fd for c in configs)
        with bus.patience():
            warm_up_drives(build_drives(configs, protocol, _demo_profile(), fd=fd), protocol)
        drives = build_drives(configs, protocol, _demo_profile(), _DEMO_THETA, 1, fd)
        simulated = SimulatedPort(drives, "simulated drive inside this program, no bus")
        return configs, lambda: simulated, None
    return configs, lambda: bus.open_bus(args), None


def _demo_profile() -> Profile:
    """The demo's profile, over and over."""
    from ipmsm_can.drive.profile import Profile, demo

    once = demo()
    starts = [k * once.duration for k in range(_DEMO_ROUNDS)]
    return Profile(tuple((t0 + t, v) for t0 in starts for t, v in once.speed),
                   tuple((t0 + t, v) for t0 in starts for t, v in once.load), once.duration * _DEMO_ROUNDS, "demo")


def _plan(args: argparse.Namespace, configs: tuple[DriveConfig, ...], rates: tuple[int, int]) -> Plan | None:
    """What is to be judged."""
    from ipmsm_can.live_view.judging import Plan

    if args.no_findings:
        return None
    return Plan(configs, rates, error_classes=args.log is None or ".log" in Path(args.log).suffixes)


def _verdict(args: argparse.Namespace, last: MonitorStatus) -> int:
    """Exit code where the bus was there: was there a drive on it, and was the log whole?"""
    code = 0
    silent = [n for n in last.run.nodes if not n.received]
    if silent:
        told = "; ".join(f"drive {n.node} sent no samples that could be used ({n.state})" for n in silent)
        print(f"ipmsm-can monitor: {told}; {last.run.bus.frames} frames came in {last.run.elapsed:.1f} s",
              file=sys.stderr)
        code = 1 if args.log is None else 2
    reader = getattr(args, "reader", None)
    return code if reader is None else session.damage(args, reader) or code
