"""The companion on a live bus: receive, think, answer; and how long that takes.

Between two answers there is nothing to do but collect samples.  A process that wakes up for every frame pays
for every frame; so after an answer the runner sleeps until shortly before the next sample that is to be
answered should arrive, and takes the ones in between in one go.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.bits import BusLoad
from ipmsm_can.bus.port import Port
from ipmsm_can.companion import Companion, Tracked
from ipmsm_can.frames import FrameBlock

IDLE_S = 0.02
"""Longest wait for a frame: the clock makes status and commands due."""
MARGIN_S = 0.0003
"""How long before the expected arrival of the next answered sample the sleep ends."""
SHORTEST_SLEEP_S = 0.0002
LONGEST_SLEEP_S = 0.005
_KEPT = 1 << 16

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

    def run(self, stop: Callable[[], bool], observer: Observer | None = None) -> None:
        """Serve the bus until stop() says so; raises BusError when the bus goes away."""
        while not stop():
            self.round(observer)

    def round(self, observer: Observer | None = None) -> None:
        """Wait for frames, answer them, sleep while nothing is to be answered."""
        block = self.port.receive(IDLE_S)
        now = time.time_ns()
        companion = self.companion
        tracked = companion.feed(block)
        answers = companion.respond(tracked, now)
        if len(answers):
            self.sent += self.port.send(answers)
            if tracked:
                took = 1e-9 * (time.time_ns() - int(tracked[-1].run.t_ns[-1]))
                self.turnaround.add(took)
                companion.turnaround = took
        if len(block):
            self.load.update(block)
        if len(answers):
            self.load.update(answers)
        companion.bus_load = self.load.load(now)
        if observer is not None:
            observer(block, tracked, answers, now)
        if len(answers):
            self._rest()

    def _rest(self) -> None:
        due = self.companion.next_due_ns()
        if due is None:
            return
        sleep = 1e-9 * (due - time.time_ns()) - MARGIN_S
        if sleep > SHORTEST_SLEEP_S:
            time.sleep(min(sleep, LONGEST_SLEEP_S))
