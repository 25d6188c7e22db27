"""Findings as they come, without holding the receiving thread up: another process makes them (`judging`).

The receiving thread only puts blocks into a queue that cannot grow; a thread takes them out twice a second and
hands them to that process.  Where it cannot keep up, frames are left out of the findings, never out of the estimate
or the record, and a finding says so.
"""

from __future__ import annotations

import contextlib
import pickle
import re
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import IO, Self

from ipmsm_can.cli.screen import environment
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.judging import Batch, Plan
from ipmsm_can.live_view.status import SEVERITIES, Told

TAKE_S = 0.5
MOST_FRAMES = 1 << 17
"""Frames that may wait: about ten seconds of a full bus."""
_NUMBER = re.compile(r"[\d.]+")
_KEYS_KEPT = 1000
_PATIENCE_S = 1.0


class Watch:
    """Has the frames judged while the `with` block lasts.

    plan: what is judged; None: nothing is.  stamp: the time, in words, for a finding that is new.  tell: called
    with each new finding.  note: puts what the port knows beside frames.
    findings: the present ones, gravest first; a new tuple each time.
    """

    def __init__(self, plan: Plan | None, stamp: Callable[[], str],
                 tell: Callable[[Told], None] = lambda told: None,
                 note: Callable[[FrameBlock], Batch] = Batch) -> None:
        self.findings: tuple[Told, ...] = ()
        self.checked = "" if plan is None else "starting"
        """What is looked at, in words; "starting" until the process is there, "" for nothing."""
        self.skipped = 0
        self._plan = plan
        self._stamp = stamp
        self._tell = tell
        self._note = note
        self._queue: deque[FrameBlock] = deque()
        self._offered = self._taken = 0
        self._ready = False
        self._since: dict[str, str] = {}
        self._end = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._threads: list[threading.Thread] = []

    def offer(self, block: FrameBlock) -> None:
        """Take in a block, or leave it out; the receiving thread's."""
        n = len(block)
        if not n or not self._ready:
            return
        if self._offered - self._taken + n > MOST_FRAMES:
            self.skipped += n
            return
        self._offered += n
        self._queue.append(block)

    def take(self) -> FrameBlock:
        """Everything that waits."""
        blocks = []
        while self._queue:
            blocks.append(self._queue.popleft())
        block = FrameBlock.concat(blocks)
        self._taken += len(block)
        return block

    def accept(self, found: tuple[Told, ...]) -> None:
        """The findings as of now: each keeps the time it was first seen at, and is told once."""
        if self.skipped:
            slow = (f"This computer is too slow for all checks: {self.skipped} frames were left out of the "
                    "findings (the estimate and the record have them).")
            found = tuple(sorted([*found, Told("warning", slow)], key=lambda told: SEVERITIES.index(told.severity)))
        if len(self._since) > _KEYS_KEPT:
            self._since.clear()
        marked = []
        for told in found:
            key = told.severity + _NUMBER.sub("#", told.sentence)  # a number that changes is no news
            new = key not in self._since
            since = self._since.setdefault(key, self._stamp())
            marked.append(Told(told.severity, told.sentence, told.advice, since))
            if new:
                self._tell(marked[-1])
        self.findings = tuple(marked)

    def begin(self, looked_at: tuple[str, ...]) -> None:
        """The frames from now on are judged."""
        self.checked, self._ready = ", ".join(looked_at), True

    # The process

    def __enter__(self) -> Self:
        if self._plan is None:
            return self
        self._process = subprocess.Popen(
            [sys.executable, "-m", "ipmsm_can.live_view.judging"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, env=environment())
        assert self._process.stdin is not None and self._process.stdout is not None
        self._threads = [
            threading.Thread(target=self._write, args=(self._process.stdin,), name="frames to judge", daemon=True),
            threading.Thread(target=self._read, args=(self._process.stdout,), name="findings", daemon=True)]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._end.set()
        process = self._process
        if process is None:
            return
        # it may be busy, and nobody waits for what it would say
        process.kill()
        process.wait()
        for thread in self._threads:
            thread.join(_PATIENCE_S)

    def _write(self, pipe: IO[bytes]) -> None:
        with contextlib.suppress(OSError, ValueError):
            pipe.write(pickle.dumps(self._plan))
            pipe.flush()
            while not self._end.wait(TAKE_S):
                if self._ready:
                    pipe.write(pickle.dumps(self._note(self.take())))
                    pipe.flush()

    def _read(self, pipe: IO[bytes]) -> None:
        with contextlib.suppress(EOFError, pickle.UnpicklingError, OSError, ValueError):
            self.begin(pickle.load(pipe))
            while True:
                self.accept(pickle.load(pipe))
        if not self._end.is_set():
            self._ready = False
            self.checked = "nothing any more"
            self.accept((Told("warning", "The process that looks for findings has ended, so there are no more."),))
