"""Settings of the simulated drive: their defaults stand here, and only here.

Nothing here needs a compiler, so that a configuration can be read and explained without one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

from ipmsm_can.motor import Motor

FINEST_CURRENT_LOOP = 12.0
"""Least ratio of sample rate to current bandwidth: with 1.5 periods of delay it leaves 45 deg of phase."""

LATEST_VOLTAGE = 4
"""Most samples by which the reported voltage may be late."""

AngleSource = Literal["encoder", "companion", "encoder_then_companion"]
ANGLE_SOURCES: tuple[str, ...] = get_args(AngleSource)
"""What the control may take its angle from."""
OLDEST_ESTIMATE = 1023
"""An estimate names its sample by ten bits: it must not grow older than that many samples."""


@dataclass(frozen=True)
class DriveParameters:
    """Settings of the simulated drive.

    sample_rate: control periods per second [Hz], 100..1e6.
    substeps: RK4 steps in a control period, 1..1000.
    v_dc: dc-link voltage [V], > 0; the voltage limit is v_dc / sqrt(3) [V peak].
    current_bandwidth: bandwidth of the current loops [Hz], > 0 and at most sample_rate / 12.
    speed_bandwidth: bandwidth of the speed loop [Hz], > 0 and at most current_bandwidth / 4.
    torque_limit: [N m], > 0; None stands for 1.5 times the rated torque.
    i_max: largest current reference [A peak], > 0; None stands for twice the rated current.
    mtpa: maximum torque per ampere instead of i_d = 0.
    dead_time_voltage: voltage each phase loses, against its current [V], >= 0.
    dead_time_zone: current below which that loss fades out [A], > 0.
    current_noise: standard deviation of the sensor noise per axis (alpha, beta) [A], >= 0.
    current_offset: sensor offset (alpha, beta) [A].
    current_gain: gain of the current sensors of the phases a, b, c, above 0; 1 where they are right.
    adc_step: resolution of the current samples [A], 0 for none.
    voltage_delay: how late the reported voltage is [samples], -1..4: the mean over the interval that ended so
        much before the voltage's last step; 0 is the convention of the wire, -1 the voltage just begun.
    sampling_lead: time by which the current is sampled before the voltage's step [samples], 0 up to below 1;
        half is a current taken in the middle.  Everything sampled, the rotor's angle included, is of that instant.
    friction: viscous [N m s/rad mechanical], >= 0.
    saturation: share by which L_d falls at rated positive d current, 0..0.5; 0: linear magnetics.
    speed_imposed: a load machine makes the rotor follow the profile's speed exactly; the drive then
        controls torque, and the profile's load torque is its torque reference.
    rotor_locked: the rotor stays where it starts; torque control as above.
    brake: a brake holds the shaft, at rest, until the drive has an angle to control with or turns it open loop.
    injection_limit: largest probing amplitude [V peak], >= 0, whatever is asked.
    injection_ramp: fastest change of the probing amplitude [V/s], > 0.
    angle_source: one of ANGLE_SOURCES; the last swaps to the companion's angle when the encoder fails.
    encoder_fails_at: time from which the encoder says nothing any more [s], >= 0; None for never.
    estimate_time_to_live: age up to which the companion's angle is used [s], 1 to 1023 samples.
    angle_sigma_limit: largest 1-sigma at which it is used [deg electrical], > 0, at most 90.
    open_loop_current: current vector that turns the rotor until the companion knows the angle [A peak];
        0: the drive waits, with the current at zero.
    open_loop_speed: speed of that vector [rad/s electrical], > 0.
    open_loop_ramp: time it takes to get there [s], > 0.

    Raises ValueError naming the setting, what it got and what it allows.
    """

    sample_rate: float = 10_000.0
    substeps: int = 10
    v_dc: float = 540.0
    current_bandwidth: float = 200.0
    speed_bandwidth: float = 15.0
    torque_limit: float | None = None
    i_max: float | None = None
    mtpa: bool = False
    dead_time_voltage: float = 0.0
    dead_time_zone: float = 0.2
    current_noise: float = 0.02
    current_offset: tuple[float, float] = (0.0, 0.0)
    current_gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    adc_step: float = 0.0
    voltage_delay: float = 0.0
    sampling_lead: float = 0.0
    friction: float = 0.0
    saturation: float = 0.0
    speed_imposed: bool = False
    rotor_locked: bool = False
    brake: bool = False
    injection_limit: float = 30.0
    injection_ramp: float = 1000.0
    angle_source: AngleSource = "encoder"
    encoder_fails_at: float | None = None
    estimate_time_to_live: float = 0.01
    angle_sigma_limit: float = 10.0
    open_loop_current: float = 0.0
    open_loop_speed: float = 60.0
    open_loop_ramp: float = 1.0

    def __post_init__(self) -> None:
        _within("sample_rate", self.sample_rate, 100.0, 1e6, "Hz")
        if not (isinstance(self.substeps, int) and 1 <= self.substeps <= 1000):
            raise ValueError(f"substeps is {self.substeps!r}; allowed is a whole number from 1 to 1000")
        _within("current_bandwidth", self.current_bandwidth, 1e-3,
                self.sample_rate / FINEST_CURRENT_LOOP, "Hz (a twelfth of sample_rate)")
        _within("speed_bandwidth", self.speed_bandwidth, 1e-3, self.current_bandwidth / 4.0,
                "Hz (a quarter of current_bandwidth)")
        for name, unit in (("v_dc", "V"), ("dead_time_zone", "A"), ("injection_ramp", "V/s"),
                           ("torque_limit", "N m"), ("i_max", "A"), ("open_loop_speed", "rad/s electrical"),
                           ("open_loop_ramp", "s")):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value!r}; allowed is a finite number above 0, in {unit}")
        for name, unit in (("dead_time_voltage", "V"), ("current_noise", "A"), ("adc_step", "A"),
                           ("friction", "N m s/rad"), ("injection_limit", "V"), ("encoder_fails_at", "s"),
                           ("open_loop_current", "A")):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value!r}; allowed is a finite number of 0 or more, in {unit}")
        _within("saturation", self.saturation, 0.0, 0.5, "")
        if len(self.current_offset) != 2 or not all(map(math.isfinite, self.current_offset)):
            raise ValueError(f"current_offset is {self.current_offset!r}; "
                             "allowed are two finite numbers, in A")
        if len(self.current_gain) != 3 or not all(math.isfinite(gain) and gain > 0.0 for gain in self.current_gain):
            raise ValueError(f"current_gain is {self.current_gain!r}; allowed are three finite numbers above 0")
        _within("voltage_delay", self.voltage_delay, -1.0, LATEST_VOLTAGE, "samples")
        if not 0.0 <= self.sampling_lead < 1.0:
            raise ValueError(f"sampling_lead is {self.sampling_lead!r}; allowed is 0 to below 1 sample")
        if self.speed_imposed and self.rotor_locked:
            raise ValueError("speed_imposed and rotor_locked are both true; allowed is one of them at most")
        if self.angle_source not in ANGLE_SOURCES:
            raise ValueError(f"angle_source is {self.angle_source!r}; allowed is {', '.join(ANGLE_SOURCES)}")
        if not 0.0 < self.angle_sigma_limit <= 90.0:
            raise ValueError(f"angle_sigma_limit is {self.angle_sigma_limit!r}; allowed is above 0 and at most 90, "
                             "in deg")
        if not 1.0 <= self.estimate_time_to_live * self.sample_rate + 1e-3 < OLDEST_ESTIMATE + 1:
            raise ValueError(f"estimate_time_to_live is {self.estimate_time_to_live!r}; allowed is 1 to "
                             f"{OLDEST_ESTIMATE} samples, {1.0 / self.sample_rate:g} to "
                             f"{OLDEST_ESTIMATE / self.sample_rate:g} s")

    @property
    def v_max(self) -> float:
        """Largest voltage the inverter gives in every direction [V peak]."""
        return self.v_dc / math.sqrt(3.0)

    @property
    def encoder_fails_sample(self) -> float:
        """First sample at which the encoder says nothing any more; inf for never."""
        if self.encoder_fails_at is None:
            return math.inf
        return float(math.ceil(self.encoder_fails_at * self.sample_rate - 1e-3))

    @property
    def estimate_max_age(self) -> int:
        """The time to live of an estimate in whole samples."""
        return int(self.estimate_time_to_live * self.sample_rate + 1e-3)

    def noise_free(self) -> DriveParameters:
        """The same drive with perfect current sensors."""
        return replace(self, current_noise=0.0, current_offset=(0.0, 0.0),
                       current_gain=(1.0, 1.0, 1.0), adc_step=0.0)

    def torque_max(self, motor: Motor) -> float:
        """Largest torque reference [N m]: the torque limit, or what i_max gives if that is less."""
        limit = 1.5 * motor.rated_torque if self.torque_limit is None else self.torque_limit
        i_max = 2.0 * motor.rated_current if self.i_max is None else self.i_max
        return min(limit, torque_at_current(motor, i_max, self.mtpa))


@dataclass(frozen=True)
class DriveNodeSettings:
    """What the drive sends: CAN FD blocks instead of single samples, and how often the rest [Hz, 0 = never].

    encoder_counts: angles the encoder tells apart in one turn of the shaft, 0 for no steps.
    """

    fd: bool = False
    timing_rate: float = 50.0
    status_rate: float = 10.0
    reference_rate: float = 500.0
    encoder_counts: int = 0


def _within(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} is {value!r}; allowed is {low:g} to {high:g} {unit}".rstrip())


def torque_at_current(motor: Motor, current: float, mtpa: bool) -> float:
    """Torque [N m] that a current of the given amplitude [A peak] gives under the chosen law."""
    if not mtpa or motor.L_0 == 0.0:
        return motor.torque(0.0, current)
    # psi_m i_d + L_0 (2 i_d^2 - I^2) = 0
    root = math.sqrt(motor.psi_m**2 + 8.0 * motor.L_0**2 * current**2)
    i_d = 2.0 * motor.L_0 * current**2 / (motor.psi_m + root)
    return motor.torque(i_d, math.sqrt(current**2 - i_d**2))
