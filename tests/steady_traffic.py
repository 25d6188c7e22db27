"""Traffic of a simulated drive as an inverter with slow, momentary reports sends it, with faults put in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping.load import map_folder
from ipmsm_can.motor import M2, Motor
from tests.mapping_traffic import dbc_text, frames

CAR = Motor(pole_pairs=4, psi_m=0.12, L_d=0.4e-3, L_q=0.9e-3, R=0.02, J=0.1, rated_torque=100.0, name="car")
RATE = 10_000.0
EVERY, LAG = 100, 2
"""Samples of the simulation between two reports (10 ms) and between two messages of a report (0.2 ms)."""

OWN_DBC = dbc_text({
    1: ("I", ['i_d : 0|16@1- (0.01,0) [0|0] "A"', 'i_q : 16|16@1- (0.01,0) [0|0] "A"']),
    2: ("V", ['v_d : 0|16@1- (0.02,0) [0|0] "V"', 'v_q : 16|16@1- (0.02,0) [0|0] "V"']),
    3: ("W", ['rpm : 0|16@1- (1,0) [0|0] "rpm"'])})
OWN_MAP = """[map]
title = "a drive that tells its rotor's frame and no angle"
dbc = "own.dbc"
[current]
form = "dq"
measure = "peak"
d = "I.i_d"
q = "I.i_q"
[voltage]
form = "dq"
measure = "peak"
per = "phase"
mean = false
d = "V.v_d"
q = "V.v_q"
[speed]
signal = "W.rpm"
unit = "rpm shaft"
"""


@dataclass(frozen=True)
class Wrong:
    """What the reports are changed by.  zero: reported angle minus rotor [rad], of the drive's own frame, or of the
    reported angle only (shown_zero).  angle, speed: factors on what is reported of them."""

    current: float = 1.0
    voltage: float = 1.0
    zero: float = 0.0
    shown_zero: float = 0.0
    angle: float = 1.0
    speed: float = 1.0
    torque: float = 1.0


RIGHT = Wrong()


def steps(motor: Motor, seconds: float = 8.0, top_rpm: float = 1000.0) -> Profile:
    """Speeds held in both directions, torques put on and off."""
    rpm = [0.3, 0.9, 0.6, -0.5, -0.9, 0.4, 1.0]
    load = [0.5, -0.4, 0.9, 0.2, -0.7, 0.7, 0.0, 0.4, -0.6]
    speed = [(0.0, rpm[0] * top_rpm * RPM)]
    for k, share in enumerate(rpm):
        t = seconds * k / len(rpm)
        speed += [(t + 0.25, share * top_rpm * RPM), (t + seconds / len(rpm), share * top_rpm * RPM)]
    torque = []
    for k, share in enumerate(load):
        torque += [(seconds * k / len(load), share * motor.rated_torque),
                   (seconds * (k + 1) / len(load) - 1e-3, share * motor.rated_torque)]
    return Profile(tuple(speed), tuple(torque), seconds, "steps")


@cache
def simulated(true: Motor, dead_time: float = 0.5, mtpa: bool = True, seconds: float = 8.0, top_rpm: float = 1000.0,
              noise: float = 0.02, profile: Profile | None = None) -> DriveSamples:
    """Every sample of a drive whose speed a load machine makes."""
    parameters = DriveParameters(sample_rate=RATE, speed_imposed=True, mtpa=mtpa, dead_time_voltage=dead_time,
                                 current_noise=noise)
    course = profile or steps(true, seconds, top_rpm)
    drive = DriveSimulation(true, parameters, course, 0.5, 7)
    return drive.run(int(course.duration * RATE))


def told(plate: Motor, **observer: float) -> DriveConfig:
    """The drive.toml."""
    names = ("pole_pairs", "psi_m", "L_d", "L_q", "R", "J", "rated_torque")
    return config_from({"motor": {n: getattr(plate, n) for n in names}, "observer": observer}, source="name plate")


def toml(folder: Path, plate: Motor) -> Path:
    """The same as a file."""
    motor = told(plate).motor.model_dump(exclude_none=True)
    path = folder / "drive.toml"
    path.write_text("[motor]\n" + "".join(f"{key} = {value}\n" for key, value in motor.items()))
    return path


def cascadia(s: DriveSamples, pole_pairs: int, wrong: Wrong = RIGHT) -> FrameBlock:
    """A5, A6, A7, A8 and B0 every 10 ms, one 0.2 ms after the other, each of the instant it is sent."""
    def at(message: int) -> tuple[np.ndarray, np.ndarray]:
        k = np.arange(2 * EVERY + message * LAG, len(s.sample) - EVERY, EVERY)
        return k, k / RATE

    i = (s.i_alpha + 1j * s.i_beta) * wrong.current
    # the voltage is the mean of the interval that ended: that of the angle in its middle
    middle = s.theta_e - 0.5 * s.omega_e / RATE
    v = (s.v_alpha + 1j * s.v_beta) * np.exp(-1j * (middle + wrong.zero)) * wrong.voltage
    frame = i * np.exp(-1j * (s.theta_e + wrong.zero))
    shown = np.cumsum(s.omega_e) / RATE * wrong.angle + s.theta_e[0] + wrong.zero + wrong.shown_zero
    (a5, t5), (a6, t6), (a7, t7), (a8, t8), (b0, tb) = (at(k) for k in range(5))
    phases = [(i[a6] * np.exp(-2j * math.pi * k / 3)).real for k in range(3)]
    hertz = s.omega_e / (2 * math.pi) * wrong.speed
    return frames(map_folder() / "cascadia_pm.dbc", {
        "PM_A5_Position": (t5, {"electrical_angle": np.degrees(shown[a5]) % 360.0, "delta_resolver": 0.0,
                                "speed": 60 * hertz[a5] / pole_pairs, "electrical_frequency": hertz[a5]}),
        "PM_A6_Currents": (t6, {"i_a": phases[0], "i_b": phases[1], "i_c": phases[2], "i_dc": 3.0}),
        "PM_A7_Voltages": (t7, {"v_dc": 320.0 + 0.2 * np.sin(t7), "v_out": np.abs(v[a7]), "v_ab_or_v_d": v[a7].real,
                                "v_bc_or_v_q": v[a7].imag}),
        "PM_A8_Flux": (t8, {"i_d": frame[a8].real, "i_q": frame[a8].imag}),
        "PM_B0_Fast": (tb, {"torque_feedback": s.torque[b0] * wrong.torque, "v_dc": 320.0})})


def own(folder: Path, s: DriveSamples, pole_pairs: int, wrong: Wrong = RIGHT) -> tuple[FrameBlock, Path]:
    """The same as one that sends d and q and the shaft's speed every 2 ms; the traffic, and its map."""
    (folder / "own.dbc").write_text(OWN_DBC)
    (folder / "own.toml").write_text(OWN_MAP)
    k = np.arange(200, len(s.sample) - 20, 20)
    middle = s.theta_e - 0.5 * s.omega_e / RATE + wrong.zero
    v = (s.v_alpha + 1j * s.v_beta) * np.exp(-1j * middle) * wrong.voltage
    i = (s.i_alpha + 1j * s.i_beta) * np.exp(-1j * (s.theta_e + wrong.zero)) * wrong.current
    rpm = s.omega_e / RPM / pole_pairs * wrong.speed
    t = k / RATE
    return frames(folder / "own.dbc", {
        "I": (t, {"i_d": i.real[k], "i_q": i.imag[k]}), "V": (t + 1e-4, {"v_d": v.real[k], "v_q": v.imag[k]}),
        "W": (t + 2e-4, {"rpm": rpm[k]})}), folder / "own.toml"


def scaled(motor: Motor, **shares: float) -> Motor:
    """A motor whose parameters are so many times those of this one."""
    return replace(motor, **{name: getattr(motor, name) * share for name, share in shares.items()})


__all__ = ["CAR", "M2", "Wrong", "cascadia", "own", "scaled", "simulated", "told", "toml"]
