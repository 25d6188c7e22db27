"""Findings as they come: the bus's health and the drive's diagnosis, beside the receiving thread.

The receiving thread only puts blocks into a queue that cannot grow; a thread of this module takes them out twice
a second.  Where it cannot keep up, frames are left out of the findings, never out of the estimate or the record,
and a finding says so.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Protocol, Self

from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.status import SEVERITIES, Told

TAKE_S = 0.5
JUDGE_S = 2.0
MOST_FRAMES = 1 << 17
"""Frames that may wait: about ten seconds of a full bus."""
_NUMBER = re.compile(r"[\d.]+")


class Source(Protocol):
    """Something that makes findings of frames; `feed` and `findings` are called from one thread."""

    def feed(self, block: FrameBlock) -> object:
        """Take in frames; memory must not grow."""

    def findings(self) -> Sequence[Any]:
        """What is the matter as of now: objects with `severity` (SEVERITIES, or "info"), `sentence`, `advice`."""


class Watch:
    """Feeds sources from a thread while the `with` block lasts.

    sources: by what they look for, in words.  stamp: the time, in words, for a finding that is new.  tell: called
    from that thread with each new finding.
    findings: the present ones, gravest first; a new tuple each time.
    """

    def __init__(self, sources: dict[str, Source], stamp: Callable[[], str],
                 tell: Callable[[Told], None] = lambda told: None) -> None:
        self.findings: tuple[Told, ...] = ()
        self.skipped = 0
        self._sources = sources
        self._stamp = stamp
        self._tell = tell
        self._queue: deque[FrameBlock] = deque()
        self._waiting = 0
        self._taken = 0
        self._broken: dict[str, str] = {}
        self._since: dict[str, str] = {}
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, name="findings", daemon=True)

    @property
    def checked(self) -> str:
        """What is looked for, in words."""
        return ", ".join(self._sources)

    def offer(self, block: FrameBlock) -> None:
        """Take in a block, or leave it out; the receiving thread's."""
        n = len(block)
        if not n:
            return
        if self._waiting - self._taken + n > MOST_FRAMES:
            self.skipped += n
            return
        self._waiting += n
        self._queue.append(block)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._end.set()
        self._thread.join(5.0)

    def _work(self) -> None:
        rounds = round(JUDGE_S / TAKE_S)
        k = 0
        while not self._end.wait(TAKE_S):
            self.take()
            k += 1
            if k % rounds == 0 or not self.findings:
                self.judge()

    def take(self) -> None:
        """Hand over what waits."""
        blocks = []
        while self._queue:
            blocks.append(self._queue.popleft())
        if not blocks:
            return
        block = FrameBlock.concat(blocks)
        self._taken += len(block)
        for name, source in self._sources.items():
            if name not in self._broken:
                self._guard(name, partial(source.feed, block))

    def judge(self) -> None:
        """Make the findings anew; what is new since the last time is told."""
        found: list[Told] = []
        for name, source in self._sources.items():
            if name not in self._broken:
                found += [_told(one) for one in self._guard(name, source.findings) or ()]
        found += [Told("warning", words) for words in self._broken.values()]
        if self.skipped:
            found.append(Told("warning", f"This computer is too slow for all checks: {self.skipped} frames were "
                                         "left out of the findings (the estimate and the record have them)."))
        found.sort(key=lambda told: SEVERITIES.index(told.severity))
        marked = []
        for told in found:
            key = told.severity + _NUMBER.sub("#", told.sentence)  # a number that changes is no news
            new = key not in self._since
            since = self._since.setdefault(key, self._stamp())
            told = Told(told.severity, told.sentence, told.advice, since)
            marked.append(told)
            if new:
                self._tell(told)
        if len(self._since) > 1000:
            self._since.clear()
        self.findings = tuple(marked)

    def _guard(self, name: str, call: Callable[[], Any]) -> Any:
        """A check that fails ends alone, with a sentence in its place."""
        try:
            return call()
        except Exception as error:
            self._broken[name] = f"The check of {name} failed and was ended: {type(error).__name__}: {error}"
            return None


def _told(finding: Any) -> Told:
    severity = finding.severity if finding.severity in SEVERITIES else "notice"
    return Told(severity, finding.sentence, getattr(finding, "advice", "") or "")
