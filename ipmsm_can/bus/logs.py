"""Recorded buses: logs of every format python-can knows as blocks of frames, and back.

candump's text (`candump -L`, `.log`) has a compiled reader and writer of its own, which keep time stamps
exact and the details of error frames; python-can's take one Python object per frame and lose those.
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
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.bus.pythoncan import block_from_messages, messages_from_block
from ipmsm_can.frames import FRAME_BYTES, FrameBlock

if TYPE_CHECKING:
    import can

_CHUNK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 12
_BROKEN = (EOFError, zlib.error, gzip.BadGzipFile)


class LogError(ValueError):
    """A log that cannot be read or written; the sentence says which and why."""


# ---- candump text -------------------------------------------------------------------------------------

@kernel
def _nibble(character: int) -> int:
    """Value of a hexadecimal digit, or -1."""
    if 48 <= character <= 57:
        return character - 48
    if 65 <= character <= 70:
        return character - 55
    if 97 <= character <= 102:
        return character - 87
    return -1


@kernel
def _parse_payload(text: NDArray[np.uint8], at: int, end: int, row: NDArray[np.uint8]) -> int:
    """Read what follows the first '#' into a row (identifier already there); position after it, or -1."""
    room = 8
    if at < end and text[at] == 35:  # '#': CAN FD, one digit of flags
        flags = _nibble(text[at + 1]) if at + 1 < end else -1
        if flags < 0:
            return -1
        row[5] = 0x04 | (flags & 0x03)
        room = 64
        at += 2
    elif at < end and (text[at] == 82 or text[at] == 114):  # 'R': remote, with or without a length
        row[3] |= 0x40
        at += 1
        length = _nibble(text[at]) if at < end else -1
        if length >= 0:
            at += 1
            row[4] = min(length, 8)
        room = 0
    n = 0
    while at + 1 < end:
        if text[at] == 46 and n > 0:  # '.' may stand between bytes
            at += 1
            continue
        high = _nibble(text[at])
        low = _nibble(text[at + 1])
        if high < 0:
            break
        if low < 0 or n >= room:
            return -1
        row[8 + n] = 16 * high + low
        n += 1
        at += 2
    if room:
        row[4] = n
    if at + 1 < end and text[at] == 95 and _nibble(text[at + 1]) >= 0:  # '_' and the raw DLC
        at += 2
    return at


@kernel
def _parse_line(text: NDArray[np.uint8], at: int, end: int, channel: NDArray[np.uint8],
                row: NDArray[np.uint8]) -> tuple[int, int]:
    """One line without its newline: (kind, time in ns).

    kind: 1 a frame, 0 nothing for us, -1 not understood.
    """
    while at < end and text[at] <= 32:
        at += 1
    if at == end:
        return 0, 0
    if text[at] != 40:  # '('
        return -1, 0
    at += 1
    seconds = 0
    digits = 0
    while at < end and 48 <= text[at] <= 57 and digits < 10:
        seconds = 10 * seconds + (text[at] - 48)
        at += 1
        digits += 1
    if digits == 0 or at == end or text[at] != 46:  # '.'
        return -1, 0
    at += 1
    fraction = 0
    scale = 1_000_000_000
    while at < end and 48 <= text[at] <= 57:
        if scale > 1:
            scale //= 10
            fraction += scale * (text[at] - 48)
        at += 1
    if at == end or text[at] != 41 or scale == 1_000_000_000:  # ')'
        return -1, 0
    at += 1
    t_ns = seconds * 1_000_000_000 + fraction
    while at < end and text[at] <= 32:
        at += 1
    begin = at
    while at < end and text[at] > 32:
        at += 1
    wanted = True
    if channel.shape[0]:
        wanted = at - begin == channel.shape[0]
        for k in range(channel.shape[0]):
            wanted = wanted and text[begin + k] == channel[k]
    while at < end and text[at] <= 32:
        at += 1
    can_id = 0
    digits = 0
    while at < end and _nibble(text[at]) >= 0 and digits < 9:
        can_id = 16 * can_id + _nibble(text[at])
        at += 1
        digits += 1
    if not 1 <= digits <= 8 or at == end or text[at] != 35:  # '#'
        return -1, 0
    if digits <= 3:
        can_id &= 0x7FF
    elif can_id & 0x20000000:
        can_id &= 0x3FFFFFFF
    else:
        can_id = (can_id & 0x1FFFFFFF) | 0x80000000
    for k in range(72):
        row[k] = 0
    for k in range(4):
        row[k] = (can_id >> (8 * k)) & 0xFF
    at = _parse_payload(text, at + 1, end, row)
    if at < 0 or (at < end and text[at] > 32):
        return -1, 0
    return (1 if wanted else 0), t_ns


@kernel
def _parse(text: NDArray[np.uint8], start: int, channel: NDArray[np.uint8], raw: NDArray[np.uint8],
           t_ns: NDArray[np.int64], rows: int, counts: NDArray[np.int64]) -> tuple[int, int]:
    """Parse whole lines from start until the text ends or the rows are full: (position, rows filled).

    counts: lines understood, lines not understood.
    """
    at = start
    while at < text.shape[0] and rows < raw.shape[0]:
        end = at
        while end < text.shape[0] and text[end] != 10:
            end += 1
        kind, stamp = _parse_line(text, at, end, channel, raw[rows])
        if kind < 0:
            counts[1] += 1
        elif kind > 0:
            t_ns[rows] = stamp
            rows += 1
            counts[0] += 1
        at = end + 1
    return at, rows


@kernel
def _digits(value: int, base: int, width: int, out: NDArray[np.uint8], at: int) -> int:
    for k in range(width):
        digit = value % base
        out[at + width - 1 - k] = 48 + digit if digit < 10 else 55 + digit
        value //= base
    return at + width


@kernel
def _format(raw: NDArray[np.uint8], t_ns: NDArray[np.int64], channel: NDArray[np.uint8],
            out: NDArray[np.uint8]) -> int:
    """Lines as candump -L writes them; returns how many bytes."""
    at = 0
    for row in range(raw.shape[0]):
        micro = max(t_ns[row], 0) // 1000
        out[at] = 40
        at = _digits(micro // 1_000_000, 10, 10, out, at + 1)
        out[at] = 46
        at = _digits(micro % 1_000_000, 10, 6, out, at + 1)
        out[at] = 41
        out[at + 1] = 32
        at += 2
        for k in range(channel.shape[0]):
            out[at + k] = channel[k]
        at += channel.shape[0]
        out[at] = 32
        at += 1
        can_id = 0
        for k in range(4):
            can_id += raw[row, k] * (1 << (8 * k))
        if can_id & 0x20000000:
            at = _digits(can_id & 0x3FFFFFFF, 16, 8, out, at)
        elif can_id & 0x80000000:
            at = _digits(can_id & 0x1FFFFFFF, 16, 8, out, at)
        else:
            at = _digits(can_id & 0x7FF, 16, 3, out, at)
        out[at] = 35
        at += 1
        is_fd = raw[row, 5] & 0x04
        length = min(0 + raw[row, 4], 64 if is_fd else 8)
        if is_fd:
            out[at] = 35
            at = _digits(raw[row, 5] & 0x03, 16, 1, out, at + 1)
        if can_id & 0x40000000 and not can_id & 0x20000000:
            out[at] = 82
            at += 1
            if length:
                at = _digits(length, 10, 1, out, at)
        else:
            for k in range(length):
                at = _digits(raw[row, 8 + k], 16, 2, out, at)
        out[at] = 10
        at += 1
    return at


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
                    at, rows = _parse(characters, at, channel, block.raw, block.t_ns, rows, self._counts)
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
        size = _format(raw, np.ascontiguousarray(block.t_ns), name, text)
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
