"""Simulated drives on a live bus, in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from ipmsm_can.bus.port import Port
from ipmsm_can.drive.node import DriveNode, Step
from ipmsm_can.frames import FrameBlock

FALLEN_BEHIND_S = 0.5
"""Lag after which lost time is given up instead of being caught up with a flood of frames."""
FALLEN_BEHIND_ANSWERED_S = 2.5e-3
"""The same for a drive that may run on the companion's angle, a quarter of how long an estimate lives by default:
while it caught up the companion would have no time to answer, or would find the samples too old to, and the drive
would stop for a delay that nobody but it made."""


class DriveRunner:
    """Drives on a port: every tick the samples that are due are simulated and sent, and commands obeyed.

    tick_s: time between two looks at the bus; at 5 kHz, 1 ms sends five samples at once, and 0.2 ms each by
    itself, for five times the system calls.
    """

    def __init__(self, port: Port, drives: Sequence[DriveNode], tick_s: float = 1e-3) -> None:
        self.port = port
        self.drives = drives
        self.sent = 0
        self.slips = 0
        """How often the machine was too slow and time was given up."""
        self._tick_s = tick_s
        self._patience_s = min((_patience(drive) for drive in drives), default=FALLEN_BEHIND_S)
        self._done = [0] * len(drives)

    def run(self, stop: Callable[[], bool], observer: Callable[[int, Step], None] | None = None) -> None:
        """Drive until stop() says so; observer gets (node, step) for every stretch of simulation."""
        begin = time.monotonic()
        tick = 0
        while not stop():
            tick += 1
            late = time.monotonic() - (begin + tick * self._tick_s)
            if late < 0.0:
                time.sleep(-late)
            elif late > self._patience_s:
                begin += late
                self.slips += 1
            self._advance(tick * self._tick_s, observer)

    def _advance(self, elapsed: float, observer: Callable[[int, Step], None] | None) -> None:
        heard = self.port.receive(0.0)
        frames: list[FrameBlock] = []
        for k, drive in enumerate(self.drives):
            if len(heard):
                drive.receive(heard)
            target = int(elapsed * drive.simulation.parameters.sample_rate + 1e-6)
            if target > self._done[k]:
                step = drive.step(target - self._done[k])
                self._done[k] = target
                frames.append(step.frames)
                if observer is not None:
                    observer(drive.node, step)
        together = FrameBlock.concat(frames)
        if len(together):
            self.sent += self.port.send(together)


def _patience(drive: DriveNode) -> float:
    on_encoder = drive.simulation.parameters.angle_source == "encoder"
    return FALLEN_BEHIND_S if on_encoder else FALLEN_BEHIND_ANSWERED_S
