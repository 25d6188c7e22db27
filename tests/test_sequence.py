"""Sequencing against a simulated sender that knows what it sent."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.wire.sequence import PENDING_MAX, Events, SampleRun, SampleSequencer
from ipmsm_can.wire.sequence_kernel import FILLED_S, FULL, NIBBLE, RESTARTED, TIMING

RATE = 5000.0
PERIOD_NS = int(1e9 / RATE)
STEPS = st.integers(1, 40).filter(lambda step: step == 1 or step % 16 != 1)
"""Without the loss of whole wraps, which only DriveTiming can tell from a stall."""


def value(counter: int) -> list[float]:
    """A sample that says who it is; straight lines survive interpolation exactly enough."""
    return [0.01 * counter, -0.02 * counter, 1.0 * counter, 5.0]


@dataclass
class Sender:
    """Makes events; `first` is the 32-bit counter of sample 0 of the list index."""

    rows: list[tuple[int, int, float, int, list[float]]] = field(default_factory=list)

    def sample(self, counter: int, t_ns: int | None = None, full: bool = False) -> None:
        t = counter * PERIOD_NS if t_ns is None else t_ns
        self.rows.append((FULL if full else NIBBLE, counter if full else counter & 15, 0.0, t, value(counter)))

    def timing(self, counter: int, rate: float = RATE, t_ns: int | None = None) -> None:
        t = counter * PERIOD_NS if t_ns is None else t_ns
        self.rows.append((TIMING, counter & 0xFFFFFFFF, rate, t, [0.0] * 4))

    def events(self) -> Events:
        kind, counter, rate, t, values = (list(c) for c in zip(*self.rows, strict=True))
        self.rows = []
        return Events(np.array(kind, np.int64), np.array(counter, np.int64), np.array(rate, float),
                      np.array(t, np.int64), np.ascontiguousarray(np.array(values, float).T))


def one(runs: list[SampleRun]) -> SampleRun:
    assert len(runs) == 1
    return runs[0]


def synced(first: int = 1000, max_gap: int = 8) -> tuple[SampleSequencer, Sender]:
    """A sequencer that has seen a DriveTiming and the sample `first`."""
    sequencer, sender = SampleSequencer(max_gap), Sender()
    sender.timing(first - 1)
    sender.sample(first)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [first]
    return sequencer, sender


def test_unbroken() -> None:
    sequencer, sender = synced()
    for k in range(1001, 1101):
        sender.sample(k)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == list(range(1001, 1101))
    assert not run.filled.any()
    assert not run.gap.any()
    assert run.sample_rate == RATE
    assert sequencer.count("lost") == 0


def test_short_loss_is_filled_by_straight_lines() -> None:
    sequencer, sender = synced()
    for k in (1001, 1002, 1007, 1008):
        sender.sample(k)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == list(range(1001, 1009))
    assert run.filled.tolist() == [0, 0, 1, 1, 1, 1, 0, 0]
    expected = np.array([value(k) for k in range(1001, 1009)]).T
    assert np.allclose(run.values, expected, rtol=1e-12)
    assert (sequencer.count("lost"), sequencer.count("filled")) == (4, 4)


def test_long_loss_leaves_a_gap_whose_wraps_the_arrival_time_tells() -> None:
    for missing in (9, 15, 17, 100, 1000):
        sequencer, sender = synced()
        sender.sample(1001)
        sender.sample(1002 + missing)
        sender.sample(1003 + missing)
        run = one(sequencer.push(sender.events()))
        assert run.counter.tolist() == [1001, 1002 + missing, 1003 + missing], missing
        assert run.gap.tolist() == [0, missing, 0]
        assert sequencer.count("lost") == missing
        assert sequencer.count("filled") == 0


def test_a_sender_that_stood_still_for_a_moment_has_lost_nothing() -> None:
    """Nothing for 8, 60 or 400 ms, then everything at once, as from a busy computer: no gap."""
    for late in (40, 300, 2000):
        sequencer, sender = synced()
        for k in range(1001, 3401):
            sender.sample(k, t_ns=max(k, 1001 + late) * PERIOD_NS)
        run = one(sequencer.push(sender.events()))
        assert run.counter.tolist() == list(range(1001, 3401))
        assert not run.gap.any()
        assert [sequencer.count(name) for name in ("lost", "gaps", "resyncs", "reordered")] == [0, 0, 0, 0]


def test_loss_of_whole_wraps_looks_like_a_stall_until_the_next_timing() -> None:
    sequencer, sender = synced()
    sender.sample(1033)
    assert one(sequencer.push(sender.events())).counter.tolist() == [1001]
    sender.timing(1033)
    sender.sample(1034)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [1034]
    assert run.gap.tolist() == [-32]
    assert sequencer.count("lost") == 32


def test_timing_settles_wraps_that_the_arrival_time_hides() -> None:
    """All frames carry the same time stamp: 32 lost samples look like none until DriveTiming."""
    sequencer, sender = synced()
    frozen = 1000 * PERIOD_NS
    sender.timing(1033, t_ns=frozen)
    sender.sample(1034, t_ns=frozen)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [1034]
    assert run.gap.tolist() == [33]


def test_timing_corrects_a_gap_that_was_guessed_too_long() -> None:
    """A reader that stalled for long stamps late: the guess is whole wraps too far; DriveTiming puts it right."""
    sequencer, sender = synced()
    sender.sample(1001, t_ns=4201 * PERIOD_NS)
    assert one(sequencer.push(sender.events())).counter.tolist() == [4201]
    sender.timing(1001, t_ns=4201 * PERIOD_NS)
    sender.sample(1002, t_ns=4202 * PERIOD_NS)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [1002]
    assert run.gap.tolist() == [-3200]
    assert sequencer.count("resyncs") == 1
    assert sequencer.count("lost") == 0


def test_a_late_burst_with_a_loss_is_seen_through_before_timing_comes() -> None:
    """One sample lost, then 40 late ones: guessed 33 lost, put right when they come faster than time."""
    sequencer, sender = synced()
    for k in range(1002, 1060):
        sender.sample(k, t_ns=max(k, 1034) * PERIOD_NS)
    run = one(sequencer.push(sender.events()))
    assert run.counter[0] == 1034
    assert run.counter[-1] == 1059
    assert sequencer.count("lost") == 1
    assert sequencer.count("resyncs") == (run.gap < 0).sum() >= 1


def test_duplicates_and_late_frames_are_dropped_and_told_apart() -> None:
    sequencer, sender = synced()
    sender.sample(1001)
    sender.sample(1001, t_ns=1001 * PERIOD_NS + 10)
    sender.sample(1003)
    sender.sample(1002, t_ns=1003 * PERIOD_NS + 10)
    sender.sample(1001, t_ns=1003 * PERIOD_NS + 20)
    sender.sample(1004)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [1001, 1002, 1003, 1004]
    assert run.filled.tolist() == [0, 1, 0, 0]
    assert sequencer.count("duplicates") == 2
    assert sequencer.count("reordered") == 1


def test_samples_before_the_first_timing_get_their_counters_in_hindsight() -> None:
    sequencer, sender = SampleSequencer(8), Sender()
    for k in range(70_003, 70_050):
        sender.sample(k)
    assert sequencer.push(sender.events()) == []
    assert sequencer.waiting
    sender.sample(70_050)
    sender.timing(70_051)
    sender.sample(70_052)
    runs = sequencer.push(sender.events())
    assert np.concatenate([r.counter for r in runs]).tolist() == list(range(70_003, 70_053))
    assert sequencer.count("lost") == 1
    assert not sequencer.waiting


def test_waiting_is_bounded() -> None:
    sequencer = SampleSequencer(0)
    n = PENDING_MAX + 500
    counter = np.arange(n, dtype=np.int64)
    zeros = np.zeros(n)
    assert sequencer.push(Events(np.zeros(n, np.int64), counter & 15, zeros, counter * PERIOD_NS,
                                 np.zeros((4, n)))) == []
    assert sequencer.count("overflow") == 500
    sender = Sender()
    sender.timing(n - 1)
    run = one(sequencer.push(sender.events()))
    assert run.counter[0] == 500
    assert run.counter[-1] == n - 1


def test_waiting_for_timing_sample_by_sample_keeps_the_newest() -> None:
    """As on a live bus whose drive sends no DriveTiming for half a minute."""
    n = PENDING_MAX + 1000
    sequencer = SampleSequencer(0)
    values = np.zeros((4, 1))
    for k in range(n):
        events = Events(np.zeros(1, np.int64), np.array([k & 15]), np.zeros(1), np.array([k * PERIOD_NS]), values)
        assert sequencer.push(events) == []
    assert sequencer.waiting
    sender = Sender()
    sender.timing(n - 1)
    run = one(sequencer.push(sender.events()))
    assert run.counter[-1] == n - 1
    assert np.array_equal(np.diff(run.counter), np.ones(run.counter.size - 1))
    assert PENDING_MAX <= run.counter.size <= PENDING_MAX + 256
    assert run.counter.size + sequencer.count("overflow") == n
    assert not sequencer.waiting


def test_the_first_timing_may_be_overtaken_by_samples() -> None:
    """DriveSample has the higher priority: up to three of them may go before an older DriveTiming."""
    for overtaken in range(4):
        for rate in (None, RATE):
            sequencer, sender = SampleSequencer(8, sample_rate=rate), Sender()
            for k in range(4000, 4010):
                sender.sample(k)
            sender.timing(4009 - overtaken, t_ns=4009 * PERIOD_NS)
            sender.sample(4010)
            counters = np.concatenate([r.counter for r in sequencer.push(sender.events())]).tolist()
            assert counters[-1] == 4010
            assert rate or counters == list(range(4000, 4011))
            assert sequencer.count("lost") == 0


def test_a_timing_that_cannot_be_is_counted_at_once() -> None:
    sequencer, sender = SampleSequencer(8), Sender()
    for rate in (0.0, 99.9, 100_001.0):
        sender.timing(5, rate)
    assert sequencer.push(sender.events()) == []
    assert sequencer.count("bad_rate") == 3
    assert not sequencer.waiting
    sender.sample(6)
    sender.timing(6)
    assert one(sequencer.push(sender.events())).counter.tolist() == [6]
    assert sequencer.count("bad_rate") == 3


def test_configured_rate_serves_until_timing_comes() -> None:
    sequencer, sender = SampleSequencer(8, sample_rate=RATE), Sender()
    for k in range(2005, 2010):
        sender.sample(k)
    run = one(sequencer.push(sender.events()))
    assert (run.counter & 15).tolist() == [k & 15 for k in range(2005, 2010)]
    sender.timing(2009)
    sender.sample(2010)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [2010]
    assert not run.gap.any()
    assert sequencer.count("restarts") == 0


def test_configured_rate_does_not_depend_on_blocks() -> None:
    """A DriveTiming in the same block as the first samples changes nothing."""
    counters = []
    for together in (True, False):
        sequencer, sender = SampleSequencer(8, sample_rate=RATE), Sender()
        runs = []
        for k in range(2005, 2010):
            sender.sample(k)
        if not together:
            runs += sequencer.push(sender.events())
        sender.timing(2009)
        sender.sample(2010)
        runs += sequencer.push(sender.events())
        counters.append(np.concatenate([r.counter for r in runs]).tolist())
    assert counters[0] == counters[1]
    assert counters[0][-1] == 2010


def test_a_clock_that_was_set_back_stops_nothing() -> None:
    sequencer, sender = SampleSequencer(8, sample_rate=RATE), Sender()
    for k in range(100):
        hour = 3600 * 10**9 if k < 50 else 0
        sender.sample(k, t_ns=hour + k * PERIOD_NS)
    run = one(sequencer.push(sender.events()))
    assert run.counter.size == 100 and not run.gap.any()
    assert sequencer.count("reordered") == 0


def test_restarted_drive() -> None:
    sequencer, sender = synced(1_000_000)
    sender.timing(3, t_ns=1_000_100 * PERIOD_NS)
    sender.sample(4, t_ns=1_000_101 * PERIOD_NS)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [4]
    assert run.gap.tolist() == [RESTARTED]
    assert sequencer.count("restarts") == 1


def test_change_of_rate_ends_a_run() -> None:
    sequencer, sender = synced()
    sender.sample(1001)
    sender.timing(1001, rate=10_000.0)
    sender.sample(1002)
    runs = sequencer.push(sender.events())
    assert [r.sample_rate for r in runs] == [5000.0, 10_000.0]
    assert runs[1].gap.tolist() == [RESTARTED]


@pytest.mark.parametrize("configured", [None, RATE])
def test_a_rate_that_the_drive_measures_is_one_rate(configured: float | None) -> None:
    """Statements that jitter: one run, at the first rate, as if the drive had stated that one again and again."""
    rng = np.random.default_rng(5)
    found = []
    for jitter in (0.0, 1.0):
        sequencer, sender = SampleSequencer(8, configured), Sender()
        for k in range(1000, 3000):
            if k % 50 == 0:
                sender.timing(k - 1, RATE if k == 1000 else RATE + jitter * rng.uniform(-4.9, 4.9))
            if k % 97:
                sender.sample(k)
        found.append(one(sequencer.push(sender.events())))
        assert sequencer.count("restarts") == sequencer.count("resyncs") == 0
    plain, measured = found
    assert measured.sample_rate == sequencer.sample_rate == RATE
    assert not measured.gap.any() and not measured.doubt.any()
    for name in ("counter", "values", "filled"):
        assert np.array_equal(getattr(measured, name), getattr(plain, name)), name


def test_a_configured_rate_gives_way_only_to_one_that_is_another() -> None:
    for stated, kept in ((4999.7, True), (5004.9, True), (5006.0, False)):
        sequencer, sender = SampleSequencer(8, RATE), Sender()
        sender.sample(1000)
        sender.timing(1000, stated)
        sender.sample(1001)
        runs = sequencer.push(sender.events())
        assert [r.sample_rate for r in runs] == ([RATE] if kept else [RATE, stated])
        assert sequencer.count("restarts") == (not kept)


def test_drift_of_the_rate_is_measured_from_the_first() -> None:
    """Small steps add up: past the tolerance it is another rate."""
    sequencer, sender = synced()
    for k in range(1, 21):
        sender.timing(1000 + k, RATE + k)
        sender.sample(1001 + k, t_ns=(1001 + k) * PERIOD_NS)
    runs = sequencer.push(sender.events())
    assert [r.sample_rate for r in runs] == [RATE, RATE + 6, RATE + 12, RATE + 18]
    assert [r.gap[0] for r in runs] == [0, *[RESTARTED] * 3]


@pytest.mark.parametrize("off", [-0.9e-3, 0.9e-3])
def test_the_latest_statement_paces_arrival(off: float) -> None:
    """First stated 0.9e-3 off, then right.  A minute on, arrival times still tell wraps apart: by the first
    statement alone they would have run 270 samples away, and every sample would look late or early by wraps."""
    sequencer, sender = SampleSequencer(8), Sender()
    first = 3_000_000_000
    sender.timing(first, RATE * (1.0 + off))
    sender.timing(first, RATE)
    n = 60 * int(RATE)
    k = np.arange(first + 1, first + 1 + n, dtype=np.int64)
    before = sender.events()
    samples = Events(np.zeros(n, np.int64), k & 15, np.zeros(n), k * PERIOD_NS, np.zeros((4, n)))
    run = one(sequencer.push(Events.joined([before, samples])))
    assert np.array_equal(run.counter, k) and not run.doubt.any()
    # A hair's change of the rate is no change of the time of day, however far the counter has come.
    sender.timing(int(k[-1]), RATE * (1.0 - 0.1 * off))
    # A sender held up for 20 samples, who then catches up: doubted until it has, and no longer.
    for j in range(int(k[-1]) + 1, int(k[-1]) + 101):
        sender.sample(j, t_ns=max(j, int(k[-1]) + 21) * PERIOD_NS)
    late = one(sequencer.push(sender.events()))
    assert late.doubt[0] and not late.doubt[20:].any()
    assert np.array_equal(late.counter, np.arange(k[-1] + 1, k[-1] + 101))
    assert sequencer.count("lost") == sequencer.count("resyncs") == 0


@given(st.lists(st.tuples(STEPS, st.booleans(), st.floats(-6.0, 6.0)), min_size=1, max_size=80),
       st.lists(st.integers(1, 30), min_size=1, max_size=20))
def test_a_jittering_rate_gives_the_same_bits_in_any_blocks(steps: list[tuple[int, bool, float]],
                                                            cuts: list[int]) -> None:
    sender = Sender()
    sender.timing(99)
    k = 100
    for step, timed, off in steps:
        sender.sample(k)
        if timed:
            sender.timing(k, RATE + off)
        k += step
    events = sender.events()
    whole = SampleSequencer(4)
    expected = whole.push(events)
    parts, begin = SampleSequencer(4), 0
    runs: list[SampleRun] = []
    while begin < len(events):
        end = begin + cuts[begin % len(cuts)]
        runs += parts.push(events.take(slice(begin, end)))
        begin = end
    assert np.array_equal(parts.state, whole.state) and np.array_equal(parts.counts, whole.counts)
    for name in ("counter", "values", "filled", "doubt", "gap", "t_ns"):
        assert np.array_equal(np.concatenate([getattr(r, name) for r in runs], axis=-1),
                              np.concatenate([getattr(r, name) for r in expected], axis=-1)), name
    rates = [np.repeat([r.sample_rate for r in each], [r.counter.size for r in each]) for each in (runs, expected)]
    assert np.array_equal(rates[0], rates[1])


def test_absurd_rates_are_refused() -> None:
    sequencer, sender = synced()
    for rate in (0.0, 50.0, 4e6, float("nan"), float("inf")):
        sender.timing(1000, rate=rate)
    sender.sample(1001)
    run = one(sequencer.push(sender.events()))
    assert run.sample_rate == RATE
    assert sequencer.count("bad_rate") == 5


def test_the_32_bit_counter_wraps() -> None:
    for full in (False, True):
        sequencer, sender = synced(0xFFFF_FFF0)
        for k in range(0xFFFF_FFF1, 0x1_0000_0010):
            sender.sample(k & 0xFFFF_FFFF if full else k, t_ns=k * PERIOD_NS, full=full)
        sender.timing(0x1_0000_000F)
        sender.sample(0x1_0000_0010 & 0xFFFF_FFFF if full else 0x1_0000_0010, t_ns=0x1_0000_0010 * PERIOD_NS,
                      full=full)
        run = one(sequencer.push(sender.events()))
        assert run.counter.tolist() == [k & 0xFFFF_FFFF for k in range(0xFFFF_FFF1, 0x1_0000_0011)]
        assert sequencer.count("restarts") == 0
        assert sequencer.count("resyncs") == 0


def test_whole_counters_need_no_guess() -> None:
    sequencer, sender = synced()
    frozen = 1000 * PERIOD_NS
    sender.sample(1001, frozen, full=True)
    sender.sample(1500, frozen, full=True)
    sender.sample(1500, frozen, full=True)
    sender.sample(1001, frozen, full=True)
    run = one(sequencer.push(sender.events()))
    assert run.counter.tolist() == [1001, 1500]
    assert run.gap.tolist() == [0, 498]
    assert sequencer.count("duplicates") + sequencer.count("reordered") == 2


@given(st.integers(0, 2**32 - 1), st.lists(STEPS, min_size=1, max_size=60),
       st.lists(st.integers(1, 30), min_size=1, max_size=20), st.integers(0, 20))
def test_losses_of_any_length_keep_the_counter_true(first: int, steps: list[int], cuts: list[int],
                                                    max_gap: int) -> None:
    """Random losses, arrival jitter up to a few samples, random blocks: counters true, nothing invented."""
    rng = np.random.default_rng(len(steps))
    sender = Sender()
    sender.timing(first - 1, t_ns=0)
    absolute = first
    sent = []
    for step in steps:
        sent.append(absolute)
        jitter = int(rng.integers(0, 3 * PERIOD_NS))
        sender.sample(absolute, t_ns=(absolute - first) * PERIOD_NS + jitter)
        absolute += step
    events = sender.events()
    sequencer = SampleSequencer(max_gap)
    runs: list[SampleRun] = []
    begin = 0
    while begin < len(events):
        size = cuts[begin % len(cuts)]
        rest = events.take(slice(begin, None))
        runs += sequencer.push(Events(rest.kind[:size], rest.counter[:size], rest.rate[:size],
                                      rest.t_ns[:size], np.ascontiguousarray(rest.values[:, :size])))
        begin += size
    counter = np.concatenate([r.counter for r in runs])
    filled = np.concatenate([r.filled for r in runs]).astype(bool)
    assert counter[~filled].tolist() == [c & 0xFFFFFFFF for c in sent]
    assert sequencer.count("lost") == sum(steps[:-1]) - len(steps) + 1
    expected = sum(s - 1 for s in steps[:-1] if s - 1 <= min(max_gap, RATE * FILLED_S))
    assert int(filled.sum()) == expected == sequencer.count("filled")
    assert np.isfinite(np.concatenate([r.values for r in runs], axis=1)).all()


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2**32 - 1), st.floats(0, 4.2e6),
                          st.integers(-(2**62), 2**62)), max_size=200))
def test_nonsense_never_raises(rows: list[tuple[int, int, float, int]]) -> None:
    n = len(rows)
    kind = np.array([r[0] for r in rows], np.int64)
    counter = np.array([r[1] for r in rows], np.int64)
    counter[kind == NIBBLE] &= 15
    events = Events(kind, counter, np.array([r[2] for r in rows], float),
                    np.array([r[3] for r in rows], np.int64), np.ones((4, n)))
    sequencer = SampleSequencer(8)
    for run in sequencer.push(events):
        assert (run.counter >= 0).all()
        assert (run.counter < 2**32).all()
        assert (run.gap >= 0).all()
        assert np.isfinite(run.values).all()
