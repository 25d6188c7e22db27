"""Findings as they come: the last seconds of a live bus, judged every few seconds, in bounded memory."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from ipmsm_can.analysis.measurement import MeasurementBuilder
from ipmsm_can.diagnosis.diagnose import diagnose
from ipmsm_can.diagnosis.finding import Finding, Report
from ipmsm_can.frames import FrameBlock

if TYPE_CHECKING:
    from ipmsm_can.analysis.pieces import MapPieces
    from ipmsm_can.analysis.steady import SteadyBuilder
    from ipmsm_can.config.model import DriveConfig
    from ipmsm_can.wire.protocol import Protocol

WINDOW_S, EVERY_S = 8.0, 3.0
LEAST_S = 1.5
"""With fewer seconds of samples nothing is said yet."""
MOST_FRAMES = 1 << 19
"""Frames that may wait for somebody to ask; beyond, the oldest are left out."""


class LiveDiagnosis:
    """The diagnosis of one drive while it runs.

    config: the drive.  protocol: the wire; None builds the one of wire.dbc.  window_s: how many of the last seconds
    count [s].  every_s: the least time between two judgements [s].  clock: monotonic [s].  pieces: what reads the
    frames instead of our own wire, such as `analysis.pieces.MapPieces`; voltage_delay: by how many samples its
    voltage is late.  builder: what collects the frames instead, of an inverter whose signals allow the
    steady-state checks only; with a window of its own.

    `feed` only keeps the block; `findings` and `report` decode and judge, in the thread of who asks, which
    therefore must not be the one that receives.
    """

    def __init__(self, config: DriveConfig, protocol: Protocol | None = None, *, window_s: float = WINDOW_S,
                 every_s: float = EVERY_S, clock: Callable[[], float] = time.monotonic,
                 pieces: MapPieces | None = None, voltage_delay: float = 0.0,
                 builder: SteadyBuilder | None = None) -> None:
        self.left_out = 0
        """Frames that came faster than anybody asked."""
        self._config = config
        self._builder = builder or MeasurementBuilder(config, protocol, pieces=pieces, window_s=window_s,
                                                      voltage_delay=voltage_delay, source="live")
        self._waiting: deque[FrameBlock] = deque()
        self._frames = 0
        self._lock = threading.Lock()
        self._judging = threading.Lock()
        self._every = every_s
        self._clock = clock
        self._next = -float("inf")
        self._findings: tuple[Finding, ...] = ()

    def feed(self, block: FrameBlock) -> None:
        """Take in frames; never raises for what is in them."""
        if not len(block):
            return
        with self._lock:
            self._waiting.append(block)
            self._frames += len(block)
            while self._frames > MOST_FRAMES and len(self._waiting) > 1:
                oldest = len(self._waiting.popleft())
                self._frames -= oldest
                self.left_out += oldest

    def findings(self) -> tuple[Finding, ...]:
        """What is the matter, the cause of the rest first; judged anew at most every few seconds."""
        with self._judging:
            now = self._clock()
            if now >= self._next:
                self._next = now + self._every
                self._take()
                measurement = self._builder.measurement()
                enough = len(measurement) > 0 and measurement.duration >= LEAST_S
                self._findings = diagnose(measurement, self._config, thorough=False).findings if enough else ()
            return self._findings

    def report(self, source: str = "live") -> Report:
        """The whole diagnosis, of what is there now."""
        with self._judging:
            self._take()
            self._builder.source = source
            return diagnose(self._builder.measurement(), self._config)

    def finish(self) -> None:
        """Nothing more comes: samples count that wait for later reports."""
        with self._judging:
            self._take()
            self._builder.finish()

    @property
    def samples(self) -> int:
        """Samples that are held."""
        with self._judging:
            self._take()
            return self._builder.samples

    def _take(self) -> None:
        with self._lock:
            blocks, self._frames = list(self._waiting), 0
            self._waiting.clear()
        for block in blocks:
            self._builder.feed(block)
