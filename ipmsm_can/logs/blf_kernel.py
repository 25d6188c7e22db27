"""Objects of a BLF file, compiled: decompressed bytes to rows of frames, and back.

Every object begins with "LOBJ", header size (2 bytes), header version (2), object size (4), object type (4); then,
in versions 1 and 2 alike, flags (4), four bytes not needed, time stamp (8).  All numbers are little-endian.
Source: the layouts in python-can's can/io/blf.py and in the manual of the library Vector_BLF.

No byte of a file can lead a kernel out of its arrays: every size is compared with what is there before it is used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import SENT

CAN_MESSAGE = 1
CAN_ERROR = 2
CAN_OVERLOAD = 3
LOG_CONTAINER = 10
CAN_ERROR_EXT = 73
CAN_MESSAGE2 = 86
GLOBAL_MARKER = 96
CAN_FD_MESSAGE = 100
CAN_FD_MESSAGE_64 = 101
CAN_FD_ERROR_64 = 104

FRAMES, PASSED_OVER, BROKEN, MARKERS, FIRST_MARKER = 0, 1, 2, 3, 4
MARKERS_KEPT = 256
COUNTS = FIRST_MARKER + MARKERS_KEPT
"""Counters of `walk`: frames of every channel, objects without a frame, 1 once the order of objects is lost; how
many global markers are in `data`, and where the first MARKERS_KEPT of them begin; the caller sets their
count back."""

ALL_CHANNELS = -1

LARGEST_OBJECT = 1 << 26
"""A size beyond this is damage: no frame comes near, and waiting for its end would fill the memory."""

_BASE = 16
_HEADER = 32
_MARKER = 40
_TEN_MICROSECONDS = 1
_LAST_NS = (1 << 63) - 1
_LOBJ = int.from_bytes(b"LOBJ", "little")
_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.int64)

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


@kernel
def _u8(data: Bytes, at: int) -> int:
    # An unsigned index spares the test for negative ones, and with it the compiler sees whole words being read.
    # The value is a signed number: mixed with signed ones, an unsigned one would become a float.
    value: int = 0 + data[np.uint64(at)]
    return value


@kernel
def _u16(data: Bytes, at: int) -> int:
    return _u8(data, at) | _u8(data, at + 1) << 8


@kernel
def _u32(data: Bytes, at: int) -> int:
    return _u16(data, at) | _u16(data, at + 2) << 16


@kernel
def _time(data: Bytes, at: int, start_ns: int) -> int:
    """Time stamp of the object at `at` in ns; the latest that int64 holds stands for anything later."""
    low = _u32(data, at + 24)
    high = _u32(data, at + 28)
    scale = 10_000 if _u32(data, at + 16) == _TEN_MICROSECONDS else 1
    if high > (_LAST_NS - start_ns) // scale >> 32:
        return _LAST_NS
    ticks = high << 32 | low
    if ticks > (_LAST_NS - start_ns) // scale:
        return _LAST_NS
    return start_ns + scale * ticks


@kernel
def _put_header(row: Bytes, can_id: int, length: int, flags: int) -> None:
    for k in range(4):
        row[k] = (can_id >> 8 * k) & 0xFF
    row[4] = length
    row[5] = flags


@kernel
def _identifier(stored: int, remote: bool) -> int:
    can_id = (stored & 0x1FFFFFFF) | 0x80000000 if stored & 0x80000000 else stored & 0x7FF
    return can_id | 0x40000000 if remote else can_id


@kernel
def _copy(data: Bytes, at: int, there: int, length: int, row: Bytes) -> None:
    """Payload of `length` bytes, of which `there` are in the file; the rest are zeros."""
    for k in range(min(length, there)):
        row[np.uint64(8 + k)] = data[np.uint64(at + k)]


@kernel
def _channel(data: Bytes, body: int, end: int, kind: int) -> int:
    """Channel of a frame's object; -1: no frame, or too short to be one."""
    room = end - body
    if kind in (CAN_MESSAGE, CAN_MESSAGE2):
        return _u16(data, body) if room >= 16 else -1
    if kind == CAN_FD_MESSAGE:
        return _u16(data, body) if room >= 20 else -1
    if kind == CAN_FD_MESSAGE_64:
        return _u8(data, body) if room >= 40 else -1
    if kind == CAN_ERROR_EXT:
        return _u16(data, body) if room >= 32 else -1
    if kind in (CAN_ERROR, CAN_OVERLOAD):
        return _u16(data, body) if room >= 4 else -1
    if kind == CAN_FD_ERROR_64:
        return _u8(data, body) if room >= 4 else -1
    return -1


@kernel
def _fill(data: Bytes, body: int, end: int, ext_end: int, kind: int, row: Bytes) -> None:
    """A row, all zero before, from the part of an object behind its header; `_channel` has looked at its size.

    ext_end: where the payload of CAN_FD_MESSAGE_64 ends at the latest.
    """
    if kind in (CAN_MESSAGE, CAN_MESSAGE2):
        remote = data[body + 2] & 0x80 != 0
        length = min(_u8(data, body + 3), 8)
        _put_header(row, _identifier(_u32(data, body + 4), remote), length, 0)
        if not remote:
            _copy(data, body + 8, 8, length, row)
    elif kind in (CAN_FD_MESSAGE, CAN_FD_MESSAGE_64):
        if kind == CAN_FD_MESSAGE:
            remote = data[body + 2] & 0x80 != 0
            dlc, valid, bits = _u8(data, body + 3), _u8(data, body + 14), _u8(data, body + 13)
            payload, there = body + 20, end - body - 20
        else:
            flags = _u32(data, body + 12)
            remote = flags & 0x10 != 0
            dlc, valid, bits = _u8(data, body + 1), _u8(data, body + 2), flags >> 12
            payload, there = body + 40, ext_end - body - 40
        fd = 0
        if bits & 1:
            fd = 0x04 | (0x01 if bits & 2 else 0) | (0x02 if bits & 4 else 0)
        length = min(dlc, 8) if remote else min(valid, 64 if fd else 8)
        _put_header(row, _identifier(_u32(data, body + 4), remote), length, fd)
        if not remote:
            _copy(data, payload, there, length, row)
    elif kind == CAN_ERROR_EXT:
        length = min(_u8(data, body + 10), 8)
        _put_header(row, (_u32(data, body + 16) & 0x1FFFFFFF) | 0x20000000, length, 0)
        _copy(data, body + 24, 8, length, row)
    elif kind == CAN_OVERLOAD:
        _put_header(row, 0x20000008, 8, 0)  # CAN_ERR_PROT with data[2] CAN_ERR_PROT_OVERLOAD
        row[10] = 0x20
    else:
        _put_header(row, 0x20000080, 8, 0)  # CAN_ERR_BUSERROR


@kernel
def walk(data: Bytes, start: int, start_ns: int, channel: int, raw: Bytes, t_ns: Ints, rows: int,
         counts: Ints) -> tuple[int, int]:
    """Rows from the objects of `data` (N,), from `start` until it ends or raw (M, 72) is full: (position, rows).

    The position is where the first object begins that is not whole; bring it again with more behind it.
    start_ns: time stamp 0 of the file, not negative.  channel: as in the file, where the first is 1, or
    ALL_CHANNELS.
    raw: zero from row `rows` on.  counts: see COUNTS; after BROKEN there is nothing more to get.
    """
    at = start
    size = data.shape[0]
    while rows < raw.shape[0]:
        # Between objects there are up to 4 bytes of padding; how many depends on the type of the object.
        begin = at
        while begin + 4 <= size and begin < at + 4 and _u32(data, begin) != _LOBJ:
            begin += 1
        if begin + 4 > size:
            return at, rows
        if _u32(data, begin) != _LOBJ:
            counts[BROKEN] = 1
            return at, rows
        if begin + _BASE > size:
            return at, rows
        header = _u16(data, begin + 4)
        version = _u16(data, begin + 6)
        object_size = _u32(data, begin + 8)
        kind = _u32(data, begin + 12)
        if object_size < _BASE or object_size > LARGEST_OBJECT:
            counts[BROKEN] = 1
            return at, rows
        end = begin + object_size
        if end > size:
            return at, rows
        at = end
        body = begin + header
        found = -1
        if (version == 1 or version == 2) and header >= _HEADER and body <= end:
            found = _channel(data, body, end, kind)
            if kind == GLOBAL_MARKER and end - body >= _MARKER and counts[MARKERS] < MARKERS_KEPT:
                counts[FIRST_MARKER + counts[MARKERS]] = begin
                counts[MARKERS] += 1
                continue
        if found < 0:
            counts[PASSED_OVER] += 1
            continue
        counts[FRAMES] += 1
        if channel != ALL_CHANNELS and found != channel:
            continue
        ext_end = end
        if kind == CAN_FD_MESSAGE_64 and data[body + 35]:
            ext_end = min(end, begin + _u8(data, body + 35))
        _fill(data, body, end, ext_end, kind, raw[rows])
        t_ns[rows] = _time(data, begin, start_ns)
        rows += 1
    return at, rows


@kernel
def _put(out: Bytes, at: int, value: int, count: int) -> None:
    for k in range(count):
        out[at + k] = (value >> 8 * k) & 0xFF


@kernel
def lay_out(raw: Bytes, t_ns: Ints, start_ns: int, channel: int, out: Bytes) -> int:
    """Objects of the frames raw (N, 72) into out, zero before, with room for OBJECT_BYTES a frame; how many bytes.

    CAN_MESSAGE, CAN_FD_MESSAGE or CAN_ERROR_EXT, header version 1, time stamps in ns after start_ns.
    """
    at = 0
    for row in range(raw.shape[0]):
        can_id = _u32(raw[row], 0)
        is_fd = raw[row, 5] & 0x04 != 0
        is_error = can_id & 0x20000000 != 0
        remote = can_id & 0x40000000 != 0 and not is_error
        length = min(_u8(raw[row], 4), 64 if is_fd else 8)
        dlc = 0
        while _LENGTHS[dlc] < length:
            dlc += 1
        stored = can_id & 0x1FFFFFFF
        if can_id & 0x80000000:
            stored |= 0x80000000
        if is_error:
            kind, body_size, payload = CAN_ERROR_EXT, 32, 24
        elif is_fd:
            kind, body_size, payload = CAN_FD_MESSAGE, 84, 20
        else:
            kind, body_size, payload = CAN_MESSAGE, 16, 8
        _put(out, at, _LOBJ, 4)
        _put(out, at + 4, _HEADER, 2)
        _put(out, at + 6, 1, 2)
        _put(out, at + 8, _HEADER + body_size, 4)
        _put(out, at + 12, kind, 4)
        _put(out, at + 16, 2, 4)  # the time stamp counts ns
        _put(out, at + 24, max(t_ns[row] - start_ns, 0), 8)
        body = at + _HEADER
        _put(out, body, channel, 2)
        if is_error:
            length = min(length, 8)
            out[body + 10] = length
            _put(out, body + 16, stored, 4)
        else:
            out[body + 2] = (0x80 if remote else 0) | (raw[row, 6] & SENT)  # bit 0: transmitted
            out[body + 3] = dlc
            _put(out, body + 4, stored, 4)
            if is_fd:
                bits = raw[row, 5]
                out[body + 13] = 1 | (2 if bits & 0x01 else 0) | (4 if bits & 0x02 else 0)
                out[body + 14] = length
        if not remote:
            for k in range(length):
                out[body + payload + k] = raw[row, 8 + k]
        at = body + body_size
    return at


OBJECT_BYTES = _HEADER + 84
"""Room for the largest object of `lay_out`."""


def warm_up() -> None:
    """Compile or load the kernel that reads, before there is anything to measure."""
    raw, t_ns = np.zeros((1, 72), np.uint8), np.zeros(1, np.int64)
    walk(_NOTHING, 0, 0, ALL_CHANNELS, raw, t_ns, 0, np.zeros(COUNTS, np.int64))


_NOTHING = np.frombuffer(b"", np.uint8)
"""Read-only, as every piece of a file is: numba compiles for that."""
