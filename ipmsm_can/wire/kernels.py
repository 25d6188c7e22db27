"""Kernels that take signals out of frames and put them in, driven by tables.

A message becomes an integer table (one row per signal: where the bits are), a float table (scale, offset,
limits) and a list of ranges (multiplexer identifiers and named values).  The kernels take the tables as
arguments, so that they are compiled once and cached, whatever the database.

Frames are worked on in chunks turned word-major (`buf[word, frame]`, word 0 the header), so that the inner
loops run over contiguous memory and a chunk stays in the first-level cache while all signals pass over it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

_U64 = NDArray[np.uint64]
_I64 = NDArray[np.int64]
_F64 = NDArray[np.float64]
_Bool = NDArray[np.bool_]
_Rows = NDArray[np.intp]

_CHUNK = 256
_SINGLE_MAX = 3.4028234663852886e38
UNSIGNED, SIGNED, FLOAT = 0, 1, 2

# Columns of the integer table.
LENGTH, WORD, SHIFT, MOTOROLA, KIND, END, PARENT, IDS, IDS_END, NAMED, NAMED_END, MIN, MAX = range(13)
# Columns of the float table; limits of an integer signal are raw, those of a float signal physical.
SCALE, OFFSET, LOW, HIGH, TYPE_LOW, TYPE_HIGH = range(6)


@kernel
def _swap(x: np.uint64) -> np.uint64:
    x = ((x & np.uint64(0x00FF00FF00FF00FF)) << np.uint64(8)) | (
        (x >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF))
    x = ((x & np.uint64(0x0000FFFF0000FFFF)) << np.uint64(16)) | (
        (x >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF))
    return (x << np.uint64(32)) | (x >> np.uint64(32))


@kernel
def _raw_bits(buf: _U64, n: int, table: _I64, s: int, bits: _U64) -> None:
    """bits[:n] = raw value of signal s in each frame, sign-extended; of a float signal the pattern."""
    w = table[s, WORD]
    length = np.uint64(table[s, LENGTH])
    shift = np.uint64(table[s, SHIFT])
    rest = np.uint64(64) - length
    crosses = shift + length > np.uint64(64)
    back = np.uint64(64) - shift
    if table[s, MOTOROLA]:
        for k in range(n):
            v = _swap(buf[w, k]) << shift
            if crosses:
                v |= _swap(buf[w + 1, k]) >> back
            bits[k] = v >> rest
    elif crosses:
        for k in range(n):
            bits[k] = (((buf[w, k] >> shift) | (buf[w + 1, k] << back)) << rest) >> rest
    else:
        for k in range(n):
            bits[k] = ((buf[w, k] >> shift) << rest) >> rest
    if table[s, KIND] == SIGNED:
        sign = np.uint64(1) << (length - np.uint64(1))
        for k in range(n):
            bits[k] = (bits[k] ^ sign) - sign


@kernel
def _place(buf: _U64, n: int, table: _I64, s: int, bits: _U64) -> None:
    """Put bits[:n], the value of signal s moved to the top of the word, into its place in each frame."""
    w = table[s, WORD]
    shift = np.uint64(table[s, SHIFT])
    rest = np.uint64(64 - table[s, LENGTH])
    crosses = table[s, SHIFT] + table[s, LENGTH] > 64
    back = np.uint64(64) - shift
    if table[s, MOTOROLA]:
        for k in range(n):
            buf[w, k] |= _swap(bits[k] >> shift)
            if crosses:
                buf[w + 1, k] |= _swap(bits[k] << back)
    else:
        for k in range(n):
            buf[w, k] |= (bits[k] >> rest) << shift
            if crosses:
                buf[w + 1, k] |= (bits[k] >> rest) >> back


@kernel
def _half_to_float(b: np.uint64) -> float:
    sign = (b & np.uint64(0x8000)) << np.uint64(48)
    exponent = (b >> np.uint64(10)) & np.uint64(0x1F)
    mantissa = b & np.uint64(0x3FF)
    if exponent == 0:
        small = np.float64(mantissa) * 2.0 ** -24
        return -small if sign else small
    # A double's exponent has a bias of 1023 instead of 15; all ones means infinite or no number in both.
    wide = np.uint64(2047) if exponent == 31 else exponent + np.uint64(1008)
    pattern = sign | (wide << np.uint64(52)) | (mantissa << np.uint64(42))
    return np.uint64(pattern).view(np.float64)


@kernel
def _float_to_half(x: float) -> np.uint64:
    sign = np.uint64(0x8000) if np.signbit(x) else np.uint64(0)
    a = abs(x)
    if np.isnan(x):
        return np.uint64(0x7E00)
    if np.isinf(x):
        return sign | np.uint64(0x7C00)
    a = min(a, 65504.0)
    exponent = -14
    while exponent < 15 and a >= 2.0 ** (exponent + 1):
        exponent += 1
    # Rounding up to the next power of two carries into the exponent field, which is the right result.
    steps = np.uint64(np.rint(a * 2.0 ** (10 - exponent)))
    return sign | (np.uint64((exponent + 14) * 1024) + steps)


@kernel
def _from_pattern(b: np.uint64, length: int) -> float:
    if length == 32:
        return np.float64(np.uint32(b).view(np.float32))
    if length == 64:
        return np.uint64(b).view(np.float64)
    return _half_to_float(b)


@kernel
def _to_pattern(x: float, length: int) -> np.uint64:
    if length == 64:
        return np.float64(x).view(np.uint64)
    if length == 32:
        held = min(max(x, -_SINGLE_MAX), _SINGLE_MAX) if np.isfinite(x) else x
        return np.uint64(np.float32(held).view(np.uint32))
    return _float_to_half(x)


@kernel
def _listed(ranges: _I64, start: int, stop: int, value: np.int64) -> bool:
    for j in range(start, stop):  # noqa: SIM110 - a generator does not compile
        if ranges[j, 0] <= value <= ranges[j, 1]:
            return True
    return False


@kernel
def _mark_short(buf: _U64, n: int, end: int, absent: _Bool) -> None:
    for k in range(n):
        absent[k] |= np.int64((buf[0, k] >> np.uint64(32)) & np.uint64(0xFF)) < end


@kernel
def _deselect(buf: _U64, n: int, shortest: np.int64, table: _I64, ranges: _I64, s: int, spare: _U64,
              absent: _Bool) -> None:
    """absent[:n]: a multiplexer above signal s selects another, or the frame is too short for it."""
    absent[:n] = False
    if shortest < table[s, END]:
        _mark_short(buf, n, table[s, END], absent)
    while table[s, PARENT] >= 0:
        parent = table[s, PARENT]
        if shortest < table[parent, END]:
            _mark_short(buf, n, table[parent, END], absent)
        _raw_bits(buf, n, table, parent, spare)
        first = table[s, IDS]
        stop = table[s, IDS_END]
        if stop - first == 1:  # the usual case, without a branch
            low = ranges[first, 0]
            high = ranges[first, 1]
            for k in range(n):
                value = np.int64(spare[k])
                absent[k] |= (value < low) | (value > high)
        else:
            for k in range(n):
                absent[k] |= not _listed(ranges, first, stop, np.int64(spare[k]))
        s = parent


@kernel
def _gather(words: _U64, rows: _Rows, use_rows: bool, start: int, n: int, n_words: int,
            buf: _U64) -> np.int64:
    """Turn the chunk word-major; returns the shortest payload length in it."""
    if not use_rows:
        for w in range(n_words + 1):
            for k in range(n):
                buf[w, k] = words[start + k, w]
    else:
        for k in range(n):
            r = rows[start + k]
            for w in range(n_words + 1):
                buf[w, k] = words[r, w]
    shortest = np.int64(64)
    for k in range(n):
        shortest = min(shortest, np.int64((buf[0, k] >> np.uint64(32)) & np.uint64(0xFF)))
    return shortest


@kernel
def _convert(word: _U64, up: int, down: int, signed: bool, scale: float, offset: float, out: _F64) -> None:
    """The usual case in one pass that vectorises: up to the top of the word, down again, to a number."""
    if signed:
        for k in range(out.shape[0]):
            out[k] = np.float64(np.int64(word[k] << np.uint64(up)) >> down) * scale + offset
    else:
        for k in range(out.shape[0]):
            out[k] = np.float64(np.int64((word[k] << np.uint64(up)) >> np.uint64(down))) * scale + offset


@kernel
def decode_block(words: _U64, rows: _Rows, use_rows: bool, n_words: int, table: _I64, scaling: _F64,
                 ranges: _I64, out: _F64) -> None:
    """out[s, k] = physical value of signal s in frame k, or in frame rows[k]; NaN where it is absent."""
    total = out.shape[1]
    size = min(total, _CHUNK)
    buf = np.empty((n_words + 1, size), np.uint64)
    bits = np.empty(size, np.uint64)
    absent = np.empty(size, np.bool_)
    for start in range(0, total, _CHUNK):
        n = min(_CHUNK, total - start)
        shortest = _gather(words, rows, use_rows, start, n, n_words, buf)
        for s in range(table.shape[0]):
            scale = scaling[s, SCALE]
            offset = scaling[s, OFFSET]
            kind = table[s, KIND]
            length = table[s, LENGTH]
            shift = table[s, SHIFT]
            if kind != FLOAT and length < 64 and shift + length <= 64 and not table[s, MOTOROLA]:
                _convert(buf[table[s, WORD], :n], 64 - shift - length, 64 - length, kind == SIGNED, scale, offset,
                         out[s, start:start + n])
            else:
                _raw_bits(buf, n, table, s, bits)
                if kind == FLOAT:
                    for k in range(n):
                        out[s, start + k] = _from_pattern(bits[k], length) * scale + offset
                elif kind == SIGNED or length < 64:
                    for k in range(n):  # a signed conversion is one machine instruction, an unsigned one is not
                        out[s, start + k] = np.float64(np.int64(bits[k])) * scale + offset
                else:
                    for k in range(n):
                        out[s, start + k] = np.float64(bits[k]) * scale + offset
            if table[s, PARENT] >= 0 or shortest < table[s, END]:
                _deselect(buf, n, shortest, table, ranges, s, bits, absent)
                for k in range(n):
                    if absent[k]:
                        out[s, start + k] = np.nan


@kernel
def decode_raw_block(words: _U64, rows: _Rows, use_rows: bool, n_words: int, table: _I64,
                     ranges: _I64, out: _I64) -> None:
    """As `decode_block`, raw values; 0 where a signal is absent."""
    total = out.shape[1]
    size = min(total, _CHUNK)
    buf = np.empty((n_words + 1, size), np.uint64)
    bits = np.empty(size, np.uint64)
    absent = np.empty(size, np.bool_)
    for start in range(0, total, _CHUNK):
        n = min(_CHUNK, total - start)
        shortest = _gather(words, rows, use_rows, start, n, n_words, buf)
        for s in range(table.shape[0]):
            _raw_bits(buf, n, table, s, bits)
            for k in range(n):
                out[s, start + k] = np.int64(bits[k])
            if table[s, PARENT] >= 0 or shortest < table[s, END]:
                _deselect(buf, n, shortest, table, ranges, s, bits, absent)
                for k in range(n):
                    if absent[k]:
                        out[s, start + k] = 0


@kernel
def _quantise(value: float, table: _I64, scaling: _F64, ranges: _I64, s: int) -> np.uint64:
    """Bit pattern of one physical value: rounded half to even, saturated; NaN gives raw 0 in integers."""
    scale = scaling[s, SCALE]
    offset = scaling[s, OFFSET]
    low = scaling[s, LOW]
    high = scaling[s, HIGH]
    if table[s, KIND] == FLOAT:
        if value < low:
            value = low
        elif value > high:
            value = high
        return _to_pattern((value - offset) / scale, table[s, LENGTH])
    if np.isnan(value):
        return np.uint64(0)
    raw = np.rint((value - offset) / scale)
    if np.isnan(raw):
        return np.uint64(0)
    if raw >= high or raw <= low:
        inside = scaling[s, TYPE_LOW] <= raw <= scaling[s, TYPE_HIGH] and abs(raw) < 2.0 ** 63
        if not (inside and _listed(ranges, table[s, NAMED], table[s, NAMED_END], np.int64(raw))):
            return np.uint64(table[s, MAX]) if raw >= high else np.uint64(table[s, MIN])
    return np.uint64(np.int64(raw)) if raw < 2.0 ** 63 else np.uint64(raw)


@kernel
def _quantise_column(values: _F64, start: int, n: int, table: _I64, scaling: _F64, ranges: _I64, s: int,
                     bits: _U64) -> None:
    """bits[:n] = bit patterns of signal s; the loop is short where the value lies well inside its limits."""
    scale = scaling[s, SCALE]
    offset = scaling[s, OFFSET]
    low = scaling[s, LOW]
    high = min(scaling[s, HIGH], 2.0 ** 63)
    integer = table[s, KIND] != FLOAT
    for k in range(n):
        raw = np.rint((values[s, start + k] - offset) / scale)
        if integer and low < raw < high:
            bits[k] = np.uint64(np.int64(raw))
        else:
            bits[k] = _quantise(values[s, start + k], table, scaling, ranges, s)


@kernel
def encode_block(values: _F64, n_words: int, order: _Rows, table: _I64, scaling: _F64, ranges: _I64,
                 header: np.uint64, words: _U64) -> None:
    """Frames from physical values; `order` puts multiplexers before the signals they select."""
    total = values.shape[1]
    size = min(total, _CHUNK)
    buf = np.empty((n_words + 1, size), np.uint64)
    bits = np.empty(size, np.uint64)
    spare = np.empty(size, np.uint64)
    absent = np.zeros(size, np.bool_)
    for start in range(0, total, _CHUNK):
        n = min(_CHUNK, total - start)
        buf[:, :] = np.uint64(0)
        buf[0, :] = header
        for s in order:
            _quantise_column(values, start, n, table, scaling, ranges, s, bits)
            rest = np.uint64(64 - table[s, LENGTH])
            for k in range(n):
                bits[k] <<= rest
            if table[s, PARENT] >= 0:
                _deselect(buf, n, np.int64(64), table, ranges, s, spare, absent)
                for k in range(n):
                    if absent[k]:
                        bits[k] = np.uint64(0)
            _place(buf, n, table, s, bits)
        for k in range(n):
            for w in range(n_words + 1):
                words[start + k, w] = buf[w, k]
