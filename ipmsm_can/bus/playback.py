"""A log as a port: its frames come as they came then, at real speed or another; nothing can be sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Self

from ipmsm_can.frames import FrameBlock

_STEP_S = 0.01
_LONGEST_PAUSE_NS = 5_000_000_000
"""A pause in the log that is longer, or time that runs backwards there, is not waited for."""


class LogPort:
    """Plays blocks of a log.

    blocks: in the order of the log.  speed: 1 as it was, 2 twice as fast; > 0.  description: for people.
    finished: all has been played.  skipped_ns: pauses left out [ns].  clock, sleep: for tests.
    Raises ValueError for a speed that is not above 0.
    """

    fd = True
    drops = 0
    unsent = 0

    def __init__(self, blocks: Iterable[FrameBlock], speed: float, description: str,
                 clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        if not speed > 0.0:
            raise ValueError(f"speed is {speed!r}; allowed is a number above 0")
        self.description = description
        self.finished = False
        self.skipped_ns = 0
        self._blocks = iter(blocks)
        self._speed = speed
        self._clock = clock
        self._sleep = sleep
        self._block = FrameBlock.zeros(0)
        self._at = 0
        self._origin: tuple[float, int] | None = None
        """A moment of the clock, and the time of the log that belongs to it."""
        self._last_ns = 0

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        """See `Port.receive`."""
        end = self._clock() + timeout_s
        while True:
            block = self._due()
            left = end - self._clock()
            if len(block) or left <= 0.0:
                return block
            self._sleep(min(left, _STEP_S))

    def _due(self) -> FrameBlock:
        """The frames whose time has come."""
        while self._at >= len(self._block):
            block = next(self._blocks, None)
            if block is None:
                self.finished = True
                return FrameBlock.zeros(0)
            self._block, self._at = block, 0
        now = self._clock()
        first = int(self._block.t_ns[self._at])
        if self._origin is None:
            self._origin, self._last_ns = (now, first), first
        if not 0 <= first - self._last_ns <= _LONGEST_PAUSE_NS:
            self.skipped_ns += max(0, first - self._last_ns)
            self._origin = now, first
        moment, t_ns = self._origin
        reached = t_ns + int(1e9 * (now - moment) * self._speed)
        t = self._block.t_ns[self._at:]
        late = t > reached
        jumps = abs(t[1:] - t[:-1] - _LONGEST_PAUSE_NS // 2) > _LONGEST_PAUSE_NS // 2
        stops = [int(mask.argmax()) + shift for mask, shift in ((late, 0), (jumps, 1)) if mask.any()]
        n = min([len(t), *stops])
        if not n:
            return FrameBlock.zeros(0)
        out = self._block.take(slice(self._at, self._at + n))
        self._at += n
        self._last_ns = int(out.t_ns[-1])
        return out

    def send(self, block: FrameBlock) -> int:
        """Nothing is sent into the past."""
        return 0

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
