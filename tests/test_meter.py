"""The high-frequency current meter against currents whose ellipse is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.injection import meter

RATE, FREQUENCY = 10_000.0, 400.0


def samples(current: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.ascontiguousarray([current.real, current.imag, 0 * current.real, 0 * current.real])


def measured(current: NDArray[np.complex128], frequency: float = FREQUENCY) -> float:
    return float(meter.meter_block(samples(current), meter.new_state(frequency, RATE)))


def turns(n: int, frequency: float = FREQUENCY) -> NDArray[np.complex128]:
    return np.asarray(np.exp(2j * np.pi * frequency * np.arange(n) / RATE))


@pytest.mark.parametrize(("positive", "negative"), [(0.3, 0.0), (0.0, 0.2), (0.25, 0.06), (0.1, 0.1)])
@pytest.mark.parametrize("phase", [0.0, 1.0, 2.5])
def test_major_axis_of_an_ellipse(positive: float, negative: float, phase: float) -> None:
    t = turns(5000)
    i = positive * t * np.exp(1j * phase) + negative / t
    assert measured(i) == pytest.approx(np.abs(i).max(), rel=0.06)


def test_slow_and_constant_currents_do_not_count() -> None:
    n = 20_000
    assert measured(np.full(n, 10 + 5j)) < 1e-3
    # 1000 rpm of a machine with three pole pairs: 50 Hz, 2 A
    assert measured(2.0 * turns(n, 50.0)) < 0.15
    assert measured(2.0 * turns(n, 1.0)) < 0.005


def test_other_frequencies_count_little() -> None:
    assert measured(turns(20_000, 1200.0)) < 0.1


def test_time_constant_is_a_few_periods() -> None:
    state = meter.new_state(FREQUENCY, RATE)
    i = turns(int(meter.AVERAGE_PERIODS * RATE / FREQUENCY))
    part = meter.meter_block(samples(i), state)
    assert 0.5 < part < 0.75  # 1 - 1/e of the way, the high-pass a little below
    later = meter.meter_block(samples(0 * turns(5000)), state)
    assert later < 1e-3


@given(st.lists(st.integers(1, 400), min_size=1, max_size=8), st.integers(0, 2**31))
def test_any_partition_gives_the_same_bits(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = sum(sizes)
    x = rng.normal(size=(4, n))
    whole_state, state = meter.new_state(FREQUENCY, RATE), meter.new_state(FREQUENCY, RATE)
    whole = meter.meter_block(x, whole_state)
    at = 0
    for size in sizes:
        part = meter.meter_block(np.ascontiguousarray(x[:, at:at + size]), state)
        at += size
    assert part == whole and state == whole_state
    assert math.isfinite(part)


def test_phase_does_not_drift_away_in_a_long_run() -> None:
    state = meter.new_state(123.456, RATE)
    meter.meter_block(np.zeros((4, 1_000_000)), state)
    assert abs(float(state["phase"][0])) <= math.pi
