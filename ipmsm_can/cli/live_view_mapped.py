"""`ipmsm-can monitor --map`: the live view of another inverter.  Nothing is ever sent to it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipmsm_can.cli import bus, recording
from ipmsm_can.cli import live_view_session as session
from ipmsm_can.cli.mapped_run import load_mapped, tell, warm_up

if TYPE_CHECKING:
    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.bus.port import Port
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.mapping.follow import Follower
    from ipmsm_can.node import Tracked


def watch_mapped(args: argparse.Namespace) -> int:
    """Watch until told to end; returns the exit code."""
    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.cli.mapped_monitor import MappedMonitor
    from ipmsm_can.live_view import course
    from ipmsm_can.live_view.judging import Plan
    from ipmsm_can.live_view.mapped import MappedSight
    from ipmsm_can.mapping.follow import Follower

    config, plan = load_mapped(args)
    rates = bus.bit_rates(args, [config])
    recording.check(args)
    open_port, source, reader, error_classes = _opener(args)
    health = BusHealth(*rates, error_classes=error_classes)
    with bus.patience():
        warm_up(health, Follower(config, plan))
        course.warm_up()
    sight = MappedSight(config, plan)
    judged = None if args.no_findings else Plan((config,), rates, error_classes, args.map, args.node)
    with (session.stop_in_order(args.duration) as stop, session.short_turns(), open_port() as port,
          Link(port, open_port) as link, session.key_recording(args, link) as (record, tap)):

        def observe(block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock, now_ns: int) -> None:
            view.observe(block, tracked, sent, now_ns)

        listener = Listener(link, health, isinstance(port, SocketCanPort), not args.no_reconnect, observe)
        sight.watch(MappedMonitor(listener, sight.follower, "ipmsm-can monitor --map", tap.status))
        view, news = session.build_view(args, sight, None, link, record, judged, stop, source)
        goes_on = session.ends_with(view, link, stop, sight.follower.flush)

        def listen() -> None:
            listener.run(goes_on)
            sight.follower.flush()

        code, _ = session.serve(listen, view, news)
    code = max(code, recording.code_of(tap), int(record is not None and not record.whole))
    tell(sight.follower)
    if link.down:
        print(f"ipmsm-can monitor: there is {link.words}", file=sys.stderr)
        code = 1
    code = code or _verdict(args, sight.follower, health)
    return code if reader is None else session.damage(args, reader) or code


def _opener(args: argparse.Namespace) -> tuple[Callable[[], Port], str | None, Any, bool]:
    """How to open where the frames come from, that in words (None: as the port says), the reader of a log, and
    whether its error frames are SocketCAN's."""
    if args.log is not None:
        from ipmsm_can.bus.playback import LogPort

        reader = session.open_log(args)
        speed, words = session.played(args)
        port = LogPort(iter(reader), speed, words)
        return lambda: port, words, reader, ".log" in Path(args.log).suffixes
    from ipmsm_can.bus.port import bus_configuration

    return lambda: bus.open_bus(args), None, None, bus_configuration(args)[0]["interface"] == "socketcan"


def _verdict(args: argparse.Namespace, follower: Follower, health: BusHealth) -> int:
    """Exit code where the bus was there: was there anything of the map on it?"""
    from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK
    from ipmsm_can.mapping.check import no_frame

    if follower.samples or follower.shown:
        if not follower.decided:
            print(follower.verdict)
        return 0
    why = f"no sample of the map {args.map} could be used: {follower.verdict}"
    seen = {one.can_id | (CAN_EFF_FLAG if one.extended else 0) for one in health.report().ids}
    # a map may leave the length of its identifiers open
    if seen and not {i & CAN_EFF_MASK for i in seen} & {s.can_id & CAN_EFF_MASK for s in follower.plan.sources}:
        why = no_frame(follower.plan, seen, args.log or "the bus")
    print(f"ipmsm-can monitor: {why}", file=sys.stderr)
    return 1 if args.log is None else 2
