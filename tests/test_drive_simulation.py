"""The whole simulated drive: timing of the samples, control, limits, sensors, injection, determinism."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from ipmsm_can.drive import control
from ipmsm_can.drive.parameters import DriveParameters, torque_at_current
from ipmsm_can.drive.profile import RPM, Profile, constant, demo, paper_ramp, torque_pulses
from ipmsm_can.drive.simulation import DriveSamples, DriveSimulation
from ipmsm_can.motor import M1, M2, Motor

Array = NDArray[np.float64]
IDEAL = DriveParameters().noise_free()
TS = 1.0 / IDEAL.sample_rate
SPINNING = constant(1000.0 * RPM, 2.0)


def bits(samples: DriveSamples) -> list[bytes]:
    return [getattr(samples, field.name).tobytes() for field in fields(samples)]


def whole(motor: Motor, parameters: DriveParameters, profile: Profile) -> DriveSamples:
    simulation = DriveSimulation(motor, parameters, profile)
    return simulation.run(simulation.samples_in_profile)


def speed_error(motor: Motor, samples: DriveSamples) -> Array:
    return samples.omega_e / motor.pole_pairs - samples.speed_reference


# ---------------------------------------------------------------- determinism


EVERYTHING = DriveParameters(mtpa=True, dead_time_voltage=0.5, current_offset=(0.1, -0.05), adc_step=0.005,
                             friction=0.001)


def busy_run(partition: list[int]) -> list[bytes]:
    """Runs the blocks; injection commands come at samples 200, 500 and 700, which must be block borders."""
    simulation = DriveSimulation(M2, EVERYTHING, demo(), theta_0=1.0, seed=7)
    commands = {200: (1, 6.0, 400.0, 0.0, 150), 500: (3, 20.0, 250.0, 0.5, 1000),
                700: (2, 8.0, 411.0, -1.0, 99)}
    parts = []
    for n in partition:
        if simulation.next_sample in commands:
            simulation.command_injection(*commands[simulation.next_sample])
        parts.append(simulation.run(n))
    joined = DriveSamples(*(np.concatenate([getattr(part, field.name) for part in parts])
                            for field in fields(DriveSamples)))
    return bits(joined)


REFERENCE_BITS: list[bytes] = []


def reference_bits() -> list[bytes]:
    if not REFERENCE_BITS:
        REFERENCE_BITS.extend(busy_run([200, 300, 200, 300]))
    return REFERENCE_BITS


def test_a_thousand_single_samples_are_one_block_of_a_thousand_to_the_last_bit() -> None:
    assert busy_run([1] * 1000) == reference_bits()
    one = DriveSimulation(M2, EVERYTHING, demo()).run(1000)
    singles = DriveSimulation(M2, EVERYTHING, demo())
    last = [singles.run(1) for _ in range(1000)][-1]
    assert (last.i_alpha[0], last.v_beta[0], last.sample[0]) == (one.i_alpha[-1], one.v_beta[-1], 999)


@given(cuts=st.lists(st.integers(1, 999), max_size=12, unique=True))
@settings(max_examples=20)
def test_any_partition_gives_the_same_bits(cuts: list[int]) -> None:
    borders = sorted({0, 200, 500, 700, 1000, *cuts})
    assert busy_run(np.diff(borders).tolist()) == reference_bits()


def test_the_seed_decides_the_noise_and_nothing_else_is_random() -> None:
    runs = [DriveSimulation(M2, DriveParameters(), demo(), seed=seed).run(100) for seed in (1, 1, 2)]
    assert bits(runs[0]) == bits(runs[1])
    assert not np.array_equal(runs[0].i_alpha, runs[2].i_alpha)


def test_an_empty_block_changes_nothing() -> None:
    simulation = DriveSimulation(M2, DriveParameters(), demo())
    assert len(simulation.run(0)) == 0
    assert bits(simulation.run(50)) == bits(DriveSimulation(M2, DriveParameters(), demo()).run(50))


# ---------------------------------------------------------------- what a sample means


def test_the_voltage_of_a_sample_is_the_mean_of_the_interval_that_ended_with_it() -> None:
    """Flux at t_k from current and angle must move by exactly Ts v_k - R (integral of i)."""
    simulation = DriveSimulation(M2, IDEAL, SPINNING, theta_0=0.8)
    simulation.command_injection(1, 20.0, 500.0, 0.0, 10_000)
    r = simulation.run(3000)
    turn = np.exp(1j * r.theta_e)
    i_dq = r.i_d + 1j * r.i_q
    assert np.allclose(r.i_alpha + 1j * r.i_beta, i_dq * turn, atol=1e-12)
    flux = (M2.L_d * r.i_d + M2.psi_m + 1j * M2.L_q * r.i_q) * turn
    i = r.i_alpha + 1j * r.i_beta
    v = r.v_alpha + 1j * r.v_beta
    mean_i = 0.5 * (i[1:] + i[:-1])
    residual = np.diff(flux) / TS - (v[1:] - M2.R * mean_i)
    assert np.abs(residual).max() < 0.05  # V: what the trapezoid of i leaves
    assert np.abs(np.diff(flux)[1:] / TS - (v[1:-1] - M2.R * mean_i[1:])).max() > 1.0  # one interval off


def test_active_flux_is_the_papers() -> None:
    r = DriveSimulation(M2, replace(IDEAL, mtpa=True), constant(50.0, 6.0)).run(4000)
    assert np.allclose(r.active_flux, M2.psi_m + M2.L_0 * r.i_d, atol=1e-12)
    assert np.allclose(r.torque, 1.5 * M2.pole_pairs * r.active_flux * r.i_q, atol=1e-10)
    assert r.active_flux[-1] > M2.psi_m


def test_a_spinning_start_has_no_transient() -> None:
    r = DriveSimulation(M2, IDEAL, constant(1000.0 * RPM, 0.0), theta_0=2.0).run(200)
    assert np.hypot(r.i_d, r.i_q).max() < 0.05
    assert r.theta_e[0] == pytest.approx(2.0)


def test_the_angle_stays_exact_over_minutes() -> None:
    """1000 rpm imposed: a turn is 600 samples, so after every 600 the angle is the same."""
    simulation = DriveSimulation(M2, replace(IDEAL, speed_imposed=True, substeps=1), constant(1000.0 * RPM))
    first = simulation.run(1).theta_e[0]
    for _ in range(20):
        r = simulation.run(60_000)
        assert np.abs(r.theta_e).max() <= math.pi
        assert math.remainder(r.theta_e[-1] - first, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-8)


# ---------------------------------------------------------------- control


@pytest.mark.parametrize("mtpa", [False, True])
def test_speed_follows_the_papers_ramp(mtpa: bool) -> None:
    r = whole(M1, DriveParameters(mtpa=mtpa), paper_ramp())
    error = speed_error(M1, r)
    assert np.abs(error).max() < 1.0
    assert np.abs(error[4000:5000]).max() < 0.1  # before the ramp
    assert np.abs(error[20_000:]).max() < 0.1  # after it


def test_speed_settles_back_between_torque_pulses() -> None:
    r = whole(M2, DriveParameters(), torque_pulses())
    error = np.abs(speed_error(M2, r))
    assert 1.0 < error.max() < 8.0
    for end in (5000, 10_000, 15_000, 20_000, 25_000):
        assert error[end - 1000 : end].max() < 0.1
    assert r.torque[9000:10_000].mean() == pytest.approx(6.2, rel=0.01)


def test_speed_follows_the_demo_through_reversal_and_standstill() -> None:
    r = whole(M2, DriveParameters(dead_time_voltage=0.5, adc_step=0.005), demo())
    error = np.abs(speed_error(M2, r))
    assert error.max() < 8.0
    assert np.quantile(error, 0.9) < 1.0
    assert np.abs(r.omega_e[5_000:15_000]).max() < 1.0


def test_torque_step_rises_with_the_current_bandwidth() -> None:
    rises = []
    for bandwidth in (100.0, 200.0, 400.0):
        parameters = replace(IDEAL, rotor_locked=True, current_bandwidth=bandwidth)
        r = DriveSimulation(M2, parameters, Profile(((0.0, 0.0),), ((0.01, 0.0), (0.01, 4.0)))).run(1000)
        assert r.torque[-1] == pytest.approx(4.0, rel=1e-3)
        assert r.torque.max() < 4.0 * 1.3
        rises.append((np.argmax(r.torque > 4.0 * (1.0 - math.exp(-1.0))) - 100) * TS)
        assert np.ptp(r.theta_e) == 0.0
    expected = [1.0 / (2.0 * math.pi * b) for b in (100.0, 200.0, 400.0)]
    assert np.abs(np.array(rises) - expected).max() < 3.0 * TS  # plus the delay, less its lead


def test_a_torque_step_at_speed_leaves_the_d_axis_alone() -> None:
    """At 1000 rpm the coupling omega_e L_q i_q is 9 V; without the feed-forward it costs 0.7 A of i_d."""
    profile = Profile(((0.0, 1000.0 * RPM),), ((0.0, 0.0), (0.01, 0.0), (0.01, 6.0)))
    r = DriveSimulation(M2, replace(IDEAL, speed_imposed=True), profile).run(1000)
    assert r.torque[-1] == pytest.approx(6.0, rel=1e-3)
    assert np.abs(r.i_d).max() < 0.15


@pytest.mark.parametrize("motor", [M1, M2, Motor(4, 0.05, 1e-3, 5e-3, 0.1), Motor(4, 0.05, 5e-3, 1e-3, 0.1)])
@pytest.mark.parametrize("torque", [-6.0, -0.5, 0.0, 0.1, 3.0, 9.0])
def test_mtpa_is_the_least_current_for_the_torque(motor: Motor, torque: float) -> None:
    i_d, i_q = control.current_reference(torque, motor.pole_pairs, motor.psi_m, motor.L_0, True)
    assert motor.torque(i_d, i_q) == pytest.approx(torque, abs=1e-9)

    def current_squared(d: float) -> float:
        q = torque / (1.5 * motor.pole_pairs * (motor.psi_m + motor.L_0 * d))
        return d * d + q * q

    span = 0.99 * motor.psi_m / abs(motor.L_0)  # up to where the active flux would vanish
    best = minimize_scalar(current_squared, bounds=(-span if motor.L_0 > 0 else -100.0,
                                                    100.0 if motor.L_0 > 0 else span),
                           method="bounded", options={"xatol": 1e-10})
    assert i_d**2 + i_q**2 == pytest.approx(best.fun, rel=1e-8, abs=1e-12)


def test_mtpa_of_a_machine_without_saliency_is_zero_i_d() -> None:
    assert control.current_reference(2.0, 3.0, 0.5, 0.0, True) == pytest.approx((0.0, 2.0 / 2.25))
    assert control.mtpa_i_d(5.0, 0.5, 0.0) == 0.0


def test_torque_at_a_current_is_the_most_that_current_can_give() -> None:
    motor = Motor(4, 0.05, 1e-3, 5e-3, 0.1)
    best = minimize_scalar(lambda beta: -motor.torque(-20.0 * math.sin(beta), 20.0 * math.cos(beta)),
                           bounds=(0.0, 1.5), method="bounded", options={"xatol": 1e-9})
    assert torque_at_current(motor, 20.0, True) == pytest.approx(-best.fun, rel=1e-9)
    torque = torque_at_current(motor, 20.0, True)
    assert math.hypot(*control.current_reference(torque, 4.0, 0.05, -4e-3, True)) == pytest.approx(20.0)
    same = brentq(lambda i: motor.torque(0.0, i) - torque_at_current(motor, 20.0, False), 0.0, 50.0)
    assert same == pytest.approx(20.0)


def test_the_simulated_drive_needs_less_current_with_mtpa() -> None:
    motor = Motor(4, 0.05, 1e-3, 5e-3, 0.1, rated_torque=6.0)
    amplitudes = []
    for mtpa in (False, True):
        r = DriveSimulation(motor, replace(IDEAL, mtpa=mtpa, i_max=50.0), constant(20.0, 4.0)).run(8000)
        assert r.torque[-1] == pytest.approx(4.0, rel=1e-3)
        amplitudes.append(math.hypot(r.i_d[-1], r.i_q[-1]))
    i_d, i_q = control.current_reference(4.0, 4.0, 0.05, -4e-3, True)
    assert amplitudes[1] == pytest.approx(math.hypot(i_d, i_q), rel=1e-3)
    assert amplitudes[1] < 0.9 * amplitudes[0]


def test_current_and_torque_limits_hold() -> None:
    pull = Profile(((0.0, 0.0), (0.001, 0.0), (0.001, 100.0)))
    for parameters, current in ((replace(IDEAL, i_max=1.5), 1.5),
                                (replace(IDEAL, torque_limit=2.0), 2.0 / (4.5 * M2.psi_m))):
        r = DriveSimulation(M2, parameters, pull).run(300)
        assert r.i_q.max() < 1.15 * current
        assert r.i_q[200:].mean() == pytest.approx(current, rel=0.02)


def test_voltage_limit_is_respected_and_does_not_wind_up() -> None:
    parameters = DriveParameters(v_dc=200.0)  # 115 V: enough for 620 rpm, not for 1000
    profile = Profile(((0.0, 300.0 * RPM), (0.5, 1000.0 * RPM), (2.0, 1000.0 * RPM), (2.2, 300.0 * RPM)),
                      duration=3.0)
    r = whole(M2, parameters, profile)
    magnitude = np.hypot(r.v_alpha, r.v_beta)
    assert magnitude.max() <= parameters.v_max * (1.0 + 1e-12)
    assert magnitude[10_000:20_000].min() > 0.99 * parameters.v_max  # the limit is what holds it
    error = speed_error(M2, r)
    assert np.abs(error[24_000:]).max() < 0.5  # 0.2 s after the ramp down it is back
    assert np.abs(error[21_100:]).max() < 12.0  # from where the reference has come down to the speed


@pytest.mark.parametrize("theta", [0.0, 2.5])
def test_neither_current_integrator_winds_up_at_the_voltage_limit(theta: float) -> None:
    """A winding that never takes current asks for ever more voltage: the integrators must stay finite."""
    motor = Motor(4, 0.05, 1e-3, 5e-3, 0.1)
    c = control.pack_control(motor, TS, 200.0, 15.0, 6.0, 10.0, True)
    s = np.zeros(control.S_SIZE)
    for _ in range(20_000):
        v = control.current_step(s, c, 0.0, 0.0, theta, 0.0, 6.0, 0.0, 0.0)
    assert math.hypot(*v) == pytest.approx(10.0)
    assert np.abs(s[[control.S_V_D, control.S_V_Q]]).max() < 10.0 + 1e-6


def test_imposed_speed_is_followed_exactly_and_torque_is_the_load_track() -> None:
    profile = Profile(((0.0, 20.0), (0.1, 20.0), (0.3, 120.0), (0.3, 80.0)),
                      ((0.0, 1.0), (0.2, 1.0), (0.2, 3.0)))
    r = DriveSimulation(M2, replace(IDEAL, speed_imposed=True), profile).run(4000)
    t = r.sample * TS
    exact = np.where(r.sample < 3000, np.interp(t, [0.1, 0.3], [20.0, 120.0]), 80.0)
    assert np.allclose(r.omega_e, 3.0 * exact, atol=1e-9)
    travelled = 3.0 * (20.0 * 0.1 + 70.0 * 0.2)  # the area under the speed up to 0.3 s
    assert math.remainder(r.theta_e[3000] - travelled, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert r.torque[1900] == pytest.approx(1.0, rel=0.01)
    assert r.torque[2900] == pytest.approx(3.0, rel=0.02)


# ---------------------------------------------------------------- inverter and sensors


def test_sensors_add_noise_offset_and_steps() -> None:
    parameters = DriveParameters(current_noise=0.05, current_offset=(0.3, -0.2))
    r = DriveSimulation(M2, parameters, SPINNING).run(20_000)
    true = (r.i_d + 1j * r.i_q) * np.exp(1j * r.theta_e)
    for measured, exact, offset in ((r.i_alpha, true.real, 0.3), (r.i_beta, true.imag, -0.2)):
        assert np.mean(measured - exact) == pytest.approx(offset, abs=0.002)
        assert np.std(measured - exact) == pytest.approx(0.05, rel=0.03)
    assert abs(np.corrcoef(r.i_alpha - true.real, r.i_beta - true.imag)[0, 1]) < 0.03
    r = DriveSimulation(M2, replace(IDEAL, adc_step=0.04), SPINNING).run(5000)
    true = (r.i_d + 1j * r.i_q) * np.exp(1j * r.theta_e)
    assert np.allclose(r.i_alpha / 0.04, np.round(r.i_alpha / 0.04), atol=1e-9)
    assert np.abs(r.i_alpha - true.real).max() <= 0.02 + 1e-12
    assert np.std(r.i_alpha - true.real) == pytest.approx(0.04 / math.sqrt(12.0), rel=0.1)


def test_noise_free_is_free_of_all_sensor_errors() -> None:
    parameters = DriveParameters(current_offset=(1.0, 1.0), adc_step=0.1).noise_free()
    r = DriveSimulation(M2, parameters, SPINNING).run(100)
    true = (r.i_d + 1j * r.i_q) * np.exp(1j * r.theta_e)
    assert np.allclose(r.i_alpha, true.real, atol=1e-13)
    assert np.allclose(r.i_beta, true.imag, atol=1e-13)


def test_dead_time_takes_power_between_the_commanded_voltage_and_the_machine() -> None:
    r = DriveSimulation(M2, replace(IDEAL, dead_time_voltage=0.5), constant(100.0 * RPM, 3.0)).run(5000)
    turn = np.exp(1j * r.theta_e)
    i = (r.i_d + 1j * r.i_q) * turn
    flux = (M2.L_d * r.i_d + M2.psi_m + 1j * M2.L_q * r.i_q) * turn
    mean_i = 0.5 * (i[1:] + i[:-1])
    error = np.diff(flux) / TS + M2.R * mean_i - (r.v_alpha + 1j * r.v_beta)[1:]
    loaded = np.abs(mean_i) > 0.5
    assert loaded.sum() > 3000
    assert np.all((error * np.conj(mean_i)).real[loaded] < 0.0)
    assert np.abs(error[loaded]).mean() == pytest.approx(4.0 / 3.0 * 0.5, rel=0.05)


# ---------------------------------------------------------------- injection


def test_injection_shows_two_samples_later_and_ends_with_its_time_to_live() -> None:
    simulation = DriveSimulation(M2, replace(IDEAL, injection_ramp=1e9), constant(0.0))
    simulation.run(100)
    simulation.command_injection(1, 6.0, 400.0, 0.0, 50)
    r = simulation.run(200)
    assert np.array_equal(np.flatnonzero(np.hypot(r.v_inj_alpha, r.v_inj_beta)), np.arange(2, 52))
    assert np.array_equal(np.flatnonzero(r.injection_waveform), np.arange(50))
    v = np.hypot(r.v_alpha, r.v_beta)
    assert v[:2].max() == 0.0
    assert v[2] == pytest.approx(6.0, rel=0.01)  # the very first: no current yet, so only the probe
    assert v[150:].max() < 0.05


def test_injection_is_cut_to_the_drives_own_limit() -> None:
    simulation = DriveSimulation(M2, replace(IDEAL, injection_limit=8.0), constant(0.0))
    simulation.command_injection(1, 500.0, 400.0, 0.0, 1000)
    r = simulation.run(1000)
    assert r.injection_amplitude.max() == 8.0
    sinc = math.sin(math.pi * 400.0 * TS) / (math.pi * 400.0 * TS)  # the mean over a period
    assert np.hypot(r.v_inj_alpha, r.v_inj_beta).max() == pytest.approx(8.0 * sinc, rel=1e-9)


def test_injection_counts_in_the_voltage_limit() -> None:
    parameters = DriveParameters(v_dc=335.0)  # 193.4 V, just above the magnet's 185 V at 1000 rpm
    simulation = DriveSimulation(M2, parameters, SPINNING)
    simulation.command_injection(1, 30.0, 400.0, 0.0, 5000)
    r = simulation.run(5000)
    assert np.hypot(r.v_alpha, r.v_beta).max() <= parameters.v_max * (1.0 + 1e-12)
    assert np.hypot(r.v_alpha, r.v_beta)[1000:].max() > 0.999 * parameters.v_max


def test_off_ramps_down() -> None:
    simulation = DriveSimulation(M2, replace(IDEAL, injection_ramp=1000.0), constant(0.0))
    simulation.command_injection(2, 10.0, 400.0, 0.0, 10_000)
    simulation.run(500)
    simulation.command_injection(0, 99.0, 0.0, math.nan, 10_000)
    r = simulation.run(200)
    assert np.allclose(r.injection_amplitude[:100], 10.0 - 0.1 * np.arange(1, 101), atol=1e-9)
    assert not r.injection_amplitude[101:].any()
    assert not r.injection_waveform[101:].any()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ((4, 6.0, 400.0, 0.0, 10), ["waveform", "4", "0 to 3"]),
        ((1, -1.0, 400.0, 0.0, 10), ["amplitude", "-1.0", "V"]),
        ((1, math.nan, 400.0, 0.0, 10), ["amplitude", "nan"]),
        ((1, 6.0, 0.0, 0.0, 10), ["frequency", "0.0", "5000"]),
        ((1, 6.0, 5001.0, 0.0, 10), ["frequency", "5001", "5000"]),
        ((1, 6.0, 400.0, math.inf, 10), ["axis_angle", "inf"]),
        ((1, 6.0, 400.0, 0.0, -1), ["ttl_samples", "-1"]),
    ],
)
def test_a_wrong_injection_command_is_refused_and_the_old_one_stays(
    command: tuple[int, float, float, float, int], words: list[str]
) -> None:
    simulation = DriveSimulation(M2, IDEAL, constant(0.0))
    simulation.command_injection(1, 6.0, 400.0, 0.0, 1000)
    with pytest.raises(ValueError) as caught:
        simulation.command_injection(*command)
    assert all(word in str(caught.value) for word in words)
    assert simulation.run(500).injection_amplitude[-1] == 6.0


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"sample_rate": 10.0}, ["sample_rate", "10.0", "100"]),
        ({"sample_rate": math.nan}, ["sample_rate", "nan"]),
        ({"substeps": 0}, ["substeps", "0", "1 to 1000"]),
        ({"substeps": 2.0}, ["substeps", "2.0", "whole"]),
        ({"v_dc": 0.0}, ["v_dc", "0.0", "above 0"]),
        ({"current_bandwidth": 1000.0}, ["current_bandwidth", "1000.0", "833.333"]),
        ({"speed_bandwidth": 51.0}, ["speed_bandwidth", "51.0", "50"]),
        ({"torque_limit": -1.0}, ["torque_limit", "-1.0"]),
        ({"i_max": math.inf}, ["i_max", "inf"]),
        ({"current_noise": -0.1}, ["current_noise", "-0.1"]),
        ({"current_offset": (0.0, math.nan)}, ["current_offset", "nan"]),
        ({"injection_ramp": 0.0}, ["injection_ramp", "0.0", "V/s"]),
        ({"speed_imposed": True, "rotor_locked": True}, ["speed_imposed", "rotor_locked"]),
    ],
)
def test_a_wrong_setting_is_refused_in_one_sentence(setting: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ValueError) as caught:
        DriveParameters(**setting)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)
