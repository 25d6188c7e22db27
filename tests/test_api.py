"""`ipmsm_can.estimate`: the call for scripts and notebooks, against a machine in closed form."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import ipmsm_can
from ipmsm_can import M2, Estimate, Motor, estimate
from ipmsm_can.estimation import confidence
from tests.rotating import Rotating, degrees_between

RATE = 10_000.0


@pytest.fixture(scope="module")
def machine() -> Rotating:
    return Rotating(M2, w=300.0, i_d=-0.5, i_q=2.0, theta_0=0.7)


@pytest.fixture(scope="module")
def samples(machine: Rotating) -> NDArray[np.float64]:
    return machine.samples(RATE, 20_000)


@pytest.fixture(scope="module")
def result(samples: NDArray[np.float64]) -> Estimate:
    return estimate(samples[:2].T, samples[2:].T, RATE, M2)


def test_angle_speed_and_flux_are_the_machines(result: Estimate, machine: Rotating) -> None:
    t = np.arange(20_000) / RATE
    late = t > 1.5
    assert np.allclose(result.time, t)
    assert np.abs(degrees_between(result.theta, machine.theta(t)))[late].max() < 0.2
    assert np.abs(degrees_between(result.theta_smooth, machine.theta(t)))[late].max() < 0.3
    assert np.abs(result.omega - 300.0)[late].max() < 0.5
    flux = machine.flux(t)
    assert np.abs(result.flux @ [1, 1j] - flux)[late].max() < 2e-3
    assert np.abs(result.active_flux @ [1, 1j] - machine.active_flux(t))[late].max() < 2e-3


def test_everything_has_one_entry_per_sample(result: Estimate) -> None:
    n = 20_000
    for name in ("time", "theta", "theta_smooth", "omega", "y", "innovation", "excitation", "sigma_theta", "locked",
                 "polarity_known", "valid"):
        assert getattr(result, name).shape == (n,), name
    for name in ("flux", "active_flux", "phi"):
        assert getattr(result, name).shape == (n, 2), name
    assert np.isfinite(result.innovation).all() and (np.abs(result.theta) <= np.pi).all()


def test_flags_and_sigma_go_together(result: Estimate) -> None:
    assert not result.valid[0] and result.valid[-1]
    assert np.array_equal(result.valid, result.valid & result.locked & result.polarity_known)
    assert (result.sigma_theta[result.valid] <= np.radians(10.0) + 1e-12).all()
    assert confidence.VALID == 4


def test_excitation_is_the_smallest_eigenvalue_of_its_window(result: Estimate) -> None:
    """By numpy over the last 0.1 s, up to the window's own granularity of a sixteenth."""
    phi = result.phi[-1000:]
    smallest = np.linalg.eigvalsh(phi.T @ phi / RATE)[0]
    assert result.excitation[-1] == pytest.approx(smallest, rel=0.08)


def test_complex_and_two_columns_are_the_same(samples: NDArray[np.float64], result: Estimate) -> None:
    other = estimate(samples[0] + 1j * samples[1], samples[2] + 1j * samples[3], RATE, "m2")
    assert np.array_equal(other.theta, result.theta)
    assert np.array_equal(other.valid, result.valid)


def test_lists_and_integers_will_do() -> None:
    r = estimate([[0, 0]] * 5, [[1, 0]] * 5, 1000, "m1")
    assert r.theta.shape == (5,)


def test_gains_take_effect(samples: NDArray[np.float64], result: Estimate) -> None:
    part = samples[:, :500]
    start = estimate(part[:2].T, part[2:].T, RATE, M2, initial_flux=(0.3, -0.4), alpha="50 1/s", gamma=1e-9)
    assert start.flux[0] == pytest.approx([0.3, -0.4])
    assert not np.allclose(start.theta, result.theta[:500])
    strict = estimate(samples[:2].T, samples[2:].T, RATE, M2, valid_sigma=0.01)
    assert not strict.valid.any()


def test_a_motor_of_ones_own(machine: Rotating) -> None:
    own = Motor(pole_pairs=4, psi_m=0.1, L_d=2e-3, L_q=3e-3, R=0.2)
    s = Rotating(own, w=500.0, i_q=5.0).samples(RATE, 10_000)
    r = estimate(s[:2].T, s[2:].T, RATE, own)
    truth = Rotating(own, w=500.0, i_q=5.0).theta(r.time)
    assert np.abs(degrees_between(r.theta, truth))[r.time > 0.8].max() < 0.3


@pytest.mark.parametrize(("change", "words"), [
    ({"i": np.zeros((5, 3))}, r"i has shape \(5, 3\); allowed is \(N, 2\)"),
    ({"v": np.zeros(5)}, r"v has shape \(5,\)"),
    ({"v": np.zeros((4, 2))}, "i has 5 samples and v 4"),
    ({"i": np.array([[0, 0], [0, np.nan], [0, 0], [0, 0], [0, 0]])}, r"i\[1\] is \[0.0, nan\]"),
    ({"v": np.full((5, 2), np.inf)}, r"v\[0\] is"),
    ({"sample_rate": 99.0}, "sample_rate is 99.0; allowed is 100 to 100000 Hz"),
    ({"sample_rate": float("nan")}, "sample_rate is nan"),
    ({"sample_rate": "5 kHz"}, "sample_rate is '5 kHz'; allowed is 100 to 100000 Hz"),
    ({"motor": "m3"}, "motor is 'm3'; allowed is a Motor or one of m1, m2"),
    ({"motor": None}, "motor is None; allowed is a Motor or one of m1, m2"),
    ({"i": [["a", "b"]]}, "i holds .*; allowed are numbers"),
    ({"alpha": -1.0}, "observer.alpha is -1"),
    ({"gama": 1.0}, "gama"),
    ({"observer": "luenberger"}, "observer.kind is"),
    ({"valid_sigma": 91.0}, "valid_sigma"),
])
def test_bad_arguments_get_one_sentence(change: dict[str, Any], words: str) -> None:
    arguments: dict[str, Any] = {"i": np.zeros((5, 2)), "v": np.zeros((5, 2)), "sample_rate": 1000.0, "motor": M2,
                                 **change}
    with pytest.raises(ValueError, match=words) as caught:
        estimate(**arguments)
    assert "\n" not in str(caught.value)


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = ("import sys, ipmsm_can; print([m for m in ('numpy', 'numba', 'can', 'cantools', 'pydantic') "
            "if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_names_of_the_package() -> None:
    for name in ipmsm_can.__all__:
        assert getattr(ipmsm_can, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ipmsm_can.nothing
