"""BLF, Vector's binary log: containers of compressed objects as blocks of frames, and blocks as containers.

The file: a header of 144 bytes with the time of the start, then containers, each packed by zlib, usually of
128 KiB.  An object may begin in one container and end in the next.  Containers are unpacked by a thread that is one
or two steps ahead of the kernel, for zlib works without the interpreter's lock.

Time stamps are absolute: the start of the measurement in the header, read as UTC as python-can does (Vector's own
tools write local time there and no zone), plus the object's, which counts ns or 10 us.  Error frames keep the
identifier and payload that are in the file.  From python-can's SocketCAN recordings that is Linux' error class;
Vector's tools write the identifier of the frame that was on the bus.
"""

from __future__ import annotations

import datetime
import struct
import zlib
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import chain, repeat
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import blf_kernel as k
from ipmsm_can.logs import marks
from ipmsm_can.logs.marks import Mark
from ipmsm_can.logs.source import CHUNK_BYTES, Filling, LogError, Outcome, Request, Source

_FILE = struct.Struct("<4sL8BQQLL8H8H")
_FILE_BYTES = 144
_BASE = struct.Struct("<4sHHLL")
_CONTAINER = struct.Struct("<H6xL4x")
_OBJECT = struct.Struct("<4sHHLLLHHQ")
_MARKER = struct.Struct("<LLL3xBLLL12x")
"""Of a global marker: event it belongs to, two colours, whether it may be moved, and the lengths of three texts:
group, name, description.  As in python-can's can/io/blf.py."""
_GROUP = "ipmsm_can"
_STORED, _DEFLATED = 0, 2
_CONTAINER_BYTES = 1 << 17
_LARGEST_UNPACKED = 1 << 28
_AHEAD = 2
_EARLIEST_S = 631_152_000
"""Before 1990 a time is none of this calendar's: it counts from the start of something."""
_UTC = datetime.UTC
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=_UTC)


# ---- reading ------------------------------------------------------------------------------------------

def read_blf(request: Request, outcome: Outcome) -> Iterator[FrameBlock]:
    """Blocks of a BLF file.  Raises LogError where it is none, or the channel asked for is no number."""
    # As python-can has it: the file's channel 1 is channel 0.
    channel = k.ALL_CHANNELS if request.channel is None else request.channel_number() + 1
    with Source(request.path, request.packed) as source:
        start_ns, promised = _read_header(source, request)
        filling = Filling(request.block_frames)
        counts = np.zeros(k.COUNTS, np.int64)
        rest = b""
        with closing(_unpacked(source, request, outcome)) as pieces:
            for piece, done in pieces:
                data = rest + piece if rest else piece
                view, at = np.frombuffer(data, np.uint8), 0
                while True:
                    block = filling.block
                    at, filling.rows = k.walk(view, at, start_ns, channel, block.raw, block.t_ns, filling.rows,
                                              counts)
                    outcome.passed_over = int(counts[k.PASSED_OVER])
                    if counts[k.MARKERS]:
                        _note_markers(data, start_ns, counts, outcome)
                    if not filling.full:
                        break
                    outcome.done = done
                    yield filling.take()
                rest = data[at:]
                if counts[k.BROKEN]:
                    outcome.problem = (f"{request.path} is damaged: no object stands where one must, behind "
                                       f"{counts[k.FRAMES]} frames; what follows is left out")
                    break
        if not counts[k.BROKEN]:
            _judge_end(source, request, promised, rest, outcome)
        outcome.done = 1.0
        if filling.rows:
            yield filling.take()


def _read_header(source: Source, request: Request) -> tuple[int, int]:
    """(time of the start [ns], size of the file it promises [bytes])."""
    head = source.exactly(_FILE.size)
    if head[:4] != b"LOGG"[:len(head)] or not head:
        raise LogError(source.problem or f"{request.path} cannot be read as .blf: it does not begin with 'LOGG'")
    if len(head) < _FILE.size:
        raise LogError(source.problem or f"{request.path} is cut off: the header of a BLF file has {_FILE_BYTES} "
                       f"bytes and {len(head)} are there")
    fields = _FILE.unpack(head)
    source.exactly(fields[1] - _FILE.size)
    return _start_ns(fields[14:22]), fields[10]


def _start_ns(systemtime: tuple[int, ...]) -> int:
    """Unix time of a SYSTEMTIME (year, month, day of week, day, hour, minute, second, ms).

    0 if it is no time, or none that int64 holds in ns (1970 to 2262).
    """
    year, month, _, day, hour, minute, second, ms = systemtime
    try:
        start = datetime.datetime(year, month, day, hour, minute, second, ms * 1000, tzinfo=_UTC)
    except ValueError:
        return 0
    since = (start - _EPOCH) // datetime.timedelta(milliseconds=1) * 1_000_000
    return since if 0 <= since < 1 << 63 else 0


def _unpacked(source: Source, request: Request, outcome: Outcome) -> Generator[tuple[bytes, float], None, None]:
    """(what a few containers hold, share of the file up to there); of a cut-off container what there is."""
    pool = ThreadPoolExecutor(1, "blf")
    ahead: deque[tuple[Future[tuple[bytes, str]], float]] = deque()
    try:
        for packed in chain(_groups(source, request, outcome), repeat(None, _AHEAD)):
            if packed is not None:
                ahead.append((pool.submit(_unpack, packed), source.done))
            if ahead and (packed is None or len(ahead) > _AHEAD):
                following, done = ahead.popleft()
                data, trouble = following.result()
                yield data, done
                if trouble:
                    outcome.problem = (outcome.problem
                                       or f"{request.path} is damaged: {trouble}; what follows is left out")
                    return
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _groups(source: Source, request: Request, outcome: Outcome) -> Iterator[list[tuple[int, int, bytes]]]:
    """Containers as (compression, bytes promised, contents), as many at a time as hold about CHUNK_BYTES."""
    group: list[tuple[int, int, bytes]] = []
    held = 0
    while True:
        at = source.delivered
        head = source.exactly(_BASE.size)
        if len(head) < _BASE.size:
            if head.strip(b"\0"):
                outcome.problem = f"{request.path} is cut off within the head of an object at byte {at}"
            break
        signature, _, _, size, kind = _BASE.unpack(head)
        if signature != b"LOBJ" or size < _BASE.size:
            outcome.problem = f"{request.path} is damaged: no object stands at byte {at}; what follows is left out"
            break
        body = source.exactly(size - _BASE.size)
        source.exactly(size % 4)
        cut = len(body) < size - _BASE.size
        if cut:
            outcome.problem = (f"{request.path} is cut off: the object at byte {at} has {size} bytes and "
                               f"{len(head) + len(body)} are there")
        if kind != k.LOG_CONTAINER:
            group.append((_STORED, size, head + body))
            held += size
        elif len(body) >= _CONTAINER.size:
            method, promised = _CONTAINER.unpack_from(body)
            group.append((method, promised, body[_CONTAINER.size:]))
            held += promised
        if cut:
            break
        if held >= CHUNK_BYTES:
            yield group
            group, held = [], 0
    if group:
        yield group


def _unpack(group: list[tuple[int, int, bytes]]) -> tuple[bytes, str]:
    """(what the containers hold, why not all of it)."""
    parts = []
    trouble = ""
    for method, _, contents in group:
        if method == _STORED:
            parts.append(contents)
        elif method == _DEFLATED:
            unpacker = zlib.decompressobj()
            try:
                parts.append(unpacker.decompress(contents, _LARGEST_UNPACKED))
            except zlib.error as error:
                trouble = f"a container cannot be unpacked ({error})"
            else:
                if not unpacker.eof:
                    trouble = "a container ends too early"
        else:
            trouble = f"a container is packed in an unknown way ({method})"
        if trouble:
            break
    return b"".join(parts), trouble


def _note_markers(data: bytes, start_ns: int, counts: NDArray[np.int64], outcome: Outcome) -> None:
    """Take in the global markers that `walk` came by."""
    places = counts[k.FIRST_MARKER:k.FIRST_MARKER + counts[k.MARKERS]].tolist()
    counts[k.MARKERS] = 0
    for at in places:
        _, header, _, size, _, unit, _, _, ticks = _OBJECT.unpack_from(data, at)
        body = data[at + header:at + size]
        texts, begin = [], _MARKER.size
        for length in _MARKER.unpack_from(body)[4:]:
            texts.append(body[begin:begin + length].split(b"\0")[0].decode("cp1252", "replace"))
            begin += length
        words = texts[1] if texts[0] == _GROUP else " - ".join(t for t in texts if t)
        t_ns = min(start_ns + ticks * (10_000 if unit == 1 else 1), (1 << 63) - 1)
        marks.note(outcome.marks, [Mark(t_ns, marks.one_line(words))])


def _judge_end(source: Source, request: Request, promised: int, rest: bytes, outcome: Outcome) -> None:
    """A file may end too early without a container that is cut in two."""
    if source.problem:
        outcome.problem = source.problem
    elif promised > source.delivered and not outcome.problem.startswith(f"{request.path} is damaged"):
        outcome.problem = (f"{request.path} is cut off: its header promises {promised} bytes and "
                           f"{source.delivered} are there")
    elif rest.strip(b"\0") and not outcome.problem:
        outcome.problem = f"{request.path} is cut off: its last object is not whole"


# ---- writing ------------------------------------------------------------------------------------------

class BlfWriter:
    """Write blocks to a new BLF file, time stamps exact to the ns.

    channel: from 0, as python-can counts.  The header gets its sizes with `close`; what is written before a
    `flush` can be read without them.
    """

    def __init__(self, path: Path, channel: int) -> None:
        self._file: IO[bytes] = path.open("wb")
        self._channel = channel + 1
        self._waiting = bytearray()
        self._objects = 0
        self._unpacked = _FILE_BYTES
        self._start_ns: int | None = None
        self._stop_ns = 0
        self._write_header(_FILE_BYTES)

    def write(self, block: FrameBlock) -> None:
        """Append the frames of a block."""
        if not len(block):
            return
        start_ns = self._begin(int(block.t_ns[0]))
        out = np.zeros(len(block) * k.OBJECT_BYTES, np.uint8)
        size = k.lay_out(np.ascontiguousarray(block.raw), np.ascontiguousarray(block.t_ns), start_ns,
                         self._channel, out)
        self._take(bytes(out[:size].data), len(block), int(block.t_ns[-1]))

    def mark(self, mark: Mark) -> None:
        """A remark, as a global marker."""
        start_ns = self._begin(mark.t_ns)
        group, name = _GROUP.encode(), marks.one_line(mark.text).encode("cp1252", "replace")
        body = _MARKER.pack(0, 0xFFFFFF, 0xFF3300, 0, len(group), len(name), 0) + group + name
        head = _OBJECT.pack(b"LOBJ", _OBJECT.size, 1, _OBJECT.size + len(body), k.GLOBAL_MARKER, 2, 0, 0,
                            max(0, mark.t_ns - start_ns))
        self._take(head + body + bytes(len(body) % 4), 1, mark.t_ns)

    def _begin(self, t_ns: int) -> int:
        """Time stamp 0 of the file [ns]; t_ns: of the first that is written."""
        if self._start_ns is None:
            self._start_ns = t_ns // 1_000_000 * 1_000_000 if t_ns >= _EARLIEST_S * 10**9 else 0
        return self._start_ns

    def _take(self, objects: bytes, count: int, stop_ns: int) -> None:
        self._waiting += objects
        self._objects += count
        self._stop_ns = stop_ns
        whole = len(self._waiting) // _CONTAINER_BYTES * _CONTAINER_BYTES
        for at in range(0, whole, _CONTAINER_BYTES):
            self._write_container(bytes(self._waiting[at:at + _CONTAINER_BYTES]))
        del self._waiting[:whole]

    def _write_container(self, data: bytes) -> None:
        packed = zlib.compress(data, 1)
        size = _BASE.size + _CONTAINER.size + len(packed)
        self._file.write(_BASE.pack(b"LOBJ", _BASE.size, 1, size, k.LOG_CONTAINER)
                         + _CONTAINER.pack(_DEFLATED, len(data)) + packed + bytes(size % 4))
        self._unpacked += _BASE.size + _CONTAINER.size + len(data)

    def _write_header(self, size: int) -> None:
        # The application is python-can's number, whose layout of objects this is.
        head = _FILE.pack(b"LOGG", _FILE_BYTES, 5, 0, 0, 0, 2, 6, 8, 1, size, self._unpacked, self._objects, 0,
                          *_systemtime(self._start_ns or 0), *_systemtime(self._stop_ns))
        self._file.write(head.ljust(_FILE_BYTES, b"\0"))

    def flush(self) -> None:
        """Hand everything written so far to the operating system, and the start's time with it."""
        if self._waiting:
            self._write_container(bytes(self._waiting))
            self._waiting.clear()
        end = self._file.tell()
        self._file.seek(0)
        self._write_header(end)
        self._file.seek(end)
        self._file.flush()

    def close(self) -> None:
        """Finish the file."""
        if not self._file.closed:
            self.flush()
            self._file.close()


def _systemtime(t_ns: int) -> tuple[int, ...]:
    if t_ns < _EARLIEST_S * 10**9:
        return (0,) * 8
    t = _EPOCH + datetime.timedelta(milliseconds=t_ns // 1_000_000)
    return (t.year, t.month, t.isoweekday() % 7, t.day, t.hour, t.minute, t.second, t.microsecond // 1000)
