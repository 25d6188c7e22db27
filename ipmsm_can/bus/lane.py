"""The fast lane: one drive, classical samples, SocketCAN, answers by return, without Python in between.

A process that is woken a thousand times a second finds its caches cold each time, and then every page of code
costs.  So the usual case, samples of one drive in unbroken order, is received, decoded, estimated and answered
in one compiled loop of a few milliseconds; whatever is not the usual case is handed to the ordinary path, with
nothing done to it yet.  Both work on the same state with the same kernels and give the same bits.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import types
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.bus.socketcan import MessageTable, SocketCanPort, unpack
from ipmsm_can.companion import Companion
from ipmsm_can.estimation import regression, speed
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator, estimate_block
from ipmsm_can.estimation.observers import ges
from ipmsm_can.frames import FrameBlock
from ipmsm_can.injection.meter import meter_block
from ipmsm_can.node import Node, Tracked
from ipmsm_can.wire.answers import due_among, position_values
from ipmsm_can.wire.e2e import crc_p02
from ipmsm_can.wire.kernels import FLOAT, KIND, PARENT, decode_block, encode_block
from ipmsm_can.wire.protocol import InjectionState, MessageKind
from ipmsm_can.wire.sequence import HALF_WRAP, NIBBLE, TIMING, SampleRun, sequence

CYCLES, CYCLES_PROBING = 50, 10
"""Answers given before Python sees what happened; fewer while it has probing commands to send."""
CAPACITY = 4096
"""Frames, and samples, that one call can take in."""
_MOST = 64

DONE, SILENCE, STRANGE, UNSENT = range(4)
"""Why the loop came back: enough cycles; no frame in time; a batch for the ordinary path; answers not taken."""

_recvmmsg = types.ExternalFunction(
    "recvmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32, types.intp))
_sendmmsg = types.ExternalFunction("sendmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32))

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Rows = NDArray[np.intp]
Records = NDArray[np.void]
Words = NDArray[np.uint64]

_ESTIMATES = regression.ROWS + ges.ROWS + speed.ROWS + 3


@kernel
def _unbroken(kind: Ints, counter: Ints, rate: Floats, t_ns: Ints, n: int, st: Any) -> bool:
    """Whether these samples follow the last one, each other, and the clock, with nothing to be settled, and any
    DriveTiming among them only says what is known."""
    if not st.has_last or st.restarted or st.correction != 0 or st.doubt or st.guess != 0 or st.rate <= 0.0:
        return False
    if st.has_floor and st.floor > st.last + 1:
        return False
    before = st.last_t
    last = st.last
    for k in range(n):
        if kind[k] == TIMING:
            ahead = (counter[k] - last) & 0xFFFFFFFF
            if not st.synced or rate[k] != st.rate or 0 < ahead <= 0xFFFFFFF0:
                return False
            continue
        silence = (t_ns[k] - before) * 1e-9 * st.rate
        if counter[k] != ((last + 1) & 15) or silence < 0.0 or silence > HALF_WRAP:
            return False
        last += 1
        before = t_ns[k]
    return True


@kernel
def _lane(handle: int, cycles: int, every: int, ids: Words,
          in_headers: Ints, in_address: int, control: Ints, in_frames: Bytes, port_state: Ints,
          raw: Bytes, words: Words, t_ns: Ints,
          table: Ints, scaling: Floats, ranges: Ints, order: Rows,
          t_table: Ints, t_scaling: Floats, t_ranges: Ints, t_order: Rows,
          seq: Records, counts: Ints,
          rp: Records, rs: Records, op: Records, os: Records, sp: Records, ex: Records, cf: Records, mt: Records,
          injecting: int, step: float, position_rows: Rows,
          p_order: Rows, p_table: Ints, p_scaling: Floats, p_ranges: Ints, p_header: np.uint64, data_ids: Bytes,
          out_frames: Bytes, out_words: Words, out_iov: Ints, out_address: int,
          all_raw: Bytes, all_t: Ints, counter: Ints, values: Floats, estimates: Floats, flags: Bytes,
          result: Ints) -> int:
    """Serve up to CYCLES answers; returns why it stopped.

    result: frames taken in, samples estimated, frames in raw that were left, answers sent, answers not taken (in
    out_frames from row result[5] on), first such row, counter of the next answer, DriveTimings taken in.
    """
    st = seq[0]
    taken = 0
    done = 0
    hf = 0.0
    for _cycle in range(cycles):
        want = every - st.last % every
        n = _recvmmsg(handle, in_address, min(want, _MOST), 0, 0)
        if n <= 0:
            result[0] = taken
            result[1] = done
            estimates[_ESTIMATES - 1, 0] = hf
            return SILENCE
        n = unpack(n, in_headers, control, in_frames, raw, t_ns, port_state)
        strange = False
        events = 0
        m = 0
        kind = np.empty(n, np.int64)
        low = np.empty(n, np.int64)
        rate = np.zeros(n)
        arrived = np.empty(n, np.int64)
        part = np.zeros((4, n))
        row = np.empty(1, np.intp)
        one = np.empty((table.shape[0], 1))
        timing = np.empty((t_table.shape[0], 1))
        for k in range(n):
            row[0] = k
            arrived[events] = t_ns[k]
            if t_ns[k] < 0:
                strange = True
            elif words[k, 0] == ids[0]:
                decode_block(words, row, True, 1, table, scaling, ranges, one)
                for r in range(4):
                    part[r, events] = one[order[r], 0]
                kind[events] = NIBBLE
                low[events] = np.int64(one[order[4], 0])
                events += 1
                m += 1
            elif words[k, 0] == ids[2]:
                decode_block(words, row, True, 1, t_table, t_scaling, t_ranges, timing)
                kind[events] = TIMING
                low[events] = np.int64(timing[t_order[0], 0])
                rate[events] = timing[t_order[1], 0]
                events += 1
            elif words[k, 0] != ids[1]:
                strange = True
        if strange or not _unbroken(kind, low, rate, arrived, events, st):
            result[0] = taken
            result[1] = done
            result[2] = n
            estimates[_ESTIMATES - 1, 0] = hf
            return STRANGE
        for k in range(n):
            for b in range(72):
                all_raw[taken + k, b] = raw[k, b]
            all_t[taken + k] = t_ns[k]
        taken += n
        run_counter = np.empty(m, np.int64)
        run_values = np.empty((4, m))
        run_filled = np.empty(m, np.uint8)
        run_doubt = np.empty(m, np.uint8)
        run_gap = np.empty(m, np.int64)
        run_t = np.empty(m, np.int64)
        sequence(0, kind[:events], low[:events], rate[:events], arrived[:events], part, 0, seq, counts, run_counter,
                 run_values, run_filled, run_doubt, run_gap, run_t)
        result[7] += events - m
        if m == 0:
            continue
        regressed = np.empty((7, m))
        flux = np.empty((6, m))
        angle = np.empty((3, m))
        excited = np.empty(m)
        sigma = np.empty(m)
        run_flags = np.empty(m, np.uint8)
        estimate_block(run_values, rp, rs, op, os, sp, ex, cf, regressed, flux, angle, excited, sigma, run_flags)
        hf = meter_block(run_values, mt)
        for k in range(m):
            counter[0, done + k] = run_counter[k]
            counter[1, done + k] = run_t[k]
            flags[done + k] = run_flags[k]
            for r in range(4):
                values[r, done + k] = run_values[r, k]
            for r in range(7):
                estimates[r, done + k] = regressed[r, k]
            for r in range(6):
                estimates[7 + r, done + k] = flux[r, k]
            for r in range(3):
                estimates[13 + r, done + k] = angle[r, k]
            estimates[16, done + k] = excited[k]
            estimates[17, done + k] = sigma[k]
        done += m
        due = np.empty(m, np.intp)
        n_due = due_among(run_counter, every, m, due)
        if n_due == 0:
            continue
        said = np.zeros(m, np.uint8)
        said[:] = injecting
        answers = np.zeros((p_table.shape[0], n_due))
        position_values(run_counter, angle, sigma, run_flags, said, due[:n_due], step, position_rows, answers)
        encode_block(answers, 1, p_order, p_table, p_scaling, p_ranges, p_header, out_words)
        for j in range(n_due):
            out_iov[j, 1] = 16
            out_frames[j, 9] = (out_frames[j, 9] & 0xF0) | (result[6] & 0x0F)
            out_frames[j, 8] = crc_p02(out_frames, j, 8, data_ids)
            result[6] += 1
        sent = max(0, _sendmmsg(handle, out_address, n_due, 0))
        result[3] += sent
        if sent < n_due:
            result[0] = taken
            result[1] = done
            result[4] = n_due - sent
            result[5] = sent
            estimates[_ESTIMATES - 1, 0] = hf
            return UNSENT
    result[0] = taken
    result[1] = done
    estimates[_ESTIMATES - 1, 0] = hf
    return DONE


@dataclass(frozen=True, slots=True)
class Lap:
    """What one call did: frames taken in, samples with their estimates, and what is left to the ordinary path.

    taken: frames that are dealt with, `timings` DriveTimings among them.  tracked: their samples, empty or one.
     left: frames not dealt with.
    unsent: answers that the port would not take.  sent: answers sent.
    """

    taken: FrameBlock
    timings: int
    tracked: list[Tracked]
    left: FrameBlock
    unsent: FrameBlock
    sent: int


class LanePort(Protocol):
    """What the loop needs of a SocketCAN port."""

    @property
    def tables(self) -> tuple[MessageTable, MessageTable]: ...

    @property
    def state(self) -> Ints: ...

    def set_timeout(self, timeout_s: float) -> None: ...

    def fileno(self) -> int: ...


class _Nowhere:
    """A port without a socket: every receive fails at once."""

    def __init__(self) -> None:
        self.tables = MessageTable(2, 10), MessageTable(2, 0)
        self.state = np.zeros(4, np.int64)

    def set_timeout(self, timeout_s: float) -> None:
        """Nothing waits here."""

    def fileno(self) -> int:
        return -1


def warm_up(companion: Companion) -> None:
    """Compile or load the loop for a companion of one node that has estimated already."""
    (node,) = companion.nodes.values()
    if sys.platform.startswith("linux") and node.estimator is not None:
        FastLane(_Nowhere(), companion).run(0.0)


class FastLane:
    """The loop with its buffers, for one companion on one SocketCAN port."""

    def __init__(self, port: LanePort, companion: Companion) -> None:
        self._port = port
        self._companion = companion
        (self._node,) = companion.nodes.values()
        protocol = companion.protocol
        sample = protocol.codecs[MessageKind.DRIVE_SAMPLE]
        position = protocol.codecs[MessageKind.POSITION_ESTIMATE]
        reference = protocol.codecs[MessageKind.DRIVE_REFERENCE]
        number = self._node.number
        timing = protocol.codecs[MessageKind.DRIVE_TIMING]
        self._ids = np.array([c.frame_id + number | c.length << 32 for c in (sample, reference, timing)], np.uint64)
        self._sample, self._position, self._timing = sample.tables, position.tables, timing.tables
        self._timing_order = np.array([timing.index["sample_counter"], timing.index["sample_rate"]], np.intp)
        self._order = np.array([sample.index[s] for s in (
            "i_alpha", "i_beta", "v_alpha", "v_beta", "sample_counter")], np.intp)
        self._header = np.uint64(int(position.tables.header) + number)
        protection = protocol.protection(MessageKind.POSITION_ESTIMATE, number)
        assert protection is not None
        self._data_ids = protection.data_ids
        self._raw = np.zeros((_MOST, 72), np.uint8)
        self._t = np.zeros(_MOST, np.int64)
        self._all_raw = np.zeros((CAPACITY, 72), np.uint8)
        self._all_t = np.zeros(CAPACITY, np.int64)
        self._counter = np.zeros((2, CAPACITY), np.int64)
        self._values = np.zeros((4, CAPACITY))
        self._estimates = np.zeros((_ESTIMATES, CAPACITY))
        self._flags = np.zeros(CAPACITY, np.uint8)

    @classmethod
    def over(cls, port: object, companion: Companion) -> FastLane | None:
        """The loop where it can serve: one drive, that is answered, on SocketCAN, with samples it can decode."""
        if not (isinstance(port, SocketCanPort) and companion.transmit and len(companion.nodes) == 1):
            return None
        codec = companion.protocol.codecs[MessageKind.DRIVE_SAMPLE]
        counter = codec.layouts[codec.index["sample_counter"]]
        table = codec.tables.table
        timing = companion.protocol.codecs[MessageKind.DRIVE_TIMING]
        simple = (timing.length == 8 and not timing.is_fd and (timing.tables.table[:, PARENT] < 0).all()
                  and codec.length == 8 and not codec.is_fd and not counter.motorola and counter.scale == 1.0
                  and counter.offset == 0.0 and (table[:, KIND] != FLOAT).all() and (table[:, PARENT] < 0).all()
                  and companion.protocol.codecs[MessageKind.POSITION_ESTIMATE].length == 8)
        return cls(port, companion) if simple else None

    def ready(self, now_ns: int) -> bool:
        """Whether samples flow and each answer is due within few enough of them."""
        node = self._node
        return (node.estimator is not None and node.running and node.frames_until_due(now_ns) > 0
                and min(node.samples_per_answer, _MOST) * CYCLES <= CAPACITY and node.samples_per_frame == 1)

    def run(self, timeout_s: float) -> Lap:
        """Serve until there is something for Python to do, at most CYCLES answers; waits timeout_s per frame."""
        node, port = self._node, self._port
        estimator = node.estimator
        assert isinstance(node, Node)
        assert isinstance(estimator, Estimator)
        port.set_timeout(timeout_s)
        incoming, outgoing = port.tables
        result = np.zeros(8, np.int64)
        result[6] = node.position_counter
        s, p, t = self._sample, self._position, self._timing
        probing = node.scheduler.state not in (InjectionState.DISABLED, InjectionState.OFF)
        rp, rs, op, os, sp, ex, cf = estimator.records
        why = _lane(port.fileno(), CYCLES_PROBING if probing else CYCLES, node.samples_per_answer, self._ids,
                    incoming.headers, incoming.headers.ctypes.data, incoming.control, incoming.frames, port.state,
                    self._raw, self._raw.view(np.uint64), self._t,
                    s.table, s.scaling, s.ranges, self._order,
                    t.table, t.scaling, t.ranges, self._timing_order,
                    node.receiver.sequencer.state, node.receiver.sequencer.counts,
                    rp, rs, op, os, sp, ex, cf, node.meter,
                    int(node.injecting), node.position_step, node.position_rows,
                    p.order, p.table, p.scaling, p.ranges, self._header, self._data_ids,
                    outgoing.frames, outgoing.frames.view(np.uint64), outgoing.iov, outgoing.headers.ctypes.data,
                    self._all_raw, self._all_t, self._counter, self._values, self._estimates, self._flags, result)
        taken, done, left, sent, unsent, first = (int(x) for x in result[:6])
        node.position_counter = int(result[6])
        node.view.estimates += sent + unsent
        frames = FrameBlock(self._all_raw[:taken].copy(), self._all_t[:taken].copy())
        return Lap(frames, int(result[7]), self._tracked(done) if done else [],
                   FrameBlock(self._raw[:left].copy(), self._t[:left].copy()) if why == STRANGE else _NOTHING,
                   FrameBlock(outgoing.frames[first:first + unsent].copy(), np.zeros(unsent, np.int64)), sent)

    def _tracked(self, done: int) -> list[Tracked]:
        node = self._node
        zeros = np.zeros(done, np.uint8)
        run = SampleRun(node.view.sample_rate, self._counter[0, :done].copy(),
                        np.ascontiguousarray(self._values[:, :done]), zeros, zeros, np.zeros(done, np.int64),
                        self._counter[1, :done].copy())
        e = self._estimates
        estimate = EstimateBlock(np.ascontiguousarray(e[:7, :done]), np.ascontiguousarray(e[7:13, :done]),
                                 np.ascontiguousarray(e[13:16, :done]), e[16, :done].copy(), e[17, :done].copy(),
                                 self._flags[:done].copy())
        node.note(run, estimate, float(e[_ESTIMATES - 1, 0]))
        return [Tracked(node.number, run, estimate, np.full(done, node.injecting, np.uint8))]


_NOTHING = FrameBlock.zeros(0)
