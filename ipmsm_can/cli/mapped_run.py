"""`ipmsm-can run --map`: another inverter, live.  Nothing is ever sent to it: it would understand none of it."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus, recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ipmsm_can.config import DriveConfig
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.mapping.follow import Follower
    from ipmsm_can.mapping.plan import Plan
    from ipmsm_can.node import Tracked


def run_mapped(args: argparse.Namespace) -> int:
    """Follow the drive until told to end; returns the exit code."""
    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.bus.port import bus_configuration
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.cli.mapped_monitor import MappedMonitor
    from ipmsm_can.mapping.follow import Follower

    config, plan = load_mapped(args)
    rates = bus.bit_rates(args, [config])
    bus.check_named(args)
    recording.check(args)
    socketcan = bus_configuration(args)[0]["interface"] == "socketcan"
    health = BusHealth(*rates, error_classes=socketcan)
    with bus.patience():
        warm_up(health, Follower(config, plan))
    follower = Follower(config, plan)
    with (bus.stop_on_signals(args.duration) as stop, bus.open_bus(args) as port,
          Link(port, lambda: bus.open_bus(args)) as link, recording.recordings(args, link) as tap):

        def observe(block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock, now_ns: int) -> None:
            tap.observe(block, tracked, sent, now_ns)
            follower.feed(block)

        listener = Listener(link, health, isinstance(port, SocketCanPort), not args.no_reconnect, observe)
        monitor = MappedMonitor(listener, follower, records=tap.status)
        def listen() -> None:
            listener.run(stop)
            follower.flush()

        code, _ = bus.serve("run", listen, monitor.status, args.quiet)
    tell(follower)
    if link.down:
        print(f"ipmsm-can run: there is {link.words}", file=sys.stderr)
        code = 1
    if not follower.samples:
        print(f"ipmsm-can run: no sample of the map {args.map} could be used: {follower.verdict}", file=sys.stderr)
        code = 1
    return max(code, recording.code_of(tap))


def load_mapped(args: argparse.Namespace) -> tuple[DriveConfig, Plan]:
    """Configuration and plan of the drive.  Raises ValueError for options that do not go with --map."""
    from ipmsm_can.config import load_configs
    from ipmsm_can.mapping import load_map, make_plan

    if len(args.configs) != 1:
        raise ValueError(f"--map takes one drive.toml, and there are {len(args.configs)}")
    if args.transmit:
        raise ValueError("--transmit does not go with --map: a mapped inverter knows none of our messages, so "
                         "nothing is ever sent to it")
    if args.measure:
        raise ValueError("--measure does not go with --map: it holds the messages of ipmsm_can.dbc; --record does, "
                         "and `ipmsm-can replay LOG --map` makes rows of the log")
    config = load_configs(args.configs)[0]
    return config, make_plan(load_map(args.map), node=args.node, pole_pairs=config.build_motor().pole_pairs)


def warm_up(health: object, follower: Follower) -> None:
    """Compile or load the kernels before there is anything to lose: a motor that stands still, for a moment."""
    import numpy as np

    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.mapping.mapper import Mapper
    from ipmsm_can.mapping.steady import SteadyState
    from ipmsm_can.mapping.track import MappedTracking

    block = FrameBlock.zeros(2 * len(follower.plan.sources))
    ids = np.array([s.can_id for s in follower.plan.sources] * 2, np.uint32)
    block.can_id[:] = ids
    block.length[:] = [s.codec.length for s in follower.plan.sources] * 2
    block.t_ns[:] = 10**9 + 1_000_000 * np.arange(len(block))
    mapper = Mapper(follower.plan, 1000.0)
    tracking = MappedTracking(follower.config, follower.plan.map, 1000.0)
    steady = SteadyState(follower.config.build_motor(), follower.plan.map)
    for part in (mapper.feed(block), mapper.flush()):
        tracking.feed(part)
        if len(part):
            steady.feed(part)
    assert isinstance(health, BusHealth)
    spare = BusHealth(1e6, 1e6)
    spare.update(block)
    spare.report()


def tell(follower: Follower) -> None:
    """What was found, after the summary."""
    for note in follower.notes:
        print(f"note: {note}")
    if follower.decided:
        print(follower.verdict)
    if follower.steady is not None:
        print("\n".join(f"  {line}" for line in follower.steady.words()))
    if follower.tracking is not None:
        s = follower.tracking.summary
        if s.encoder.compared:
            print(f"reported angle: the estimate is {math.degrees(s.encoder.rms):.3f} deg rms off it, "
                  f"{math.degrees(s.encoder.largest):.3f} deg at most (electrical), at {s.encoder.compared} valid "
                  f"samples of {s.duration:.1f} s")
