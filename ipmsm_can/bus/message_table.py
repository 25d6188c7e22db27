"""The tables that recvmmsg and sendmmsg work on, and a compiled kernel that reads what came back.

The kernel's tables (struct mmsghdr, iovec, cmsghdr, see socket(7), recvmmsg(2)) are NumPy arrays in their 64-bit
little-endian layout.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import FRAME_BYTES

# <sys/socket.h>, <asm-generic/socket.h>
SOL_SOCKET = 1
SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40

# columns of struct mmsghdr as 64-bit words
_IOV, _IOVLEN, _CONTROL, _CONTROLLEN, _FLAGS, _MSG_LEN = 2, 3, 4, 5, 6, 7
CONTROL_WORDS = 10
"""Per message: time stamp 4 words, drop counter 3 words, and room to spare."""

_COUNTER, DROPS, NO_STAMP, _ODD, ERRORS = 0, 1, 2, 3, 4
STATES = 5
"""State of `unpack`."""


@kernel
def unpack(n: int, headers: NDArray[np.int64], control: NDArray[np.int64], frames: NDArray[np.uint8],
            raw: NDArray[np.uint8], t_ns: NDArray[np.int64], state: NDArray[np.int64]) -> int:
    """Copy n received frames out as clean rows, with their time stamps; rearm their headers.

    Returns the number of rows written; time -1 where the kernel gave none.  state: last drop counter
    (32 bit), drops in all, frames without a time stamp, messages of an unknown size, error frames.
    """
    out = 0
    for j in range(n):
        size = headers[j, _MSG_LEN] & 0xFFFFFFFF
        words = min(headers[j, _CONTROLLEN] // 8, control.shape[1])
        headers[j, _CONTROLLEN] = 8 * control.shape[1]
        headers[j, _FLAGS] = 0
        stamp = -1
        at = 0
        while at + 2 < words:
            length = control[j, at]
            if length < 16:
                break
            level = control[j, at + 1] & 0xFFFFFFFF
            kind = control[j, at + 1] >> 32
            if level == SOL_SOCKET and kind == SO_TIMESTAMPNS and at + 3 < words:
                stamp = control[j, at + 2] * 1_000_000_000 + control[j, at + 3]
            elif level == SOL_SOCKET and kind == SO_RXQ_OVFL:
                counter = control[j, at + 2] & 0xFFFFFFFF
                state[DROPS] += (counter - state[_COUNTER]) & 0xFFFFFFFF
                state[_COUNTER] = counter
            at += (length + 7) // 8
        if size != 16 and size != 72:
            state[_ODD] += 1
            continue
        if stamp < 0:
            state[NO_STAMP] += 1
        if frames[j, 3] & 0x20:
            state[ERRORS] += 1
        t_ns[out] = stamp
        room = 8 if size == 16 else 64
        used = min(0 + frames[j, 4], room)
        for k in range(4):
            raw[out, k] = frames[j, k]
        raw[out, 4] = used
        # byte 5 of a classical frame is padding; bytes 6, 7 are reserved or the raw DLC
        raw[out, 5] = 0 if size == 16 else frames[j, 5] | 0x04
        raw[out, 6] = 0
        raw[out, 7] = 0
        if frames[j, 3] & 0x40:  # a remote frame carries a length but no data
            used = 0
        for k in range(8, 8 + used):
            raw[out, k] = frames[j, k]
        for k in range(8 + used, 72):
            raw[out, k] = 0
        out += 1
    return out


class MessageTable:
    """M struct mmsghdr, each pointing to one row of `frames` and, for receiving, of `control`."""

    def __init__(self, rows: int, control_words: int) -> None:
        self.frames = np.zeros((rows, FRAME_BYTES), np.uint8)
        self.control = np.zeros((rows, max(control_words, 1)), np.int64)
        self.iov = np.zeros((rows, 2), np.int64)
        self.iov[:, 0] = self.frames.ctypes.data + FRAME_BYTES * np.arange(rows)
        self.iov[:, 1] = FRAME_BYTES
        self.headers = np.zeros((rows, 8), np.int64)
        self.headers[:, _IOV] = self.iov.ctypes.data + 16 * np.arange(rows)
        self.headers[:, _IOVLEN] = 1
        if control_words:
            width = 8 * control_words
            self.headers[:, _CONTROL] = self.control.ctypes.data + width * np.arange(rows)
            self.headers[:, _CONTROLLEN] = width
