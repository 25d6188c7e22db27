"""The companion on a live bus: receive, think, answer; and how long that takes.

Between two answers there is nothing to do but collect samples.  A process that wakes up for every frame pays
for every frame; so the runner asks the port for as many frames as are missing until the next sample that is
to be answered, or until a command or status is due, and is woken once, by that one.  A companion that only
listens has nothing to be in time for: it lets frames gather.

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
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.port import BusError, Port
from ipmsm_can.companion import Companion
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import OLDEST_ANSWER, STALE_AFTER_NS, Tracked

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
"""A first frame that seems to have waited longer was stamped by another clock than ours."""
_STALE_S = 1e-9 * STALE_AFTER_NS + 0.5 * IDLE_S
_NOTHING = FrameBlock.zeros(0)

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

    bitrate, data_bitrate: for the bus load [bit/s].  link: opens the port again when its bus goes away; without
    one, `run` ends then.
    """

    def __init__(self, port: Port, companion: Companion, bitrate: float, data_bitrate: float,
                 link: Link | None = None) -> None:
        self.port = port
        self.link = link
        self.companion = companion
        self.turnaround = Turnaround()
        self.load = BusLoad(bitrate, data_bitrate)
        self.sent = 0
        self._now_ns = 0
        self._answered = 0
        self._unweighed: list[FrameBlock] = []
        self._rounds = 0
        self._flowing = False
        self._own_clock: bool | None = None
        """Whether the adapter stamps by a clock that is not the computer's."""
        self._lane = self._find_lane()

    def _find_lane(self) -> FastLane | None:
        from ipmsm_can.bus.lane import FastLane

        return FastLane.over(self.port, self.companion)

    def run(self, stop: Callable[[], bool], observer: Observer | None = None) -> None:
        """Serve the bus until stop() says so; raises BusError when the bus goes away and there is no link."""
        while not stop():
            try:
                self.round(observer)
            except BusError as error:
                if self.link is None:
                    raise
                self._wait_for_bus(self.link, error, stop, observer)

    def _wait_for_bus(self, link: Link, error: BusError, stop: Callable[[], bool],
                      observer: Observer | None) -> None:
        """Take in what had arrived; then try again and again, while the companion sees silence go by."""
        self._deaf_round(link.lose(error), _STALE_S, observer)  # what it claimed is over at once
        while not stop():
            passed = link.pause()
            self._deaf_round(link.take(), passed, observer)
            if link.retry():
                self.port = link.port
                self._lane = self._find_lane()
                return

    def _deaf_round(self, block: FrameBlock, passed_s: float, observer: Observer | None) -> None:
        """A round whose answers nobody could hear; in steps no longer than the bus would make them, so that the
        scheduler comes to rest as it does on a silent one."""
        self._flowing = False
        if len(block):
            self._time(block)
        tracked = self.companion.feed(block)
        self.companion.respond(tracked, self._now_ns, late=True)
        while passed_s > 0.0:
            step = min(passed_s, IDLE_S)
            passed_s -= step
            self._now_ns += round(1e9 * step)
            self.companion.respond([], self._now_ns)
        for node in self.companion.nodes.values():
            node.update_state(self._now_ns)
        self._weigh(block, _NOTHING, self._now_ns, at_once=True)
        if observer is not None:
            observer(block, tracked, _NOTHING, self._now_ns)

    @property
    def drops(self) -> int:
        """Frames that arrived and were lost before they were read, of all ports so far."""
        return self.port.drops if self.link is None else self.link.drops

    @property
    def unsent(self) -> int:
        """Frames that could not be sent, of all ports so far."""
        return self.port.unsent if self.link is None else self.link.unsent

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
        companion.count_usual(lap.by_kind, lap.foreign)
        companion.late += lap.late
        unstamped = lap.left.t_ns < 0
        if unstamped.any():
            lap.left.t_ns[unstamped] = time.time_ns()
        now = self._time(lap.left if len(lap.left) else lap.taken)
        tracked = companion.feed(lap.left)
        answers = FrameBlock.concat([lap.unsent, companion.respond(tracked, now, self._is_late(tracked))])
        block = FrameBlock.concat([lap.taken, lap.left])
        self._send(answers, block, [*lap.tracked, *tracked], now, observer, lap.sent)
        if lap.silent:
            lane.check_bus()

    def _plain_round(self, observer: Observer | None) -> None:
        block = self._receive()
        now = self._time(block)
        tracked = self.companion.feed(block)
        answers = self.companion.respond(tracked, now, self._is_late(tracked))
        if self._send(answers, block, tracked, now, observer) and tracked:
            self._time_answer(int(tracked[-1].run.t_ns[-1]))

    def _send(self, answers: FrameBlock, block: FrameBlock, tracked: Sequence[Tracked], now_ns: int,
              observer: Observer | None, before: FrameBlock = _NOTHING) -> int:
        """Send answers, weigh and show the round; returns how many the port took.  It is also shown, and so
        recorded, where the bus goes away at that moment.

        before: answers of this round that are sent already.
        """
        sent = 0
        try:
            if len(answers):
                sent = self.port.send(answers)
                self.sent += sent
        finally:
            gone = FrameBlock.concat([before, answers.take(slice(0, sent))])
            self._weigh(block, gone, now_ns, at_once=len(before) > 0)
            if observer is not None:
                observer(block, tracked, gone, now_ns)
        return sent

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
        if self._own_clock is None:
            # Told by the first samples: later ones may be as old because this process was stopped.
            self._own_clock = not -_ABSURD_S < waited < _ABSURD_S
        return waited > OLDEST_ANSWER and not self._own_clock

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
