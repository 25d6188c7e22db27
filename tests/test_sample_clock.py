"""Times of replayed samples: from counters, whatever arrival times and blocks do."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.bus.replay import SampleClock
from ipmsm_can.wire.sequence import SampleRun
from ipmsm_can.wire.sequence_kernel import RESTARTED


def run_of(counter: list[int], gap: list[int] | None = None, t_ms: list[float] | None = None,
           rate: float = 1000.0) -> SampleRun:
    n = len(counter)
    t = np.array(t_ms if t_ms is not None else [float(c) for c in counter]) * 1e6
    return SampleRun(rate, np.array(counter, np.int64), np.zeros((4, n)), np.zeros(n, np.uint8),
                     np.zeros(n, np.uint8), np.array(gap or [0] * n, np.int64), t.astype(np.int64))


def test_clock_counts_samples_not_arrivals() -> None:
    clock = SampleClock()
    run = run_of([70, 71, 72, 75, 76], [0, 0, 0, 2, 0], [0, 5, 5.1, 9, 90])
    assert np.allclose(clock.times(run), [0, 0.001, 0.002, 0.005, 0.006])
    assert np.allclose(clock.times(run_of([77, 78], None, [91, 92])), [0.007, 0.008])


def test_clock_goes_through_the_wrap_of_the_counter() -> None:
    clock = SampleClock()
    last = (1 << 32) - 1
    assert np.allclose(clock.times(run_of([last - 1, last, 0, 1])), [0, 0.001, 0.002, 0.003])
    assert np.allclose(clock.times(run_of([2, 3])), [0.004, 0.005])


def test_clock_bridges_restart_rate_change_and_setting_back_by_arrival() -> None:
    clock = SampleClock()
    clock.times(run_of([1000, 1001], t_ms=[0, 1]))
    assert np.allclose(clock.times(run_of([3, 4], [RESTARTED, 0], [51, 52])), [0.051, 0.052])
    assert np.allclose(clock.times(run_of([5, 6], t_ms=[53, 53.5], rate=2000.0)), [0.053, 0.0535])
    # put right backwards, and the two arrived in the same millisecond: still forwards
    back = clock.times(run_of([-10 + 6, -9 + 6], [1, 0], [53.5, 53.5], rate=2000.0))
    assert np.allclose(back, [0.054, 0.0545])


@given(st.lists(st.integers(1, 30), min_size=1, max_size=60), st.sets(st.integers(1, 59)))
def test_clock_does_not_depend_on_blocks(steps: list[int], cuts: set[int]) -> None:
    counter = np.cumsum(steps).astype(np.int64)
    gap = np.array(steps, np.int64) - 1
    nothing = np.zeros(counter.size, np.uint8)
    run = SampleRun(7000.0, counter, np.zeros((4, counter.size)), nothing, nothing, gap, counter * 142857)
    whole = SampleClock().times(run)
    clock, parts = SampleClock(), []
    edges = [0, *sorted(c for c in cuts if c < counter.size), counter.size]
    for a, b in pairwise(edges):
        parts.append(clock.times(SampleRun(7000.0, counter[a:b], run.values[:, a:b], run.filled[a:b],
                                           run.doubt[a:b], gap[a:b], run.t_ns[a:b])))
    assert np.array_equal(whole, np.concatenate(parts))
    assert (np.diff(whole) > 0).all()
    assert np.allclose(whole, (counter - counter[0]) / 7000.0)
