"""What the readers of all formats share: the bytes of a file, what was asked for, and what became of it."""

from __future__ import annotations

import gzip
import re
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Self, cast

from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.marks import Mark

CHUNK_BYTES = 1 << 20
BROKEN = (EOFError, zlib.error, gzip.BadGzipFile)
"""What a cut-off or damaged .gz raises while it is unpacked."""


class LogError(ValueError):
    """A log that cannot be read or written; the sentence says which and why."""


@dataclass(frozen=True, slots=True)
class Request:
    """What to read.  kind: the suffix that tells the format, ".blf"; channel: None takes all."""

    path: Path
    kind: str
    packed: bool
    block_frames: int
    channel: str | None

    def channel_number(self) -> int:
        """The number at the end of the channel's name, as python-can has it.  Raises LogError if there is none."""
        number = re.search(r"\d+$", self.channel or "")
        if number is None:
            raise LogError(f"the channels of {self.path} have numbers, and {self.channel!r} has none; "
                           "allowed is 0 or can0, and so on")
        return int(number[0])


@dataclass(slots=True)
class Outcome:
    """What became of reading so far.

    problem: why it ended before the end of the file, "" where it did not.  bad_lines: lines of a text not
    understood.  passed_over: objects of a BLF file that hold no frame.  done: share of the file read, 0..1.
    marks: remarks found between the frames, at most `marks.KEPT`.
    """

    problem: str = ""
    bad_lines: int = 0
    passed_over: int = 0
    done: float = 0.0
    marks: list[Mark] = field(default_factory=list)


class Source:
    """The bytes of a log from its beginning, unpacked where the file is packed with gzip.

    problem: "" or why there is nothing more to unpack; what came before the damage is handed out.
    delivered: how many bytes were handed out.  stream: the same bytes for who wants a file.
    """

    def __init__(self, path: Path, packed: bool) -> None:
        self.problem = ""
        self.delivered = 0
        self._path = path
        self._size = max(1, path.stat().st_size)
        self._file = path.open("rb")
        self.stream: IO[bytes] = cast("IO[bytes]", gzip.GzipFile(fileobj=self._file)) if packed else self._file

    @property
    def done(self) -> float:
        """Share of the file that was taken, 0..1."""
        return 1.0 if self._file.closed else min(1.0, self._file.tell() / self._size)

    def some(self, most: int = CHUNK_BYTES) -> bytes:
        """The next bytes, at least one and at most `most`; empty at the end."""
        try:
            # read1 hands over what was unpacked before the damage; read would throw it away
            piece: bytes = self.stream.read1(most)  # type: ignore[attr-defined]
        except BROKEN as error:
            self.problem = f"{self._path} is cut off or damaged: {error}"
            return b""
        self.delivered += len(piece)
        return piece

    def exactly(self, count: int) -> bytes:
        """The next `count` bytes; fewer only where the file ends before."""
        pieces = []
        while count > 0 and (piece := self.some(min(count, CHUNK_BYTES))):
            pieces.append(piece)
            count -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def close(self) -> None:
        self.stream.close()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


@contextmanager
def unpacked_file(request: Request) -> Iterator[Path]:
    """The path of a file that can be read in any order: the log itself, or a temporary copy of a packed one.

    Raises LogError for a packed log that is cut off or damaged: without its end such a format says nothing.
    """
    if not request.packed:
        yield request.path
        return
    with tempfile.TemporaryDirectory(prefix="ipmsm_can") as folder:
        copy = Path(folder) / f"unpacked{request.kind}"
        try:
            with gzip.open(request.path) as stream, copy.open("wb") as out:
                shutil.copyfileobj(stream, out, CHUNK_BYTES)
        except BROKEN as error:
            raise LogError(f"{request.path} is cut off or damaged: {error}") from error
        yield copy


class Filling:
    """A block that a kernel fills; rows: how far it is."""

    def __init__(self, block_frames: int) -> None:
        self.block = FrameBlock.zeros(block_frames)
        self.rows = 0

    @property
    def full(self) -> bool:
        return self.rows == len(self.block)

    def take(self) -> FrameBlock:
        """What is filled; filling goes on with a new block."""
        block, rows = self.block, self.rows
        self.block, self.rows = FrameBlock.zeros(len(block)), 0
        return block if rows == len(block) else FrameBlock(block.raw[:rows].copy(), block.t_ns[:rows].copy())


def words_of(error: Exception) -> str:
    """What an exception says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__
