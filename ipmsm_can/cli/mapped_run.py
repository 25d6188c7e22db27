"""`ipmsm-can run --map`: another inverter, live.  Nothing is ever sent to it: it would understand none of it."""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus, recording
from ipmsm_can.cli.status import BusStatus, NodeStatus, RunStatus

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ipmsm_can.bus.health_report import HealthReport
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.frames import FrameBlock
    from ipmsm_can.mapping.follow import Follower
    from ipmsm_can.node import Tracked
    from ipmsm_can.record.tap import Tap

_SILENT_NS = 500_000_000


def run_mapped(args: argparse.Namespace) -> int:
    """Follow the drive until told to end; returns the exit code."""
    from ipmsm_can.bus.health import BusHealth
    from ipmsm_can.bus.link import Link
    from ipmsm_can.bus.listen import Listener
    from ipmsm_can.bus.port import bus_configuration
    from ipmsm_can.bus.socketcan import SocketCanPort
    from ipmsm_can.config import load_configs
    from ipmsm_can.mapping import load_map, make_plan
    from ipmsm_can.mapping.follow import Follower

    if len(args.configs) != 1:
        raise ValueError(f"--map takes one drive.toml, and there are {len(args.configs)}")
    if args.transmit:
        raise ValueError("--transmit does not go with --map: a mapped inverter knows none of our messages, so "
                         "nothing is ever sent to it")
    if args.measure:
        raise ValueError("--measure does not go with --map: it holds the messages of ipmsm_can.dbc; --record does, "
                         "and `ipmsm-can replay LOG --map` makes rows of the log")
    config = load_configs(args.configs)[0]
    rates = bus.bit_rates(args, [config])
    plan = make_plan(load_map(args.map), node=args.node, pole_pairs=config.build_motor().pole_pairs)
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
        monitor = MappedMonitor(listener, follower, tap)
        def listen() -> None:
            listener.run(stop)
            follower.flush()

        code, status = bus.serve("run", listen, monitor.status, args.quiet)
    _tell(follower, status.elapsed)
    if link.down:
        print(f"ipmsm-can run: there is {link.words}", file=sys.stderr)
        code = 1
    if not follower.samples:
        print(f"ipmsm-can run: no sample of the map {args.map} could be used: {follower.verdict}", file=sys.stderr)
        code = 1
    return max(code, recording.code_of(tap))


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


def _tell(follower: Follower, elapsed: float) -> None:
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
                  f"samples of {elapsed:.1f} s")


class MappedMonitor:
    """Takes a `RunStatus` from a listener and a follower; may be called from another thread."""

    def __init__(self, listener: Listener, follower: Follower, tap: Tap) -> None:
        from ipmsm_can.cli.monitor import Rates

        self._listener = listener
        self._follower = follower
        self._tap = tap
        self._begin = time.monotonic()
        self._rates = Rates(self._begin)
        self._ever = 0

    def status(self) -> RunStatus:
        """As of now."""
        now = time.monotonic()
        report = self._listener.report()
        rates = self._rates.update(now, {"frames": report.frames, "samples": self._follower.samples})
        return RunStatus("ipmsm-can run --map", now - self._begin, False, self._bus(report, rates["frames"]),
                         (self._node(report, rates["samples"]),), self._tap.status())

    def _bus(self, r: HealthReport, frames_per_s: float) -> BusStatus:
        link = self._listener.link
        e = r.errors
        told = f"{e.frames} error frames" + (f", controller {e.state}" if e.state else "") if e.frames else (
            "no error frames")
        return BusStatus(
            description=r.source, load=r.load, frames=r.frames, frames_per_s=frames_per_s, sent=0, unsent=0, late=0,
            unknown=0, remote=sum(i.remote for i in r.ids), wrong_length=0, drops=max(0, r.kernel_drops),
            error_frames=e.frames, errors=told, turnaround_p50=math.nan, turnaround_p99=math.nan, no_bus=r.no_bus,
            outages=link.outages, outage_time=link.outage_time)

    def _node(self, r: HealthReport, samples_per_s: float) -> NodeStatus:
        from ipmsm_can.cli.monitor import RPM
        from ipmsm_can.estimation import confidence

        follower = self._follower
        tracking = follower.tracking
        motor = follower.config.build_motor()
        flowing = follower.samples > 0 and 1e9 * r.last - follower.last_ns < _SILENT_NS and not r.no_bus
        live = flowing and tracking is not None
        theta, omega, sigma, flags, excitation = (tracking.latest if tracking is not None else
                                                  (math.nan, 0.0, math.pi, 0, 0.0))
        self._ever |= flags
        flags = flags if live else 0
        state = follower.verdict.partition(":")[0]  # the reason is told at the end: it takes more than a line
        if tracking is not None:
            state = ("locked" if flags & confidence.LOCKED else "tracking, not locked") if flowing else (
                "no samples any more")
        delay = tracking.estimator.voltage_delay if tracking is not None else None
        return NodeStatus(
            node=follower.config.wire.node, motor=motor.name, state=state, live=live, theta=theta, sigma=sigma,
            omega=omega, rpm=omega / motor.pole_pairs * RPM, valid=bool(flags & confidence.VALID),
            locked=bool(flags & confidence.LOCKED), polarity_known=bool(flags & confidence.POLARITY_KNOWN),
            excitation=excitation, injection="none: a mapped inverter is only listened to", injecting=False,
            amplitude=0.0, hf_current=0.0, sample_rate=follower.rate,
            samples_per_s=samples_per_s, estimates_per_s=samples_per_s if live else 0.0, received=follower.samples,
            lost=tracking.lost if tracking else 0, filled=tracking.filled if tracking else 0, gaps=0, duplicates=0,
            reordered=0, resyncs=0, restarts=0, bad_frames=tracking.unusable if tracking else 0,
            rejected_commands=0, timing=delay.words if delay is not None and delay.applied else "",
            ever_locked=tracking is None or bool(self._ever & confidence.LOCKED),
            ever_valid=tracking is None or bool(self._ever & confidence.VALID))
