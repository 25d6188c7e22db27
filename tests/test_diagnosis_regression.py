"""Least squares with errors in groups and in the columns, against what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from ipmsm_can.diagnosis.regression import Solution, solve

WIDE = {"a": (0.0, 100.0), "b.x": (0.0, 100.0), "b.y": (0.0, 100.0)}


def simulated(seed: int, n: int = 400, blur: float = 0.0) -> Solution:
    """left = 2 p + (1 - 3j) q + errors that are alike within groups of 20; p is seen with noise `blur`."""
    rng = np.random.default_rng(seed)

    def noise(size: int) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
        return rng.standard_normal(size) + 1j * rng.standard_normal(size)

    p, q = noise(n), noise(n) + np.repeat(noise(n // 20), 20)
    group = np.repeat(np.arange(n // 20), 20)
    left = 2.0 * p + (1.0 - 3.0j) * q + 0.1 * noise(n) + 0.3 * np.repeat(noise(n // 20), 20)
    seen = p + blur * noise(n)
    return solve({"a": seen, "b.x": q, "b.y": 1j * q}, left, group, WIDE, {"a": 2.0 * blur**2} if blur else None)


def test_the_intervals_cover_what_was_put_in_although_errors_come_in_groups() -> None:
    inside = {"a": 0, "b.x": 0, "b.y": 0}
    for seed in range(300):
        s = simulated(seed)
        for name, true in (("a", 2.0), ("b.x", 1.0), ("b.y", -3.0)):
            inside[name] += abs(s[name] - true) < 1.96 * s.sigma(name)
    assert all(0.9 <= count / 300 <= 0.995 for count in inside.values()), inside


def test_noise_in_a_column_does_not_pull_its_value_to_zero() -> None:
    found = [simulated(seed, blur=0.5)["a"] for seed in range(100)]
    assert np.mean(found) == pytest.approx(2.0, abs=0.03)  # without the correction: 2/(1 + 0.25) = 1.6


def test_what_the_equations_do_not_tell_keeps_what_was_known() -> None:
    rng = np.random.default_rng(1)
    p = rng.standard_normal(100).astype(np.complex128)
    left = np.asarray(3.0 * p + 0.01 * rng.standard_normal(100), np.complex128)
    s = solve({"a": p, "b": np.zeros(100, np.complex128)}, left,
              np.arange(100) // 10, {"a": (0.0, 10.0), "b": (7.0, 0.5)})
    assert s["a"] == pytest.approx(3.0, abs=0.01)
    assert s["b"] == pytest.approx(7.0)
    assert s.sigma("b") == pytest.approx(0.5, rel=0.02)


def test_a_pair_has_the_sigma_of_its_worst_direction() -> None:
    rng = np.random.default_rng(2)
    n = 200
    q = rng.standard_normal(n).astype(np.complex128)  # b.x from the real equations, b.y from the imaginary ones
    noise = np.asarray(0.1 * rng.standard_normal(n) + 0.5j * rng.standard_normal(n), np.complex128)
    s = solve({"b.x": q, "b.y": 1j * q}, np.asarray((1.0 + 2.0j) * q + noise), np.arange(n), WIDE)
    assert s.pair("b") == pytest.approx(1.0 + 2.0j, abs=0.15)
    assert s.pair_sigma("b") >= max(s.sigma("b.x"), s.sigma("b.y")) * 0.999
