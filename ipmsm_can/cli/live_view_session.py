"""What `ipmsm-can monitor` does for every kind of drive: open a log, record by key, show the screen, end well."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipmsm_can.cli import bus, recording

if TYPE_CHECKING:
    from ipmsm_can.bus.link import Link
    from ipmsm_can.companion import Companion
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.live_view.judging import Batch, Plan
    from ipmsm_can.live_view.recording import KeyRecording
    from ipmsm_can.live_view.sight import Sight
    from ipmsm_can.live_view.status import MonitorStatus
    from ipmsm_can.live_view.taking import LiveView
    from ipmsm_can.record.tap import Tap
    from ipmsm_can.wire.protocol import Protocol

_BLOCK_FRAMES = 2048
_TURN_S = 0.001
_TOLD_AT_THE_END = ("mark ", "recording ", "cannot record", "drive ")


def open_log(args: argparse.Namespace) -> Any:
    """The log of --log, to be read."""
    from ipmsm_can.logs import read_log

    return read_log(Path(args.log), block_frames=_BLOCK_FRAMES, channel=getattr(args, "channel", None))


def played(args: argparse.Namespace) -> tuple[float, str]:
    """Speed at which --log is played, and what is played in words."""
    speed = args.speed or 1.0
    return speed, f"{Path(args.log).name}, played" + (f" {speed:g} times as fast" if speed != 1.0 else "")


def damage(args: argparse.Namespace, reader: Any) -> int:
    """Exit code of a log that was played: 2 where it is cut off or damaged, and that is said."""
    if not (reader.problem or reader.bad_lines):
        return 0
    told = reader.problem or f"{args.log} is damaged: {reader.bad_lines} of its lines cannot be read"
    print(f"ipmsm-can monitor: {told}; what was readable was played", file=sys.stderr)
    return 2


def _notes(link: Link) -> Callable[[FrameBlock], Batch]:
    """Frames with what the port knows beside them."""
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.live_view.judging import Batch

    counts_drops = isinstance(link.port, SocketCanPort)
    return lambda block: Batch(block, link.drops if counts_drops else -1, link.outages, link.outage_time,
                               link.words)


def build_view(args: argparse.Namespace, sight: Sight, companion: Companion | None, link: Link,
               record: KeyRecording | None, plan: Plan | None, stop: bus.Stop, source: str | None
               ) -> tuple[LiveView, threading.Event]:
    """The view of a sight with its keys and findings, and the event that makes the screen look at once.

    companion: as `Controls` takes it.  source: where the frames come from, None: as the port says.
    """
    from ipmsm_can.live_view.control import Controls
    from ipmsm_can.live_view.taking import FrameClock, LiveView
    from ipmsm_can.live_view.watch import Watch

    clock, news = FrameClock(of_day=args.log is None), threading.Event()
    controls = Controls(companion, record, lambda: stop.now("q"), clock.now_ns, clock.words, news)
    if args.record:
        controls.toggle_record()
    watch = Watch(plan, lambda: clock.words(clock.now_ns()), controls.note_finding, _notes(link))
    view = LiveView(sight, controls, watch, clock, source)
    view.ascii = args.ascii or not _is_utf8()
    return view, news


def ends_with(view: LiveView, link: Link, stop: bus.Stop, at_end: Callable[[], None] = lambda: None
              ) -> Callable[[], bool]:
    """What tells the runner to end: the user does, or the log where there is no keyboard.

    at_end: called once a log is over, before its last picture is taken.
    """

    def ends() -> bool:
        over = getattr(link.port, "finished", False)
        if over and not view.over:
            at_end()
            view.hold_at_end()
        return bool(stop()) or (over and not view.keys)

    return ends


@contextmanager
def key_recording(args: argparse.Namespace, link: Link, configs: Sequence[DriveConfig] = (),
                  protocol: Protocol | None = None) -> Iterator[tuple[KeyRecording | None, Tap]]:
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


def serve(run: Callable[[], None], view: LiveView, news: threading.Event) -> tuple[int, MonitorStatus]:
    """Run until it ends, with the screen; print how it went.  Returns the exit code and the last status.

    run: of a runner whose observer is the view's.
    """
    from ipmsm_can.bus.port import BusError
    from ipmsm_can.cli import plain
    from ipmsm_can.cli.screen import Screen, is_terminal
    from ipmsm_can.live_view.keys import Keys

    gone: BusError | None = None
    keys = Keys(view.controls.press)
    keys.available = view.keys = keys.available and is_terminal(sys.stdout)
    with view.watch, Screen(view.status, drawer="ipmsm_can.live_view.drawing", line=line, news=news), keys:
        try:
            run()
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


def line(status: MonitorStatus) -> str:
    """For pipes: as of `run`, and the gravest finding."""
    from ipmsm_can.cli import plain

    first = next((f for f in status.findings if f.severity != "notice"), None)
    return plain.line(status.run) + (f" | {first.severity}: {first.sentence}" if first else "")


@contextmanager
def stop_in_order(duration: float | None) -> Iterator[bus.Stop]:
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
def short_turns() -> Iterator[None]:
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
