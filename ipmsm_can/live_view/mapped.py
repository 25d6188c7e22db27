"""A live view of another inverter through its map: what can be estimated, else what it reports."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ipmsm_can.cli.mapped_monitor import MappedMonitor
from ipmsm_can.cli.status import RunStatus
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.course import CourseRing
from ipmsm_can.live_view.sight import Aside
from ipmsm_can.mapping.convert import spoils_dq
from ipmsm_can.mapping.follow import Follower
from ipmsm_can.mapping.look import LOOK_S
from ipmsm_can.mapping.mapper import MappedBlock
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.node import Tracked


class MappedSight:
    """One drive through its map.  It is only listened to.

    config: of the drive.  plan: of its map, from `make_plan`.  look_s: how long its signals are looked at [s].
    `watch` says what listens, before the first status.
    """

    def __init__(self, config: DriveConfig, plan: Plan, look_s: float = LOOK_S) -> None:
        self.number = config.wire.node
        self.follower = Follower(config, plan, look_s, self._reported, self._tracked)
        self.motors = {self.number: config.build_motor()}
        self._ring = CourseRing()
        self.courses = {self.number: self._ring}
        self._spoils = spoils_dq(plan.map)
        self._decided = False
        self._monitor: MappedMonitor | None = None

    def watch(self, monitor: MappedMonitor) -> None:
        """Take the status from there."""
        self._monitor = monitor

    def _reported(self, part: MappedBlock) -> None:
        self._begin_anew()
        self._ring.add_reported(part, self._spoils)

    def _tracked(self, part: Tracked) -> None:
        self._begin_anew()
        self._ring.add(part)

    def _begin_anew(self) -> None:
        """Once it is decided, what was shown while it looked comes again, as it is from then on."""
        if self.follower.decided and not self._decided:
            self._decided = True
            self._ring.clear()

    def status(self) -> RunStatus:
        """As of now."""
        assert self._monitor is not None
        return self._monitor.status()

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Take in a round."""
        self.follower.feed(block)

    def aside(self, number: int) -> Aside:
        """Steady-state quantities, or how far the estimate is off a reported angle."""
        follower = self.follower
        steady, tracking = follower.steady, follower.tracking
        if tracking is not None:
            e = tracking.summary.encoder
            if not e.compared:
                return Aside()
            return Aside(figures=(("reported", f"angle {math.degrees(e.rms):.2f} deg rms off the estimate, "
                                   f"{math.degrees(e.largest):.2f} at most"),))
        reported = self._monitor is not None and self._monitor.flowing
        figures = () if steady is None else (("steady", steady.judged), *steady.figures())
        return Aside(reported, tuple(figures))
