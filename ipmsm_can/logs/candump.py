"""candump's text (`candump -L` or `-l`), compiled: characters to rows of frames, and back.

    (1700000000.000000) can0 123#0102030405060708        classical; 8 digits before '#': extended, or an error frame
    (1700000000.000000) can0 123#R4                      remote
    (1700000000.000000) can0 123##1AABB                  CAN FD, one digit of flags
    (1700000000.000000)  can0  123   [8]  01 02 03 ...   for people, `candump -ta`; [08] with two digits: CAN FD

The fraction may have any number of digits; what follows the payload (R or T, a raw DLC) is passed over.
Lines that begin with '#' are comments, as for can-utils; `marks` are among them.
Time stamps stay exact and error frames keep their details; through python-can's messages both would be lost.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import SENT, FrameBlock
from ipmsm_can.logs import marks
from ipmsm_can.logs.source import CHUNK_BYTES, Filling, LogError, Outcome, Request, Source

_LONGEST_LINE = 1 << 12


def read_candump(request: Request, outcome: Outcome) -> Iterator[FrameBlock]:
    """Blocks of a candump text.  Raises LogError where none of its lines reads like one."""
    channel = np.frombuffer((request.channel or "").encode(), np.uint8)
    counts = np.zeros(2, np.int64)
    filling = Filling(request.block_frames)
    with Source(request.path, request.packed) as source:
        for text in _texts(source, counts):
            characters, at = np.frombuffer(text, np.uint8), 0
            if text.startswith(b"#") or b"\n#" in text:
                marks.note(outcome.marks, marks.from_comments(text))
            while at < len(characters):
                block = filling.block
                at, filling.rows = parse(characters, at, channel, block.raw, block.t_ns, filling.rows, counts)
                outcome.bad_lines = int(counts[1])
                if filling.full:
                    outcome.done = source.done
                    yield filling.take()
        outcome.problem = source.problem
    outcome.bad_lines = int(counts[1])
    outcome.done = 1.0
    if counts[1] and not counts[0] and not request.channel:
        raise LogError(f"{request.path} is no candump log: none of its {counts[1]} lines reads like "
                       "'(1700000000.000000) can0 123#0102'; `candump -l can0` writes such lines, and those of "
                       "`candump -ta can0` can be read, too")
    if filling.rows:
        yield filling.take()


def _texts(source: Source, counts: NDArray[np.int64]) -> Iterator[bytes]:
    """The file in pieces that end with a line; what was readable of a damaged one."""
    rest = b""
    while piece := source.some(CHUNK_BYTES):
        text = rest + piece
        cut = text.rfind(b"\n") + 1
        rest = text[cut:]
        if len(rest) > _LONGEST_LINE:
            counts[1] += 1
            rest = b""
        if cut:
            yield text[:cut]
    if rest:
        yield rest


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
def _parse_columns(text: NDArray[np.uint8], at: int, end: int, row: NDArray[np.uint8]) -> int:
    """Read what stands behind the identifier for people, "  [2]  AA BB", into a row; position after it, or -1."""
    while at < end and text[at] <= 32:
        at += 1
    if at == end or text[at] != 91:  # '['
        return -1
    at += 1
    length = 0
    digits = 0
    while at < end and 48 <= text[at] <= 57 and digits < 2:
        length = 10 * length + (text[at] - 48)
        at += 1
        digits += 1
    room = 8
    if digits == 2:
        row[5] = 0x04
        room = 64
    if digits == 0 or length > room or at == end or text[at] != 93:  # ']'
        return -1
    at += 1
    row[4] = length
    for k in range(length):
        while at < end and text[at] <= 32:
            at += 1
        if k == 0 and at < end and text[at] == 114:  # "remote request"
            row[3] |= 0x40
            break
        high = _nibble(text[at]) if at + 1 < end else -1
        low = _nibble(text[at + 1]) if at + 1 < end else -1
        if high < 0 or low < 0:
            return -1
        row[8 + k] = 16 * high + low
        at += 2
    return end  # the same as characters, or the word ERRORFRAME, may follow


@kernel
def _parse_line(text: NDArray[np.uint8], at: int, end: int, channel: NDArray[np.uint8],
                row: NDArray[np.uint8]) -> tuple[int, int]:
    """One line without its newline: (kind, time in ns).

    kind: 1 a frame, 0 nothing for us, -1 not understood.
    """
    while at < end and text[at] <= 32:
        at += 1
    if at == end or text[at] == 35:  # '#': a comment
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
    if not 1 <= digits <= 8 or at == end:
        return -1, 0
    # with times since the last frame (-td) or the start (-tz) it is not known when it was
    columns = text[at] <= 32 and seconds >= 1_000_000_000
    if text[at] != 35 and not columns:  # '#'
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
    at = _parse_columns(text, at, end, row) if columns else _parse_payload(text, at + 1, end, row)
    if at < 0 or (at < end and text[at] > 32):
        return -1, 0
    return (1 if wanted else 0), t_ns


@kernel
def parse(text: NDArray[np.uint8], start: int, channel: NDArray[np.uint8], raw: NDArray[np.uint8],
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


def warm_up() -> None:
    """Compile or load the kernel that reads, before there is anything to measure."""
    nothing = np.frombuffer(b"", np.uint8)  # read-only, as every piece of a file is: numba compiles for that
    parse(nothing, 0, nothing, np.zeros((1, 72), np.uint8), np.zeros(1, np.int64), 0, np.zeros(2, np.int64))


@kernel
def _digits(value: int, base: int, width: int, out: NDArray[np.uint8], at: int) -> int:
    for k in range(width):
        digit = value % base
        out[at + width - 1 - k] = 48 + digit if digit < 10 else 55 + digit
        value //= base
    return at + width


@kernel
def format_rows(raw: NDArray[np.uint8], t_ns: NDArray[np.int64], channel: NDArray[np.uint8],
            out: NDArray[np.uint8]) -> int:
    """Lines as candump -L writes them, with " T" behind a frame that was SENT; returns how many bytes."""
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
        if raw[row, 6] & SENT:
            out[at] = 32
            out[at + 1] = 84
            at += 2
        out[at] = 10
        at += 1
    return at
