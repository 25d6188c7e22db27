"""Drift of a clock from jittery arrivals, against clocks of known drift."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.bus.clock import BINS, ClockDrift, fit_line

RATE = 5000.0
Ints = NDArray[np.int64]


def arrivals(rng: np.random.Generator, ppm: float, seconds: float, first: int = 2**32 - 1000, every: int = 1
             ) -> tuple[Ints, Ints]:
    """32-bit counters of a clock that runs ppm fast, and when their frames arrive [ns]: late by a random time, one
    in a hundred by much more, and once by 80 ms; in order."""
    n = np.arange(0, int(RATE * seconds), every)
    t = n / RATE / (1.0 + 1e-6 * ppm) + rng.exponential(3e-4, n.size)
    t += (rng.random(n.size) < 0.01) * rng.exponential(5e-3, n.size)
    t[n.size // 3:n.size // 3 + 40] += 0.08
    stamps = 1_700_000_000_000_000_000 + np.maximum.accumulate((1e9 * t).astype(np.int64))
    return (n + first) & 0xFFFFFFFF, stamps


def measured(counter: Ints, t_ns: Ints, cuts: int = 0) -> ClockDrift:
    clock = ClockDrift()
    for part in np.array_split(np.arange(len(counter)), cuts + 1):
        clock.update(counter[part], t_ns[part], RATE)
    return clock


def test_drift_within_its_own_sigma() -> None:
    """Forty clocks: the error is what the 1-sigma says, neither half nor twice."""
    rng = np.random.default_rng(7)
    relative, sigmas = [], []
    for _ in range(40):
        ppm = float(rng.uniform(-300.0, 300.0))
        drift = measured(*arrivals(rng, ppm, 12.0)).drift()
        assert drift is not None
        relative.append((drift.ppm - ppm) / drift.sigma_ppm)
        sigmas.append(drift.sigma_ppm)
    assert max(sigmas) < 0.5
    assert 0.6 < np.std(relative) < 1.5
    assert np.abs(relative).max() < 4.0


def test_jitter_of_one_side_does_not_bias_it() -> None:
    """Frames that come ever later on average, but some of them at once, as on a bus that fills up: no drift."""
    rng = np.random.default_rng(1)
    n = np.arange(100_000)
    t = n / RATE + rng.exponential(1.0, n.size) * 1e-3 * n / n.size
    drift = measured(n, np.maximum.accumulate((1e9 * t).astype(np.int64))).drift()
    assert drift is not None and abs(drift.ppm) < 0.5
    assert np.polyfit(n / RATE, t - n / RATE, 1)[0] > 40e-6  # what a plain line through all of them says


def test_the_same_for_any_cut_and_over_hours() -> None:
    rng = np.random.default_rng(3)
    counter, t_ns = arrivals(rng, 42.0, 4 * 3600.0, every=500)
    whole, parts = measured(counter, t_ns), measured(counter, t_ns, 997)
    assert whole.drift() == parts.drift()
    drift = whole.drift()
    assert drift is not None and drift.points <= BINS
    assert drift.ppm == pytest.approx(42.0, abs=0.05)
    assert drift.span_s == pytest.approx(4 * 3600.0, rel=0.02)


def test_a_restart_and_a_clock_that_is_set_begin_anew() -> None:
    rng = np.random.default_rng(4)
    before, t_before = arrivals(rng, 500.0, 10.0)
    after, t_after = arrivals(rng, -20.0, 10.0, first=5)
    for shift in (11.0, 9.0):  # the second: the computer's clock was set back by a second meanwhile
        restarted = np.zeros(len(before) + len(after), bool)
        restarted[len(before)] = shift > 10.0
        clock = ClockDrift()
        counter = after if shift > 10.0 else (before[-1] + 1 + np.arange(len(after))) & 0xFFFFFFFF
        clock.update(np.concatenate([before, counter]), np.concatenate([t_before, t_after + round(shift * 1e9)]),
                     RATE, None, restarted)
        drift = clock.drift()
        assert drift is not None and drift.ppm == pytest.approx(-20.0, abs=1.0)


def test_counters_not_believed_are_left_out() -> None:
    counter, t_ns = arrivals(np.random.default_rng(5), 10.0, 10.0)
    wrong = counter.copy()
    wrong[1000::7] += 16
    skip = np.zeros(len(counter), np.uint8)
    skip[1000::7] = 1
    clock = ClockDrift()
    clock.update(wrong, t_ns, RATE, skip)
    drift = clock.drift()
    assert drift is not None and drift.ppm == pytest.approx(10.0, abs=1.0)


def test_too_little_is_not_told() -> None:
    counter, t_ns = arrivals(np.random.default_rng(6), 10.0, 1.0)
    assert ClockDrift().drift() is None
    assert measured(counter, t_ns).drift() is None


def test_a_line_through_points_half_of_which_are_elsewhere() -> None:
    rng = np.random.default_rng(8)
    x = np.arange(300.0)
    y = 3.0 - 0.25 * x + rng.normal(0.0, 0.1, 300)
    y[rng.random(300) < 0.25] += 50.0
    slope, sigma = fit_line(x, y)
    assert abs(slope + 0.25) < 4.0 * sigma < 0.001
    assert fit_line(x, 2.0 * x) == (2.0, 0.0)
