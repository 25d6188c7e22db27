"""Blocks of frames as logs: candump text and BLF by compiled writers, MF4 in arrays, the others by python-can."""

from __future__ import annotations

import gzip
import re
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Protocol, Self, cast

import numpy as np

from ipmsm_can.bus.pythoncan import messages_from_block
from ipmsm_can.frames import FRAME_BYTES, FrameBlock
from ipmsm_can.logs import blf_kernel, candump
from ipmsm_can.logs.blf import BlfWriter
from ipmsm_can.logs.marks import SIGNS, Mark, as_comment, beside
from ipmsm_can.logs.source import LogError, words_of

if TYPE_CHECKING:
    from ipmsm_can.logs.mf4_writer import Mf4Writer

_PATIENCE_S = 60.0
KINDS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")
"""Suffixes of the logs that can be written."""


class _Writer(Protocol):
    def write(self, block: FrameBlock) -> None: ...

    def mark(self, mark: Mark) -> bool | None: ...

    def flush(self) -> None: ...

    def close(self) -> None: ...


class _CandumpWriter:
    def __init__(self, path: Path, packed: bool, channel: str) -> None:
        stream: Any = gzip.open(path, "wb", compresslevel=5) if packed else path.open("wb")  # noqa: SIM115
        self._stream = cast("IO[bytes]", stream)
        self._name = np.frombuffer(channel.encode(), np.uint8)

    def write(self, block: FrameBlock) -> None:
        raw = np.ascontiguousarray(block.raw)
        text = np.empty(len(block) * (43 + len(self._name) + 2 * (FRAME_BYTES - 8)), np.uint8)
        size = candump.format_rows(raw, np.ascontiguousarray(block.t_ns), self._name, text)
        self._stream.write(text[:size].tobytes())

    def mark(self, mark: Mark) -> None:
        self._stream.write(as_comment(mark).encode())

    def flush(self) -> None:
        self._stream.flush()

    def close(self) -> None:
        self._stream.close()


class _PythonCanWriter:
    def __init__(self, path: Path, channel: str) -> None:
        import can

        self._logger: Any = can.Logger(path)
        self._channel = channel
        self._sign = SIGNS.get(next((s.lower() for s in reversed(path.suffixes) if s.lower() != ".gz"), ""))
        self._is_database = isinstance(self._logger, can.SqliteWriter)
        self._sent = 0

    def write(self, block: FrameBlock) -> None:
        self._sent += len(block)
        for message in messages_from_block(block, self._channel):
            self._logger.on_message_received(message)

    def mark(self, mark: Mark) -> bool:
        if self._sign is None:
            return False
        if getattr(self._logger, "header_written", True) is False and hasattr(self._logger, "write_header"):
            self._logger.write_header(1e-9 * mark.t_ns)  # nothing may stand before that of a .trc
        self._logger.file.write(as_comment(mark, self._sign))
        return True

    def flush(self) -> None:
        """python-can's database keeps its own time: it commits about five times a second."""
        file = getattr(self._logger, "file", None)
        if file is not None and hasattr(file, "flush"):
            file.flush()

    def close(self) -> None:
        if self._logger is not None:
            # python-can's database is written by a thread, which at `stop` drops what is beyond its next 500.
            until = time.monotonic() + _PATIENCE_S
            while self._is_database and self._logger.num_frames < self._sent and time.monotonic() < until:
                time.sleep(0.01)
            self._logger.stop()
            self._logger = None


def check_log_path(path: Path) -> None:
    """Raise LogError for a suffix that no writer knows."""
    kind = ([s.lower() for s in path.suffixes if s.lower() != ".gz"] or [""])[-1]
    if kind not in KINDS:
        raise LogError(f"{path} has the suffix {kind!r}; allowed are {', '.join(KINDS)}, also packed (.log.gz)")


def warm_up() -> None:
    """Compile or load the kernels that write, before frames are waiting."""
    block = FrameBlock.zeros(1)
    candump.format_rows(block.raw, block.t_ns, np.frombuffer(b"can0", np.uint8), np.empty(300, np.uint8))
    blf_kernel.lay_out(block.raw, block.t_ns, 0, 1, np.zeros(blf_kernel.OBJECT_BYTES, np.uint8))


def _mf4_writer() -> type[Mf4Writer]:
    try:
        import asammdf  # noqa: F401
    except ImportError:
        raise LogError("MF4 needs the package asammdf, which is not installed; install it "
                       "(pip install 'ipmsm_can[mf4]')") from None
    from ipmsm_can.logs.mf4_writer import Mf4Writer

    return Mf4Writer


class LogWriter:
    """Record blocks in a log; the suffix chooses the format, as in `read_log`.

    channel: the name written with each frame; formats that number channels take the number at its end, else 0.
    candump text cuts time stamps to us, BLF keeps them.  The file is complete after `close`.
    Raises LogError for a suffix or a folder that cannot be written.
    """

    def __init__(self, path: str | Path, channel: str = "can0") -> None:
        self.path = Path(path)
        suffixes = [s.lower() for s in self.path.suffixes]
        self._writer: _Writer
        try:
            if suffixes[-1:] == [".log"] or suffixes[-2:] == [".log", ".gz"]:
                self._writer = _CandumpWriter(self.path, suffixes[-1] == ".gz", channel)
            elif suffixes[-1:] in ([".blf"], [".mf4"]):
                number = re.search(r"\d+$", channel)
                kind = BlfWriter if suffixes[-1] == ".blf" else _mf4_writer()
                self._writer = kind(self.path, int(number[0]) if number else 0)
            else:
                self._writer = _PythonCanWriter(self.path, channel)
        except Exception as error:  # every format's writer raises what it likes
            raise LogError(f"the log {self.path} cannot be written: {words_of(error)}") from error

    def write(self, block: FrameBlock) -> None:
        """Append the frames of a block."""
        self._writer.write(block)

    def mark(self, mark: Mark) -> None:
        """Append a remark; where the format has no place for it, to the text file beside the log."""
        if self._writer.mark(mark) is False:
            with beside(self.path).open("a", encoding="utf-8") as file:
                file.write(as_comment(mark))

    @property
    def size(self) -> int:
        """Bytes written so far; of an MF4 file, which exists only at the end, those that are to be packed."""
        own: int | None = getattr(self._writer, "size", None)
        return self.path.stat().st_size if own is None else own

    def flush(self) -> None:
        """Hand over to the operating system what is still buffered, where the format can."""
        self._writer.flush()

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

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
