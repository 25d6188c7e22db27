"""The companion on a live bus: receive, think, answer; and how long that takes.

Between two answers there is nothing to do but collect samples.  A process that wakes up for every frame pays
for every frame; so the runner asks the port for as many frames as are missing until the next sample that is
to be answered, and is woken once, by that one.  A companion that only listens has nothing to be in time for: it
lets frames gather.

The clock is the frames' own: the time of the newest frame is now.  Only silence is timed by the runner.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.bits import BusLoad
from ipmsm_can.bus.port import Port
from ipmsm_can.companion import Companion
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import OLDEST_ANSWER, Tracked

if TYPE_CHECKING:
    from ipmsm_can.bus.lane import FastLane

IDLE_S = 0.02
"""Longest wait for a frame: the clock makes status and commands due."""
GATHER_S = 0.01
"""How long a companion that only listens lets frames gather; the port's buffer holds many times that."""
TURNAROUND_EVERY = 8
"""Of so many answers, one is timed: reading the clock is not free everywhere."""
LOAD_EVERY = 32
"""Rounds after which the bus load is worked out."""
_KEPT = 1 << 16
_ABSURD_S = 10.0
"""A frame that seems to have waited longer was stamped by another clock than ours."""

Observer = Callable[[FrameBlock, Sequence[Tracked], FrameBlock, int], None]
"""Called after each round with what came in, what was estimated, what was sent, and the time [ns]."""


@dataclass(slots=True)
class Turnaround:
    """Time from the arrival of a sample frame to the departure of the answer to it; the last 65536 of them."""

    count: int = 0
    _seconds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(_KEPT))

    def add(self, seconds: float) -> None:
        """One more."""
        self._seconds[self.count % _KEPT] = seconds
        self.count += 1

    def quantiles(self, at: Sequence[float]) -> NDArray[np.float64]:
        """Quantiles [s]; NaN before the first answer."""
        n = min(self.count, _KEPT)
        return np.quantile(self._seconds[:n], at) if n else np.full(len(at), np.nan)


class LiveRunner:
    """Companion and port together.

    bitrate, data_bitrate: for the bus load [bit/s].
    """

    def __init__(self, port: Port, companion: Companion, bitrate: float, data_bitrate: float) -> None:
        self.port = port
        self.companion = companion
        self.turnaround = Turnaround()
        self.load = BusLoad(bitrate, data_bitrate)
        self.sent = 0
        self._now_ns = 0
        self._answered = 0
        self._unweighed: list[FrameBlock] = []
        self._rounds = 0
        self._flowing = False
        self._lane = self._find_lane()

    def _find_lane(self) -> FastLane | None:
        from ipmsm_can.bus.lane import FastLane

        return FastLane.over(self.port, self.companion)

    def run(self, stop: Callable[[], bool], observer: Observer | None = None) -> None:
        """Serve the bus until stop() says so; raises BusError when the bus goes away."""
        while not stop():
            self.round(observer)

    def round(self, observer: Observer | None = None) -> None:
        """Wait for the frames up to the next one that is to be answered, and answer."""
        if self._lane is not None and self._lane.ready(self._now_ns):
            self._fast_round(self._lane, observer)
        else:
            self._plain_round(observer)

    def _fast_round(self, lane: FastLane, observer: Observer | None) -> None:
        """A quarter of a second in one go; then what Python has to see to."""
        companion = self.companion
        lap = lane.run(IDLE_S, self._now_ns)
        self.sent += len(lap.sent)
        for took in lap.took.tolist():
            self._note_turnaround(took)
        unstamped = lap.left.t_ns < 0
        if unstamped.any():
            lap.left.t_ns[unstamped] = time.time_ns()
        companion.count_usual(lap.by_kind)
        now = self._time(lap.left if len(lap.left) else lap.taken)
        tracked = companion.feed(lap.left)
        companion.late += lap.late
        answers = FrameBlock.concat([lap.unsent, companion.respond(tracked, now, self._is_late(tracked))])
        if len(answers):
            self.sent += self.port.send(answers)
        block = FrameBlock.concat([lap.taken, lap.left])
        answers = FrameBlock.concat([lap.sent, answers])
        self._weigh(block, answers, now, at_once=True)
        if observer is not None:
            observer(block, [*lap.tracked, *tracked], answers, now)

    def _plain_round(self, observer: Observer | None) -> None:
        companion = self.companion
        block = self._receive()
        now = self._time(block)
        tracked = companion.feed(block)
        answers = companion.respond(tracked, now, self._is_late(tracked))
        if len(answers):
            self.sent += self.port.send(answers)
            if tracked:
                self._time_answer(int(tracked[-1].run.t_ns[-1]))
        self._weigh(block, answers, now)
        if observer is not None:
            observer(block, tracked, answers, now)

    def _receive(self) -> FrameBlock:
        if self.companion.transmit:
            return self.port.receive(IDLE_S, self.companion.frames_until_due(self._now_ns))
        if self._flowing:
            time.sleep(GATHER_S)
        block = self.port.receive(IDLE_S)
        self._flowing = len(block) > 0
        return block

    def _time(self, block: FrameBlock) -> int:
        if len(block):
            self._now_ns = int(block.t_ns[-1])
        else:
            # Counts from zero until the first frame: an adapter may stamp by any clock.
            self._now_ns += round(1e9 * IDLE_S)
        return self._now_ns

    def _is_late(self, tracked: Sequence[Tracked]) -> bool:
        """Whether the newest of these samples has waited too long to be answered, for want of a running process."""
        if not (tracked and self.companion.transmit):
            return False
        waited = 1e-9 * (time.time_ns() - max(int(t.run.t_ns[-1]) for t in tracked))
        return OLDEST_ANSWER < waited < _ABSURD_S

    def _time_answer(self, arrived_ns: int) -> None:
        self._answered += 1
        if self._answered % TURNAROUND_EVERY == 0:
            self._note_turnaround(1e-9 * (time.time_ns() - arrived_ns))

    def _note_turnaround(self, took: float) -> None:
        if 0.0 <= took < _ABSURD_S:  # else the adapter stamps by a clock of its own
            self.turnaround.add(took)
            self.companion.turnaround = took

    def _weigh(self, block: FrameBlock, answers: FrameBlock, now_ns: int, at_once: bool = False) -> None:
        self._unweighed += [block, answers]
        self._rounds += 1
        if at_once or self._rounds % LOAD_EVERY == 0:
            self.load.update(FrameBlock.concat(self._unweighed))
            self._unweighed.clear()
            self.companion.bus_load = self.load.load(now_ns)
