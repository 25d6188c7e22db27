"""The simulated machine against SciPy and first principles; the inverter against per-phase arithmetic."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ipmsm_can.drive import inverter, machine
from ipmsm_can.drive.machine import (
    X_LAMBDA_ALPHA,
    X_LAMBDA_BETA,
    X_OMEGA_M,
    X_THETA_M,
    advance,
    air_gap_torque,
    initial_state,
    pack_machine,
    stationary_current,
    wrap,
)
from ipmsm_can.motor import M1, M2, Motor

Array = NDArray[np.float64]
FRICTION = 0.004
PERIOD = 2e-4


def random_voltages(motor: Motor, n: int) -> Array:
    rng = np.random.default_rng(5)
    return rng.uniform(-60.0, 60.0, (n, 2))


def currents(motor: Motor, x: Array) -> tuple[float, float]:
    return stationary_current(x[X_LAMBDA_ALPHA], x[X_LAMBDA_BETA], motor.pole_pairs * x[X_THETA_M],
                              pack_machine(motor))


def run_kernel(motor: Motor, voltages: Array, load: float, substeps: int) -> Array:
    m = pack_machine(motor, FRICTION)
    x = initial_state(motor, 0.4, 30.0)
    for v_alpha, v_beta in voltages:
        advance(x, v_alpha, v_beta, load, PERIOD, substeps, True, 0.0, 0.0, 0.2, m)
    i_alpha, i_beta = currents(motor, x)
    return np.array([i_alpha, i_beta, x[X_OMEGA_M], wrap(motor.pole_pairs * x[X_THETA_M])])


def run_scipy(motor: Motor, voltages: Array, load: float) -> Array:
    """dq currents as states, rotor frame, DOP853: nothing in common with the kernel but the physics."""
    p = motor.pole_pairs

    def derivative(_: float, y: Array, v_alpha: float, v_beta: float) -> list[float]:
        i_d, i_q, omega_m, theta = y
        v = (v_alpha + 1j * v_beta) * np.exp(-1j * theta)
        omega = p * omega_m
        return [
            (v.real - motor.R * i_d + omega * motor.L_q * i_q) / motor.L_d,
            (v.imag - motor.R * i_q - omega * (motor.L_d * i_d + motor.psi_m)) / motor.L_q,
            (motor.torque(i_d, i_q) - load - FRICTION * omega_m) / motor.J,
            omega,
        ]

    y = np.array([0.0, 0.0, 30.0, 0.4])
    for v_alpha, v_beta in voltages:
        y = solve_ivp(derivative, (0.0, PERIOD), y, "DOP853", rtol=1e-12, atol=1e-12,
                      args=(v_alpha, v_beta)).y[:, -1]
    i = (y[0] + 1j * y[1]) * np.exp(1j * y[3])
    return np.array([i.real, i.imag, y[2], math.remainder(y[3], 2.0 * math.pi)])


@pytest.mark.parametrize("motor", [M1, M2])
def test_agrees_with_scipy_on_dq_currents_and_converges_with_the_fourth_order(motor: Motor) -> None:
    voltages = random_voltages(motor, 100)
    reference = run_scipy(motor, voltages, 1.5)
    assert np.hypot(reference[0], reference[1]) > 0.5  # the sequence does something
    errors = [np.abs(run_kernel(motor, voltages, 1.5, n) - reference).max() for n in (1, 2, 4, 10)]
    assert errors[3] < 1e-8
    assert 12.0 < errors[0] / errors[1] < 20.0
    assert 12.0 < errors[1] / errors[2] < 20.0


@pytest.mark.parametrize("motor", [M1, M2])
def test_current_is_the_papers_inductance_matrix_inverted(motor: Motor) -> None:
    rng = np.random.default_rng(1)
    for theta in rng.uniform(-7.0, 7.0, 50):
        i = rng.uniform(-10.0, 10.0, 2)
        c2, s2 = math.cos(2 * theta), math.sin(2 * theta)
        L = motor.L_s * np.eye(2) + 0.5 * motor.L_0 * np.array([[c2, s2], [s2, -c2]])
        flux = L @ i + motor.psi_m * np.array([math.cos(theta), math.sin(theta)])
        m = pack_machine(motor)
        assert stationary_current(flux[0], flux[1], theta, m) == pytest.approx(i, abs=1e-11)
        i_dq = (i[0] + 1j * i[1]) * np.exp(-1j * theta)
        assert air_gap_torque(flux[0], flux[1], i[0], i[1], m) == pytest.approx(
            motor.torque(i_dq.real, i_dq.imag), abs=1e-10)


@pytest.mark.parametrize("motor", [M1, M2])
def test_energy_is_neither_made_nor_lost(motor: Motor) -> None:
    """Electrical energy in = copper loss + friction + load + change of kinetic and magnetic energy."""
    m = pack_machine(motor, FRICTION)
    x = initial_state(motor, -1.0, 20.0)
    step, load = 5e-6, 0.8

    def stored() -> float:
        c, s = math.cos(motor.pole_pairs * x[X_THETA_M]), math.sin(motor.pole_pairs * x[X_THETA_M])
        i_alpha, i_beta = currents(motor, x)
        i_d, i_q = c * i_alpha + s * i_beta, c * i_beta - s * i_alpha
        return float(0.75 * (motor.L_d * i_d**2 + motor.L_q * i_q**2) + 0.5 * motor.J * x[X_OMEGA_M] ** 2)

    def powers(v_alpha: float, v_beta: float) -> Array:
        i_alpha, i_beta = currents(motor, x)
        return np.array([1.5 * (v_alpha * i_alpha + v_beta * i_beta),
                         1.5 * motor.R * (i_alpha**2 + i_beta**2),
                         FRICTION * x[X_OMEGA_M] ** 2, load * x[X_OMEGA_M]])

    before = stored()
    energy = np.zeros(4)
    for v_alpha, v_beta in random_voltages(motor, 100):
        for _ in range(40):
            at_start = powers(v_alpha, v_beta)
            advance(x, v_alpha, v_beta, load, step, 1, True, 0.0, 0.0, 0.2, m)
            energy += 0.5 * step * (at_start + powers(v_alpha, v_beta))
    electrical, copper, friction, shaft = energy
    change = stored() - before
    assert copper > 0.01
    assert abs(change) > 0.01
    assert electrical == pytest.approx(copper + friction + shaft + change, abs=1e-5 * np.abs(energy).sum())


def test_imposed_speed_moves_the_angle_by_the_area_under_the_line() -> None:
    x = initial_state(M2, 0.2, 3.0)
    m = pack_machine(M2)
    for k in range(50):
        advance(x, 10.0, -5.0, 0.0, PERIOD, 3, False, 3.0 + 2.0 * (k + 1), 0.0, 0.2, m)
    t = 50 * PERIOD
    assert x[X_OMEGA_M] == 103.0
    assert x[X_THETA_M] == pytest.approx(0.2 / 3.0 + 3.0 * t + 0.5 * 100.0 * t, abs=1e-13)


@pytest.mark.parametrize("angle", [0.0, math.pi, -math.pi, 3.0, -3.2, 100.0, -1e4, np.nextafter(math.pi, 0)])
def test_wrap_keeps_the_angle_and_puts_it_in_range(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped <= math.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-11)


CLARKE = 2.0 / 3.0 * np.array([[1.0, -0.5, -0.5], [0.0, math.sqrt(0.75), -math.sqrt(0.75)]])


def test_dead_time_takes_a_voltage_off_each_phase_against_its_current() -> None:
    rng = np.random.default_rng(3)
    for _ in range(300):
        i = rng.normal(0.0, 3.0, 2)
        phases = 1.5 * CLARKE.T @ i  # inverse Clarke, no zero sequence
        error = np.array(inverter.dead_time_error(i[0], i[1], 0.5, 0.2))
        assert error @ i < 0.0  # it always takes power
        assert np.hypot(*error) <= 4.0 / 3.0 * 0.5 + 1e-12
        if np.abs(phases).min() > 0.2:
            assert error == pytest.approx(CLARKE @ (-0.5 * np.sign(phases)), abs=1e-12)


def test_dead_time_fades_out_smoothly_around_zero_current() -> None:
    x = np.linspace(-1.5, 1.5, 3001)
    sign = np.array([inverter.soft_sign(value) for value in x])
    assert sign[1500] == 0.0
    assert np.all(np.diff(sign) >= 0.0)
    assert np.abs(np.diff(sign, 2)).max() < 4e-6  # no kink: second difference is of order dx^2
    assert (sign[0], sign[-1]) == (-1.0, 1.0)


def test_voltage_limit_shortens_and_keeps_the_direction() -> None:
    assert inverter.limit_voltage(3.0, 4.0, 5.0) == (3.0, 4.0)
    assert inverter.limit_voltage(-30.0, 40.0, 5.0) == pytest.approx((-3.0, 4.0))


def test_adc_rounds_noise_and_offset_included() -> None:
    assert inverter.measure_current(1.0, 0.25, -0.1, 0.0) == pytest.approx(1.15)
    assert inverter.measure_current(1.0, 0.25, -0.08, 0.1) == pytest.approx(1.2)
    assert inverter.measure_current(-1.0, -0.25, 0.13, 0.1) == pytest.approx(-1.1)


def test_dead_time_error_acts_inside_the_machine() -> None:
    """A locked rotor fed with V settles where V = R i + what the dead time takes."""
    m = pack_machine(M2)
    x = initial_state(M2)
    for _ in range(2000):
        advance(x, 4.0, 0.0, 0.0, PERIOD, 4, False, 0.0, 0.5, 0.2, m)
    i_alpha, i_beta = currents(M2, x)
    # i_a > 0 > i_b = i_c: the error in alpha is 2/3 (1 + 1/2 + 1/2) 0.5 V
    assert i_alpha == pytest.approx((4.0 - 4.0 / 3.0 * 0.5) / M2.R, rel=1e-9)
    assert i_beta == pytest.approx(0.0, abs=1e-12)


def test_machine_parameters_are_in_the_kernels_order() -> None:
    m = pack_machine(M1, 0.1)
    assert len(m) == machine.M_SIZE
    assert (m[machine.M_L_D], m[machine.M_L_Q], m[machine.M_FRICTION]) == (M1.L_d, M1.L_q, 0.1)
