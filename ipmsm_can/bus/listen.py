"""Listening on a live bus for its health: it receives and never sends, and goes on when the bus comes back."""

from __future__ import annotations

import time
from collections.abc import Callable

from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.health_report import HealthReport
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.live import GATHER_S, Observer
from ipmsm_can.bus.port import BusError
from ipmsm_can.frames import FrameBlock

_WAIT_S = 0.1
_SILENT_NS = 300_000_000
_NOTHING = FrameBlock.zeros(0)


class Listener:
    """Feeds a `BusHealth` from a link.

    counts_drops: the port knows what the kernel dropped.  reconnect: go on when the bus comes back; else `run`
    raises BusError.  observer: is shown every block, as those of `LiveRunner` are.  clock: monotonic [s].
    """

    def __init__(self, link: Link, health: BusHealth, counts_drops: bool, reconnect: bool = True,
                 observer: Observer | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.link = link
        self.health = health
        self._counts_drops = counts_drops
        self._reconnect = reconnect
        self._observer = observer
        self._clock = clock
        self._newest: tuple[int, float] | None = None

    def run(self, stop: Callable[[], bool]) -> None:
        """Listen until stop() says so."""
        while not stop():
            try:
                block = self.link.port.receive(_WAIT_S)
            except BusError as error:
                self._take(self.link.lose(error))
                if not self._reconnect:
                    raise
                self._wait(stop)
                continue
            self._take(block)
            if len(block):
                time.sleep(GATHER_S)

    def _wait(self, stop: Callable[[], bool]) -> None:
        while not stop():
            self.link.pause()
            self._take(self.link.take())
            if self.link.retry():
                return

    def _take(self, block: FrameBlock) -> None:
        self.health.update(block)
        if len(block):
            self._newest = int(block.t_ns[-1]), self._clock()
        if self._observer is not None:
            self._observer(block, (), _NOTHING, self.now_ns())

    def now_ns(self) -> int:
        """The time on the frames' axis [ns], which goes on in a silence; 0 before the first frame."""
        if self._newest is None:
            return 0
        t_ns, at = self._newest
        return t_ns + round(1e9 * (self._clock() - at))

    def report(self) -> HealthReport:
        """As of now; may be called from another thread."""
        link = self.link
        self.health.note_port(link.drops if self._counts_drops else -1)
        self.health.note_outages(link.outages, link.outage_time, link.words)
        now_ns = None
        if self._newest is not None:
            # the adapter may stamp by a clock of its own: its newest frame is now, unless nothing comes
            now = self.now_ns()
            now_ns = now if now - self._newest[0] > _SILENT_NS else None
        return self.health.report(link.port.description, now_ns)
