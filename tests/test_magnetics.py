"""The saturating flux map: one energy behind it, reciprocal, passive, and what was asked for at rated current."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.drive.machine import advance, initial_state, pack_machine
from ipmsm_can.drive.magnetics import (
    current_from_flux,
    flux_from_current,
    inductances,
    inverse_inductance,
    saturation_parameters,
    stored_energy,
)
from ipmsm_can.motor import M1, M2, Motor

Array = NDArray[np.float64]
MOTORS = [(M1, 0.2), (M2, 0.2), (M2, 0.1), (M1, 0.5)]
# three times the rated current, and the whole magnet taken off on the other side
within = st.tuples(st.sampled_from(MOTORS), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


def at(case: tuple[tuple[Motor, float], float, float]) -> tuple[Array, float, float]:
    """(machine, lambda_d, lambda_q) for a point in multiples of the flux of the rated current."""
    (motor, saturation), d, q = case
    return (pack_machine(motor, saturation=saturation), motor.psi_m + d * motor.L_d * motor.rated_current,
            q * motor.L_q * motor.rated_current)


@pytest.mark.parametrize(("motor", "saturation"), MOTORS)
def test_l_d_falls_by_what_was_asked_for_at_rated_positive_d_current(motor: Motor, saturation: float) -> None:
    m = pack_machine(motor, saturation=saturation)
    step = 1e-5 * motor.rated_current

    def chord(i_d: float) -> float:
        high, low = flux_from_current(i_d + step, 0.0, m)[0], flux_from_current(i_d - step, 0.0, m)[0]
        return (high - low) / (2.0 * step)

    assert chord(motor.rated_current) == pytest.approx((1.0 - saturation) * motor.L_d, rel=1e-6)
    assert chord(0.0) == pytest.approx(motor.L_d, rel=1e-6)
    assert motor.L_d < chord(-motor.rated_current) < (1.0 + 0.7 * saturation) * motor.L_d


def test_q_current_saturates_the_d_axis_and_itself() -> None:
    m = pack_machine(M2, saturation=0.2)
    rest, loaded = inductances(0.0, 0.0, m), inductances(0.0, M2.rated_current, m)
    assert rest == pytest.approx((M2.L_d, 0.0, M2.L_q))
    assert loaded[0] < 0.9 * M2.L_d
    assert loaded[2] < 0.95 * M2.L_q
    assert loaded[1] < -0.01 * M2.L_d
    assert inductances(0.0, -M2.rated_current, m)[1] == pytest.approx(-loaded[1])


@given(within)
def test_current_is_the_gradient_of_one_energy(case: tuple[tuple[Motor, float], float, float]) -> None:
    m, d, q = at(case)
    h = 1e-6
    numeric = ((stored_energy(d + h, q, m) - stored_energy(d - h, q, m)) / (2 * h),
               (stored_energy(d, q + h, m) - stored_energy(d, q - h, m)) / (2 * h))
    assert current_from_flux(d, q, m) == pytest.approx(numeric, rel=1e-4, abs=1e-5)


@given(within)
def test_reciprocal(case: tuple[tuple[Motor, float], float, float]) -> None:
    m, d, q = at(case)
    h = 1e-6
    d_of_q = (current_from_flux(d, q + h, m)[0] - current_from_flux(d, q - h, m)[0]) / (2 * h)
    q_of_d = (current_from_flux(d + h, q, m)[1] - current_from_flux(d - h, q, m)[1]) / (2 * h)
    assert d_of_q == pytest.approx(q_of_d, rel=1e-5, abs=1e-5)
    # and as a matrix of incremental inductances, through the inverse map
    i_d, i_q = current_from_flux(d, q, m)
    assert flux_from_current(i_d, i_q, m) == pytest.approx((d, q), rel=1e-8, abs=1e-9)
    dd, dq, qq = inverse_inductance(d, q, m)
    assert np.linalg.inv([[dd, dq], [dq, qq]])[0, 1] == pytest.approx(inductances(i_d, i_q, m)[1], abs=1e-12)


@given(within, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_passive(case: tuple[tuple[Motor, float], float, float], away_d: float, away_q: float) -> None:
    """Strictly monotone, so the energy has one minimum, and it lies at zero current."""
    m, d, q = at(case)
    other_d, other_q = d + away_d * m[1], q + away_q * m[1]
    a, b = np.array(current_from_flux(d, q, m)), np.array(current_from_flux(other_d, other_q, m))
    work = (b - a) @ (other_d - d, other_q - q)
    assert work >= 0.3 * ((other_d - d) ** 2 / m[2] + (other_q - q) ** 2 / m[3]) - 1e-12
    assert stored_energy(d, q, m) >= 0.3 * ((d - m[1]) ** 2 / (2 * m[2]) + q**2 / (2 * m[3])) - 1e-12


def test_a_closed_loop_in_flux_takes_no_energy() -> None:
    m = pack_machine(M1, saturation=0.2)
    turn = np.linspace(0.0, 2.0 * np.pi, 2001)
    d = M1.psi_m + 0.03 * np.cos(turn) + 0.01
    q = 0.05 * np.sin(turn)
    i = np.array([current_from_flux(a, b, m) for a, b in zip(d, q, strict=True)])
    work = np.trapezoid(i[:, 0], d) + np.trapezoid(i[:, 1], q)
    one_way = np.abs(np.diff(d) * i[1:, 0]).sum() + np.abs(np.diff(q) * i[1:, 1]).sum()
    assert abs(work) < 1e-6 * one_way


def test_energy_balance_of_the_whole_machine() -> None:
    """What the terminals give is copper loss, stored energy and mechanical energy, to integration error."""
    m = pack_machine(M2, saturation=0.2)
    x = initial_state(M2, 0.3, 20.0)
    rng = np.random.default_rng(3)
    period, given_in, lost = 5e-6, 0.0, 0.0

    def dq() -> tuple[float, float, float, float]:
        theta = M2.pole_pairs * x[3]
        turned = (x[0] + 1j * x[1]) * np.exp(-1j * theta)
        i_d, i_q = current_from_flux(turned.real, turned.imag, m)
        i = (i_d + 1j * i_q) * np.exp(1j * theta)
        return turned.real, turned.imag, i.real, i.imag

    def energy() -> float:
        d, q, _, _ = dq()
        return 1.5 * stored_energy(d, q, m) + 0.5 * M2.J * float(x[2]) ** 2

    start, largest = energy(), 0.0
    for k in range(8000):
        if k % 200 == 0:
            v = rng.uniform(-60.0, 60.0, 2) + 35.0 * np.array([-np.sin(M2.pole_pairs * x[3]),
                                                               np.cos(M2.pole_pairs * x[3])])
        before = np.array(dq()[2:])
        advance(x, v[0], v[1], 0.0, period, 1, True, 0.0, 0.0, 0.2, m)
        after = np.array(dq()[2:])
        mean = 0.5 * (before + after)
        given_in += 1.5 * period * float(v @ mean)
        lost += 1.5 * M2.R * period * float(mean @ mean)
        largest = max(largest, float(np.hypot(*after)))
    assert largest > 1.5 * M2.rated_current
    assert given_in - lost == pytest.approx(energy() - start, rel=2e-4)


def test_without_saturation_the_same_bits_as_the_linear_law() -> None:
    rng = np.random.default_rng(1)
    m = pack_machine(M2)
    for d, q in rng.uniform(-1.0, 1.0, (200, 2)):
        assert current_from_flux(d, q, m) == ((d - M2.psi_m) / M2.L_d, q / M2.L_q)
    # and it is the limit of little saturation
    weak = pack_machine(M2, saturation=1e-9)
    assert current_from_flux(0.61, 0.02, weak) == pytest.approx(current_from_flux(0.61, 0.02, m), rel=1e-7)


@pytest.mark.parametrize("saturation", [-0.1, 0.51, float("nan")])
def test_a_saturation_out_of_range_is_named(saturation: float) -> None:
    with pytest.raises(ValueError, match=r"saturation is .*; allowed is 0 to 0.5"):
        saturation_parameters(M2, saturation)


def test_a_machine_that_would_not_be_passive_is_refused() -> None:
    with pytest.raises(ValueError, match="would not be passive"):
        saturation_parameters(Motor(3, 0.5, L_d=50e-3, L_q=5e-3, R=1.0), 0.5)
