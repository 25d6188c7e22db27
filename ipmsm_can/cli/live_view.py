"""`ipmsm-can monitor`: everything of a drive on one screen, with keys."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus, recording

if TYPE_CHECKING:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.bus.port import Port
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.drive.profile import Profile
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.live_view.judging import Batch, Plan
    from ipmsm_can.live_view.recording import KeyRecording
    from ipmsm_can.live_view.status import MonitorStatus
    from ipmsm_can.live_view.taking import LiveView
    from ipmsm_can.record.tap import Tap
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
_BLOCK_FRAMES = 2048
_TURN_S = 0.001
_TOLD_AT_THE_END = ("mark ", "recording ", "cannot record", "drive ")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("configs", nargs="*", metavar="drive.toml", help="configuration of a drive, one file each")
    parser.add_argument("--transmit", action="store_true",
                        help="send estimates, status and injection commands; without it nothing is ever sent")
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
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.bus.warmup import warm_up_companion
    from ipmsm_can.companion import Companion
    from ipmsm_can.config import config_from, load_configs
    from ipmsm_can.config.build import build_protocol
    from ipmsm_can.live_view.control import Controls
    from ipmsm_can.live_view.course import warm_up
    from ipmsm_can.live_view.taking import FrameClock, LiveView
    from ipmsm_can.live_view.watch import Watch

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
    with (_stop(args.duration) as stop, _short_turns(), open_port() as port,
          Link(port, open_port, transmits=args.transmit) as link,
          _recording(args, link, configs, protocol) as (record, tap)):
        runner = LiveRunner(port, Companion(configs, protocol, args.transmit), *rates,
                            None if args.no_reconnect else link)
        clock, news = FrameClock(of_day=args.log is None), threading.Event()
        controls = Controls(runner.companion, record, lambda: stop.now("q"), clock.now_ns, clock.words, news)
        if args.record:
            controls.toggle_record()
        watch = Watch(_plan(args, configs, rates), lambda: clock.words(clock.now_ns()), controls.note_finding,
                      _notes(link))
        view = LiveView(runner, controls, watch, clock, source, tap.status)
        view.ascii = args.ascii or not _is_utf8()

        def ends() -> bool:
            over = getattr(link.port, "finished", False)
            if over and view.keys:
                view.hold_at_end()
            return bool(stop()) or (over and not view.keys)

        code, last = _serve(runner, view, news, ends)
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
    if not args.configs and not args.demo:
        raise ValueError("no drive.toml is given; allowed is one for each drive (`ipmsm-can config --explain` "
                         "writes one), or --demo")


def _opener(args: argparse.Namespace, configs: tuple[DriveConfig, ...], protocol: Protocol
            ) -> tuple[tuple[DriveConfig, ...], Callable[[], Port], str | None]:
    """Configurations to use, how to open where the frames come from, and that in words (None: as the port says)."""
    if args.log is not None:
        from ipmsm_can.bus.playback import LogPort
        from ipmsm_can.bus.replay import prepare
        from ipmsm_can.logs import read_log

        reader = read_log(Path(args.log), block_frames=_BLOCK_FRAMES, channel=getattr(args, "channel", None))
        chosen, blocks = prepare(configs, protocol, reader)
        speed = args.speed or 1.0
        words = f"{Path(args.log).name}, played" + (f" {speed:g} times as fast" if speed != 1.0 else "")
        played = LogPort(blocks, speed, words)
        args.reader = reader
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


def _notes(link: Link) -> Callable[[FrameBlock], Batch]:
    """Frames with what the port knows beside them."""
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.live_view.judging import Batch

    counts_drops = isinstance(link.port, SocketCanPort)
    return lambda block: Batch(block, link.drops if counts_drops else -1, link.outages, link.outage_time,
                               link.words)


@contextmanager
def _recording(args: argparse.Namespace, link: Link, configs: tuple[DriveConfig, ...],
               protocol: Protocol) -> Iterator[tuple[KeyRecording | None, Tap]]:
    """What the keys record with, None where a recording is played; and what feeds it and --measure."""
    from ipmsm_can.live_view.recording import KeyRecording
    from ipmsm_can.logs.writer import warm_up

    path = None if args.record is None else Path(args.record)
    own = argparse.Namespace(**{**vars(args), "record": None})
    with recording.recordings(own, link, configs, protocol) as tap:
        if args.log is not None:
            yield None, tap
            return
        with bus.patience():
            warm_up()
        record = KeyRecording(tap, str(getattr(args, "channel", None) or "can0"), path, recording.rotation(args))
        try:
            yield record, tap
        finally:
            record.stop()
            with contextlib.suppress(OSError):  # a terminal that hung up
                print("".join(f"{words}\n" for words in record.summaries), end="")


def _serve(runner: LiveRunner, view: LiveView, news: threading.Event,
           stop: Callable[[], bool]) -> tuple[int, MonitorStatus]:
    """Run until it ends, with the screen; print how it went.  Returns the exit code and the last status."""
    from ipmsm_can.bus.port import BusError
    from ipmsm_can.cli import plain
    from ipmsm_can.cli.screen import Screen, is_terminal
    from ipmsm_can.live_view.keys import Keys

    gone: BusError | None = None
    keys = Keys(view.controls.press)
    keys.available = view.keys = keys.available and is_terminal(sys.stdout)
    with view.watch, Screen(view.status, drawer="ipmsm_can.live_view.drawing", line=_line, news=news), keys:
        try:
            runner.run(stop, view.observe)
        except BusError as error:
            gone = error
    view.controls.paused = view.over  # a recording is summed up as it was, not as the silence after it
    view.controls.stop_record()
    last = view.status()
    with contextlib.suppress(OSError):  # a terminal that hung up
        print(plain.summary(last.run))
        for event in last.events:
            if event.words.startswith(_TOLD_AT_THE_END):
                print(f"{event.time} {event.words}")
        sys.stdout.flush()
    if gone is not None:
        print(f"ipmsm-can monitor: the bus went away after {last.run.elapsed:.1f} s: {gone}", file=sys.stderr)
    return int(gone is not None), last


def _line(status: MonitorStatus) -> str:
    """For pipes: as of `run`, and the gravest finding."""
    from ipmsm_can.cli import plain

    first = next((f for f in status.findings if f.severity != "notice"), None)
    return plain.line(status.run) + (f" | {first.severity}: {first.sentence}" if first else "")


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
    if reader is not None and (reader.problem or reader.bad_lines):
        told = reader.problem or f"{args.log} is damaged: {reader.bad_lines} of its lines cannot be read"
        print(f"ipmsm-can monitor: {told}; what was readable was played", file=sys.stderr)
        code = 2
    return code


@contextmanager
def _stop(duration: float | None) -> Iterator[bus.Stop]:
    """As `bus.stop_on_signals`; a connection that hangs up ends the program in order, too, so that a record is
    finished."""
    with bus.stop_on_signals(duration) as stop:
        number = getattr(signal, "SIGHUP", None)
        if number is None or threading.current_thread() is not threading.main_thread():
            yield stop
            return
        before = signal.signal(number, lambda *_: stop.now("SIGHUP"))
        try:
            yield stop
        finally:
            signal.signal(number, before)


@contextmanager
def _short_turns() -> Iterator[None]:
    """The receiving thread must not wait for the others' turns of 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_TURN_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _is_utf8() -> bool:
    """Whether the terminal takes more than ASCII, as far as its locale and kind say."""
    encoding = (getattr(sys.stdout, "encoding", "") or "").lower().replace("-", "")
    # the console of the Linux kernel has no braille in its font
    return encoding == "utf8" and os.environ.get("TERM") != "linux" and _locale_is_utf8()


def _locale_is_utf8() -> bool:
    if sys.platform == "win32":
        return True
    # Where LANG is C, Python takes UTF-8 for itself, and sets LC_CTYPE so: neither tells of the terminal.
    ours = os.environ.get("LC_CTYPE") == "C.UTF-8"
    names = ("LC_ALL", "LANG") if ours else ("LC_ALL", "LC_CTYPE", "LANG")
    said = next((value for name in names if (value := os.environ.get(name))), "C")
    return "utf8" in said.lower().replace("-", "")
