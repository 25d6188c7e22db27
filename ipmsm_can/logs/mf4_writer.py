"""CAN bus logging as MF4, whole blocks at a time: python-can's writer takes 0.2 ms a frame, more than a full bus.

Source: ASAM MDF 4.1, associated standard "Bus Logging".  A group each of data, error and remote frames.  asammdf
puts the file together at the end, from a temporary one beside it.
"""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    SENT,
    FrameBlock,
)
from ipmsm_can.logs.marks import Mark
from ipmsm_can.logs.mf4 import DATA, ERROR, REMOTE

if TYPE_CHECKING:
    from asammdf import MDF

BATCH = 1 << 14
"""Frames that gather before they are written."""
_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.uint8)


class Mf4Writer:
    """Write blocks to a new MF4 file; nothing can be read of it before `close`.

    channel: from 0.  size: bytes so far, before they are packed.  Raises ImportError where there is no asammdf.
    """

    def __init__(self, path: Path, channel: int) -> None:
        from asammdf import MDF

        path.open("wb").close()  # now rather than after an hour
        self._path = path
        self._channel = channel
        self._file: MDF = MDF(version="4.10", temporary_folder=str(path.resolve().parent))
        self._groups: dict[str, int] = {}
        self._start_s: int | None = None
        self._waiting: list[FrameBlock] = []
        self._count = 0
        self.size = 0

    def write(self, block: FrameBlock) -> None:
        """Append the frames of a block."""
        if not len(block):
            return
        self._waiting.append(block)
        self._count += len(block)
        if self._count >= BATCH:
            self._write_waiting()

    def _write_waiting(self) -> None:
        block = FrameBlock.concat(self._waiting)
        self._waiting, self._count = [], 0
        if not len(block):
            return
        if self._start_s is None:
            self._start_s = max(0, int(block.t_ns[0])) // 10**9
        seconds = (block.t_ns - self._start_s * 10**9) * 1e-9
        ids = block.can_id.astype(np.int64)
        error = ids & CAN_ERR_FLAG != 0
        remote = (ids & CAN_RTR_FLAG != 0) & ~error
        for name, rows in ((DATA, ~error & ~remote), (ERROR, error), (REMOTE, remote)):
            if rows.any():
                self._append(name, self._records(name, block.take(rows)), np.ascontiguousarray(seconds[rows]))

    def _records(self, name: str, part: FrameBlock) -> NDArray[Any]:
        stored, length, flags = part.can_id.astype(np.int64), part.length, part.flags
        fields: dict[str, NDArray[Any]] = {
            "BusChannel": np.full(len(part), self._channel, np.uint8),
            "ID": (stored & CAN_EFF_MASK).astype(np.uint32),
            "IDE": (stored & CAN_EFF_FLAG != 0).astype(np.uint8),
            "DLC": np.searchsorted(_LENGTHS, length).astype(np.uint8),
            "DataLength": length.copy(),
            "Dir": part.raw[:, 6] & SENT,
            "EDL": (flags & CANFD_FDF != 0).astype(np.uint8),
            "BRS": (flags & CANFD_BRS != 0).astype(np.uint8),
            "ESI": (flags & CANFD_ESI != 0).astype(np.uint8)}
        if name != REMOTE:
            fields["DataBytes"] = part.data.copy()
        kind = np.dtype([(f"{name}.{key}", value.dtype, value.shape[1:]) for key, value in fields.items()])
        records = np.zeros(len(part), kind)
        for key, value in fields.items():
            records[f"{name}.{key}"] = value
        return records

    def _append(self, name: str, records: NDArray[Any], seconds: NDArray[np.float64]) -> None:
        self.size += records.nbytes + seconds.nbytes
        if name in self._groups:
            self._file.extend(self._groups[name], [(seconds, None), (records, None)])
            return
        from asammdf import Signal, Source
        from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

        self._groups[name] = self._file.append(Signal(
            name=name, samples=records, timestamps=seconds,
            source=Source(f"CAN{self._channel}", f"CAN{self._channel}", "", SOURCE_BUS, BUS_TYPE_CAN)))

    def mark(self, _mark: Mark) -> bool:
        """There is no place for remarks."""
        return False

    def flush(self) -> None:
        """Nothing can be read before the end in any case."""

    def close(self) -> None:
        """Put the file together."""
        try:
            self._write_waiting()
            if self._start_s is not None:
                self._file.header.start_time = datetime.datetime.fromtimestamp(self._start_s, datetime.UTC)
            self._file.save(self._path, overwrite=True, compression=2)
        finally:
            with contextlib.suppress(Exception):
                self._file.close()
