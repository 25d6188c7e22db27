"""What a live view looks through: the companion of drives that speak our wire, or (`mapped`) a map of another's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.cli.monitor import RunMonitor
from ipmsm_can.cli.status import RunStatus
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.course import CourseRing
from ipmsm_can.motor import Motor
from ipmsm_can.node import Tracked
from ipmsm_can.record.status import RecordStatus


@dataclass(frozen=True, slots=True)
class Aside:
    """What there is of a drive beside its status.

    reported: speed and the axes of i_d and i_q are the drive's own word, for there is no estimate.
    figures: what else is known, as (name, words).
    """

    reported: bool = False
    figures: tuple[tuple[str, str], ...] = ()


NOTHING_ASIDE = Aside()


class Sight(Protocol):
    """Drives, as a live view sees them.  motors, courses: by the number of the drive."""

    @property
    def motors(self) -> Mapping[int, Motor]:
        """Of all drives, in the order of the screen."""

    @property
    def courses(self) -> Mapping[int, CourseRing]:
        """Of all drives."""

    def status(self) -> RunStatus:
        """As of now; another thread's than `observe`."""

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Take in a round, as observers of a runner do."""

    def aside(self, number: int) -> Aside:
        """Of one drive, as of now."""


class WireSight:
    """Drives that speak our wire, through the companion of `runner`.  records: what is recorded."""

    def __init__(self, runner: LiveRunner, records: Callable[[], tuple[RecordStatus, ...]] = tuple) -> None:
        self.monitor = RunMonitor(runner, "ipmsm-can monitor", records)
        nodes = runner.companion.nodes
        self.motors = {number: node.config.build_motor() for number, node in nodes.items()}
        self.courses = {number: CourseRing() for number in nodes}

    def status(self) -> RunStatus:
        """As of now."""
        return self.monitor.status()

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Note a round."""
        self.monitor.observe(block, tracked, answers, now_ns)
        for part in tracked:
            self.courses[part.node].add(part)

    def aside(self, number: int) -> Aside:
        """All there is is in the status."""
        return NOTHING_ASIDE
