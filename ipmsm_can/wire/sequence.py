"""From sample frames in order of arrival to samples in order of time.

Time comes from the drive's sample counter.  A classical DriveSample carries its low four bits, so a longer
silence leaves open how many whole wraps went by: the arrival time gives the first guess.  A guess that was
too high shows when samples then seem to arrive before they were taken; in any case the 32-bit counter of the
next DriveTiming settles it.  A DriveSampleBlock carries the whole counter.

What can happen, and what is done:

    lost, at most max_gap       and FILLED_S long: filled by straight lines between the neighbours, marked as filled
    lost, more                  `gap` tells the estimator how many are missing: its filters restart
    duplicate                   dropped
    reordered (late)            dropped: its place was filled already
    wraps guessed wrong         put right by DriveTiming, filters restart          (resync)
    drive restarted             counter jumps back or far ahead: everything anew   (restart)

A drive that measures its sample rate never states the same one twice: statements within RATE_TOLERANCE of the
rate in force are the same sampling and interrupt nothing.  The rate in force, which the estimator's coefficients
hang on, stays; the latest statement paces the guesses from arrival times, which would run away from it.

Everything is counted.  Samples that arrive before the sample rate is known wait (see `SampleSequencer`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.wire.sequence_kernel import (
    BAD_RATE,
    COUNTERS,
    FULL,
    KIND_BITS,
    NIBBLE,
    OVERFLOW,
    RATE_MAX,
    RATE_MIN,
    SEQUENCED,
    STATE,
    TIMING,
    WRAP,
    sequence,
    settled,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PENDING_MAX = 1 << 17
"""Events kept while the sample rate is unknown."""
_PIECES_MAX = 256


@dataclass(frozen=True, slots=True)
class Events:
    """Sample and timing frames of one drive in order of arrival, N events.

    kind (N,) int64: NIBBLE, TIMING or FULL; CLIPPED is added to that of a sample which was cut off.
    counter (N,) int64: 4 or 32 bits.  rate (N,) float64 [Hz], for TIMING.  t_ns (N,) int64 arrival time [ns].
    values (4, N): i_alpha, i_beta [A], v_alpha, v_beta [V].
    """

    kind: Ints
    counter: Ints
    rate: Floats
    t_ns: Ints
    values: Floats

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, which: slice | NDArray[np.bool_]) -> Events:
        """The chosen events, in order."""
        return Events(self.kind[which], self.counter[which], self.rate[which], self.t_ns[which],
                      np.ascontiguousarray(self.values[:, which]))

    @classmethod
    def joined(cls, parts: Sequence[Events]) -> Events:
        """All of them, one after the other; at least one."""
        return cls(np.concatenate([p.kind for p in parts]), np.concatenate([p.counter for p in parts]),
                   np.concatenate([p.rate for p in parts]), np.concatenate([p.t_ns for p in parts]),
                   np.concatenate([p.values for p in parts], axis=1))


@dataclass(frozen=True, slots=True)
class SampleRun:
    """Samples in order of time, M of them, all at one sample rate.

    sample_rate [Hz].  counter (M,) int64: the drive's 32-bit counter.  values (4, M), C-contiguous.
    filled (M,) uint8: 1 where interpolated.  gap (M,) int64: samples missing right before this one (0 where
    none, RESTARTED after a restart of the drive; negative where the samples before it turn out to have been
    dated wrong, by so many samples).
    doubt (M,) uint8: 1 while the counter, so the time, may be wrong by whole wraps: after a silence that could be
    loss or lateness, until DriveTiming or the pace of arrival settles it.  CLIPPED is added where the sample, or
    the one that a filled one leads to, was cut off at the end of its range.
    t_ns (M,) int64: arrival of the frame (filled: of the frame that closed the gap).
    """

    sample_rate: float
    counter: Ints
    values: Floats
    filled: NDArray[np.uint8]
    doubt: NDArray[np.uint8]
    gap: Ints
    t_ns: Ints


class SampleSequencer:
    """Sequencing of one drive's samples, with its state and counters.

    max_gap: longest loss, in samples, that is filled by interpolation, 0..64, if it is not longer than FILLED_S.
    sample_rate: [Hz], used where the drive sends no DriveTiming, or states nearly the same there; None: samples
    wait for the first one, at most PENDING_MAX of them, and then get the right 32-bit counters in hindsight.
    """

    def __init__(self, max_gap: int, sample_rate: float | None = None) -> None:
        self.max_gap = max_gap
        self.counts = np.zeros(len(COUNTERS), np.int64)
        self._fallback_rate = sample_rate
        self._state = np.zeros(1, STATE)
        self._pending: list[Events] = []

    def count(self, name: str) -> int:
        """One of COUNTERS."""
        return int(self.counts[COUNTERS.index(name)])

    @property
    def state(self) -> NDArray[np.void]:
        """Record array (1,) of STATE, which `sequence` works on."""
        return self._state

    @property
    def sample_rate(self) -> float:
        """Sample rate in force [Hz]; 0 while unknown."""
        return float(self._state["rate"][0])

    @property
    def waiting(self) -> bool:
        """True while samples have come but no sample rate."""
        return any(map(len, self._pending))

    def push(self, events: Events) -> list[SampleRun]:
        """Take in events; returns the samples they complete, in runs of one sample rate each."""
        if not len(events):
            return []
        if self.sample_rate == 0.0 and self._fallback_rate is not None:
            self._state["rate"] = self._state["pace"] = self._fallback_rate
        if self.sample_rate == 0.0:
            events = self._believed(events)
            self._pending.append(events)
            timings = np.flatnonzero(events.kind == TIMING)
            if not timings.size:
                self._bound()
                return []
            before = sum(map(len, self._pending)) - len(events)
            events = Events.joined(self._pending)
            self._pending = []
            self._synchronise(events, before + int(timings[0]))
        return self._run(events)

    def _believed(self, events: Events) -> Events:
        """Without the timings that cannot be; they would make a drive without samples look as if it had some."""
        wrong = (events.kind == TIMING) & ~((events.rate >= RATE_MIN) & (events.rate <= RATE_MAX))
        if not wrong.any():
            return events
        self.counts[BAD_RATE] += int(wrong.sum())
        return events.take(~wrong)

    def _bound(self) -> None:
        """Keep the newest PENDING_MAX events, in few pieces; seldom, as it copies them all."""
        over = sum(map(len, self._pending)) - PENDING_MAX
        if len(self._pending) <= _PIECES_MAX and over < _PIECES_MAX:
            return
        together = Events.joined(self._pending)
        if over > 0:
            self.counts[OVERFLOW] += over
            together = together.take(slice(over, None))
        self._pending = [together]

    def _synchronise(self, events: Events, timing: int) -> None:
        """Give the samples before the first DriveTiming the counters they must have had."""
        self._state["rate"] = self._state["pace"] = events.rate[timing]
        kinds = events.kind[:timing] & KIND_BITS
        nibbles = np.flatnonzero(kinds == NIBBLE)
        if not nibbles.size or (kinds == FULL).any():
            return
        before = events.take(slice(0, timing))
        trial = SampleSequencer(0)
        trial._state["rate"] = trial._state["pace"] = self._state["rate"]
        runs = trial._run(before)
        if not runs:
            return
        first = int(runs[0].counter[0])
        last = int(runs[-1].counter[-1])
        sent = int(events.counter[timing])
        self._state["has_floor"] = 1
        self._state["floor"] = (settled(last, sent) - last + first) % WRAP

    def _run(self, events: Events) -> list[SampleRun]:
        runs: list[SampleRun] = []
        begin = 0
        while begin < len(events):
            room = (len(events) - begin) * (self.max_gap + 1)
            rate = self.sample_rate
            counter = np.empty(room, np.int64)
            values = np.empty((4, room))
            filled = np.empty(room, np.uint8)
            doubt = np.empty(room, np.uint8)
            gap = np.empty(room, np.int64)
            t_ns = np.empty(room, np.int64)
            m, begin, why = sequence(begin, events.kind, events.counter, events.rate, events.t_ns,
                                     events.values, self.max_gap, self._state, self.counts,
                                     counter, values, filled, doubt, gap, t_ns)
            if m:
                runs.append(SampleRun(rate, counter[:m], np.ascontiguousarray(values[:, :m]), filled[:m],
                                      doubt[:m], gap[:m], t_ns[:m]))
            if why == SEQUENCED:
                break
        return runs
