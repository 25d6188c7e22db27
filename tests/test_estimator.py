"""The whole estimator: partitions, gaps, speed, excitation, and what it calls valid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.estimation import confidence, excitation, regression, speed
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.motor import M2
from tests.rotating import Rotating, degrees_between
from tests.test_ges import settings

FIELDS = ("regression", "flux", "angle", "excitation", "sigma", "flags")
RATE = 5000.0


def noisy(n: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    samples = Rotating(M2, 90.0, -0.5, 2.0).samples(RATE, n)
    return np.ascontiguousarray(samples + rng.normal(0.0, [[0.02], [0.02], [0.3], [0.3]], samples.shape))


def joined(parts: list[EstimateBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(p, name) for p in parts], axis=-1)


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.integers(0, 3))
def test_any_partition_gives_the_same_bits(sizes: list[int], gaps: int) -> None:
    n = sum(sizes)
    samples = noisy(n)
    gap = np.zeros(n, np.int64)
    gap[[(j + 1) * n // 5 for j in range(gaps)]] = 50
    whole = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(samples, gap)
    estimator = Estimator(M2, RATE, settings(M2, 10.0, 0.5))
    parts, begin = [], 0
    for size in sizes:
        span = slice(begin, begin + size)
        parts.append(estimator.process(np.ascontiguousarray(samples[:, span]), gap[span]))
        begin += size
    for name in FIELDS:
        assert np.array_equal(joined(parts, name), getattr(whole, name)), name


def test_carries_the_angle_over_a_gap() -> None:
    """Fifty samples missing: the angle goes on with the speed, the filters restart, lock returns."""
    n = 10_000
    machine = Rotating(M2, 314.0, 0.0, 2.0)
    samples = machine.samples(RATE, n)
    keep = np.ones(n, bool)
    keep[6000:6050] = False
    gap = np.zeros(n, np.int64)
    gap[6050] = 50
    out = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(
        np.ascontiguousarray(samples[:, keep]), gap[keep])
    error = degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE)[keep])
    assert np.abs(error[5000:6000]).max() < 0.01
    assert np.abs(error[6000:]).max() < 2.0
    assert np.abs(error[-200:]).max() < 0.05


def test_a_long_gap_forgets_everything() -> None:
    samples = Rotating(M2, 314.0, 0.0, 2.0).samples(RATE, 5000)
    estimator = Estimator(M2, RATE, settings(M2, 10.0, 0.5))
    before = estimator.process(samples)
    assert before.flags[-1] & confidence.VALID
    gap = np.zeros(5000, np.int64)
    gap[0] = int(RATE)
    after = estimator.process(samples, gap)
    assert not after.flags[0]
    fresh = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(samples)
    assert np.array_equal(after.flux, fresh.flux)
    assert np.array_equal(after.flags, fresh.flags)


def test_excitation_is_the_smallest_eigenvalue_of_the_window() -> None:
    samples = noisy(3000)
    out = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(samples)
    phi = out.regression[[regression.PHI_A, regression.PHI_B]]
    n_bin = round(0.1 * RATE / excitation.BINS)
    for k in (0, 10, n_bin, 700, 1234, 2999):
        begin = max(0, k // n_bin - (excitation.BINS - 1)) * n_bin
        window = phi[:, begin:k + 1]
        expected = max(0.0, np.linalg.eigvalsh(window @ window.T / RATE)[0])
        assert out.excitation[k] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_excitation_of_a_turning_rotor() -> None:
    """|Phi| = 2 alpha psi w / sqrt(w^2 + alpha^2) at i_d = 0, half of it in each direction."""
    out = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(Rotating(M2, 314.0, 0.0, 2.0).samples(RATE, 10_000))
    size = 2.0 * 10.0 * M2.psi_m * 314.0 / math.hypot(314.0, 10.0)
    spans = np.array([15, 16]) * round(0.1 * RATE / 16) / RATE
    # The window never holds whole turns only; the rest is worth at most a quarter turn.
    assert out.excitation[-1] / (0.5 * size**2) == pytest.approx(spans.mean(), abs=0.01)


def test_speed_loop_pulls_in_from_rest_at_once() -> None:
    """A fast machine: the loop alone would need seconds."""
    rate, w = 20_000.0, 8000.0
    t = np.arange(6000) / rate
    flux = np.zeros((4, t.size))
    flux[2], flux[3] = np.cos(w * t), np.sin(w * t)
    out = np.empty((speed.ROWS, t.size))
    speed.speed_block(flux, speed.new_state(20.0, 0.1, rate), out)
    assert np.abs(out[speed.OMEGA, 2000:] - w).max() < 0.01 * w
    assert np.abs(degrees_between(out[speed.THETA], w * t)[-1000:]).max() < 0.1


def test_speed_loop_has_no_lag_at_constant_speed_and_a_known_one_in_a_ramp() -> None:
    rate, bandwidth, slope = RATE, 20.0, 500.0
    t = np.arange(10_000) / rate
    theta = 0.5 * slope * t**2
    flux = np.zeros((4, t.size))
    flux[2], flux[3] = np.cos(theta), np.sin(theta)
    out = np.empty((speed.ROWS, t.size))
    speed.speed_block(flux, speed.new_state(bandwidth, 0.1, rate), out)
    pole = math.exp(-2 * math.pi * bandwidth / rate)
    lag = slope / rate**2 * pole**2 / (1 - pole) ** 2
    assert degrees_between(theta, out[speed.THETA])[-1] == pytest.approx(math.degrees(lag), rel=0.02)


def test_speed_rests_while_the_flux_has_no_direction() -> None:
    rng = np.random.default_rng(3)
    flux = np.zeros((4, 1000))
    flux[2:] = rng.normal(0, 0.01, (2, 1000))
    out = np.empty((speed.ROWS, 1000))
    speed.speed_block(flux, speed.new_state(20.0, 0.1, RATE), out)
    assert not out[speed.OMEGA].any()


def test_standstill_is_never_valid() -> None:
    """With injection but without rotation the axis may lock; polarity stays unknown, valid stays off."""
    n, w_h = 20_000, 2 * math.pi * 400.0
    t = np.arange(n + 1) / RATE
    # A locked rotor at theta = 0: d and q are alpha and beta, each an R-L circuit, solved exactly for a
    # voltage held over each interval.
    v = 6.0 * np.exp(1j * w_h * (t[1:] - 0.5 / RATE))
    i = np.zeros(n + 1, complex)
    decay_d, decay_q = math.exp(-M2.R / M2.L_d / RATE), math.exp(-M2.R / M2.L_q / RATE)
    for k in range(n):
        i[k + 1] = complex(decay_d * i[k].real + (1 - decay_d) / M2.R * v[k].real,
                           decay_q * i[k].imag + (1 - decay_q) / M2.R * v[k].imag)
    samples = np.ascontiguousarray([i[1:].real, i[1:].imag, v.real, v.imag])
    for start in ((M2.psi_m, 0.0), (-M2.psi_m, 0.0), (0.0, M2.psi_m), (0.0, 0.0)):
        for gamma in (0.5, 50.0, 1e5):
            out = Estimator(M2, RATE, settings(M2, 10.0, gamma, start)).process(samples)
            assert not (out.flags & (confidence.VALID | confidence.POLARITY_KNOWN)).any()


def test_valid_means_close() -> None:
    """From any initial angle, at any speed: while valid, the error is below three sigma and 30 deg."""
    rng = np.random.default_rng(5)
    seen = 0
    for _ in range(60):
        w = float(rng.choice([-1, 1]) * 10 ** rng.uniform(0.8, 2.8))
        machine = Rotating(M2, w, 0.0, float(rng.uniform(-2.3, 2.3)), float(rng.uniform(0, 6.28)))
        start = M2.psi_m * np.exp(1j * rng.uniform(0, 6.28)) * rng.uniform(0, 2)
        n = int(RATE * min(4.0, 1.0 + 20.0 / abs(w)))
        samples = machine.samples(RATE, n) + rng.normal(0, [[0.02]] * 2 + [[0.1]] * 2, (4, n))
        out = Estimator(M2, RATE, settings(M2, 10.0, 0.5, (start.real, start.imag))).process(
            np.ascontiguousarray(samples))
        error = np.abs(degrees_between(out.angle[0], machine.theta(np.arange(n) / RATE)))
        valid = out.flags & confidence.VALID > 0
        seen += bool(valid[-1])
        if valid.any():
            assert (error[valid] < 15.0).all(), (w, error[valid].max())
    assert seen >= 45


def test_a_sudden_half_turn_loses_the_lock() -> None:
    """The flux jumps to the other side (a slipped rotor, a swapped phase): lock and polarity are given up."""
    n = 10_000
    machine = Rotating(M2, 314.0, 0.0, 2.0)
    other = Rotating(M2, 314.0, 0.0, 2.0, 0.3 + math.pi)
    samples = machine.samples(RATE, n)
    samples[:, 6000:] = other.samples(RATE, n)[:, 6000:]
    estimator = Estimator(M2, RATE, settings(M2, 10.0, 0.5))
    out = estimator.process(samples)
    assert out.flags[5999] & confidence.VALID
    lost = 6000 + int(np.argmin(out.flags[6000:] & confidence.VALID))
    assert lost < 6000 + int(0.02 * RATE)
    assert estimator.lost_locks == 1
    assert out.flags[-1] & confidence.VALID
    assert abs(degrees_between(out.angle[0], other.theta(np.arange(n) / RATE))[-1]) < 1.0


@pytest.mark.parametrize("spike", [1e30, 1e100, 1e200])
def test_an_absurd_sample_leaves_nothing_that_looks_like_knowledge(spike: float) -> None:
    """Possible where somebody's database has float signals."""
    samples = Rotating(M2, 400.0).samples(RATE, 8000)
    samples[0, 5000] = spike
    with np.errstate(all="ignore"):
        estimate = Estimator(M2, RATE, settings(M2, 10.0, 0.5)).process(samples)
    assert estimate.flags[4999] & confidence.VALID
    assert (estimate.sigma <= math.pi).all()
    assert not (estimate.flags[5010:] & (confidence.VALID | confidence.LOCKED)).any()
