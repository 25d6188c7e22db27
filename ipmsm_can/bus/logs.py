"""Recorded buses: logs of every format python-can knows as blocks of frames, and back.

candump's text (`candump -L`, `.log`) has a compiled reader and writer of its own, in `candump`, which keep time
stamps exact and the details of error frames; python-can's take one Python object per frame and lose those.
Every other format goes through python-can.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self, cast

import numpy as np

from ipmsm_can.bus import candump
from ipmsm_can.bus.pythoncan import block_from_messages, messages_from_block
from ipmsm_can.frames import FRAME_BYTES, FrameBlock

if TYPE_CHECKING:
    import can

_CHUNK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 12
_BROKEN = (EOFError, zlib.error, gzip.BadGzipFile)


class LogError(ValueError):
    """A log that cannot be read or written; the sentence says which and why."""


# ---- reading ------------------------------------------------------------------------------------------

class LogReader:
    """Blocks of a log, in the order of the file; iterate over it once.

    path: the log's path.  bad_lines: lines of a candump text not understood so far.
    problem: why reading ended before the end of the file (cut off or damaged), "" where it did not.
    """

    def __init__(self, path: str | Path, *, block_frames: int = 65536, channel: str | None = None) -> None:
        if block_frames < 1:
            raise ValueError(f"block_frames is {block_frames}; allowed is 1 or more")
        self.path = Path(path)
        self.problem = ""
        self._lines: _WholeLines | None = None
        self._counts = np.zeros(2, np.int64)
        self._block_frames = block_frames
        self._channel = channel
        if not self.path.is_file():
            what = "is a folder, not a file" if self.path.is_dir() else "does not exist"
            raise LogError(f"the log {self.path} {what}")
        suffixes = [s.lower() for s in self.path.suffixes]
        self._packed = bool(suffixes) and suffixes[-1] == ".gz"
        self._kind = (suffixes[:-1] if self._packed else suffixes)[-1:] or [""]
        if self._kind[0] == ".log":
            self._blocks = self._candump(_open(self.path, self._packed, "rb"))
        else:
            self._blocks = self._other(self._open_other())

    @property
    def bad_lines(self) -> int:
        return int(self._counts[1])

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> FrameBlock:
        return next(self._blocks)

    def _texts(self, stream: IO[bytes]) -> Iterator[bytes]:
        """The file in pieces that end with a line; what was readable of a damaged one."""
        rest = b""
        while True:
            try:
                # read1 hands over what was unpacked before the damage; read would throw it away
                piece = stream.read1(_CHUNK_BYTES)  # type: ignore[attr-defined]
            except _BROKEN as error:
                self.problem = f"{self.path} is cut off or damaged: {error}"
                piece = b""
            if not piece:
                if rest:
                    yield rest
                return
            text = rest + piece
            cut = text.rfind(b"\n") + 1
            rest = text[cut:]
            if len(rest) > _LONGEST_LINE:
                self._counts[1] += 1
                rest = b""
            if cut:
                yield text[:cut]

    def _candump(self, stream: IO[bytes]) -> Iterator[FrameBlock]:
        channel = np.frombuffer((self._channel or "").encode(), np.uint8)
        block, rows = FrameBlock.zeros(self._block_frames), 0
        with stream:
            for text in self._texts(stream):
                characters, at = np.frombuffer(text, np.uint8), 0
                while at < len(characters):
                    at, rows = candump.parse(characters, at, channel, block.raw, block.t_ns, rows, self._counts)
                    if rows == self._block_frames:
                        yield block
                        block, rows = FrameBlock.zeros(self._block_frames), 0
        if self._counts[1] and not self._counts[0] and not self._channel:
            raise LogError(f"{self.path} is no candump log: none of its {self._counts[1]} lines reads like "
                           "'(1700000000.000000) can0 123#0102'")
        if self.problem and not self._counts[0]:
            raise LogError(self.problem)
        if rows:
            yield FrameBlock(block.raw[:rows].copy(), block.t_ns[:rows].copy())

    def _open_other(self) -> can.io.generic.MessageReader:
        import can
        from can.io.generic import TextIOMessageReader
        from can.io.player import MESSAGE_READERS

        kind = self._kind[0]
        if kind not in MESSAGE_READERS:
            raise LogError(f"{self.path} has the suffix {kind!r}; allowed are "
                           f"{', '.join(sorted(MESSAGE_READERS))}, with or without .gz")
        reader: Any = MESSAGE_READERS[kind]
        opened: can.io.generic.MessageReader
        try:
            if issubclass(reader, TextIOMessageReader):
                self._lines = _WholeLines(_open(self.path, self._packed, "rb"))
                opened = reader(self._lines)
            elif self._packed:
                # python-can's own way of unpacking refuses names with one more dot in them
                opened = reader(_open(self.path, self._packed, "rb"))
            else:
                opened = can.LogReader(self.path)
            return opened
        except Exception as error:  # every format's reader raises what it likes
            raise LogError(f"{self.path} cannot be read as {kind}: {_words(error)}") from error

    def _other(self, reader: can.io.generic.MessageReader) -> Iterator[FrameBlock]:
        waiting: list[can.Message] = []
        seen = 0
        try:
            for message in reader:
                if self._channel is not None and str(message.channel) != self._channel:
                    continue
                waiting.append(message)
                seen += 1
                if len(waiting) == self._block_frames:
                    yield block_from_messages(waiting)
                    waiting = []
        except Exception as error:
            self.problem = f"{self.path} cannot be read as {self._kind[0]}: {_words(error)}"
            if not seen:
                raise LogError(self.problem) from error
        finally:
            reader.stop()
        self.problem = self.problem or self._blf_problem(reader) or self._text_problem()
        if waiting:
            yield block_from_messages(waiting)

    def _text_problem(self) -> str:
        """Nor does it mind a text that ends within a line, or an ASC file whose block was begun and never ended."""
        if self._lines is None:
            return ""
        if self._lines.rest:
            return f"{self.path} is cut off: its last line has no end and is left out"
        if self._lines.open_block:
            return f"{self.path} is cut off: it has no line 'End TriggerBlock'"
        return ""

    def _blf_problem(self, reader: can.io.generic.MessageReader) -> str:
        """python-can reads a BLF file that ends too early without a word; its header knows the whole size."""
        promised = getattr(reader, "file_size", 0) if self._kind[0] == ".blf" and not self._packed else 0
        there = self.path.stat().st_size
        if promised <= there:
            return ""
        return f"{self.path} is cut off: its header promises {promised} bytes and {there} are there"


class _WholeLines(io.TextIOWrapper):
    """The lines of a text that have an end: half a line of python-can's formats reads like a shorter frame.

    rest: a last line without an end, "" if there is none.  open_block: an ASC file's block was begun, not ended.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(cast("io.BufferedReader", stream), encoding="utf-8", errors="replace")
        self.rest = ""
        self.open_block = False

    def __next__(self) -> str:  # type: ignore[override]  # typeshed has it yield bytes here
        line = super().__next__()
        if line[0] in "BEbe":
            words = line.lower().split(maxsplit=2)[:2]
            self.open_block = words == ["begin", "triggerblock"] or (
                self.open_block and words != ["end", "triggerblock"])
        if not line.endswith("\n") and line.lower().split() != ["end", "triggerblock"]:
            self.rest = line
            raise StopIteration
        return line


def _open(path: Path, packed: bool, mode: str) -> IO[bytes]:
    stream: Any = gzip.open(path, mode, compresslevel=5) if packed else path.open(mode)  # noqa: SIM115
    return cast("IO[bytes]", stream)


def _words(error: Exception) -> str:
    return str(error) or type(error).__name__


def read_log(path: str | Path, *, block_frames: int = 65536, channel: str | None = None) -> LogReader:
    """Read a log as an iterator of `FrameBlock`, each of block_frames frames, the last with the rest.

    path: candump text (.log, -L format) or any format python-can reads (.asc .blf .csv .db .mf4 .trc),
        also packed with .gz.
    channel: only the frames of this channel, as it is named in the log; None takes all.

    t_ns is what the log holds: exact for candump; other formats pass through a float of seconds, which
    near the present resolves 240 ns.  A log that was cut off gives its readable part, and `problem` says so.
    Raises LogError (a ValueError) for a missing file, an unknown suffix, or a file with nothing readable.
    """
    return LogReader(path, block_frames=block_frames, channel=channel)


# ---- writing ------------------------------------------------------------------------------------------

class LogWriter:
    """Record blocks in a log; the suffix chooses the format, as in `read_log`.

    channel: the name written with each frame.  candump text cuts time stamps to us.  The file is complete
    after `close`.
    Raises LogError for a suffix or a folder that cannot be written.
    """

    def __init__(self, path: str | Path, channel: str = "can0") -> None:
        self.path = Path(path)
        self._channel = channel
        self._stream: IO[bytes] | None = None
        self._logger: Any = None
        suffixes = [s.lower() for s in self.path.suffixes]
        try:
            if suffixes[-1:] == [".log"] or suffixes[-2:] == [".log", ".gz"]:
                self._stream = _open(self.path, suffixes[-1] == ".gz", "wb")
            else:
                import can

                self._logger = can.Logger(self.path)
        except Exception as error:
            raise LogError(f"the log {self.path} cannot be written: {_words(error)}") from error

    def write(self, block: FrameBlock) -> None:
        """Append the frames of a block."""
        if self._stream is None:
            for message in messages_from_block(block, self._channel):
                self._logger.on_message_received(message)
            return
        name = np.frombuffer(self._channel.encode(), np.uint8)
        raw = np.ascontiguousarray(block.raw)
        text = np.empty(len(block) * (41 + len(name) + 2 * (FRAME_BYTES - 8)), np.uint8)
        size = candump.format_rows(raw, np.ascontiguousarray(block.t_ns), name, text)
        self._stream.write(text[:size].tobytes())

    def flush(self) -> None:
        """Hand over to the operating system what is still buffered, where the format can."""
        if self._stream is not None:
            self._stream.flush()

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        elif self._logger is not None:
            self._logger.stop()
            self._logger = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def write_log(path: str | Path, blocks: Iterable[FrameBlock], channel: str = "can0") -> None:
    """Write blocks to a new log (see `LogWriter`)."""
    with LogWriter(path, channel) as writer:
        for block in blocks:
            writer.write(block)
