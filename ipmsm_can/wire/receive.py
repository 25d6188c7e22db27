"""From the frames of one drive to its samples: decoding, end-to-end checks, sequencing, and the counts.

A value at the end of its signal's range was cut off there: its sample goes on, marked CLIPPED, not to be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.codec import MessageCodec
from ipmsm_can.wire.e2e import E2EStatus, SequenceChecker
from ipmsm_can.wire.kernels import FLOAT, KIND
from ipmsm_can.wire.protocol import BLOCK_SAMPLES, MessageKind, Protocol
from ipmsm_can.wire.sequence import Events, SampleRun, SampleSequencer
from ipmsm_can.wire.sequence_kernel import CLIPPED, DUPLICATES, FULL, NIBBLE, TIMING

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
PLAUSIBLE = 1e6
"""Largest current [A] and voltage [V] that is taken for a measurement."""
AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")


@kernel
def is_clipped(values: Floats, first_row: int, k: int, ends: Floats) -> bool:
    """One of the four values of column k from first_row on, stands at an end of its range (`range_ends`)."""
    for r in range(4):
        value = values[first_row + r, k]
        for e in range(4):
            if abs(value - ends[r, e]) <= ends[r, 4]:
                return True
    return False


@kernel
def _mark_clipped(values: Floats, ends: Floats, kind: Ints) -> None:
    for k in range(kind.shape[0]):
        if is_clipped(values, 0, k, ends):
            kind[k] += CLIPPED


def range_ends(codec: MessageCodec, names: Sequence[str]) -> Floats:
    """Ends of the range of signals i_alpha, i_beta, v_alpha, v_beta, for `is_clipped`, float64 (4, 5).

    Per signal: the ends of the range that the DBC gives it, those of what its bits can hold, and how near counts:
    a step and a half, as some senders limit to +-max and leave out the lowest value.  Physical units.
    """
    out = np.empty((4, 5))
    for r, name in enumerate(names):
        s = codec.index[name]
        scale, offset, low, high, type_low, type_high = codec.tables.scaling[s].tolist()
        if codec.tables.table[s, KIND] == FLOAT:
            # Its limits are physical, and bits that hold 1e38 cut nothing off.
            near = 1e-6 * max(abs(low), abs(high)) if math.isfinite(high - low) else 0.0
            out[r] = low, high, low, high, near
        else:
            out[r, :4] = np.array([low, high, type_low, type_high]) * scale + offset
            out[r, 4] = 1.5 * abs(scale)
    return out


@kernel
def _merge(rows_s: Rows, samples: Floats, rows_t: Rows, timings: Floats, rows_b: Rows,
           blocks: Floats, first_row: int, ends_s: Floats, ends_b: Floats, t_ns: Ints, kind: Ints, counter: Ints,
           rate: Floats, t_out: Ints, values: Floats) -> int:
    """Events of sample, timing and block frames in order of arrival; returns how many.

    rows_*: where each frame stood in the block.  samples (5, .): i, v, counter.  timings (2, .): counter, rate.
    blocks (30, .): first_sample, sample_count, 7 x (i, v), whose rows begin at first_row.
    ends_s, ends_b: `range_ends` of a DriveSample and a DriveSampleBlock.
    """
    n = 0
    s = 0
    t = 0
    b = 0
    end = t_ns.shape[0]
    while True:
        row_s = rows_s[s] if s < rows_s.shape[0] else end
        row_t = rows_t[t] if t < rows_t.shape[0] else end
        row_b = rows_b[b] if b < rows_b.shape[0] else end
        if row_s < row_t and row_s < row_b:
            kind[n] = NIBBLE + (CLIPPED if is_clipped(samples, 0, s, ends_s) else 0)
            counter[n] = int(samples[4, s])
            rate[n] = 0.0
            t_out[n] = t_ns[row_s]
            for r in range(4):
                values[r, n] = samples[r, s]
            n += 1
            s += 1
        elif row_t < row_b:
            kind[n] = TIMING
            counter[n] = int(timings[0, t])
            rate[n] = timings[1, t]
            t_out[n] = t_ns[row_t]
            for r in range(4):
                values[r, n] = 0.0
            n += 1
            t += 1
        elif row_b < end:
            for j in range(int(blocks[1, b])):
                kind[n] = FULL + (CLIPPED if is_clipped(blocks, first_row + 4 * j, b, ends_b) else 0)
                counter[n] = (int(blocks[0, b]) + j) & 0xFFFFFFFF
                rate[n] = 0.0
                t_out[n] = t_ns[row_b]
                for r in range(4):
                    values[r, n] = blocks[first_row + 4 * j + r, b]
                n += 1
            b += 1
        else:
            return n


class SampleReceiver:
    """Receives DriveSample, DriveSampleBlock and DriveTiming of one node.

    counts of trouble are in `sequencer` and `bad_frames` (wrong CRC or impossible content).
    """

    def __init__(self, protocol: Protocol, node: int, max_gap: int, sample_rate: float | None) -> None:
        self._protocol = protocol
        self._node = node
        self.sequencer = SampleSequencer(max_gap, sample_rate)
        self.bad_frames = 0
        self._blocks = SequenceChecker(256, 255)
        codecs = protocol.codecs
        self._sample = codecs[MessageKind.DRIVE_SAMPLE]
        self._timing = codecs[MessageKind.DRIVE_TIMING]
        self._sample_rows = self._order(MessageKind.DRIVE_SAMPLE, (*AXES, "sample_counter"))
        self._timing_rows = self._order(MessageKind.DRIVE_TIMING, ("sample_counter", "sample_rate"))
        self._block_rows = self._order(MessageKind.DRIVE_SAMPLE_BLOCK, (
            "first_sample", "sample_count",
            *(f"{axis}_{j}" for j in range(BLOCK_SAMPLES) for axis in AXES)))
        self.sample_ends = range_ends(self._sample, AXES)
        self._block_ends = range_ends(codecs[MessageKind.DRIVE_SAMPLE_BLOCK], [f"{axis}_0" for axis in AXES])
        self._no_blocks = np.zeros((2 + 4 * BLOCK_SAMPLES, 0))

    def _order(self, kind: MessageKind, names: tuple[str, ...]) -> Rows | None:
        """Where these signals stand in the DBC's message; None where they are its first ones, in order."""
        index = self._protocol.codecs[kind].index
        rows = np.array([index[name] for name in names], np.intp)
        return None if np.array_equal(rows, np.arange(rows.size)) else rows

    def push(self, block: FrameBlock, samples: Rows, timings: Rows, blocks: Rows) -> list[SampleRun]:
        """Take in frames of this node; rows of `block` by kind, each in order of arrival."""
        words = block.words
        s = self._sample.decode_rows(words, samples)
        if self._sample_rows is not None:
            s = s[self._sample_rows]
        samples, s = self._plausible(samples, s, 4)
        if not timings.size and not blocks.size:
            kind = np.full(samples.size, NIBBLE, np.int64)
            _mark_clipped(s, self.sample_ends, kind)
            events = Events(kind, s[4].astype(np.int64), np.zeros(samples.size),
                            block.t_ns[samples], s[:4])
            return self.sequencer.push(events)
        t = self._timing.decode_rows(words, timings)
        if self._timing_rows is not None:
            t = t[self._timing_rows]
        timings, t = self._plausible(timings, t, 0)
        blocks, b = self._intact_blocks(block, blocks)
        room = samples.size + timings.size + BLOCK_SAMPLES * blocks.size
        kind = np.empty(room, np.int64)
        counter = np.empty(room, np.int64)
        rate = np.empty(room)
        t_ns = np.empty(room, np.int64)
        values = np.empty((4, room))
        n = _merge(samples, s, timings, t, blocks, b, 2, self.sample_ends, self._block_ends,
                   block.t_ns, kind, counter, rate, t_ns, values)
        return self.sequencer.push(Events(kind[:n], counter[:n], rate[:n], t_ns[:n],
                                          values if n == room else np.ascontiguousarray(values[:, :n])))

    def _plausible(self, rows: Rows, values: Floats, measured: int) -> tuple[Rows, Floats]:
        """Without the frames that hold a NaN, an infinity, or beyond PLAUSIBLE in their first `measured` rows.

        Only somebody's float signals or scalings can hold such a thing; it would spoil the filters for good.
        """
        largest = np.abs(values[:measured]).max(initial=0.0)
        if math.isfinite(values.sum()) and largest <= PLAUSIBLE:
            return rows, values
        good = np.isfinite(values).all(axis=0) & (np.abs(values[:measured]) <= PLAUSIBLE).all(axis=0)
        self.bad_frames += int(good.size - good.sum())
        return rows[good], np.ascontiguousarray(values[:, good])

    def _intact_blocks(self, block: FrameBlock, rows: Rows) -> tuple[Rows, Floats]:
        if not rows.size:
            return rows, self._no_blocks
        b, intact, counters = self._protocol.decode(MessageKind.DRIVE_SAMPLE_BLOCK, self._node, block.raw, rows)
        if self._block_rows is not None:
            b = b[self._block_rows]
        status = self._blocks.update(intact, counters)
        repeated = status == E2EStatus.REPEATED
        self.sequencer.counts[DUPLICATES] += int(np.nansum(b[1][repeated]))
        self.bad_frames -= int(repeated.sum())
        good = status <= E2EStatus.OK_SOME_LOST
        good &= np.isfinite(b).all(axis=0) & (b[1] >= 1) & (b[1] <= BLOCK_SAMPLES)
        good &= (np.abs(b[2:]) <= PLAUSIBLE).all(axis=0)
        if good.all():
            return rows, np.ascontiguousarray(b)
        self.bad_frames += int(good.size - good.sum())
        return rows[good], np.ascontiguousarray(b[:, good])
