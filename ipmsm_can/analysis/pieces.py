"""From frames to pieces of a measurement: of a drive that speaks our wire, or through a map of any inverter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.companion import group_rows
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping.convert import ANGLE_APART, CURRENT_APART, VOLTAGE_APART
from ipmsm_can.mapping.mapper import MappedBlock, Mapper
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.wire.protocol import NODES, WRONG_LENGTH, MessageKind, Protocol
from ipmsm_can.wire.receive import SampleReceiver
from ipmsm_can.wire.sequence import SampleRun
from ipmsm_can.wire.sequence_kernel import CLIPPED, COUNTERS, LONGEST_SILENCE, RESTARTED, WRAP

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_IN_DOUBT = 1
_LABELS = len(MessageKind) * NODES - WRONG_LENGTH


@dataclass(frozen=True, slots=True)
class SamplePiece:
    """M samples.  counter: as the drive counts; sample: the same without wraps and steps backwards.

    values (4, M): i_alpha, i_beta [A], v_alpha, v_beta [V].  t_ns: arrival.
    """

    sample_rate: float
    counter: Ints
    sample: Ints
    t_ns: Ints
    values: Floats
    filled: Bools
    clipped: Bools
    good: Bools


@dataclass(frozen=True, slots=True)
class EncoderPiece:
    """Reports of an encoder.  counter: of the sample they belong to; theta [rad electrical], omega [rad/s]."""

    t_ns: Ints
    counter: Ints
    theta: Floats
    omega: Floats


@dataclass(frozen=True, slots=True)
class StatusPiece:
    """Reports of the drive's state, NaN where it does not say."""

    t_ns: Ints
    mode: Floats
    v_dc: Floats
    temperature: Floats
    faults: Floats
    waveform: Floats


@dataclass(slots=True)
class Pieces:
    """What one block of frames gave."""

    samples: list[SamplePiece] = field(default_factory=list)
    encoder: list[EncoderPiece] = field(default_factory=list)
    status: list[StatusPiece] = field(default_factory=list)


class SampleCount:
    """Numbers of samples that only rise, from counters that wrap, restart, or are put right backwards.

    Where the counter says nothing the time between the arrivals counts, at least two sample periods: what stands
    on both sides of such a step is never taken for neighbours.
    """

    def __init__(self) -> None:
        self._counter = self._sample = self._arrival = 0
        self._started = False

    def numbers(self, counter: Ints, gap: Ints, t_ns: Ints, rate: float) -> Ints:
        """int64 (M,) numbers of samples with these counters, samples missing before each, arrival times [ns]."""
        first = not self._started
        if first:
            self._counter = self._sample = int(counter[0]) - 1
            self._arrival = int(t_ns[0])
            self._started = True
        step = np.diff(counter, prepend=self._counter)
        step[step < -(WRAP // 2)] += WRAP
        step[(gap == 0) & (step != 1)] = 1
        broken = (gap >= RESTARTED) | (step <= 0) | (step > LONGEST_SILENCE * rate)
        broken[0] &= not first
        if broken.any():
            waited = np.diff(t_ns, prepend=self._arrival)[broken]
            step[broken] = np.maximum(2, np.rint(1e-9 * rate * waited)).astype(np.int64)
        numbers = np.asarray(self._sample + np.cumsum(step), np.int64)
        self._counter, self._sample, self._arrival = int(counter[-1]), int(numbers[-1]), int(t_ns[-1])
        return numbers


class WirePieces:
    """Frames of a drive that speaks the project's own wire.

    config: whose node and settings count.  sample_rate: [Hz] until DriveTiming says it; None waits for that.
    """

    def __init__(self, config: DriveConfig, protocol: Protocol) -> None:
        self.node = config.wire.node
        self.receiver = SampleReceiver(protocol, self.node, config.wire.max_gap, config.wire.sample_rate)
        self.frames = self.unknown = self.errors = self.wrong_length = 0
        self._protocol = protocol
        self._number = SampleCount()

    def feed(self, block: FrameBlock) -> Pieces:
        """Take in the next frames."""
        out = Pieces()
        if not len(block):
            return out
        labels = self._protocol.classify(block.raw)
        order, begin = np.empty(len(block), np.intp), np.empty(_LABELS + 1, np.intp)
        group_rows(labels, order, begin)

        def rows(kind: MessageKind) -> NDArray[np.intp]:
            at = kind * NODES + self.node - WRONG_LENGTH
            return order[begin[at]:begin[at + 1]]

        self.frames += len(block)
        self.wrong_length += int(begin[1])
        self.errors += int(begin[-WRONG_LENGTH - 1] - begin[-WRONG_LENGTH - 2])
        self.unknown += int(begin[-WRONG_LENGTH] - begin[-WRONG_LENGTH - 1])
        self._reports(block, rows(MessageKind.DRIVE_REFERENCE), rows(MessageKind.DRIVE_STATUS), out)
        runs = self.receiver.push(block, rows(MessageKind.DRIVE_SAMPLE), rows(MessageKind.DRIVE_TIMING),
                                  rows(MessageKind.DRIVE_SAMPLE_BLOCK))
        out.samples = [self._piece(run) for run in runs]
        return out

    def finish(self) -> Pieces:
        """Nothing more comes."""
        return Pieces()

    def _piece(self, run: SampleRun) -> SamplePiece:
        filled, clipped = run.filled != 0, run.doubt & CLIPPED != 0
        number = self._number.numbers(run.counter, run.gap, run.t_ns, run.sample_rate)
        return SamplePiece(run.sample_rate, run.counter, number, run.t_ns, run.values, filled, clipped,
                           ~filled & ~clipped & (run.doubt & _IN_DOUBT == 0))

    def _reports(self, block: FrameBlock, reference: NDArray[np.intp], status: NDArray[np.intp],
                 out: Pieces) -> None:
        if reference.size:
            value = self._decoded(MessageKind.DRIVE_REFERENCE, block, reference)
            counter, theta = value["sample_counter"], value["theta_e"]
            good = np.isfinite(theta) & np.isfinite(counter) & (np.abs(counter) < WRAP)
            out.encoder.append(EncoderPiece(block.t_ns[reference][good], counter[good].astype(np.int64),
                                            theta[good], value["omega_e"][good]))
        if status.size:
            value = self._decoded(MessageKind.DRIVE_STATUS, block, status)
            out.status.append(StatusPiece(block.t_ns[status], value["mode"], value["v_dc"], value["temperature"],
                                          value["faults"], value["active_waveform"]))

    def _decoded(self, kind: MessageKind, block: FrameBlock, rows: NDArray[np.intp]) -> dict[str, Floats]:
        codec = self._protocol.codecs[kind]
        values, _, _ = self._protocol.decode(kind, self.node, block.raw, rows)
        return {name: values[row] for name, row in codec.index.items()}

    @property
    def waiting(self) -> bool:
        """Samples came, but nothing that says their rate."""
        return self.receiver.sequencer.waiting

    @property
    def counts(self) -> Mapping[str, int]:
        """What came and what went wrong, by name."""
        sequencer = self.receiver.sequencer
        return {**{name: int(n) for name, n in zip(COUNTERS, sequencer.counts, strict=True)},
                "bad_frames": self.receiver.bad_frames, "frames": self.frames, "unknown": self.unknown,
                "error_frames": self.errors, "wrong_length": self.wrong_length}


class MapPieces:
    """Frames of any inverter through its map.  rate: samples per second, which a survey of the log found."""

    def __init__(self, plan: Plan, rate: float) -> None:
        self.mapper = Mapper(plan, rate)
        self._rate = rate
        self._number = SampleCount()
        self._received = self._lost = self._apart = self._impossible = 0
        self.waiting = False

    def feed(self, block: FrameBlock) -> Pieces:
        """Take in the next frames."""
        return self._pieces(self.mapper.feed(block))

    def finish(self) -> Pieces:
        """Nothing more comes: the samples that wait for later reports."""
        return self._pieces(self.mapper.flush())

    def _pieces(self, b: MappedBlock) -> Pieces:
        out = Pieces()
        if not len(b):
            return out
        values = np.stack([b.i_alpha, b.i_beta, b.v_alpha, b.v_beta])
        finite = np.isfinite(values).all(axis=0)
        near = b.quality & (CURRENT_APART | VOLTAGE_APART) == 0
        self._received += len(b)
        self._lost += int(b.gap[b.gap < RESTARTED].sum())
        self._apart += int(np.count_nonzero(~near))
        self._impossible += int(np.count_nonzero(~finite))
        none = np.zeros(len(b), np.bool_)
        number = self._number.numbers(b.sample, b.gap, b.t_ns, self._rate)
        out.samples.append(SamplePiece(self._rate, b.sample, number, b.t_ns, values, none, none, finite & near))
        measured = np.isfinite(b.theta_encoder) & (b.quality & ANGLE_APART == 0)
        if measured.any():
            out.encoder.append(EncoderPiece(b.t_ns[measured], b.sample[measured], b.theta_encoder[measured],
                                            b.omega_e[measured]))
        told = np.isfinite(b.v_dc) | np.isfinite(b.temperature)
        # Reported values stand still between two frames: only what is new says anything.
        told[1:] &= (b.v_dc[1:] != b.v_dc[:-1]) | (b.temperature[1:] != b.temperature[:-1])
        if told.any():
            nothing = np.full(int(np.count_nonzero(told)), np.nan)
            out.status.append(StatusPiece(b.t_ns[told], nothing, b.v_dc[told], b.temperature[told], nothing,
                                          nothing))
        return out

    @property
    def counts(self) -> Mapping[str, int]:
        """What came and what went wrong, by name."""
        return {"received": self._received, "lost": self._lost, "apart": self._apart,
                "impossible": self._impossible, "duplicates": self.mapper.dropped,
                "frames": int(self.mapper.frames.sum()) + self.mapper.foreign, "unknown": self.mapper.foreign}
