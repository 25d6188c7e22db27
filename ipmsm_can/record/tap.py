"""The observer of a runner that feeds recordings, and tells them of gaps and losses as they become known."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Protocol

from ipmsm_can.bus.link import Link
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.marks import Mark, gap_begins, gap_ends
from ipmsm_can.node import Tracked
from ipmsm_can.record.status import RecordStatus

_ABSURD_NS = 10_000_000_000


class Sink(Protocol):
    """A recording; its methods but `close` never wait."""

    def take(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock) -> None:
        """What came in, what was estimated, what was sent."""

    def mark(self, mark: Mark) -> None:
        """A remark between the frames."""

    def status(self) -> RecordStatus:
        """How it is doing."""

    def close(self) -> None:
        """Finish the files; never raises."""


class Tap:
    """Recordings of one link.  `observe` is an observer of `LiveRunner` and `Listener`; the other methods may be
    called from any thread."""

    def __init__(self, link: Link, sinks: Iterable[Sink] = ()) -> None:
        self._link = link
        self._sinks: tuple[Sink, ...] = tuple(sinks)
        self._begun = self._ended = link.outages
        self._drops = link.drops
        self._last_ns = 0
        self._shift_ns = 0
        """How far the frames' clock is ahead of this computer's, where an adapter stamps by its own."""

    @property
    def sinks(self) -> tuple[Sink, ...]:
        """The recordings that run."""
        return self._sinks

    def add(self, sink: Sink) -> None:
        """Record here, too, from the next round on."""
        self._sinks = (*self._sinks, sink)

    def remove(self, sink: Sink) -> None:
        """No more of it; closing it is the caller's."""
        self._sinks = tuple(s for s in self._sinks if s is not sink)

    def status(self) -> tuple[RecordStatus, ...]:
        """How they are doing."""
        return tuple(sink.status() for sink in self._sinks)

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock, now_ns: int) -> None:
        """Hand on a round."""
        link = self._link
        over = link.outages - int(link.down)
        while self._ended < over:  # it is back, and this block came after
            outage = link.past[max(self._ended - over, -len(link.past))]
            if self._begun == self._ended:
                self._mark(gap_begins(outage.began_ns, outage.reason))
                self._begun += 1
            self._mark(gap_ends(outage.began_ns, outage.ended_ns))
            self._ended += 1
        for sink in self._sinks:
            sink.take(block, tracked, sent)
        if len(block):
            self._last_ns = int(block.t_ns[-1])
            ahead = self._last_ns - time.time_ns()
            self._shift_ns = ahead if abs(ahead) > _ABSURD_NS else 0
        drops = link.drops
        if drops > self._drops:
            told = f"{drops - self._drops} frames dropped by the kernel shortly before this"
            self._mark(Mark(self._last_ns - self._shift_ns, told))
            self._drops = drops
        if link.down and self._begun < link.outages:  # what had arrived is in this block
            self._mark(gap_begins(link.since_ns, link.cause))
            self._begun = link.outages

    def _mark(self, mark: Mark) -> None:
        mark = Mark(mark.t_ns + self._shift_ns, mark.text)
        for sink in self._sinks:
            sink.mark(mark)

    def close(self) -> None:
        """Finish all recordings."""
        for sink in self._sinks:
            sink.close()
