"""The whole simulated drive, sample by sample: profile, sensors, control, injection, inverter, machine.

One compiled loop runs a block of samples over explicit state, so blocks of any size give the same bits.

Time line.  At t_k the current is sampled; control and injection then make the voltage for the interval
t_(k+1) to t_(k+2), while the voltage made at t_(k-1) is being applied.  Sample k reports the current at
t_k and the commanded voltage of the interval that ended at t_k, which is exactly its mean; an injection
command given before sample k therefore first shows in the voltage of sample k + 2.

That is the convention; a drive can break it.  `sampling_lead` moves all that is sampled ahead of the voltage's
steps: t_k is then the instant of the current, and the voltage steps `sampling_lead` samples after it.
`voltage_delay` reports an older voltage, or the mean over parts of two.  So the reported voltage is late against
the current by voltage_delay - sampling_lead.

The probing voltage of a block, and what the control is told of the companion's angle, are made before the block is
simulated, here or by somebody else: they depend on frames only, and those come between blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.drive import angle_source, control, machine
from ipmsm_can.drive.angle_source import (
    A_OMEGA,
    A_OPEN_SPEED,
    A_OPEN_THETA,
    A_SAMPLE,
    A_THETA,
    COMPANION,
    ENCODER,
    G_OPEN_CURRENT,
    HOLD,
    OPEN_LOOP,
    STOPPED,
    T_OMEGA,
    T_SIZE,
    T_THETA,
    T_VERDICT,
    choose,
    coast,
    tell,
    turn_open_loop,
)
from ipmsm_can.drive.control import current_step, regulate_current, speed_step
from ipmsm_can.drive.estimates import Estimate
from ipmsm_can.drive.inverter import measure_current, sensor_gain
from ipmsm_can.drive.machine import (
    M_L_Q,
    M_POLE_PAIRS,
    X_LAMBDA_ALPHA,
    X_LAMBDA_BETA,
    X_OMEGA_M,
    X_THETA_M,
    advance,
    air_gap_torque,
    stationary_current,
    wrap,
)
from ipmsm_can.drive.parameters import LATEST_VOLTAGE
from ipmsm_can.drive.parameters import DriveParameters as DriveParameters
from ipmsm_can.drive.profile import Profile, value_at
from ipmsm_can.injection import waveform as probing
from ipmsm_can.motor import Motor

Array = NDArray[np.float64]

# Drive parameters beyond machine and control, float64 (D_SIZE,)
D_PERIOD = 0  # s
D_SUBSTEPS = 1
D_FREE_SHAFT = 2
D_LOCKED = 3
D_DEAD_TIME_VOLTAGE = 4  # V
D_DEAD_TIME_ZONE = 5  # A
D_CURRENT_NOISE = 6  # A
D_OFFSET_ALPHA = 7  # A
D_OFFSET_BETA = 8  # A
D_ADC_STEP = 9  # A
D_INJECTION_LIMIT = 10  # V
D_INJECTION_RAMP = 11  # V/s
D_VOLTAGE_DELAY = 12  # samples
D_SAMPLING_LEAD = 13  # samples
D_BRAKE = 14
D_GAIN = 15  # of the current sensors: four numbers, see inverter.sensor_gain
D_SIZE = 19

# Voltage state, float64 (V_SIZE,): (alpha, beta) of the interval that ended, then of the one that begins, and of
# those before the one that ended, latest first
V_ENDED = 0
V_BEGINS = 2
V_INJ_ENDED = 4
V_INJ_BEGINS = 6
V_PAST = 8
V_SIZE = V_PAST + 2 * LATEST_VOLTAGE


@dataclass(frozen=True, slots=True)
class DriveSamples:
    """n samples in order; float64 (n,) unless said otherwise.  Peak, amplitude-invariant.

    sample: int64, sample counter, 0 for the first sample of the simulation.
    i_alpha, i_beta: measured current at t_k [A], with noise, offset and ADC steps.
    v_alpha, v_beta: mean commanded voltage over the interval that ended at t_k, or the one that the drive reports
        in its place [V].
    theta_e: true rotor angle at t_k [rad electrical], -pi..pi.  omega_e: true speed [rad/s electrical].
    i_d, i_q: true current [A].  torque: air-gap torque [N m].
    load_torque: the profile's load torque [N m] (the torque reference with an imposed or locked rotor).
    active_flux: lambda_d - L_q i_d [Wb], without saturation psi_m + L_0 i_d, the length of the paper's x,
        which points along theta_e.
    v_inj_alpha, v_inj_beta: probing part of the voltage [V], as it was before the voltage limit.
    speed_reference: the profile's speed [rad/s mechanical].
    injection_waveform, injection_amplitude: probing waveform (0..3) and its amplitude [V peak] as decided
        at t_k, for the interval from t_(k+1) on.
    angle_state: what the control ran on at t_k, an `AngleState`.
    control_theta: the angle it took at t_k [rad electrical], NaN where it had none.
    """

    sample: NDArray[np.int64]
    i_alpha: Array
    i_beta: Array
    v_alpha: Array
    v_beta: Array
    theta_e: Array
    omega_e: Array
    i_d: Array
    i_q: Array
    torque: Array
    load_torque: Array
    active_flux: Array
    v_inj_alpha: Array
    v_inj_beta: Array
    speed_reference: Array
    injection_waveform: Array
    injection_amplitude: Array
    angle_state: Array
    control_theta: Array

    def __len__(self) -> int:
        return len(self.sample)


O_SIZE = len(fields(DriveSamples)) - 1
"""Rows of the kernel's output: the fields of DriveSamples after `sample`, in their order."""


@kernel
def _probe(out: Array, inj: Array, d: Array) -> None:
    """Fill out (4, n) with what `DriveSimulation.run` takes for probing; inj is the state, moved on."""
    for j in range(out.shape[1]):
        out[0, j], out[1, j] = probing.step(inj, d[D_PERIOD], d[D_INJECTION_RAMP], d[D_INJECTION_LIMIT])
        out[2, j] = inj[probing.W_WAVEFORM]
        out[3, j] = inj[probing.W_AMPLITUDE]


@kernel
def _step_voltage(back: int) -> int:
    """Where the alpha voltage of `back` periods before the one that ended stands in v; -1: the one that begins."""
    return V_BEGINS if back < 0 else V_ENDED if back == 0 else V_PAST + 2 * (back - 1)


@kernel
def _reported(v: Array, axis: int, delay: float) -> float:
    """Mean commanded voltage [V] over the interval that ended `delay` samples before the voltage's last step."""
    back = math.floor(delay)
    part = delay - back
    latest = v[_step_voltage(back) + axis]
    return float(latest if part == 0.0 else (1.0 - part) * latest + part * v[_step_voltage(back + 1) + axis])


@kernel
def _advance_period(x: Array, v: Array, load: float, free_shaft: bool, omega_end: float, m: Array,
                    d: Array) -> None:
    """One sampling period: what is left of the voltage before its step, then the one that begins."""
    period = d[D_PERIOD]
    substeps = int(d[D_SUBSTEPS])
    lead = d[D_SAMPLING_LEAD]
    if lead > 0.0:
        omega_m = x[X_OMEGA_M]
        advance(x, v[V_ENDED], v[V_ENDED + 1], load, lead * period, max(1, round(lead * substeps)), free_shaft,
                omega_m + lead * (omega_end - omega_m), d[D_DEAD_TIME_VOLTAGE], d[D_DEAD_TIME_ZONE], m)
        substeps = max(1, round((1.0 - lead) * substeps))
        period *= 1.0 - lead
    advance(x, v[V_BEGINS], v[V_BEGINS + 1], load, period, substeps, free_shaft, omega_end,
            d[D_DEAD_TIME_VOLTAGE], d[D_DEAD_TIME_ZONE], m)


@kernel
def _simulate(
    out: Array, first: int, noise: Array, probe: Array, told: Array, x: Array, s: Array, v: Array, a: Array,
    m: Array, c: Array, d: Array, g: Array, speed_track: Array, load_track: Array,
) -> None:
    """Fill out (O_SIZE, n) with samples first.., from noise (n, 2), probe (4, n), told (T_SIZE, n).

    x, s, v, a are moved on.
    """
    period = d[D_PERIOD]
    substeps = int(d[D_SUBSTEPS])
    free_shaft = d[D_FREE_SHAFT] != 0.0
    locked = d[D_LOCKED] != 0.0
    braked = free_shaft and d[D_BRAKE] != 0.0
    pole_pairs = m[M_POLE_PAIRS]
    for j in range(out.shape[1]):
        k = float(first + j)
        reference = value_at(speed_track, k, False)
        load = value_at(load_track, k, False)
        if not free_shaft:
            x[X_OMEGA_M] = 0.0 if locked else reference
        omega_m = x[X_OMEGA_M]
        omega_e = pole_pairs * omega_m
        theta_e = wrap(pole_pairs * x[X_THETA_M])
        lambda_alpha = x[X_LAMBDA_ALPHA]
        lambda_beta = x[X_LAMBDA_BETA]
        i_alpha, i_beta = stationary_current(lambda_alpha, lambda_beta, theta_e, m)
        cos_k = math.cos(theta_e)
        sin_k = math.sin(theta_e)
        i_d = cos_k * i_alpha + sin_k * i_beta
        seen_alpha = d[D_GAIN] * i_alpha + d[D_GAIN + 1] * i_beta
        seen_beta = d[D_GAIN + 2] * i_alpha + d[D_GAIN + 3] * i_beta
        measured_alpha = measure_current(seen_alpha, d[D_CURRENT_NOISE] * noise[j, 0], d[D_OFFSET_ALPHA],
                                         d[D_ADC_STEP])
        measured_beta = measure_current(seen_beta, d[D_CURRENT_NOISE] * noise[j, 1], d[D_OFFSET_BETA],
                                        d[D_ADC_STEP])
        out[0, j] = measured_alpha
        out[1, j] = measured_beta
        out[2, j] = _reported(v, 0, d[D_VOLTAGE_DELAY])
        out[3, j] = _reported(v, 1, d[D_VOLTAGE_DELAY])
        out[4, j] = theta_e
        out[5, j] = omega_e
        out[6, j] = i_d
        out[7, j] = cos_k * i_beta - sin_k * i_alpha
        out[8, j] = air_gap_torque(lambda_alpha, lambda_beta, i_alpha, i_beta, m)
        out[9, j] = load
        out[10, j] = cos_k * lambda_alpha + sin_k * lambda_beta - m[M_L_Q] * i_d
        out[11, j] = v[V_INJ_ENDED]
        out[12, j] = v[V_INJ_ENDED + 1]
        out[13, j] = reference

        inj_alpha = probe[0, j]
        inj_beta = probe[1, j]
        out[14, j] = probe[2, j]
        out[15, j] = probe[3, j]
        load_mean = 0.5 * (load + value_at(load_track, k + 1.0, True))
        omega_end = 0.0 if locked else value_at(speed_track, k + 1.0, True)
        state = choose(a, g, k, int(told[T_VERDICT, j]), reference, free_shaft)
        held = braked and state == HOLD
        out[16, j] = state
        out[17, j] = math.nan
        if state == STOPPED:
            v[:] = 0.0
            coast(x, load_mean, period, substeps, free_shaft, omega_end, m)
            continue
        if state == ENCODER:
            out[17, j] = theta_e
            torque = speed_step(s, c, omega_m, reference) if free_shaft else load
            v_alpha, v_beta = current_step(s, c, measured_alpha, measured_beta, theta_e, omega_e, torque,
                                           inj_alpha, inj_beta)
        elif state == COMPANION:
            omega = told[T_OMEGA, j]
            theta = told[T_THETA, j]
            out[17, j] = wrap(theta)
            torque = speed_step(s, c, omega / pole_pairs, reference) if free_shaft else load
            v_alpha, v_beta = current_step(s, c, measured_alpha, measured_beta, theta, omega, torque,
                                           inj_alpha, inj_beta)
        elif state == OPEN_LOOP:
            out[17, j] = a[A_OPEN_THETA]
            v_alpha, v_beta = regulate_current(s, c, measured_alpha, measured_beta, a[A_OPEN_THETA],
                                               a[A_OPEN_SPEED], g[G_OPEN_CURRENT], 0.0, inj_alpha, inj_beta)
            turn_open_loop(a, g, reference, period)
        else:
            v_alpha, v_beta = regulate_current(s, c, measured_alpha, measured_beta, 0.0, 0.0, 0.0, 0.0,
                                               inj_alpha, inj_beta)

        _advance_period(x, v, load_mean, free_shaft and not held, 0.0 if held else omega_end, m, d)
        for place in range(V_SIZE - 1, V_PAST + 1, -1):
            v[place] = v[place - 2]
        for axis in range(2):
            v[V_PAST + axis] = v[V_ENDED + axis]
            v[V_ENDED + axis] = v[V_BEGINS + axis]
            v[V_INJ_ENDED + axis] = v[V_INJ_BEGINS + axis]
        v[V_BEGINS] = v_alpha
        v[V_BEGINS + 1] = v_beta
        v[V_INJ_BEGINS] = inj_alpha
        v[V_INJ_BEGINS + 1] = inj_beta


class DriveSimulation:
    """A simulated drive that runs a profile, block by block.

    motor, parameters, profile: what is simulated.  theta_0: rotor angle at the start [rad electrical].
    seed: of the sensor noise.  The rotor starts at the profile's first speed without current, as after a
    catch of a spinning machine: the voltage before and at the start is the magnet's.
    """

    def __init__(
        self, motor: Motor, parameters: DriveParameters, profile: Profile, theta_0: float = 0.0, seed: int = 0
    ) -> None:
        if not math.isfinite(theta_0):
            raise ValueError(f"theta_0 is {theta_0!r}; allowed is a finite angle, in rad electrical")
        self.motor = motor
        self.parameters = parameters
        self.profile = profile
        p = parameters
        period = 1.0 / p.sample_rate
        self._machine = machine.pack_machine(motor, p.friction, p.saturation)
        self._control = control.pack_control(motor, period, p.current_bandwidth, p.speed_bandwidth,
                                             p.torque_max(motor), p.v_max, p.mtpa)
        self._drive = np.array([
            period, p.substeps, not (p.speed_imposed or p.rotor_locked), p.rotor_locked,
            p.dead_time_voltage, p.dead_time_zone, p.current_noise, *p.current_offset, p.adc_step,
            p.injection_limit, p.injection_ramp, p.voltage_delay, p.sampling_lead, p.brake,
            *sensor_gain(p.current_gain),
        ], dtype=np.float64)
        self._speed_track, self._load_track = profile.tracks(p.sample_rate)
        at_rest = p.rotor_locked or (p.brake and not p.speed_imposed and p.angle_source == "companion")
        omega_m = 0.0 if at_rest else value_at(self._speed_track, 0.0, False)
        self._x = machine.initial_state(motor, theta_0, omega_m)
        self._s = np.zeros(control.S_SIZE)
        self._v = np.zeros(V_SIZE)
        omega_e = motor.pole_pairs * omega_m
        past = [(V_PAST + 2 * k, -1.5 - k) for k in range(LATEST_VOLTAGE)]
        for place, after in ((V_ENDED, -0.5), (V_BEGINS, 0.5), *past):
            middle = after + p.sampling_lead
            angle = theta_0 + middle * omega_e * period
            self._v[place] = -omega_e * motor.psi_m * math.sin(angle)
            self._v[place + 1] = omega_e * motor.psi_m * math.cos(angle)
        self._injection = np.zeros(probing.W_SIZE)
        self._angle_settings, self._angle = angle_source.pack(p)
        self._noise = np.random.default_rng(seed)
        self._next = 0

    @property
    def next_sample(self) -> int:
        """Counter of the sample that the next `run` begins with."""
        return self._next

    @property
    def samples_in_profile(self) -> int:
        """Samples until the end of the profile; `run` may go on beyond it, with its last values."""
        return round(self.profile.duration * self.parameters.sample_rate)

    def command_injection(
        self, waveform: int, amplitude: float, frequency: float, axis_angle: float, ttl_samples: int
    ) -> None:
        """Ask for a probing waveform from the next sample on, for ttl_samples samples.

        waveform: 0 off, 1 rotating, 2 pulsating, 3 polarity_pulses.  amplitude [V peak], >= 0, cut to the
        drive's own limit.  frequency [Hz], above 0 and at most half the sample rate.  axis_angle
        [rad electrical].  With waveform 0 only ttl_samples counts of the rest: the old one ramps down.

        Raises ValueError naming the argument; the command in force then stays.
        """
        nyquist = 0.5 * self.parameters.sample_rate
        if waveform not in (0, 1, 2, 3):
            raise ValueError(f"waveform is {waveform!r}; allowed is 0 to 3")
        if ttl_samples < 0:
            raise ValueError(f"ttl_samples is {ttl_samples!r}; allowed is 0 or more")
        if waveform == 0:
            amplitude, frequency, axis_angle = 0.0, nyquist, 0.0
        if not (math.isfinite(amplitude) and amplitude >= 0.0):
            raise ValueError(f"amplitude is {amplitude!r}; allowed is a finite number of 0 or more, in V")
        if not 0.0 < frequency <= nyquist:
            raise ValueError(f"frequency is {frequency!r}; allowed is above 0 and up to {nyquist:g} Hz")
        if not math.isfinite(axis_angle):
            raise ValueError(f"axis_angle is {axis_angle!r}; allowed is a finite angle, in rad electrical")
        probing.ask(self._injection, waveform, amplitude, frequency, axis_angle, ttl_samples)

    def take_estimate(self, estimate: Estimate) -> None:
        """Let this estimate be the last one from the next sample on."""
        self._angle[angle_source.A_HELD] = 1.0
        self._angle[A_SAMPLE] = estimate.sample
        self._angle[A_THETA] = estimate.theta_e
        self._angle[A_OMEGA] = estimate.omega_e
        self._angle[angle_source.A_VERDICT] = estimate.verdict

    def run(self, n: int, probe: Array | None = None, told: Array | None = None) -> DriveSamples:
        """The next n samples, n >= 0.

        probe: float64 (4, n), what is decided at each of them in place of the generator here: probing voltage
        (alpha, beta) [V] for the interval from t_(k+1) on, waveform 0..3, amplitude [V peak].
        told: float64 (3, n), what the control is told of the companion's angle at each of them in place of the
        estimates taken here: an AngleVerdict, theta at t_k [rad electrical], omega [rad/s electrical].
        """
        if n < 0:
            raise ValueError(f"n is {n!r}; allowed is 0 or more samples")
        if probe is None:
            probe = np.empty((4, n))
            _probe(probe, self._injection, self._drive)
        elif probe.shape != (4, n):
            raise ValueError(f"probe has the shape {probe.shape}; allowed is (4, {n})")
        if told is None:
            told = np.empty((T_SIZE, n))
            tell(told, self._next, self._angle, self._angle_settings, self._drive[D_PERIOD])
        elif told.shape != (T_SIZE, n):
            raise ValueError(f"told has the shape {told.shape}; allowed is ({T_SIZE}, {n})")
        out = np.empty((O_SIZE, n))
        noise = self._noise.standard_normal((n, 2))
        _simulate(out, self._next, noise, probe, told, self._x, self._s, self._v, self._angle, self._machine,
                  self._control, self._drive, self._angle_settings, self._speed_track, self._load_track)
        sample = np.arange(self._next, self._next + n, dtype=np.int64)
        self._next += n
        return DriveSamples(sample, *out)
