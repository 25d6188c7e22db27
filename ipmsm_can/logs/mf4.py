"""MF4, the measurement file of ASAM MDF 4: its CAN bus logging as blocks of frames, through asammdf.

Bus logging keeps data frames, error frames and remote frames in channel groups of their own, and some recorders
make one group per bus or identifier.  Their records are merged by time; records of the same time stand in the order
of the groups.  Source: ASAM MDF 4.1, associated standard "Bus Logging"; python-can's can/io/mf4.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    DATA_OFFSET,
    FrameBlock,
)
from ipmsm_can.logs.source import LogError, Outcome, Request, unpacked_file, words_of

if TYPE_CHECKING:
    from asammdf import MDF

DATA, ERROR, REMOTE = "CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame"
_RECORDS = 65536
_LATEST_S = 4e9
_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.int64)

Samples = NDArray[Any]
Ints = NDArray[np.int64]


def read_mf4(request: Request, outcome: Outcome) -> Iterator[FrameBlock]:
    """Blocks of an MF4 file.

    Raises LogError where it is none, holds no CAN bus logging, or where asammdf is not installed.
    """
    try:
        from asammdf import MDF
    except ImportError:
        raise LogError(f"{request.path}: MF4 needs the package asammdf, which is not installed; "
                       "install it (pip install 'ipmsm_can[mf4]')") from None
    channel = None if request.channel is None else request.channel_number()
    with unpacked_file(request) as path:
        with path.open("rb") as stream:
            begins = stream.read(8).strip()
        if begins not in (b"MDF", b"UnFinMF"):
            raise LogError(f"{request.path} cannot be read as .mf4: it does not begin with 'MDF'")
        try:
            file = MDF(path)
        except Exception as error:  # asammdf raises what its parsers meet
            _forget(error)
            raise LogError(f"{request.path} is cut off or damaged: {words_of(error)}") from error
        with closing(file):
            groups = _bus_groups(file)
            if not groups:
                raise LogError(f"{request.path} holds no CAN bus logging (a channel group {DATA}); signals that "
                               "were decoded already cannot be replayed")
            try:
                records = max(1, sum(file.groups[g].channel_group.cycles_nr for g, _ in groups))
                parts = [_group_blocks(file, g, name, channel) for g, name in groups]
                taken = 0
                for block in _in_pieces(_merged(parts), request.block_frames):
                    taken += len(block)
                    outcome.done = min(1.0, taken / records)
                    yield block
            except Exception as error:
                outcome.problem = f"{request.path} is cut off or damaged: {words_of(error)}"
    outcome.done = 1.0


def _forget(error: Exception) -> None:
    """Tell a file that asammdf could not open that it is closed: else its destructor fails, and Python says so."""
    from asammdf.blocks.mdf_v4 import MDF4

    at = error.__traceback__
    while at is not None:
        half_open = at.tb_frame.f_locals.get("self")
        if isinstance(half_open, MDF4):
            half_open._closed = True
        at = at.tb_next


def _bus_groups(file: MDF) -> list[tuple[int, str]]:
    """(number, what frames) of the channel groups with frames of a CAN bus."""
    found = []
    groups: list[Any] = file.groups
    for number, group in enumerate(groups):
        names = {channel.name for channel in group.channels}
        kind = next((name for name in (DATA, ERROR, REMOTE) if name in names), None)
        if kind is not None:
            found.append((number, kind))
    return found


def _start_ns(file: MDF) -> int:
    """Unix time of time stamp 0; a file that holds local time is read in the zone of this machine."""
    header = file.header
    return int(header.abs_time) + round(header.start_time.timestamp() - header.abs_time / 1e9) * 1_000_000_000


def _group_blocks(file: MDF, group: int, name: str, channel: int | None) -> Iterator[FrameBlock]:
    start_ns = _start_ns(file)
    for at in range(0, file.groups[group].channel_group.cycles_nr, _RECORDS):
        signal = file.get(name, group=group, record_offset=at, record_count=_RECORDS)
        seconds = np.clip(np.nan_to_num(np.asarray(signal.timestamps, np.float64)), -_LATEST_S, _LATEST_S)
        t_ns = np.maximum.accumulate(start_ns + np.rint(1e9 * seconds).astype(np.int64))
        block = FrameBlock(_rows(signal.samples, name), t_ns)
        if channel is not None:
            block = block.take(_field(signal.samples, name, "BusChannel") == channel)
        yield block


def _field(samples: Samples, name: str, field: str, default: int = 0) -> Ints:
    full = f"{name}.{field}"
    if full not in (samples.dtype.names or ()):
        return np.full(len(samples), default, np.int64)
    return np.asarray(samples[full]).astype(np.int64)


def _rows(samples: Samples, name: str) -> NDArray[np.uint8]:
    """Rows of a `FrameBlock` (N, 72) from the records of a group (N,)."""
    block = FrameBlock.zeros(len(samples))
    stored = _field(samples, name, "ID")
    extended = (_field(samples, name, "IDE") != 0) | (stored & CAN_EFF_FLAG != 0)
    fd = _field(samples, name, "EDL") != 0
    dlc = _field(samples, name, "DLC")
    if name == ERROR:
        can_id = stored & CAN_EFF_MASK | CAN_ERR_FLAG
    else:
        can_id = np.where(extended, stored & CAN_EFF_MASK | CAN_EFF_FLAG, stored & CAN_SFF_MASK)
    length = np.clip(dlc, 0, 8)
    if name == REMOTE:
        can_id |= CAN_RTR_FLAG
    else:
        full = f"{name}.DataBytes"
        payload = np.asarray(samples[full], np.uint8) if full in (samples.dtype.names or ()) else (
            np.zeros((len(samples), 0), np.uint8))
        if f"{name}.DataLength" in (samples.dtype.names or ()):
            length = _field(samples, name, "DataLength")
        else:
            length = _LENGTHS[np.clip(dlc, 0, 15)]
        length = np.clip(length, 0, np.where(fd, 64, 8))
        width = min(64, payload.shape[1])
        kept = np.arange(width) < length[:, None]
        block.raw[:, DATA_OFFSET:DATA_OFFSET + width] = np.where(kept, payload[:, :width], 0)
    block.can_id[:] = can_id
    block.raw[:, 4] = length
    bits = CANFD_FDF + CANFD_BRS * (_field(samples, name, "BRS") != 0) + (
        CANFD_ESI * (_field(samples, name, "ESI") != 0))
    block.raw[:, 5] = np.where(fd, bits, 0)
    return block.raw


def _merged(parts: list[Iterator[FrameBlock]]) -> Iterator[FrameBlock]:
    """Blocks of several sources, each in the order of time, as one."""
    empty = FrameBlock.zeros(0)
    heads = [empty for _ in parts]
    open_parts = set(range(len(parts)))
    while True:
        for number in sorted(open_parts):
            while not len(heads[number]) and number in open_parts:
                following = next(parts[number], None)
                if following is None:
                    open_parts.discard(number)
                else:
                    heads[number] = following
        # Of a source that goes on, later records are not before the last one here; of an ended one there are none.
        limits = [int(heads[number].t_ns[-1]) for number in open_parts]
        limit = min(limits, default=np.iinfo(np.int64).max)
        counts = [int(np.searchsorted(head.t_ns, limit, side="right")) for head in heads]
        ready = FrameBlock.concat([h.take(slice(0, n)) for h, n in zip(heads, counts, strict=True)])
        heads = [h.take(slice(n, None)) for h, n in zip(heads, counts, strict=True)]
        if len(ready):
            yield ready if len(parts) == 1 else ready.take(np.argsort(ready.t_ns, kind="stable"))
        elif not open_parts:
            return


def _in_pieces(blocks: Iterator[FrameBlock], size: int) -> Iterator[FrameBlock]:
    """The same frames in blocks of `size`, the last with the rest."""
    held: list[FrameBlock] = []
    count = 0
    for block in blocks:
        held.append(block)
        count += len(block)
        if count >= size:
            whole = FrameBlock.concat(held)
            for at in range(0, count - size + 1, size):
                yield whole.take(slice(at, at + size))
            held, count = [whole.take(slice(count // size * size, None))], count % size
    if count:
        yield FrameBlock.concat(held)
