"""Probing waveforms against numerical integrals of their definitions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson

from ipmsm_can.injection import waveform as w

PERIOD = 1e-4
INSTANT = 1e9  # V/s: the amplitude is there with the first step


def steps(
    state: NDArray[np.float64], n: int, ramp: float = INSTANT, limit: float = 100.0, period: float = PERIOD
) -> NDArray[np.float64]:
    return np.array([w.step(state, period, ramp, limit) for _ in range(n)]).reshape(n, 2)


def definition(
    waveform: int, amplitude: float, phase: NDArray[np.float64], axis: float
) -> NDArray[np.float64]:
    """The continuous waveform (2, N), written with matrices instead of the kernel's formulas."""
    c, s = math.cos(axis), math.sin(axis)
    turn = np.array([[c, -s], [s, c]])
    along = {w.ROTATING: np.array([np.cos(phase), np.sin(phase)]),
             w.PULSATING: np.array([np.cos(phase), 0.0 * phase]),
             w.POLARITY_PULSES: np.array([np.sign(np.cos(phase)), 0.0 * phase])}[waveform]
    product: NDArray[np.float64] = amplitude * turn @ along
    return product


@pytest.mark.parametrize("waveform", [w.ROTATING, w.PULSATING, w.POLARITY_PULSES])
@pytest.mark.parametrize("frequency", [37.0, 400.0, 1234.5, 4999.0])
def test_each_step_is_the_mean_of_the_waveform_over_the_period(waveform: int, frequency: float) -> None:
    state = np.zeros(w.W_SIZE)
    axis = 0.7
    w.ask(state, waveform, 6.0, frequency, axis, 200)
    got = steps(state, 60)
    fine = 20_000
    t = np.arange(60 * fine + 1, dtype=np.float64) * (PERIOD / fine)
    v = definition(waveform, 6.0, 2.0 * np.pi * frequency * t, axis)
    flux = cumulative_simpson(v, x=t, initial=0.0)[:, ::fine]
    mean = np.diff(flux, axis=1).T / PERIOD
    # the square wave's jumps fall between the points of the numerical integral
    assert np.abs(got - mean).max() < (2e-3 if waveform == w.POLARITY_PULSES else 1e-9)


def test_polarity_pulses_drive_equal_triangles_of_flux_to_both_sides() -> None:
    state = np.zeros(w.W_SIZE)
    w.ask(state, w.POLARITY_PULSES, 20.0, 250.0, 0.0, 400)  # 40 samples a period: corners on samples
    v = steps(state, 400)
    flux = np.cumsum(v[:, 0]) * PERIOD
    quarter = 20.0 / 250.0 / 4.0
    assert np.abs(v[:, 1]).max() == 0.0
    assert flux.max() == pytest.approx(quarter, rel=1e-9)
    assert flux.min() == pytest.approx(-quarter, rel=1e-9)
    assert np.abs(flux[19::20]).max() < 1e-12  # back at zero after each pulse
    assert flux[9] > 0.0 > flux[29]  # the first pulse goes along +axis


def test_off_within_one_sample_of_the_end_of_its_time_to_live() -> None:
    state = np.zeros(w.W_SIZE)
    w.ask(state, w.ROTATING, 6.0, 400.0, 0.0, 25)
    v = np.hypot(*steps(state, 40).T)
    assert np.all(v[:25] > 5.0)
    assert np.all(v[25:] == 0.0)
    assert state[w.W_WAVEFORM] == w.OFF


def test_a_repeated_command_renews_the_time_to_live_without_a_break() -> None:
    once, renewed = np.zeros(w.W_SIZE), np.zeros(w.W_SIZE)
    w.ask(once, w.PULSATING, 6.0, 400.0, 0.3, 1000)
    whole = steps(once, 300)
    parts = []
    for _ in range(15):
        w.ask(renewed, w.PULSATING, 6.0, 400.0, 0.3, 25)
        parts.append(steps(renewed, 20))
    assert np.array_equal(np.concatenate(parts), whole)


def test_amplitude_follows_the_ramp_up_and_down() -> None:
    state = np.zeros(w.W_SIZE)
    w.ask(state, w.ROTATING, 6.0, 400.0, 0.0, 10_000)
    up = []
    for _ in range(150):
        w.step(state, PERIOD, 600.0, 100.0)
        up.append(state[w.W_AMPLITUDE])
    assert np.allclose(up, np.minimum(6.0, 600.0 * PERIOD * np.arange(1, 151)), atol=1e-12)
    w.ask(state, w.ROTATING, 2.0, 400.0, 0.0, 10_000)
    down = []
    for _ in range(100):
        w.step(state, PERIOD, 600.0, 100.0)
        down.append(state[w.W_AMPLITUDE])
    assert np.allclose(down, np.maximum(2.0, 6.0 - 600.0 * PERIOD * np.arange(1, 101)), atol=1e-12)


@pytest.mark.parametrize("new", [w.OFF, w.PULSATING, w.POLARITY_PULSES])
def test_another_waveform_waits_until_the_old_one_has_ramped_down(new: int) -> None:
    state = np.zeros(w.W_SIZE)
    w.ask(state, w.ROTATING, 6.0, 400.0, 0.0, 10_000)
    steps(state, 200, ramp=600.0)
    w.ask(state, new, 3.0, 700.0, 1.0, 10_000)
    waveforms, amplitudes, frequencies = [], [], []
    for _ in range(200):
        w.step(state, PERIOD, 600.0, 100.0)
        waveforms.append(int(state[w.W_WAVEFORM]))
        amplitudes.append(state[w.W_AMPLITUDE])
        frequencies.append(state[w.W_FREQUENCY])
    change = waveforms.index(new)
    assert 98 <= change <= 101  # 6 V at 0.06 V a sample
    assert set(waveforms[:change]) == {w.ROTATING}
    assert set(frequencies[:change]) == {400.0}
    assert np.all(np.diff(amplitudes[:change]) < 0.0)
    assert np.abs(np.diff(amplitudes)).max() < 0.06 + 1e-9
    assert amplitudes[-1] == pytest.approx(3.0 if new != w.OFF else 0.0)


def test_another_waveform_starts_at_the_beginning_of_its_period() -> None:
    changed, fresh = np.zeros(w.W_SIZE), np.zeros(w.W_SIZE)
    w.ask(changed, w.ROTATING, 6.0, 433.0, 0.0, 10_000)
    steps(changed, 57)
    w.ask(changed, w.PULSATING, 5.0, 400.0, 0.2, 10_000)
    w.ask(fresh, w.PULSATING, 5.0, 400.0, 0.2, 10_000)
    assert np.array_equal(steps(changed, 50), steps(fresh, 50))


COMMANDS = st.lists(
    st.tuples(st.integers(0, 3), st.floats(0.0, 500.0), st.floats(1.0, 5000.0), st.floats(-10.0, 10.0),
              st.integers(0, 60), st.integers(1, 80)),
    min_size=1, max_size=8,
)


@given(commands=COMMANDS)
def test_whatever_is_asked_the_limit_the_ramp_and_the_time_to_live_hold(
    commands: list[tuple[int, float, float, float, int, int]],
) -> None:
    state = np.zeros(w.W_SIZE)
    amplitude = 0.0
    for waveform, asked, frequency, axis, ttl, wait in commands:
        w.ask(state, waveform, asked, frequency, axis, ttl)
        for number in range(wait):
            v_alpha, v_beta = w.step(state, PERIOD, 2000.0, 12.0)
            assert math.hypot(v_alpha, v_beta) <= 12.0 * (1.0 + 1e-12)
            assert 0.0 <= state[w.W_PHASE] <= 2.0 * math.pi
            if number >= ttl:
                assert (v_alpha, v_beta) == (0.0, 0.0)
            else:
                assert abs(state[w.W_AMPLITUDE] - amplitude) <= 2000.0 * PERIOD + 1e-9
            amplitude = float(state[w.W_AMPLITUDE])
