"""Simulated drives as a port, inside the program and in real time: no bus, no thread, no other program."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

import numpy as np

from ipmsm_can.drive.node import DriveNode
from ipmsm_can.frames import FrameBlock

TICK_S = 0.004
"""Samples come in bursts of this length, as from an adapter on USB."""
FALLEN_BEHIND_S = 0.5


class SimulatedPort:
    """The companion's end of a bus with simulated drives on it.

    Frames carry Unix time, the first samples that of the first `receive`.  clock_ns: Unix time [ns];
    sleep: for tests.
    """

    fd = True
    drops = 0
    unsent = 0

    def __init__(self, drives: Sequence[DriveNode], description: str, clock_ns: Callable[[], int] = time.time_ns,
                 sleep: Callable[[float], None] = time.sleep) -> None:
        self.description = description
        self.sent = 0
        self._drives = drives
        self._clock_ns = clock_ns
        self._sleep = sleep
        self._t0_ns: int | None = None
        self._done_s = 0.0

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        """See `Port.receive`."""
        if self._t0_ns is None:
            self._t0_ns = self._clock_ns()
        next_ns = self._t0_ns + round(1e9 * (self._done_s + TICK_S))
        wait = 1e-9 * (next_ns - self._clock_ns())
        if wait > timeout_s:
            self._sleep(timeout_s)
            return FrameBlock.zeros(0)
        if wait > 0.0:
            self._sleep(wait)
        elapsed = max(self._done_s + TICK_S, 1e-9 * (self._clock_ns() - self._t0_ns))
        if elapsed > self._done_s + FALLEN_BEHIND_S:
            # a computer that slept: the drives did, too
            self._t0_ns += round(1e9 * (elapsed - self._done_s - TICK_S))
            elapsed = self._done_s + TICK_S
        self._done_s = elapsed
        return self._advance(elapsed, self._t0_ns)

    def _advance(self, elapsed: float, t0_ns: int) -> FrameBlock:
        parts = []
        for drive in self._drives:
            due = int(elapsed * drive.simulation.parameters.sample_rate + 1e-6) - drive.simulation.next_sample
            if due > 0:
                parts.append(drive.step(due, t0_ns).frames)
        frames = FrameBlock.concat(parts)
        return frames.take(np.argsort(frames.t_ns, kind="stable")) if len(parts) > 1 else frames

    def send(self, block: FrameBlock) -> int:
        """The drives hear it before their next samples."""
        self.sent += len(block)
        for drive in self._drives:
            drive.receive(block)
        return len(block)

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
