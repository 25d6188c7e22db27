"""What the keys record with: a new file each time, fed by the same observer as every other recording."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.marks import Mark
from ipmsm_can.node import Tracked
from ipmsm_can.record.recorder import Recorder
from ipmsm_can.record.rotation import Rotation
from ipmsm_can.record.status import RecordStatus, megabytes
from ipmsm_can.record.tap import Tap

STEM, SUFFIX = "ipmsm-can", ".blf"


class KeyRecording:
    """A record that can be started and stopped again and again.

    tap: hands the frames on.  channel: as it is named in the log.  path: of the first file, None for a name of the
    present folder with date and time in it; files after the first get date and time behind that name.
    """

    def __init__(self, tap: Tap, channel: str, path: Path | None, rotation: Rotation) -> None:
        self._tap = tap
        self._channel = channel
        self._path = path
        self._rotation = rotation
        self._recorder: Recorder | None = None
        self._last: RecordStatus | None = None
        self._begun = 0
        self.whole = True
        """Every record so far holds all frames that came."""
        self.summaries: list[str] = []
        """Of the last 100 records that ended."""

    @property
    def running(self) -> bool:
        """A file is being written."""
        return self._recorder is not None

    def start(self) -> None:
        """Begin a file.  Raises LogError (a ValueError) where it cannot be made."""
        if self._recorder is not None:
            return
        recorder = Recorder(self._next_path(), self._channel, self._rotation)
        self._begun += 1
        self._recorder = recorder
        self._tap.add(recorder)

    def _next_path(self) -> Path:
        if self._path is not None and (self._begun == 0 or self._rotation.on):
            return self._path
        told = time.strftime("%Y%m%d-%H%M%S")
        if self._path is None:
            path = Path(f"{STEM}-{told}{SUFFIX}")
        else:
            suffixes = "".join(self._path.suffixes[-2:] if self._path.suffix == ".gz" else self._path.suffixes[-1:])
            path = self._path.with_name(f"{self._path.name.removesuffix(suffixes)}-{told}{suffixes}")
        again = 1
        free = path
        while free.exists():  # twice in a second
            again += 1
            free = path.with_name(path.name.replace(told, f"{told}-{again}"))
        return free

    def stop(self) -> None:
        """Finish the file; takes as long as the disk does."""
        recorder = self._recorder
        if recorder is None:
            return
        self._recorder = None
        self._tap.remove(recorder)
        recorder.close()
        self._last = recorder.status()
        self.whole = self.whole and self._last.whole
        self.summaries = [*self.summaries[-99:], self._last.summary]

    def mark(self, t_ns: int, words: str) -> None:
        """Note an event between the frames."""
        recorder = self._recorder
        if recorder is not None:
            recorder.mark(Mark(t_ns, words))

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Take in a round: for this and every other recording of the tap."""
        self._tap.observe(block, tracked, answers, now_ns)

    def _status(self) -> RecordStatus | None:
        recorder = self._recorder
        return self._last if recorder is None else recorder.status()

    @property
    def path(self) -> str:
        """The file that is, or was last, written."""
        status = self._status()
        return "" if status is None else status.path

    @property
    def words(self) -> str:
        """"run.blf 1.2 MB"."""
        status = self._status()
        return "" if status is None else f"{status.path} {megabytes(status.size)}"

    @property
    def trouble(self) -> str:
        """Why the record is not whole; "" where it is."""
        status = self._status()
        if status is None or status.whole:
            return ""
        missing = status.refused + status.lost
        return status.problem or f"{missing} frames are not in {status.path}: writing was slower than the bus"
