"""A recorded bus through the companion: rows for a file, and counts for a person.

Nothing is transmitted and nothing waits for a clock, so a log runs as fast as the machine computes.  The rows
depend on the frames alone, not on the blocks they come in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.absence import Identifiers
from ipmsm_can.bus.rows import RowBlock
from ipmsm_can.companion import Companion
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.estimation.observers import ges
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import NODES, MessageKind, Protocol
from ipmsm_can.wire.sequence import SampleRun
from ipmsm_can.wire.sequence_kernel import LONGEST_SILENCE, RESTARTED

TIMING_WITHIN_NS = 2_000_000_000
"""A drive.toml's sample_rate counts only if the log has no DriveTiming of the drive within this time."""
_REFERENCES_KEPT = 1 << 16
_ROWS_KEPT = 4096
_WRAP = 1 << 32

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Sink = Callable[[int, RowBlock], None]
"""Called with a node's number and its next rows."""


class SampleClock:
    """Time of samples from their counters, 0 at the first one: monotone, and free of the jitter of arrival.

    Within a stretch of counters the time is the counter over the sample rate.  Where counters say nothing -
    the drive restarted, the rate changed, or a counter was put right backwards - the time between the two
    arrivals bridges the step, at least one sample period.
    """

    def __init__(self) -> None:
        self._anchor = 0.0
        self._base = 0
        self._rate = 0.0
        self._last = 0
        self._last_arrival = 0

    def times(self, run: SampleRun) -> Floats:
        """float64 (M,) times [s] of the samples of a run."""
        counter, n = run.counter, run.counter.size
        step = np.empty(n, np.int64)
        step[1:] = np.diff(counter)
        step[0] = counter[0] - self._last
        step[step < -(_WRAP // 2)] += _WRAP
        step[(run.gap == 0) & (step != 1)] = 1
        broken = (run.gap >= RESTARTED) | (step <= 0) | (step > LONGEST_SILENCE * run.sample_rate)
        if run.sample_rate != self._rate:
            broken[0] = True
        # Counted from the start of the present stretch, so that a block boundary changes no bit.
        position = np.cumsum(np.where(broken, 0, step))
        out = np.empty(n)
        breaks = np.flatnonzero(broken).tolist()
        for begin, end in zip([0, *breaks], [*breaks, n], strict=True):
            if begin == end:
                continue
            if broken[begin]:
                self._bridge(run, begin, out)
                offset = int(position[begin])
            else:
                offset = -self._base
            out[begin:end] = self._anchor + (position[begin:end] - offset) / self._rate
            self._base = int(position[end - 1]) - offset
        self._last = int(counter[-1])
        self._last_arrival = int(run.t_ns[-1])
        return out

    def _bridge(self, run: SampleRun, k: int, out: Floats) -> None:
        if self._rate == 0.0:
            self._anchor = 0.0
        else:
            before = out[k - 1] if k else self._anchor + self._base / self._rate
            arrival = int(run.t_ns[k - 1]) if k else self._last_arrival
            silence = 1e-9 * (int(run.t_ns[k]) - arrival)
            self._anchor = float(before) + max(1.0 / run.sample_rate, silence)
        self._rate = run.sample_rate
        self._base = 0


class EncoderComparison:
    """The estimate against the drive's own DriveReference frames, matched by sample counter.

    Counted are samples whose estimate was valid.  error: estimate minus encoder [rad electrical].
    """

    def __init__(self) -> None:
        self.references = 0
        self.compared = 0
        self.largest = 0.0
        self._squares = 0.0
        self._counter = np.zeros(0, np.int64)
        self._theta = np.zeros(0)
        self._rows = (np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.bool_))

    @property
    def rms(self) -> float:
        """Root mean square of the error [rad electrical]; NaN while nothing was compared."""
        return math.sqrt(self._squares / self.compared) if self.compared else math.nan

    def reference(self, counter: Ints, theta: Floats) -> None:
        """Encoder angles theta (N,) [rad electrical] at samples `counter` (N,)."""
        good = np.isfinite(theta)
        self.references += int(good.sum())
        self._counter = np.concatenate([self._counter, counter[good]])[-_REFERENCES_KEPT:]
        self._theta = np.concatenate([self._theta, theta[good]])[-_REFERENCES_KEPT:]

    def estimate(self, counter: Ints, theta: Floats, valid: NDArray[np.bool_]) -> None:
        """Estimates theta (N,) [rad electrical] at samples `counter` (N,), in order."""
        old = self._rows
        self._rows = (np.concatenate([old[0], counter]), np.concatenate([old[1], theta]),
                      np.concatenate([old[2], valid]))
        self._match()
        kept = slice(-_ROWS_KEPT, None)
        self._rows = (self._rows[0][kept], self._rows[1][kept], self._rows[2][kept])

    def _match(self) -> None:
        counter, theta, valid = self._rows
        if not self._counter.size or not counter.size:
            return
        order = np.argsort(counter, kind="stable")
        at = np.searchsorted(counter, self._counter, side="right", sorter=order) - 1
        row = order[np.maximum(at, 0)]
        found = (at >= 0) & (counter[row] == self._counter)
        use = found & valid[row]
        error = np.abs((theta[row[use]] - self._theta[use] + np.pi) % (2.0 * np.pi) - np.pi)
        self.compared += error.size
        self._squares += float(error @ error)
        self.largest = max(self.largest, float(error.max(initial=0.0)))
        self._counter, self._theta = self._counter[~found], self._theta[~found]


@dataclass(slots=True)
class NodeSummary:
    """What a replay found of one drive; times are those of the rows [s], None if it never happened."""

    rows: int = 0
    valid: int = 0
    locked: int = 0
    first_locked: float | None = None
    first_valid: float | None = None
    duration: float = 0.0
    sample_rate: float = 0.0
    encoder: EncoderComparison = field(default_factory=EncoderComparison)


class Replay:
    """Feeds blocks of a log to a companion and hands rows to `sink`.

    configs: the drives; `prepare` should have looked at them.  sink: may be None.  tap: is shown each block with
    what was estimated from it.
    summaries, companion: results by node number.  seen: the identifiers of the log.
    """

    def __init__(self, configs: Sequence[DriveConfig], protocol: Protocol, sink: Sink | None = None,
                 tap: Callable[[FrameBlock, Sequence[Tracked]], None] | None = None) -> None:
        self._tap = tap
        self.companion = Companion(configs, protocol, transmit=False)
        self.summaries = {c.wire.node: NodeSummary() for c in configs}
        self.seen = Identifiers()
        self._protocol = protocol
        self._sink = sink
        self._clocks = {c.wire.node: SampleClock() for c in configs}

    def feed(self, block: FrameBlock) -> None:
        """Take in the next frames of the log."""
        if not len(block):
            return
        self.seen.note(block)
        self._references(block)
        tracked = self.companion.feed(block)
        for part in tracked:
            self._rows(part)
        if self._tap is not None:
            self._tap(block, tracked)

    def _references(self, block: FrameBlock) -> None:
        kind = MessageKind.DRIVE_REFERENCE
        codec = self._protocol.codecs[kind]
        label = self._protocol.classify(block.raw)
        for number, summary in self.summaries.items():
            rows = np.flatnonzero(label == kind * NODES + number)
            if rows.size:
                values = codec.decode_rows(block.words, rows)
                summary.encoder.reference(values[codec.index["sample_counter"]].astype(np.int64),
                                          values[codec.index["theta_e"]])

    def _rows(self, part: Tracked) -> None:
        run, e = part.run, part.estimate
        time_s = self._clocks[part.node].times(run)
        valid = (e.flags & confidence.VALID) != 0
        locked = (e.flags & confidence.LOCKED) != 0
        theta = e.angle[speed.THETA_HAT]
        summary = self.summaries[part.node]
        summary.rows += time_s.size
        for name, flag in (("locked", locked), ("valid", valid)):
            count = int(np.count_nonzero(flag))
            setattr(summary, name, getattr(summary, name) + count)
            if count and getattr(summary, f"first_{name}") is None:
                setattr(summary, f"first_{name}", float(time_s[np.argmax(flag)]))
        summary.duration = float(time_s[-1])
        summary.sample_rate = run.sample_rate
        summary.encoder.estimate(run.counter, theta, valid)
        if self._sink is not None:
            self._sink(part.node, RowBlock(
                run.counter, run.filled, time_s, theta, e.angle[speed.OMEGA], valid.view(np.uint8),
                locked.view(np.uint8), part.injecting, e.excitation, e.flux[ges.LAMBDA_A],
                e.flux[ges.LAMBDA_B]))


def prepare(configs: Sequence[DriveConfig], protocol: Protocol,
            blocks: Iterable[FrameBlock]) -> tuple[list[DriveConfig], Iterator[FrameBlock]]:
    """Look ahead in the log for DriveTiming: (configurations to use, all the blocks again).

    The sample_rate of a drive.toml is for drives that send no DriveTiming.  Live, samples before the first
    DriveTiming are taken at that rate, with counters that are relative until it comes; in a log they can
    have the right ones, so the key is dropped where DriveTiming follows within TIMING_WITHIN_NS.
    """
    source = iter(blocks)
    held: list[FrameBlock] = []
    open_nodes = {c.wire.node for c in configs if c.wire.sample_rate is not None}
    timed: set[int] = set()
    first: int | None = None
    while open_nodes - timed:
        block = next(source, None)
        if block is None:
            break
        held.append(block)
        if not len(block):
            continue
        first = int(block.t_ns[0]) if first is None else first
        late = np.flatnonzero(block.t_ns > first + TIMING_WITHIN_NS)
        labels = protocol.classify(block.raw[:late[0]] if late.size else block.raw)
        timed |= {n for n in open_nodes if (labels == MessageKind.DRIVE_TIMING * NODES + n).any()}
        if late.size:
            break
    chosen = [c.model_copy(update={"wire": c.wire.model_copy(update={"sample_rate": None})})
              if c.wire.node in timed else c for c in configs]
    return chosen, _again(held, source)


def _again(held: list[FrameBlock], source: Iterator[FrameBlock]) -> Iterator[FrameBlock]:
    held.reverse()
    while held:
        yield held.pop()
    yield from source
