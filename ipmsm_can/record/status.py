"""How a recording is doing, as plain numbers and words.

A display in a process of its own gets it through a pipe, so nothing here imports more than the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath


@dataclass(frozen=True, slots=True)
class RecordStatus:
    """One recording.

    what: "record" or "measure".  path: the file that is written now, or was last; files: how many so far.
    frames: in all files; size: of all [bytes].  waiting: frames in the queue; refused: frames that found it full.
    lost: frames that came after writing had failed.  problem: why nothing is written any more, "" where it is.
    """

    what: str
    path: str
    files: int
    frames: int
    size: int
    waiting: int = 0
    refused: int = 0
    lost: int = 0
    problem: str = ""

    @property
    def whole(self) -> bool:
        """Every frame that came is written, or will be."""
        return not (self.problem or self.refused or self.lost)

    @property
    def words(self) -> str:
        """"REC run_002.blf 12.3 MB", and what is wrong."""
        name = PurePath(self.path).name
        text = f"{'REC' if self.what == 'record' else 'MEASURE'} {name} {megabytes(self.size)}"
        if self.problem:
            text = f"NOT RECORDING: {self.problem}"
        return text + (f", {self.refused + self.lost} frames NOT in it" if self.refused or self.lost else "")

    @property
    def summary(self) -> str:
        """What was recorded, when all is over."""
        where = self.path if self.files <= 1 else f"{self.files} files, the last {self.path}"
        verb = "recorded" if self.what == "record" else "measured"
        text = f"{verb} {self.frames} frames in {where}, {megabytes(self.size)}"
        if self.refused:
            text += f"; {self.refused} frames are not in it: writing was slower than the bus"
        if self.problem:
            text += f"; {self.problem}; {self.lost} frames that came later are not in it"
        return text


def megabytes(size: int) -> str:
    """"12.3 MB"."""
    if size < 1_000_000:
        return f"{1e-3 * size:.0f} kB"
    return f"{1e-6 * size:.1f} MB" if size < 10**9 else f"{1e-9 * size:.2f} GB"
