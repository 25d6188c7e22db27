"""Blocks of frames as logs: candump text and BLF by compiled writers, every other format by python-can."""

from __future__ import annotations

import gzip
import re
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Protocol, Self, cast

import numpy as np

from ipmsm_can.bus.pythoncan import messages_from_block
from ipmsm_can.frames import FRAME_BYTES, FrameBlock
from ipmsm_can.logs import candump
from ipmsm_can.logs.blf import BlfWriter
from ipmsm_can.logs.source import LogError, words_of

_PATIENCE_S = 60.0


class _Writer(Protocol):
    def write(self, block: FrameBlock) -> None: ...

    def flush(self) -> None: ...

    def close(self) -> None: ...


class _CandumpWriter:
    def __init__(self, path: Path, packed: bool, channel: str) -> None:
        stream: Any = gzip.open(path, "wb", compresslevel=5) if packed else path.open("wb")  # noqa: SIM115
        self._stream = cast("IO[bytes]", stream)
        self._name = np.frombuffer(channel.encode(), np.uint8)

    def write(self, block: FrameBlock) -> None:
        raw = np.ascontiguousarray(block.raw)
        text = np.empty(len(block) * (41 + len(self._name) + 2 * (FRAME_BYTES - 8)), np.uint8)
        size = candump.format_rows(raw, np.ascontiguousarray(block.t_ns), self._name, text)
        self._stream.write(text[:size].tobytes())

    def flush(self) -> None:
        self._stream.flush()

    def close(self) -> None:
        self._stream.close()


class _PythonCanWriter:
    def __init__(self, path: Path, channel: str) -> None:
        import can

        self._logger: Any = can.Logger(path)
        self._channel = channel
        self._is_database = isinstance(self._logger, can.SqliteWriter)
        self._sent = 0

    def write(self, block: FrameBlock) -> None:
        self._sent += len(block)
        for message in messages_from_block(block, self._channel):
            self._logger.on_message_received(message)

    def flush(self) -> None:
        """python-can's loggers keep their own time."""

    def close(self) -> None:
        if self._logger is not None:
            # python-can's database is written by a thread, which at `stop` drops what is beyond its next 500.
            until = time.monotonic() + _PATIENCE_S
            while self._is_database and self._logger.num_frames < self._sent and time.monotonic() < until:
                time.sleep(0.01)
            self._logger.stop()
            self._logger = None


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
            elif suffixes[-1:] == [".blf"]:
                number = re.search(r"\d+$", channel)
                self._writer = BlfWriter(self.path, int(number[0]) if number else 0)
            else:
                self._writer = _PythonCanWriter(self.path, channel)
        except Exception as error:  # every format's writer raises what it likes
            raise LogError(f"the log {self.path} cannot be written: {words_of(error)}") from error

    def write(self, block: FrameBlock) -> None:
        """Append the frames of a block."""
        self._writer.write(block)

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
