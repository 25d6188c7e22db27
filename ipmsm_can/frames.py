"""Blocks of CAN frames as arrays: what the wire, the companion, the drive and the runners exchange.

A row of `FrameBlock.raw` is Linux' `struct canfd_frame`, 72 bytes: can_id with the flag bits
CAN_EFF_FLAG, CAN_RTR_FLAG and CAN_ERR_FLAG (4 bytes, host order), payload length in bytes (1), FD
flags (1), two reserved bytes (the first tells a recorder of a frame that was SENT), 64 bytes of payload.
SocketCAN writes such rows straight into the array;
a classical frame is a row without CANFD_FDF whose payload ends at byte 8.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FRAME_BYTES = 72
DATA_OFFSET = 8

CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
CAN_ERR_FLAG = 0x20000000
CAN_EFF_MASK = 0x1FFFFFFF
CAN_SFF_MASK = 0x7FF

CANFD_BRS = 0x01
CANFD_ESI = 0x02
CANFD_FDF = 0x04

SENT = 0x01
"""In the first reserved byte of a row that goes into a recording: this program sent the frame."""


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """N frames in order of arrival.

    raw: uint8 (N, 72), C-contiguous, rows as `struct canfd_frame`.
    t_ns: int64 (N,), time of arrival in ns (Unix time on a live bus, virtual time in co-simulation).
    """

    raw: NDArray[np.uint8]
    t_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.raw)

    @classmethod
    def zeros(cls, n: int) -> FrameBlock:
        """n empty frames: identifier 0, no payload, time 0."""
        return cls(np.zeros((n, FRAME_BYTES), np.uint8), np.zeros(n, np.int64))

    @classmethod
    def concat(cls, blocks: Iterable[FrameBlock]) -> FrameBlock:
        """The blocks one after another."""
        parts = [b for b in blocks if len(b)]
        if not parts:
            return cls.zeros(0)
        if len(parts) == 1:
            return parts[0]
        return cls(np.concatenate([b.raw for b in parts]), np.concatenate([b.t_ns for b in parts]))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FrameBlock:
        """The chosen rows, in the order asked for."""
        return FrameBlock(np.ascontiguousarray(self.raw[rows]), self.t_ns[rows])

    @property
    def can_id(self) -> NDArray[np.uint32]:
        """uint32 (N,), a view: identifier with CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG."""
        return self.raw.view(np.uint32)[:, 0]

    @property
    def length(self) -> NDArray[np.uint8]:
        """uint8 (N,), a view: payload length in bytes, 0..8 or 0..64."""
        return self.raw[:, 4]

    @property
    def flags(self) -> NDArray[np.uint8]:
        """uint8 (N,), a view: CANFD_FDF, CANFD_BRS, CANFD_ESI."""
        return self.raw[:, 5]

    @property
    def data(self) -> NDArray[np.uint8]:
        """uint8 (N, 64), a view: the payload."""
        return self.raw[:, DATA_OFFSET:]

    @property
    def words(self) -> NDArray[np.uint64]:
        """uint64 (N, 9), a view: word 0 is the header, words 1..8 the payload, little-endian."""
        return self.raw.view(np.uint64)
