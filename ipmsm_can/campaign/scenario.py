"""What one run of a campaign is: everything random about it, drawn from (seed, number) and nothing else.

The limits of what is drawn are what the product promises to stand: motor data within R +-20 %, L_d and L_q +-10 %,
psi_m +-5 %, dead time up to twice the stated 1-sigma, losses up to 5 %, bursts, every speed profile that the drive
can follow.  What a wrong dc-link scale would do, v' = k v, is the same as psi_m, L_d, L_q and R told wrong by one
factor, so it is covered by their draw.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ipmsm_can.bus.cosim import BusFaults
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.motor import PRESETS, Motor

SPREAD = {"R": 0.2, "L_d": 0.1, "L_q": 0.1, "psi_m": 0.05}
"""Motor parameters and how far, as a share, what the companion is told may be off."""
DURATION = (1.0, 3.0)
SPEED_RPM = (5.0, 1000.0)
"""Speeds other than zero, log-uniform [rpm mechanical]."""
ACCELERATION = (5.0, 600.0)
"""Of ramps, log-uniform [rad/s^2 mechanical]; the drive can do 930 at J = 0.01 kg m^2."""
LOOP_SHARE = 25.0
"""Sample rate over bandwidth of the current loops: they stay stable when the inductance falls with saturation."""
SPEED_LOOP = 15.0
SATURATED_LOAD = 0.5
"""Largest load on a saturating machine, of rated torque: beyond, its inductances fall out of what SPREAD says."""
CURRENT_OFFSET = 0.02
CURRENT_NOISE = (0.005, 0.03)
DEAD_TIME = 1.0
"""Largest voltage that each phase loses [V]; the companion is told 0.5 V as 1-sigma."""
LOSS = 0.05
PROBING_VOLTS = {"m1": 9.0, "m2": 4.2}
"""Amplitudes that keep the probing current below 15 % of rated [V peak]; half to all of it is drawn."""

Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Scenario:
    """One run.  Units as in the names' own places: `Profile`, `DriveParameters`, `BusFaults`, `DriveConfig`.

    seed, number: where it was drawn from.  kind: of the observer.  scale_*: what the companion is told over what
    is true.  begins: when the companion is switched on [s].  shaft: free, imposed (a load machine holds the
    profile's speed) or locked.  speed [rad/s mechanical], load [N m]: breakpoints.  initial_flux [Wb].
    """

    seed: int
    number: int
    kind: str
    motor: str
    saturation: float
    scale_R: float
    scale_L_d: float
    scale_L_q: float
    scale_psi_m: float
    sample_rate: float
    fd: bool
    duration: float
    begins: float
    theta_0: float
    shaft: str
    mtpa: bool
    speed: Points
    load: Points
    current_noise: float
    offset_alpha: float
    offset_beta: float
    adc_step: float
    dead_time: float
    dead_zone: float
    loss: float
    burst: float
    burst_length: int
    duplication: float
    reordering: float
    delay_ns: int
    jitter_ns: int
    injection: bool
    waveform: str
    amplitude: float
    frequency: float
    injection_limit: float
    current_limit: float
    initial_alpha: float
    initial_beta: float
    noise_seed: int
    bus_seed: int

    @property
    def machine(self) -> Motor:
        """The machine as it is."""
        return PRESETS[self.motor]

    @property
    def profile(self) -> Profile:
        """What the drive is asked to do."""
        return Profile(self.speed, self.load, self.duration, f"run {self.number}")

    def parameters(self) -> DriveParameters:
        """The simulated drive's settings."""
        return DriveParameters(
            sample_rate=self.sample_rate, current_bandwidth=self.sample_rate / LOOP_SHARE,
            speed_bandwidth=SPEED_LOOP, mtpa=self.mtpa, dead_time_voltage=self.dead_time,
            dead_time_zone=self.dead_zone, current_noise=self.current_noise,
            current_offset=(self.offset_alpha, self.offset_beta), adc_step=self.adc_step,
            saturation=self.saturation, speed_imposed=self.shaft == "imposed", rotor_locked=self.shaft == "locked",
            injection_limit=self.injection_limit)

    def node_settings(self) -> DriveNodeSettings:
        """What the drive sends."""
        return DriveNodeSettings(fd=self.fd, reference_rate=0.0)

    def faults(self) -> BusFaults:
        """What the bus does to the frames."""
        return BusFaults(self.loss, self.duplication, self.reordering, self.burst, self.burst_length,
                         self.delay_ns, self.jitter_ns, seed=self.bus_seed)

    def config(self) -> DriveConfig:
        """The drive.toml of the companion: the machine as it is told."""
        machine = self.machine
        motor: dict[str, Any] = {key: getattr(machine, key) for key in ("pole_pairs", "J", "rated_torque")}
        motor |= {key: getattr(machine, key) * getattr(self, f"scale_{key}") for key in SPREAD}
        return config_from({
            "motor": motor,
            "observer": {"kind": self.kind, "initial_flux": (self.initial_alpha, self.initial_beta)},
            "injection": {"enabled": self.injection, "waveform": self.waveform, "amplitude": self.amplitude,
                          "frequency": self.frequency, "current_limit": self.current_limit},
        }, source=f"run {self.number} of seed {self.seed}")

    def as_dict(self) -> dict[str, Any]:
        """Flat, of what JSON knows."""
        return asdict(self)


def draw(seed: int, number: int, kind: str = "riccati") -> Scenario:
    """Run `number` of the campaign `seed`, both 0 or more; the kind of observer changes nothing else about it."""
    rng = np.random.default_rng([seed, number])
    motor = str(rng.choice(["m1", "m2"]))
    machine = PRESETS[motor]
    scales = {name: 1.0 + float(rng.uniform(-most, most)) for name, most in SPREAD.items()}
    saturation = float(rng.uniform(0.1, 0.2)) if rng.random() < 0.5 else 0.0
    rate = float(rng.choice([2500.0, 5000.0, 10_000.0], p=[0.15, 0.7, 0.15]))
    fd = bool(rng.random() < 0.15) or rate > 5000.0
    duration = round(float(rng.uniform(*DURATION)), 3)
    shaft = str(rng.choice(["free", "imposed", "locked"], p=[0.7, 0.25, 0.05]))
    begins = round(float(rng.uniform(0.05, 0.4 * duration)), 4) if rng.random() < 0.3 else 0.0
    speed = _speed(rng, duration)
    load = _load(rng, duration, machine.rated_torque * (SATURATED_LOAD if saturation else 1.0))
    loss = float(rng.uniform(0.0, LOSS)) if rng.random() < 0.6 else 0.0
    burst, length = _bursts(rng, rate * duration)
    known_flux = rng.random() < 0.2
    flux = machine.psi_m * np.exp(1j * rng.uniform(-math.pi, math.pi)) if known_flux else 0j
    return Scenario(
        seed=seed, number=number, kind=kind, motor=motor, saturation=saturation,
        scale_R=scales["R"], scale_L_d=scales["L_d"], scale_L_q=scales["L_q"], scale_psi_m=scales["psi_m"],
        sample_rate=rate, fd=fd, duration=duration, begins=begins,
        theta_0=float(rng.uniform(-math.pi, math.pi)), shaft=shaft, mtpa=bool(rng.random() < 0.3),
        speed=speed, load=load,
        current_noise=float(rng.uniform(*CURRENT_NOISE)),
        offset_alpha=float(rng.uniform(-CURRENT_OFFSET, CURRENT_OFFSET)),
        offset_beta=float(rng.uniform(-CURRENT_OFFSET, CURRENT_OFFSET)),
        adc_step=0.01 if rng.random() < 0.3 else 0.0,
        dead_time=float(rng.uniform(0.0, DEAD_TIME)), dead_zone=float(rng.uniform(0.05, 0.4)),
        loss=loss, burst=burst, burst_length=length,
        duplication=0.01 if rng.random() < 0.1 else 0.0, reordering=0.002 if rng.random() < 0.1 else 0.0,
        delay_ns=int(rng.integers(0, 2_000_000)), jitter_ns=int(rng.integers(0, 500_000)),
        injection=bool(rng.random() < 0.6), waveform=str(rng.choice(["rotating", "pulsating"])),
        amplitude=float(rng.uniform(0.5, 1.0)) * PROBING_VOLTS[motor],
        frequency=float(rng.choice([200.0, 250.0, 400.0, 500.0])),
        injection_limit=3.0 if rng.random() < 0.1 else 30.0,
        current_limit=float(rng.uniform(0.1, 0.2)) * machine.rated_current,
        initial_alpha=float(np.real(flux)), initial_beta=float(np.imag(flux)),
        noise_seed=int(rng.integers(1 << 31)), bus_seed=int(rng.integers(1 << 31)))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _speed(rng: np.random.Generator, duration: float) -> Points:
    """Speeds held and ramps between them until the end; every fourth of the speeds is zero."""
    def any_speed() -> float:
        if rng.random() < 0.25:
            return 0.0
        return float(rng.choice([-1.0, 1.0])) * _log_uniform(rng, *SPEED_RPM) * RPM

    points = [(0.0, any_speed())]
    while points[-1][0] < duration:
        t, before = points[-1]
        t = round(t + _log_uniform(rng, 0.02, 1.0), 4)
        points.append((t, before))
        after = -before if rng.random() < 0.3 else any_speed()
        points.append((round(t + abs(after - before) / _log_uniform(rng, *ACCELERATION) + 1e-3, 4), after))
    return tuple(points)


def _load(rng: np.random.Generator, duration: float, rated: float) -> Points:
    """Up to four steps within +-rated, from a load that is there from the beginning in every other run."""
    value = float(rng.uniform(-rated, rated)) if rng.random() < 0.5 else 0.0
    points = [(0.0, value)]
    for t in np.sort(rng.uniform(0.0, duration, int(rng.integers(0, 5)))):
        at = round(float(t), 4)
        if at <= points[-1][0]:
            continue
        points.append((at, value))
        value = float(rng.uniform(-rated, rated)) if rng.random() < 0.7 else 0.0
        points.append((at, value))
    return tuple(points)


def _bursts(rng: np.random.Generator, samples: float) -> tuple[float, int]:
    """Probability per frame that a burst begins, and its length: up to 50 samples, some longer, few very long."""
    if rng.random() < 0.5:
        return 0.0, 50
    u = rng.random()
    longest = 50 if u < 0.8 else 400 if u < 0.95 else 4000
    return float(rng.uniform(0.5, 4.0)) / samples, int(rng.integers(2, longest + 1))
