"""One way to read every log: which reader belongs to a file, and what became of reading it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import blf_kernel, candump
from ipmsm_can.logs.blf import read_blf
from ipmsm_can.logs.candump import read_candump
from ipmsm_can.logs.marks import Mark, beside, from_comments, note
from ipmsm_can.logs.mf4 import read_mf4
from ipmsm_can.logs.others import check_kind, read_other
from ipmsm_can.logs.source import LogError, Outcome, Request

_OWN: dict[str, Callable[[Request, Outcome], Iterator[FrameBlock]]] = {
    ".blf": read_blf, ".log": read_candump, ".mf4": read_mf4}
_WARM_UP = {".blf": blf_kernel.warm_up, ".log": candump.warm_up}
"""Compile or load the kernel of a format: before anybody's clock runs."""


class LogReader:
    """Blocks of a log, in the order of the file; iterate over it once.  `read_log` makes one."""

    def __init__(self, path: str | Path, *, block_frames: int = 65536, channel: str | None = None) -> None:
        if block_frames < 1:
            raise ValueError(f"block_frames is {block_frames}; allowed is 1 or more")
        self.path = Path(path)
        if not self.path.is_file():
            what = "is a folder, not a file" if self.path.is_dir() else "does not exist"
            raise LogError(f"the log {self.path} {what}")
        suffixes = [s.lower() for s in self.path.suffixes]
        packed = suffixes[-1:] == [".gz"]
        kind = ((suffixes[:-1] if packed else suffixes)[-1:] or [""])[0]
        request = Request(self.path, kind, packed, block_frames, channel)
        if kind not in _OWN:
            check_kind(request, list(_OWN))
        if kind in _WARM_UP:
            _WARM_UP[kind]()
        self._outcome = Outcome()
        if beside(self.path).is_file():
            note(self._outcome.marks, from_comments(beside(self.path).read_bytes()))
        self._blocks = self._guarded(_OWN.get(kind, read_other)(request, self._outcome))

    def _guarded(self, blocks: Iterator[FrameBlock]) -> Iterator[FrameBlock]:
        """A log that ended early and gave nothing is not read, but refused."""
        seen = False
        for block in blocks:
            seen = True
            yield block
        if self.problem and not seen:
            raise LogError(self.problem)

    @property
    def problem(self) -> str:
        """Why reading ended before the end of the file (cut off or damaged), "" where it did not."""
        return self._outcome.problem

    @property
    def bad_lines(self) -> int:
        """Lines of a candump text not understood so far."""
        return self._outcome.bad_lines

    @property
    def passed_over(self) -> int:
        """Objects of a BLF file so far that hold no CAN frame: statistics, frames of other buses."""
        return self._outcome.passed_over

    @property
    def marks(self) -> list[Mark]:
        """Remarks of the recorder found so far (`logs.marks`), at most 10000."""
        return self._outcome.marks

    @property
    def done(self) -> float:
        """Share of the file read so far, 0..1, for a progress bar; 1 only at the end."""
        return self._outcome.done

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> FrameBlock:
        return next(self._blocks)


def read_log(path: str | Path, *, block_frames: int = 65536, channel: str | None = None) -> LogReader:
    """Read a log as an iterator of `FrameBlock`, each of block_frames frames, the last with the rest.

    path: BLF (.blf), candump text (.log, -L format), MF4 (.mf4, needs asammdf) or another format python-can reads
        (.asc .csv .db .trc), also packed with .gz.
    channel: only the frames of this channel, as it is named in the log; where channels have numbers, the number
        at the end of the name counts, from 0 in BLF.  None takes all.

    t_ns is what the log holds: exact for candump and BLF, a float of seconds from the start for MF4; the other
    formats pass through a float of seconds, which near the present resolves 240 ns.  A log that was cut off gives
    its readable part, and `problem` says so.  Memory does not grow with the log.
    Raises LogError (a ValueError) for a missing file, an unknown suffix, or a file with nothing readable.
    """
    return LogReader(path, block_frames=block_frames, channel=channel)
