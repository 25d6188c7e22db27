"""The fast lane: one drive, classical samples, SocketCAN, answers by return, without Python in between.

A process that is woken a thousand times a second finds its caches cold each time, and then every page of code
costs.  So the usual case, samples of one drive in unbroken order, is received, decoded, estimated and answered
in one compiled loop for a quarter of a second; whatever is not the usual case is handed to the ordinary path, with
nothing done to it yet.  Both work on the same state with the same kernels and give the same bits.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus import lane_kernel as loop
from ipmsm_can.bus.live import TURNAROUND_EVERY
from ipmsm_can.bus.message_table import STATES, MessageTable
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.companion import Companion
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import OLDEST_ANSWER, Tracked
from ipmsm_can.wire.codec import MessageCodec
from ipmsm_can.wire.kernels import FLOAT, KIND, PARENT
from ipmsm_can.wire.protocol import NODES, MessageKind
from ipmsm_can.wire.receive import AXES, PLAUSIBLE
from ipmsm_can.wire.sequence import SampleRun

LAP_NS = 250_000_000
"""How long the loop runs before Python sees what happened; shorter where a probing command is due."""
CAPACITY = 1 << 15
"""Frames, and samples, that one lap can take in."""
CHEAP_NS = 1000
"""Where reading the clock takes longer [ns], only one answer in TURNAROUND_EVERY, and the first of each lap, is
looked at for coming too late; else each."""
_TRIALS = 100
_READ = {
    MessageKind.DRIVE_SAMPLE: ("i_alpha", "i_beta", "v_alpha", "v_beta", "sample_counter"),
    MessageKind.DRIVE_TIMING: ("sample_counter", "sample_rate"),
    MessageKind.DRIVE_STATUS: ("mode", "active_waveform", "protocol_version", "rejected_commands"),
}


@dataclass(frozen=True, slots=True)
class Lap:
    """What one call did: frames taken in, samples with their estimates, and what is left to the ordinary path.

    taken: frames that are dealt with; by_kind: how many of each kind.  tracked: their samples, empty or one.
    left: frames not dealt with.
    sent: answers sent, at the time of what they answer.  unsent: answers that the port would not take.
    silent: it ended because no frame came in time, or none can.  took: some of the turnarounds [s].
    late: answers withheld because their samples were read too late.  foreign: frames taken that are nobody's here.
    """

    taken: FrameBlock
    by_kind: dict[MessageKind, int]
    tracked: list[Tracked]
    left: FrameBlock
    sent: FrameBlock
    unsent: FrameBlock
    silent: bool
    took: NDArray[np.float64]
    late: int
    foreign: int


class LanePort(Protocol):
    """What the loop needs of a SocketCAN port."""

    @property
    def tables(self) -> tuple[MessageTable, MessageTable]: ...

    @property
    def state(self) -> NDArray[np.int64]: ...

    def set_timeout(self, timeout_s: float) -> None: ...

    def fileno(self) -> int: ...

    def check(self) -> None: ...

    def look(self, block: FrameBlock) -> None: ...


class _Nowhere:
    """A port without a socket: every receive fails at once."""

    def __init__(self) -> None:
        self.tables = MessageTable(2, 10), MessageTable(2, 0)
        self.state = np.zeros(STATES, np.int64)

    def set_timeout(self, timeout_s: float) -> None:
        """Nothing waits here."""

    def fileno(self) -> int:
        return -1

    def check(self) -> None:
        """It is as it should be."""

    def look(self, block: FrameBlock) -> None:
        """Nothing is ever received."""


def warm_up(companion: Companion) -> None:
    """Compile or load the loop for a companion of one node that has estimated already."""
    (node,) = companion.nodes.values()
    if sys.platform.startswith("linux") and node.estimator is not None:
        FastLane(_Nowhere(), companion).run(0.0, 0)


def _is_simple(codec: MessageCodec) -> bool:
    """Eight bytes of integers, nothing multiplexed, and no measured value beyond what is believed."""
    table = codec.tables.table
    measured = [s for s in codec.layouts if s.name in AXES]
    largest = max((abs(s.scale) * 2.0**s.length + abs(s.offset) for s in measured), default=0.0)
    return bool(codec.length == 8 and not codec.is_fd and (table[:, KIND] != FLOAT).all()
                and (table[:, PARENT] < 0).all() and largest <= PLAUSIBLE)


class FastLane:
    """The loop with its buffers, for one companion on one SocketCAN port."""

    def __init__(self, port: LanePort, companion: Companion) -> None:
        self._port = port
        self._companion = companion
        (self._node,) = companion.nodes.values()
        codecs, number = companion.protocol.codecs, self._node.number
        protection = companion.protocol.protection(MessageKind.POSITION_ESTIMATE, number)
        assert protection is not None

        def frame(kind: MessageKind) -> np.uint64:
            return np.uint64(codecs[kind].frame_id + number | codecs[kind].length << 32)

        def decoder(kind: MessageKind) -> loop.Decoder:
            t = codecs[kind].tables
            rows = np.array([codecs[kind].index[s] for s in _READ[kind]], np.intp)
            return loop.Decoder(frame(kind), t.table, t.scaling, t.ranges, rows)

        def encoder(kind: MessageKind, rows: NDArray[np.intp]) -> loop.Encoder:
            t = codecs[kind].tables
            return loop.Encoder(np.uint64(int(t.header) + number), t.order, t.table, t.scaling, t.ranges, rows)

        none = np.zeros(0, np.intp)
        self._wire = loop.Wire(
            decoder(MessageKind.DRIVE_SAMPLE), decoder(MessageKind.DRIVE_TIMING), decoder(MessageKind.DRIVE_STATUS),
            frame(MessageKind.DRIVE_REFERENCE), companion.protocol.id_lut,
            encoder(MessageKind.POSITION_ESTIMATE, self._node.position_rows),
            encoder(MessageKind.ACTIVE_FLUX_ESTIMATE, self._node.flux_rows),
            encoder(MessageKind.COMPANION_STATUS, none), protection.data_ids, self._node.receiver.sample_ends)
        self._state_row = codecs[MessageKind.COMPANION_STATUS].index["state"]
        table, out = port.tables
        raw = np.zeros((loop.MOST, 72), np.uint8)
        self._incoming = loop.Incoming(
            port.fileno(), table.headers, table.headers.ctypes.data, table.control, table.frames, port.state, raw,
            raw.view(np.uint64), np.zeros(loop.MOST, np.int64))
        moment = np.zeros(2, np.int64)
        self._outgoing = loop.Outgoing(out.frames, out.frames.view(np.uint64), out.iov, out.headers.ctypes.data,
                                       moment, moment.ctypes.data)
        cheap = loop.time_clock(self._outgoing, _TRIALS) < _TRIALS * CHEAP_NS
        self._clock_every = 1 if cheap else TURNAROUND_EVERY
        n = CAPACITY
        self._kept = loop.Kept(
            raw=np.zeros((n, 72), np.uint8), t_ns=np.zeros(n, np.int64), counter=np.zeros((2, n), np.int64),
            marks=np.zeros((2, n), np.uint8), values=np.zeros((4, n)), estimates=np.zeros((loop.ESTIMATES, n)),
            flags=np.zeros(n, np.uint8), took=np.zeros(n), hf_current=np.zeros(1),
            sent_words=np.zeros((n, 9), np.uint64), sent_t_ns=np.zeros(n, np.int64))

    @classmethod
    def over(cls, port: object, companion: Companion) -> FastLane | None:
        """The loop where it can serve: one drive, that is answered, on SocketCAN, with samples it can decode."""
        if not (isinstance(port, SocketCanPort) and companion.transmit and len(companion.nodes) == 1
                and len(port.tables[0].headers) >= loop.MOST):
            return None
        codecs = companion.protocol.codecs
        sample = codecs[MessageKind.DRIVE_SAMPLE]
        counter = sample.layouts[sample.index["sample_counter"]]
        out = (MessageKind.POSITION_ESTIMATE, MessageKind.ACTIVE_FLUX_ESTIMATE, MessageKind.COMPANION_STATUS)
        simple = (all(_is_simple(codecs[kind]) for kind in _READ) and not counter.motorola and counter.scale == 1.0
                  and counter.offset == 0.0
                  and all(codecs[kind].length == 8 and not codecs[kind].is_fd for kind in out))
        return cls(port, companion) if simple else None

    def ready(self, now_ns: int) -> bool:
        """Whether samples flow and nothing but samples is due now."""
        node = self._node
        return (node.estimator is not None and node.running and node.flowing(now_ns)
                and node.samples_per_frame == 1 and node.quiet_ns(now_ns) > 0 and not node.distrusting
                and self._room_for_answers())

    def _room_for_answers(self) -> bool:
        """Whether the port's table can hold what one batch can call for, every loss in it filled."""
        node = self._node
        every = node.samples_per_answer
        samples = (node.receiver.sequencer.max_gap + 1) * min(every, loop.MOST)
        most = samples // every + samples // node.samples_per_flux_answer + 3
        return most <= len(self._outgoing.frames)

    def run(self, timeout_s: float, now_ns: int) -> Lap:
        """Serve until there is something for Python to do, at most LAP_NS; waits timeout_s per frame."""
        node, port = self._node, self._port
        estimator = node.estimator
        assert isinstance(estimator, Estimator)
        port.set_timeout(timeout_s)
        result = np.zeros(loop.RESULTS, np.int64)
        result[loop.COUNTER] = node.position_counter
        result[loop.NEXT_STATUS] = node.next_status
        companion = self._companion
        calm_speed, calm_excitation, calm_sigma = node.scheduler.calm
        plan = loop.Plan(
            lap_ns=min(LAP_NS, node.lap_ns), end_ns=now_ns + node.quiet_ns(now_ns),
            max_gap=node.receiver.sequencer.max_gap,
            every=node.samples_per_answer, flux_every=node.samples_per_flux_answer,
            oldest=int(OLDEST_ANSWER * node.view.sample_rate), injecting=int(node.injecting),
            rejected=node.rejected_commands, step=node.position_step, calm_speed=calm_speed,
            calm_excitation=calm_excitation, calm_sigma=calm_sigma, status_period=node.status_period,
            status=node.status_values(now_ns, companion.bus_load, companion.turnaround),
            state_row=self._state_row, time_every=TURNAROUND_EVERY, clock_every=self._clock_every,
            oldest_s=OLDEST_ANSWER)
        sequencer = node.receiver.sequencer
        rp, rs, op, os, sp, ex, cf = estimator.records
        records = loop.LaneRecords(sequencer.state, sequencer.counts, rp, rs, op, os, sp, ex, cf, node.meter)
        why = loop.lap(plan, self._wire, self._incoming, self._outgoing, records, self._kept, result)
        (taken, done, left, sent, unsent, first, counter, samples, timings, statuses, next_status,
         timed, late, foreign) = result.tolist()
        node.view.estimates += counter - node.position_counter
        node.position_counter = counter
        node.next_status = next_status
        kept, incoming = self._kept, self._incoming
        frames = FrameBlock(kept.raw[:taken].copy(), kept.t_ns[:taken].copy())
        by_kind = {MessageKind.DRIVE_SAMPLE: samples, MessageKind.DRIVE_TIMING: timings,
                   MessageKind.DRIVE_STATUS: statuses,
                   MessageKind.DRIVE_REFERENCE: taken - samples - timings - statuses - foreign}
        last_ns = kept.t_ns[taken - 1] if taken else now_ns
        tracked = self._tracked(done) if done else []
        strange = (FrameBlock(incoming.raw[:left].copy(), incoming.t_ns[:left].copy()) if why == loop.STRANGE
                   else _NOTHING)
        if left:
            port.look(strange)
        if by_kind[MessageKind.DRIVE_REFERENCE]:
            label = MessageKind.DRIVE_REFERENCE * NODES + node.number
            node.hear_encoder(frames, np.flatnonzero(companion.protocol.classify(frames.raw) == label), tracked)
        return Lap(frames, by_kind, tracked, strange,
                   FrameBlock(kept.sent_words[:sent].copy().view(np.uint8), kept.sent_t_ns[:sent].copy()),
                   FrameBlock(self._outgoing.frames[first:first + unsent].copy(),
                              np.full(unsent, last_ns, np.int64)),
                   why == loop.SILENCE, kept.took[:timed].copy(), late, foreign)

    def check_bus(self) -> None:
        """Raise BusError where there is nothing to wait for; the loop does not tell silence from an interface that
        went down."""
        self._port.check()

    def _tracked(self, done: int) -> list[Tracked]:
        node, kept = self._node, self._kept
        run = SampleRun(node.view.sample_rate, kept.counter[0, :done].copy(),
                        np.ascontiguousarray(kept.values[:, :done]), kept.marks[0, :done].copy(),
                        kept.marks[1, :done].copy(), np.zeros(done, np.int64),
                        kept.counter[1, :done].copy())
        e = kept.estimates[:, :done]
        estimate = EstimateBlock(
            np.ascontiguousarray(e[:loop.FLUX_AT]), np.ascontiguousarray(e[loop.FLUX_AT:loop.ANGLE_AT]),
            np.ascontiguousarray(e[loop.ANGLE_AT:loop.EXCITATION_AT]), e[loop.EXCITATION_AT].copy(),
            e[loop.SIGMA_AT].copy(), kept.flags[:done].copy())
        node.note(run, estimate, float(kept.hf_current[0]))
        return [Tracked(node.number, run, estimate, np.full(done, node.injecting, np.uint8))]


_NOTHING = FrameBlock.zeros(0)
