"""What the campaign found while an angle was valid and wrong, each cause by itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st_
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import CoSimulation
from ipmsm_can.campaign import scenario, trial
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from, parse_config
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.estimation.estimator import Estimator
from ipmsm_can.estimation.observers import common, covariance, forgetting, handover, lost_steps, voltage_errors
from ipmsm_can.estimation.observers.kinds import KINDS
from ipmsm_can.motor import M1, M2
from ipmsm_can.startup import Phase, StartUp, StartUpSettings
from ipmsm_can.wire.protocol import Protocol
from ipmsm_can.wire.sequence import Events, SampleSequencer
from ipmsm_can.wire.sequence_kernel import FILLED_S, NIBBLE, TIMING

RATE = 5000.0


def test_what_was_learned_of_the_voltage_at_the_wrong_end_is_forgotten() -> None:
    """The polarity turned out to be the other one: the voltage errors found with it were its excuse."""
    state = common.new_state(0.0, 0.0, 0.0)
    state["P"][0] = 1e-6 * np.eye(9)
    state["bias"][0] = 0.1, -0.2, 0.9, 0.3, 0.4, 0.01, -0.01
    prior = np.array([0.01, 0.01, 0.25, 0.02, 0.09, 1e-4, 1e-4])
    handover.take_angle(state, 0.59, prior, -0.59 + 0j, 0.59 + 0j, 0.05)
    assert np.array_equal(state["bias"][0], np.zeros(7))
    assert np.array_equal(state["P"][0][2:, 2:], np.diag(prior))
    assert not state["P"][0][:2, 2:].any()
    assert state["P"][0][1, 1] == pytest.approx((0.59 * 0.05) ** 2)


def test_the_shape_of_dead_time_counts_for_phases_near_zero_current() -> None:
    """Against the phase currents of the Clarke transformation; nothing is left once all are large, and at zero only
    what the measured current may be wrong by."""
    for angle in np.linspace(0.0, 2.0 * math.pi, 13):
        i = 0.7 * np.exp(1j * angle)
        phases = np.real(i * np.exp(-2j * math.pi / 3.0 * np.arange(3)))
        shares = np.minimum(np.abs(phases) / 0.1, 1.0) * np.maximum(0.0, 1.0 - np.abs(phases) / 0.5)
        near = np.maximum(0.0, 1.0 - np.abs(phases) / 0.1)
        assert voltage_errors.near_zero(i.real, i.imag, 0.1, 0.5) == pytest.approx(
            (4.0 / 9.0 * (shares**2).sum(), 4.0 / 9.0 * (near**2).sum()))
    assert voltage_errors.near_zero(5.0, 2.0, 0.1, 0.5) == (0.0, 0.0)
    assert voltage_errors.near_zero(0.0, 0.0, 0.1, 0.5) == pytest.approx((0.0, 4.0 / 3.0))


@given(st_.floats(0.0, 0.7), st_.floats(-math.pi, math.pi), st_.floats(-1.0, 1.0), st_.floats(-0.5, 0.5))
def test_the_dead_time_of_a_wrong_current_is_that_of_another_current(size: float, angle: float, dead: float,
                                                                    late: float) -> None:
    """B_5 and B_6 against the difference that a small offset makes of B_2 and B_4."""
    i, zone, corner, step = size * np.exp(1j * angle), 0.1, 0.5, 1e-6
    phases = np.abs(np.real(i * np.exp(-2j * math.pi / 3.0 * np.arange(3))))
    assume(all(np.abs(phases - edge).min() > 1e-5 for edge in (zone, corner)))

    def lost(i_a: float, i_b: float) -> NDArray[np.float64]:
        B = np.zeros((7, 2))
        voltage_errors.directions(i_a, i_b, zone, B)
        voltage_errors.rounded(i_a, i_b, corner, B)
        return np.asarray(dead * B[2] + late * B[4], np.float64)

    B = np.zeros((7, 2))
    voltage_errors.shifted(i.real, i.imag, zone, corner, dead, late, B)
    for row, (d_a, d_b) in ((5, (step, 0.0)), (6, (0.0, step))):
        expected = (lost(i.real - d_a, i.imag - d_b) - lost(i.real + d_a, i.imag + d_b)) / (2.0 * step)
        assert B[row] == pytest.approx(expected, abs=1e-6)


def test_an_acceleration_that_ends_in_a_gap_is_allowed_for() -> None:
    """The rotor brakes hard, then 60 ms are missing in which the braking ends: sigma covers where it then is."""
    track = Profile(((0.0, 40.0), (0.5, 40.0), (0.6, 0.0), (1.0, 0.0)), ((0.0, 0.0),), 1.0)
    s = DriveSimulation(M2, DriveParameters(sample_rate=RATE, speed_imposed=True), track, 0.3).run(5000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    keep, gap = np.ones(5000, np.bool_), np.zeros(5000, np.int64)
    keep[2950:3250], gap[3250] = False, 300
    config = parse_config('[motor]\npreset = "m2"\n[observer]\nkind = "riccati"\n')
    out = Estimator(M2, RATE, estimator_settings(config)).process(np.ascontiguousarray(samples[:, keep]), gap[keep])
    first = int(np.flatnonzero(gap[keep])[0])
    error = abs(math.remainder(out.angle[0, first] - s.theta_e[keep][first], 2.0 * math.pi))
    assert out.flags[first - 1] & confidence.VALID
    assert error > math.radians(15.0), "else it shows nothing"
    assert error < 2.0 * out.sigma[first]
    assert not out.flags[first] & confidence.VALID


@pytest.mark.parametrize(("rate", "lost", "filled"), [(2500.0, 4, True), (2500.0, 5, False), (5000.0, 8, True),
                                                      (10_000.0, 8, True)])
def test_a_loss_is_filled_only_while_a_line_is_a_path(rate: float, lost: int, filled: bool) -> None:
    sequencer = SampleSequencer(8)
    counters = [0, 1, 2, 3 + lost, 4 + lost]
    kind = np.array([TIMING, *[NIBBLE] * 5])
    counter = np.array([0, *(c & 15 for c in counters)], np.int64)
    t_ns = np.array([0, *(round(c * 1e9 / rate) for c in counters)], np.int64)
    runs = sequencer.push(Events(kind, counter, np.array([rate, *[0.0] * 5]), t_ns, np.zeros((4, 6))))
    assert sum(int(r.filled.sum()) for r in runs) == (lost if filled else 0)
    assert max(int(r.gap.max()) for r in runs) == (0 if filled else lost)
    assert lost / rate < FILLED_S or not filled


def test_an_angle_has_to_be_surer_at_standstill_and_surer_still_to_become_valid() -> None:
    limit = math.radians(7.5)
    state = confidence.new_state(M2, 100.0, 0.06, 0.5, 0.02, limit, RATE, KINDS["riccati"])

    def judge(share: float, omega: float) -> int:
        n = round(0.5 * RATE)
        regression, flux, speed = np.zeros((7, n)), np.zeros((7, n)), np.zeros((3, n))
        regression[1] = 2.0 * 100.0 * M2.psi_m * omega / math.hypot(omega, 100.0)  # |Phi| of a rotor turning so
        flux[5], flux[6], speed[2] = share * limit, common.FITS + common.POLARITY, omega
        flags = np.empty(n, np.uint8)
        confidence.confidence_block(regression, flux, speed, state, np.empty(n), flags)
        return int(flags[-1])

    said = [bool(judge(share, omega) & confidence.VALID) for share, omega in (
        (0.7, 0.0), (0.5, 0.0), (0.75, 0.0), (0.85, 0.0), (0.75, 0.0), (0.9, 50.0), (0.8, 50.0), (0.95, 50.0),
        (0.75, 0.0))]
    assert said == [False, True, True, False, False, False, True, True, True]


def test_an_angle_put_right_at_standstill_is_no_speed() -> None:
    """A drive in closed loop would answer the speed of a correction with torque, and drop its load."""
    settings = estimator_settings(parse_config('[motor]\npreset = "m2"\n'), RATE)
    estimator = Estimator(M2, RATE, settings)
    still = np.zeros((4, 500))
    estimator.take_angle(0.3, math.radians(2.0))
    estimator.process(still)
    estimator.take_angle(0.4, math.radians(0.5))
    out = estimator.process(still[:, :200])
    assert 0.35 < out.angle[0, 0] < 0.41
    assert np.abs(out.angle[1] - out.angle[0]).max() < 1e-3
    assert np.abs(out.angle[2]).max() < 0.1  # rad/s electrical


def test_an_angle_has_to_be_sure_for_a_while_before_it_is_valid() -> None:
    limit = math.radians(7.5)
    state = confidence.new_state(M2, 100.0, 0.06, 0.5, 0.02, limit, RATE, KINDS["riccati"])
    n = 500
    regression, flux, speed = np.zeros((7, n)), np.zeros((7, n)), np.zeros((3, n))
    flux[5], flux[6] = 0.5 * limit, common.FITS + common.POLARITY
    flux[5, 120] = 1.1 * limit
    flux[5, 200:210] = 1.1 * limit
    flux[6, 300] = common.POLARITY  # no lock
    flux[5, 400:450] = 1.1 * limit
    flags = np.empty(n, np.uint8)
    confidence.confidence_block(regression, flux, speed, state, np.empty(n), flags)
    valid = flags & confidence.VALID != 0
    first = np.flatnonzero(np.diff(valid.astype(int), prepend=0) == 1)
    hold = round(0.005 * RATE)
    # sure again for as long as it was not, a few samples; a lock that was lost has its own probation
    locked = int(np.flatnonzero(flags & confidence.LOCKED)[0])
    assert first.tolist() == [locked + hold, 121, 219]
    assert not valid[120] and not valid[200:219].any() and not valid[300:].any()
    again = confidence.new_state(M2, 100.0, 0.06, 0.5, 0.02, limit, RATE, KINDS["riccati"])
    parts = []
    for at in range(0, n, 7):
        part = np.empty(min(7, n - at), np.uint8)
        cut = slice(at, at + part.size)
        confidence.confidence_block(np.ascontiguousarray(regression[:, cut]), np.ascontiguousarray(flux[:, cut]),
                                    np.ascontiguousarray(speed[:, cut]), again, np.empty(part.size), part)
        parts.append(part)
    assert np.array_equal(np.concatenate(parts), flags)


@pytest.mark.parametrize(("omega", "again"), [(0.0, 0.2), (5.0, 0.2), (25.0, 0.08), (100.0, 0.02), (2000.0, 0.005)])
def test_an_angle_that_went_astray_has_to_fit_while_the_rotor_turns_on(omega: float, again: float) -> None:
    limit = math.radians(7.5)
    state = confidence.new_state(M2, 100.0, 0.06, 0.5, 0.02, limit, RATE, KINDS["riccati"])
    n, lost = 8000, 5000
    regression, flux, speed = np.zeros((7, n)), np.zeros((7, n)), np.zeros((3, n))
    flux[5], flux[6] = 0.3 * limit, common.FITS + common.POLARITY
    flux[5, lost:lost + 100] = 1.3 * limit
    speed[2] = omega
    regression[1] = 2.0 * 100.0 * M2.psi_m * omega / math.hypot(omega, 100.0)  # |Phi| of a rotor that turns so fast
    flags = np.empty(n, np.uint8)
    confidence.confidence_block(regression, flux, speed, state, np.empty(n), flags)
    valid = flags & confidence.VALID != 0
    assert (flags[lost:] & confidence.LOCKED).all()
    assert valid[lost - 1] and not valid[lost:lost + 100].any()
    assert np.argmax(valid[lost + 100:]) == pytest.approx(again * RATE, abs=2)
    assert valid[lost + 100 + round(again * RATE) + 2:].all()


def test_samples_dated_anew_after_a_lock_was_lost_leave_no_angle() -> None:
    """What had been taken for the next samples came long after a gap: the speed from before it is forgotten."""
    estimator = Estimator(M2, RATE, estimator_settings(parse_config('[motor]\npreset = "m2"\n'), RATE))
    track = Profile(((0.0, 10.0),), ((0.0, 0.0),), 0.6)
    s = DriveSimulation(M2, DriveParameters(sample_rate=RATE), track).run(3000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    known = estimator.process(samples[:, :2900].copy())
    assert known.flags[-1] & confidence.VALID
    estimator._confidence["locked"] = 0
    gap = np.zeros(100, np.int64)
    gap[0] = -16
    after = estimator.process(samples[:, 2900:].copy(), gap)
    assert np.degrees(after.sigma[0]) > 90.0 and not after.flags[0] & confidence.POLARITY_KNOWN


def test_a_gap_after_a_lost_lock_allows_for_a_load_that_nobody_saw() -> None:
    estimator = Estimator(M2, RATE, estimator_settings(parse_config('[motor]\npreset = "m2"\n'), RATE))
    s = DriveSimulation(M2, DriveParameters(sample_rate=RATE), Profile(((0.0, 3.0),), ((0.0, 0.0),), 0.6)).run(3000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    estimator.process(samples[:, :2500].copy())
    estimator._confidence["locked"] = 0
    gap = np.zeros(50, np.int64)
    gap[0] = 250
    after = estimator.process(samples[:, 2750:2800].copy(), gap)
    unseen = 0.25 * M2.pole_pairs * M2.rated_torque / M2.J
    assert after.sigma[0] > 0.7 * min(0.5 * unseen * (250 / RATE) ** 2, math.pi)


def test_a_rotor_that_stood_still_may_have_crept_on_in_a_gap() -> None:
    settings = estimator_settings(parse_config('[motor]\npreset = "m1"\n'))

    def after(missing: int) -> StartUp:
        startup = StartUp(M1, Estimator(M1, RATE, settings), StartUpSettings(400.0, 5.0, 60.0))
        startup.phase, startup.angle, startup.sigma = Phase.KNOWN, 0.3, math.radians(3.0)
        startup.process(np.zeros((4, 1)), np.array([missing]), np.zeros(1, np.uint8))
        return startup

    crept = 0.5 / M1.psi_m * 150 / RATE  # as much as 0.5 V may hide
    assert after(150).sigma == pytest.approx(math.hypot(math.radians(3.0), crept))
    assert after(150).phase is Phase.KNOWN
    assert after(1000).phase is Phase.WATCH


def test_lost_samples_take_the_volts_of_a_step_of_the_current_with_them() -> None:
    """A straight line stands in for eight samples in which the current went from 5 A to nothing."""
    track = Profile(((0.0, 80.0), (0.6, 80.0)), ((0.0, 4.5), (0.4, 4.5), (0.4, 0.0)), 0.6)
    drive = DriveParameters(sample_rate=RATE, speed_imposed=True, current_bandwidth=400.0, current_noise=0.01)
    s = DriveSimulation(M1, drive, track, 0.3).run(3000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    config = parse_config('[motor]\npreset = "m1"\n')
    current = np.hypot(samples[0], samples[1])
    first = int(np.flatnonzero(current[1900:] < 0.97 * current[1900])[0]) + 1900
    lost = np.arange(first, first + 8)
    cut = samples.copy()
    for row in cut:
        row[lost] = np.interp(lost, [first - 1, first + 8], row[[first - 1, first + 8]])
    for told, least, most in ((samples, 0.0, 2.0), (cut, 8.0, 90.0)):
        out = Estimator(M1, RATE, estimator_settings(config, RATE)).process(told)
        error = np.abs(np.degrees(np.angle(np.exp(1j * (out.angle[0] - s.theta_e)))))[first - 5:first + 60]
        assert least < error.max() < most
        assert (error < 2.0 * np.degrees(out.sigma[first - 5:first + 60]) + 1.0).all()
    assert not (out.flags[lost[4:]] & confidence.VALID).any()


def test_the_length_of_the_active_flux_holds_while_a_standing_rotor_is_probed() -> None:
    """What the regression says of it there is wrong, and shrank it by half within a second."""
    track = Profile(((0.0, 0.0),), ((0.0, 0.0),), 2.0)
    drive = DriveParameters(sample_rate=RATE, saturation=0.2, rotor_locked=True, dead_time_voltage=0.5)
    companion = Companion([config_from({"motor": {"preset": "m1"}})], Protocol(), transmit=True)
    node = DriveNode(Protocol(), 0, DriveSimulation(M1, drive, track, 0.7, 2), DriveNodeSettings())
    tracked = CoSimulation([node], companion).run(2.0).tracked[0]
    length = np.abs(np.concatenate([t.estimate.flux[2] + 1j * t.estimate.flux[3] for t in tracked]))
    flags = np.concatenate([t.estimate.flags for t in tracked])
    assert (flags[2500:] & confidence.VALID).all()
    assert length[2500:] == pytest.approx(M1.psi_m, rel=0.15)


def test_what_the_probing_signal_moves_within_lost_samples_is_counted() -> None:
    """Seven of twenty samples of a period are a straight line: the volts between its arc and its chord."""
    rate, lost = 10_000.0, 7
    p = common.parameters(KINDS["riccati"], M1, 100.0, 1.0, 1e-3, rate, current_noise=0.02)[0]
    state = common.new_state(M1.psi_m, 0.0, 0.0)
    st = state[0]
    st["x_a"] = M1.psi_m
    st["P"][0, 0] = st["P"][1, 1] = (0.5 * M1.psi_m) ** 2  # an angle that is roughly known, to 29 deg
    turn = 2.0 * math.pi * 500.0 / rate
    voltage = 6.6 * np.exp(1j * turn * np.arange(40))  # mean over the interval that a sample ends
    inductance = np.array([M1.L_d, M1.L_q])
    moved = voltage / rate
    change = moved.real / inductance[0] + 1j * moved.imag / inductance[1]
    current = 5.0j + np.cumsum(change)
    at = np.arange(40)
    gap = at[20:20 + lost]
    ends = [gap[0] - 1, gap[-1] + 1]
    line_v, line_i = (np.where(np.isin(at, gap), np.interp(at, ends, x[ends].real)
                               + 1j * np.interp(at, ends, x[ends].imag), x) for x in (voltage, current))
    # of the flux, by the line's own volts and by the machine's
    missing = abs(moved[gap[0]:ends[1] + 1].sum() - line_v[gap[0]:ends[1] + 1].sum() / rate)

    def counted(v: NDArray[np.complex128], i: NDArray[np.complex128]) -> float:
        samples = np.ascontiguousarray([i.real, i.imag, v.real, v.imag])
        total = 0.0
        for k in at:
            straight = lost_steps.straight_on(samples, int(k), st)
            di = i[k] - i[k - 1] if k else 0j
            total += lost_steps.left_out(di.real, di.imag, v[k].real / rate, v[k].imag / rate, straight, st, p)
        return math.sqrt(total)

    assert missing > 0.01 * M1.psi_m, "else it shows nothing"
    assert counted(voltage, current) == 0.0
    assert counted(line_v, line_i) == pytest.approx(missing, rel=0.2)
    st["P"][0, 0] = st["P"][1, 1] = (2.0 * M1.psi_m) ** 2  # with no angle there is no inductance either
    assert counted(line_v, line_i) == 0.0


def test_saturation_by_the_load_is_in_sigma() -> None:
    """A machine that gives way as `uncertainty.saturation` says: what it was told of L_q is wrong under load."""
    track = Profile(((0.0, 100.0), (0.6, 100.0)), ((0.0, 0.0), (0.2, 1.15 * M1.rated_torque)), 0.6)
    drive = DriveParameters(sample_rate=RATE, speed_imposed=True, saturation=0.2)
    s = DriveSimulation(M1, drive, track, 0.3).run(3000)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    settings = estimator_settings(parse_config('[motor]\npreset = "m1"\n'), RATE)
    out = Estimator(M1, RATE, settings).process(samples)
    error = np.degrees(np.abs(np.angle(np.exp(1j * (out.angle[0] - s.theta_e)))))[2500:]
    sigma = np.degrees(out.sigma)[2500:]
    assert error.mean() > 4.0, "else it shows nothing"
    assert (error < 2.0 * sigma).all() and sigma.max() < 6.0
    # By hand, where nothing else is wrong: L_q i_q/psi_m times the share that the law gives.
    p = common.parameters(KINDS["riccati"], M1, 100.0, 1.0, 1e-3, RATE, current_noise=0.0,
                          uncertainty=voltage_errors.Uncertainty(current=0.0, inductance=0.0, saturation=0.3))[0]
    rated = M1.rated_current
    for i_q in (rated, 0.5 * rated):
        share = 0.5 * 0.3 * (i_q / rated) ** 3
        assert covariance.angle_sigma(np.zeros((9, 9)), M1.psi_m, 0.0, i_q**2, p) == pytest.approx(
            M1.L_q * i_q * share / M1.psi_m)


@pytest.mark.parametrize("theta_0", [0.0, 1.57, 3.9])
def test_offsets_of_the_current_sensors_are_learned_and_so_is_their_dead_time(theta_0: float) -> None:
    """Loaded, so that the dead time is known; idling, where the sensors' offsets make a quarter of it; then a load
    at standstill, where nothing is seen of the angle and a wrong voltage would turn it away, surely.
    """
    offset = (0.02, -0.02)
    track = Profile(((0.0, 55.0), (1.0, 55.0), (1.2, 0.0), (1.5, 0.0)),
                    ((0.0, 3.0), (0.4, 3.0), (0.4, 0.0), (1.2, 0.0), (1.2, 0.9 * M2.rated_torque)), 1.5)
    drive = DriveParameters(sample_rate=RATE, speed_imposed=True, dead_time_voltage=0.95, dead_time_zone=0.1,
                            current_offset=offset, current_noise=0.02)
    s = DriveSimulation(M2, drive, track, theta_0).run(7500)
    samples = np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
    estimator = Estimator(M2, RATE, estimator_settings(parse_config('[motor]\npreset = "m2"\n'), RATE))
    out = estimator.process(np.ascontiguousarray(samples[:, :6000]))
    learned = estimator.records[3]["bias"][0]
    assert learned[2] == pytest.approx(0.95, abs=0.3)
    assert learned[5:] == pytest.approx(offset, abs=0.008)
    out = estimator.process(np.ascontiguousarray(samples[:, 6000:]))
    error = np.degrees(np.abs(np.angle(np.exp(1j * (out.angle[0] - s.theta_e[6000:])))))
    assert (error < 1.5 * np.degrees(out.sigma)).all()


@given(st_.integers(0, 2**32 - 1), st_.floats(0.5, 2.0), st_.floats(0.1, 4.0))
def test_doubt_makes_nothing_surer(seed: int, wide: float, test: float) -> None:
    """The voltage's errors go back to their priors, the flux's grow by what the innovations are too large."""
    root = np.random.default_rng(seed).standard_normal((9, 9))
    before = root @ root.T / 9.0
    parameters = np.zeros(1, [("prior", "f8", (7,))])
    parameters["prior"] = wide * np.diag(before)[2:]
    P = before.copy()
    forgetting.distrust(P, test, parameters[0])
    assert np.array_equal(P, P.T)
    assert np.allclose(P[:2, :2], max(test, 1.0) * before[:2, :2])
    assert np.allclose(np.diag(P)[2:], max(1.0, wide) * np.diag(before)[2:])
    assert np.linalg.eigvalsh(P).min() > -1e-12


def test_windows_that_are_wrong_alike_make_the_angle_no_surer_than_one_of_them() -> None:
    estimator = Estimator(M2, RATE, estimator_settings(parse_config('[motor]\npreset = "m2"\n'), RATE))
    start_up = StartUp(M2, estimator, StartUpSettings(frequency=400.0, current=2.0, amplitude=40.0))
    estimator.take_angle(0.0, 0.2)
    start_up.resume(0.0, 0.2)
    state = estimator._observer[0]

    def sigma() -> float:
        x = float(state["x_a"]), float(state["x_b"])
        return math.sqrt(covariance.across(state["P"], *x)) / math.hypot(*x)

    assert sigma() == pytest.approx(0.2, rel=0.05)
    for _ in range(50):
        start_up._judge_known(True, sigma(), 0.1, 0.12)
    assert 0.119 < sigma() < 0.125
    assert 0.02 < math.atan2(state["x_b"], state["x_a"]) < 0.1


@pytest.mark.parametrize("number", [436, 2130, 2435, 2861, 5187, 6088, 7318, 11992, 13878])
def test_runs_of_the_campaign_that_were_wrong_once(number: int) -> None:
    """Numbers beyond 10,000: of seed 2."""
    course = trial.simulate(scenario.draw(*divmod(number + 10_000, 10_000)))
    error = np.abs(course.error[course.valid])
    assert error.size > 500
    assert error.max() < trial.WRONG_DEG
    assert (error / course.sigma[course.valid]).max() < 4.0
