"""The counting behind bus health: one pass over the frames, a fixed amount of memory, the same for any blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

Ints = NDArray[np.int64]

SLOTS = 4096
"""Places of the table of identifiers, a power of two."""
IDS_MAX = 2048
"""Identifiers that are told apart; frames of further ones are only counted."""
GAP_BINS = 64
"""Bins of the gaps between frames of an identifier: two an octave, from 1 us on."""
WINDOW_NS = 1_000_000_000
"""Windows for the least and most frames a second, and for the highest bus load."""

ENTRY = np.dtype([
    ("key", "i8"), ("count", "i8"), ("first_t", "i8"), ("last_t", "i8"),
    ("gaps", "i8"), ("mean_gap", "f8"), ("m2", "f8"), ("max_gap", "i8"), ("max_gap_at", "i8"),
    ("length", "i8"), ("min_length", "i8"), ("max_length", "i8"), ("changes", "i8"),
    ("remote", "i8"), ("fd", "i8"), ("nominal", "i8"), ("data", "i8"),
    ("window", "i8"), ("in_window", "i8"), ("windows", "i8"), ("least", "i8"), ("most", "i8"),
    ("bins", "i8", (GAP_BINS,)), ("sums", "f8", (GAP_BINS,)),
])
"""One identifier.  key: identifier with CAN_EFF_FLAG, -1 where the place is free.  Gaps in ns: how many, their
mean, sum of squared deviations, the longest and when it began; how many there are of each size, and their sums.
changes: frames whose length differs from the one before.  nominal, data: bits on the wire.
windows: whole seconds seen, least and most frames in one; -1 before the first."""

TOTAL = np.dtype([
    ("ids", "i8"), ("frames", "i8"), ("errors", "i8"), ("unkept", "i8"), ("back", "i8"),
    ("first_t", "i8"), ("last_t", "i8"), ("silence", "i8"), ("silence_at", "i8"),
    ("nominal", "i8"), ("data", "i8"), ("passed", "i8"),
    ("window", "i8"), ("window_nominal", "i8"), ("window_data", "i8"), ("peak", "f8"), ("peak_at", "i8"),
])
"""The bus.  frames: without error frames.  back: how often time ran backwards.  passed: time that went by [ns],
jumps back left out.  silence: longest time without a frame [ns] and when it began.  peak: most time the bus was
busy in one window [ns] and when that window began."""


@kernel
def _place(entries: Any, total: Any, key: int) -> int:
    """Where an identifier stands or is to stand; -1 where the table is full."""
    at = ((key * 2654435761) >> 9) & (SLOTS - 1)
    while entries[at].key != key:
        if entries[at].key < 0:
            if total.ids >= IDS_MAX:
                return -1
            total.ids += 1
            entries[at].key = key
            return at
        at = (at + 1) & (SLOTS - 1)
    return at


@kernel
def _count_window(e: Any, t_ns: int) -> None:
    """Least and most frames of an identifier in a whole second; the second in which it first came is none."""
    window = t_ns // WINDOW_NS
    if window == e.window:
        e.in_window += 1
        return
    if window > e.window:
        if e.windows < 0:
            e.windows = 0
        else:
            e.least = e.in_window if e.windows == 0 else min(e.least, e.in_window)
            e.most = max(e.most, e.in_window)
            e.windows += 1
        if window > e.window + 1:
            e.least = 0
            e.windows += window - e.window - 1
    else:
        e.windows = -1
    e.window = window
    e.in_window = 1


@kernel
def _count_gap(e: Any, gap: int) -> None:
    e.gaps += 1
    deviation = gap - e.mean_gap
    e.mean_gap += deviation / e.gaps
    e.m2 += deviation * (gap - e.mean_gap)
    if gap > e.max_gap:
        e.max_gap = gap
        e.max_gap_at = e.last_t
    at = int(2.0 * np.log2(1e-3 * gap)) if gap > 1000 else 0
    at = min(at, GAP_BINS - 1)
    e.bins[at] += 1
    e.sums[at] += gap


@kernel
def _count_frame(e: Any, t_ns: int, length: int, nominal: int, data: int) -> None:
    if e.count == 0:
        e.first_t = t_ns
        e.length = length
        e.min_length = length
        e.max_length = length
        e.window = t_ns // WINDOW_NS
        e.in_window = 1
        e.windows = -1
    else:
        if t_ns >= e.last_t:
            _count_gap(e, t_ns - e.last_t)
        _count_window(e, t_ns)
        if length != e.length:
            e.changes += 1
            e.length = length
            e.min_length = min(e.min_length, length)
            e.max_length = max(e.max_length, length)
    e.count += 1
    e.last_t = t_ns
    e.nominal += nominal
    e.data += data


@kernel
def close_window(total: Any, nominal_ns: float, data_ns: float) -> None:
    """Take the window in progress into the peak."""
    busy = total.window_nominal * nominal_ns + total.window_data * data_ns
    if busy > total.peak:
        total.peak = busy
        total.peak_at = total.window * WINDOW_NS


@kernel
def count_frames(raw: NDArray[np.uint8], t_ns: Ints, nominal: Ints, data: Ints, nominal_ns: float, data_ns: float,
                 entries: Any, totals: Any) -> None:
    """Count N frames in order.  nominal, data (N,): their bits; nominal_ns, data_ns: how long a bit lasts."""
    total = totals[0]
    for k in range(t_ns.shape[0]):
        can_id = 0
        for b in range(4):
            can_id |= (0 + raw[k, b]) << (8 * b)
        t = t_ns[k]
        if total.frames + total.errors == 0:
            total.first_t = t
            total.last_t = t
            total.window = t // WINDOW_NS
        if t < total.last_t:
            total.back += 1
        else:
            total.passed += t - total.last_t
            if t - total.last_t > total.silence:
                total.silence = t - total.last_t
                total.silence_at = total.last_t
        total.last_t = t
        if can_id & 0x20000000:
            total.errors += 1
            continue
        if t // WINDOW_NS != total.window:
            close_window(total, nominal_ns, data_ns)
            total.window = t // WINDOW_NS
            total.window_nominal = 0
            total.window_data = 0
        total.frames += 1
        total.nominal += nominal[k]
        total.data += data[k]
        total.window_nominal += nominal[k]
        total.window_data += data[k]
        at = _place(entries, total, can_id & (0x9FFFFFFF if can_id & 0x80000000 else 0x7FF))
        if at < 0:
            total.unkept += 1
            continue
        e = entries[at]
        if can_id & 0x40000000:
            e.remote += 1
        if raw[k, 5] & 4:
            e.fd += 1
        _count_frame(e, t, 0 + raw[k, 4], nominal[k], data[k])
