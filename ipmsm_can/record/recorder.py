"""Every frame into a log, while everything else runs.

Frames wait in a bounded queue; twice a second a thread writes them, in blocks, and hands them to the operating
system.  So nobody waits for the disk, and a program that is killed leaves a file that is whole up to a second
before its end: FLUSH_S, and LAP_NS of `bus.lane` where the compiled loop takes frames in.  A machine that loses
its power may lose more, for the operating system writes when it likes.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ipmsm_can.frames import SENT, FrameBlock
from ipmsm_can.logs.marks import Mark
from ipmsm_can.logs.source import words_of
from ipmsm_can.logs.writer import LogWriter
from ipmsm_can.node import Tracked
from ipmsm_can.record.background import Background
from ipmsm_can.record.rotation import Names, Rotation
from ipmsm_can.record.status import RecordStatus

FLUSH_S = 0.5
"""How often what has come is written and handed to the operating system [s]."""
ROOM = 1 << 19
"""Frames that may wait for the disk: 60 s of a full classical bus at 1 Mbit/s, 42 MB."""

_Item = tuple[FrameBlock, FrameBlock] | Mark
_NEVER = Rotation()


def words_of_failure(path: Path, error: Exception) -> str:
    """Why a file cannot be written any more, in a few words."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space left on the disk of {path}"
    if isinstance(error, OSError) and error.strerror:
        return f"writing {path} failed: {error.strerror}"
    return f"writing {path} failed: {words_of(error)}"


class Recorder:
    """Writes frames and marks to a log, or to one after the other (`rotation`); the suffix chooses the format.

    path: of the log; with rotation numbers are added to its name.  channel: as in `LogWriter`.
    room: frames that may wait; what finds no room is counted, and marked in the log.
    Raises LogError where the file exists or cannot be made.
    Its methods may be called from any thread and never wait, but `close`.
    """

    def __init__(self, path: str | Path, channel: str = "can0", rotation: Rotation = _NEVER, *,
                 room: int = ROOM, flush_s: float = FLUSH_S) -> None:
        self._names = Names(Path(path), rotation)
        self._channel = channel
        self._rotation = rotation
        self._frames = self._before = self._files = 0
        self._missing = 0
        self._problem = ""
        self._open()
        self._background: Background[_Item] = Background("recorder", self._work, room, flush_s)

    def _open(self) -> None:
        self._path = self._names.following()
        self._writer = LogWriter(self._path, self._channel)
        self._files += 1
        self._size = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    # Called by the runner

    def take(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock) -> None:
        """Record the frames of a round: received, and sent."""
        count = len(block) + len(sent)
        if not count:
            return
        if self._missing:
            self._tell_missing(int((block if len(block) else sent).t_ns[0]))
        if not self._background.put((block, sent), count):
            self._missing += count

    def mark(self, mark: Mark) -> None:
        """Put a remark between the frames."""
        self._background.put(mark, 0)

    def note(self, text: str) -> None:
        """A remark of a person, as of now."""
        self.mark(Mark(time.time_ns(), text))

    def _tell_missing(self, t_ns: int) -> None:
        told = f"{self._missing} frames before this are missing: writing was slower than the bus"
        if self._background.put(Mark(t_ns, told), 0):
            self._missing = 0

    def status(self) -> RecordStatus:
        """As of now."""
        b = self._background
        return RecordStatus("record", str(self._path), self._files, self._frames, self._before + self._size,
                            b.waiting, b.refused, b.lost, self._problem)

    def close(self) -> None:
        """Write what waits, and finish the file; never raises."""
        if self._missing:
            self._tell_missing(time.time_ns())
        self._background.close()
        if not self._problem:
            try:
                self._writer.close()
                self._size = self._path.stat().st_size
            except Exception as error:
                self._give_up(error)

    # In the thread

    def _work(self, items: list[_Item]) -> None:
        try:
            self._write(items)
        except Exception as error:
            self._give_up(error)
            raise

    def _write(self, items: list[_Item]) -> None:
        waiting: list[FrameBlock] = []
        frames = 0
        for item in items:
            if isinstance(item, Mark):
                frames += self._append(waiting)
                waiting = []
                self._writer.mark(item)
            else:
                waiting.append(_in_order(*item))
        frames += self._append(waiting)
        self._writer.flush()
        self._frames += frames
        self._size = self._writer.size
        lasted = 0.0 if self._first_ns is None else 1e-9 * (self._last_ns - self._first_ns)
        if self._rotation.due(self._size, lasted):
            self._writer.close()
            self._before += self._path.stat().st_size
            self._size = 0
            self._open()

    def _append(self, blocks: list[FrameBlock]) -> int:
        block = FrameBlock.concat(blocks)
        if not len(block):
            return 0
        self._writer.write(block)
        if self._first_ns is None:
            self._first_ns = int(block.t_ns[0])
        self._last_ns = int(block.t_ns[-1])
        return len(block)

    def _give_up(self, error: Exception) -> None:
        self._problem = words_of_failure(self._path, error)
        with contextlib.suppress(Exception):
            self._writer.close()
        with contextlib.suppress(OSError):
            self._size = self._path.stat().st_size


def _in_order(block: FrameBlock, sent: FrameBlock) -> FrameBlock:
    """Received and sent frames by their time, an answer behind what it answers."""
    if not len(sent):
        return block
    marked = FrameBlock(sent.raw.copy(), sent.t_ns)
    marked.raw[:, 6] |= SENT
    both = FrameBlock.concat([block, marked])
    return both.take(np.argsort(both.t_ns, kind="stable"))
