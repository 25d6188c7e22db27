"""Seeded faults and healthy drives through the wire: what the diagnosis says of each.

Every run is a simulated drive with sensor noise, dead time, tolerances of the motor and losses on the bus, all
drawn from (seed, number) within what drive.toml tells; five seconds of an ordinary profile of speeds and loads, no
probing. Its frames are read as a log's.  A fault counts as named when it is the first finding.

    python -m tools.faults                  24 faults and 24 healthy runs
    python -m tools.faults --seeds 5        the same for five seeds
    python -m tools.faults --more           further faults beside the 24
    python -m tools.faults --no-encoder     the same drives without encoder reports
    python -m tools.faults --quick          as the live diagnosis judges

exit code 0 where at least 23 of 24 faults are named and no healthy run gives an error.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder
from ipmsm_can.bus.cosim import BusFaults, Channel
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.diagnosis import Report, diagnose
from ipmsm_can.drive.faults import DriveFaults
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import PRESETS, Motor
from ipmsm_can.wire.protocol import Protocol

SECONDS = 5.0
TOLERANCE = {"R": 0.15, "L_d": 0.07, "L_q": 0.07, "psi_m": 0.03}
"""How far the healthy motor is off its name plate, as a share."""
TOP_RPM = 1000.0
NEEDED = 23


@dataclass(frozen=True)
class Drive:
    """One drive: what it is, what it is told to be, what is wrong with it."""

    plate: Motor
    true: Motor
    parameters: DriveParameters
    profile: Profile
    settings: DriveNodeSettings
    faults: DriveFaults
    bus: BusFaults
    theta_0: float
    seed: int


Break = Callable[[Drive], Drive]


def healthy(seed: int, number: int, encoder: bool = True) -> Drive:
    """A drive without a fault."""
    rng = np.random.default_rng([seed, number])
    plate = PRESETS[str(rng.choice(["m1", "m2"]))]
    off = {name: getattr(plate, name) * (1.0 + float(rng.uniform(-most, most))) for name, most in TOLERANCE.items()}
    fd = bool(rng.random() < 0.3)
    rate = 10_000.0 if fd else 5000.0
    parameters = DriveParameters(
        sample_rate=rate, current_bandwidth=rate / 25.0, current_noise=float(rng.uniform(0.005, 0.03)),
        dead_time_voltage=float(rng.uniform(0.0, 0.8)), dead_time_zone=float(rng.uniform(0.05, 0.3)),
        current_offset=(float(rng.uniform(-0.01, 0.01)), float(rng.uniform(-0.01, 0.01))),
        adc_step=0.01 if rng.random() < 0.3 else 0.0, mtpa=bool(rng.random() < 0.4),
        saturation=float(rng.uniform(0.05, 0.12)) if rng.random() < 0.3 else 0.0)
    return Drive(
        plate, replace(plate, **off), parameters, ordinary_profile(rng, 0.7 * plate.rated_torque),
        DriveNodeSettings(fd=fd, reference_rate=float(rng.choice([200.0, 500.0, 1000.0])) if encoder else 0.0,
                          encoder_counts=int(rng.choice([0, 4096, 16384]))),
        DriveFaults(), BusFaults(loss=float(rng.uniform(0.0, 0.008)), seed=number), float(rng.uniform(-3.0, 3.0)),
        int(rng.integers(1 << 31)))


def ordinary_profile(rng: np.random.Generator, torque: float, seconds: float = SECONDS) -> Profile:
    """Speeds held and ramps between them, loads put on and off: nothing is done for the sake of the diagnosis."""
    speed, load = [(0.0, 0.0)], [(0.0, 0.0)]
    t, v = 0.0, 0.0
    while t < seconds:
        t += float(rng.uniform(0.15, 0.6))
        speed.append((t, v))
        after = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 1.0)) * TOP_RPM * RPM
        t += abs(after - v) / float(rng.uniform(100.0, 400.0)) + 0.01
        v = after
        speed.append((t, v))
    t, v = 0.0, 0.0
    while t < seconds:
        t += float(rng.uniform(0.2, 0.7))
        load.append((t, v))
        v = float(rng.uniform(-torque, torque))
        load.append((t, v))
    return Profile(tuple(speed), tuple(load), seconds, "ordinary")


def frames(drive: Drive, protocol: Protocol) -> FrameBlock:
    """Everything that the drive sends, as it arrives."""
    simulation = DriveSimulation(drive.true, drive.parameters, drive.profile, drive.theta_0, drive.seed)
    node = DriveNode(protocol, 0, simulation, drive.settings, drive.faults)
    sent = node.step(simulation.samples_in_profile, 1_700_000_000_000_000_000).frames
    channel = Channel(drive.bus, 0)
    channel.send(sent)
    return channel.receive(1 << 62)


def config(drive: Drive) -> DriveConfig:
    """The drive.toml: the name plate, and defaults."""
    return config_from({"motor": {name: getattr(drive.plate, name) for name in (
        "pole_pairs", "psi_m", "L_d", "L_q", "R", "J", "rated_torque")}}, source="the name plate")


def measure(drive: Drive, protocol: Protocol) -> tuple[Measurement, DriveConfig]:
    """What a log of the drive holds."""
    told = config(drive)
    builder = MeasurementBuilder(told, protocol, source="simulated")
    builder.feed(frames(drive, protocol))
    builder.finish()
    return builder.measurement(), told


def _faults(**wrong: Any) -> Break:
    return lambda d: replace(d, faults=replace(d.faults, **wrong))


def _parameters(**wrong: Any) -> Break:
    return lambda d: replace(d, parameters=replace(d.parameters, **wrong))


def _offset(alpha: float, beta: float) -> Break:
    return lambda d: replace(d, parameters=replace(d.parameters, current_offset=(
        alpha * d.plate.rated_current, beta * d.plate.rated_current)))


def _motor(**scales: float) -> Break:
    return lambda d: replace(d, true=replace(d.true, **{
        name: getattr(d.plate, name) * scale for name, scale in scales.items()}))


def _other_pole_pairs(change: int) -> Break:
    return lambda d: replace(d, faults=replace(d.faults, encoder_pole_pairs=d.plate.pole_pairs + change))


_DEG = math.radians(1.0)
FAULTS: tuple[tuple[str, str, Break], ...] = (
    ("current offset 6 % of rated", "current.offset", _offset(0.06, 0.0)),
    ("current offset 13 %", "current.offset", _offset(-0.05, 0.12)),
    ("phase b reads 8 % high", "current.gain", _parameters(current_gain=(1.0, 1.08, 1.0))),
    ("phase c reads 20 % low", "current.gain", _parameters(current_gain=(1.0, 1.0, 0.8))),
    ("current phases b, c swapped", "wiring.current_phases", _faults(current_phases="acb")),
    ("voltage phases a, b swapped", "wiring.voltage_phases", _faults(voltage_phases="bac")),
    ("current reversed", "wiring.current_sign", _faults(current_sign=-1)),
    ("voltage reversed", "wiring.voltage_sign", _faults(voltage_sign=-1)),
    ("voltage 0.3 samples late", "voltage.delay", _parameters(voltage_delay=0.3)),
    ("voltage 0.8 samples late", "voltage.delay", _parameters(voltage_delay=0.8)),
    ("dead time 2 V", "voltage.dead_time", _parameters(dead_time_voltage=2.0)),
    ("dead time 4 V", "voltage.dead_time", _parameters(dead_time_voltage=4.0)),
    ("winding 100 K hotter", "motor.R", _motor(R=1.39)),
    ("winding 180 K hotter", "motor.R", _motor(R=1.71)),
    ("magnets 12 % weaker", "motor.psi_m", _motor(psi_m=0.88)),
    ("magnets 25 % weaker", "motor.psi_m", _motor(psi_m=0.75)),
    ("encoder's zero off by 8 deg", "encoder.zero", _faults(encoder_zero=8.0 * _DEG)),
    ("encoder's zero off by -50 deg", "encoder.zero", _faults(encoder_zero=-50.0 * _DEG)),
    ("encoder counts backwards", "encoder.direction", _faults(encoder_direction=-1)),
    ("encoder with a pole pair more", "encoder.pole_pairs", _other_pole_pairs(1)),
    ("encoder eccentric, 3 deg", "encoder.eccentricity", _faults(eccentricity=3.0 * _DEG)),
    ("encoder eccentric, 12 deg", "encoder.eccentricity", _faults(eccentricity=12.0 * _DEG)),
    ("encoder slips by 8 deg", "encoder.slip", _faults(slip=8.0 * _DEG, slip_at=2.1)),
    ("encoder slips by -60 deg", "encoder.slip", _faults(slip=-60.0 * _DEG, slip_at=3.4)),
)
"""Kinds of fault in two sizes each: words, the code that has to come first, and what is broken."""
MORE: tuple[tuple[str, str, Break], ...] = (
    ("encoder with a pole pair less", "encoder.pole_pairs", _other_pole_pairs(-1)),
    ("current phases in the order c, a, b", "wiring.current_phases", _faults(current_phases="cab")),
    ("voltage phases a, c swapped", "wiring.voltage_phases", _faults(voltage_phases="cba")),
    ("encoder's zero off by half a turn", "encoder.zero", _faults(encoder_zero=math.pi)),
    ("encoder backwards, zero off by 30 deg", "encoder.direction",
     _faults(encoder_direction=-1, encoder_zero=30.0 * _DEG)),
    ("voltage a sample early", "voltage.delay", _parameters(voltage_delay=-1.0)),
    ("voltage two samples late", "voltage.delay", _parameters(voltage_delay=2.0)),
    ("L_q 30 % less", "motor.L_q", _motor(L_q=0.7)),
    ("L_q 30 % more", "motor.L_q", _motor(L_q=1.3)),
)


def judge(breaks: Break | None, seed: int, number: int, protocol: Protocol, encoder: bool = True,
          thorough: bool = True) -> Report:
    """The report on one drive; thorough as for `diagnose`."""
    drive = healthy(seed, number, encoder)
    measurement, told = measure(breaks(drive) if breaks else drive, protocol)
    return diagnose(measurement, told, thorough=thorough)


def _words(report: Report) -> str:
    return "; ".join(f"{f.severity} {f.code}" for f in report.findings) or "nothing found"


def main(argv: list[str] | None = None) -> int:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1, help="how many seeds, from --seed on")
    parser.add_argument("--more", action="store_true", help="further faults beside the 24")
    parser.add_argument("--no-encoder", action="store_true")
    parser.add_argument("--quick", action="store_true", help="the motor's parameters by the quick fit, as live")
    args = parser.parse_args(argv)
    protocol = Protocol()
    faults = FAULTS + (MORE if args.more else ())
    good = True
    for seed in range(args.seed, args.seed + args.seeds):
        named = alarms = warnings = 0
        print(f"seed {seed}")
        for number, (what, code, breaks) in enumerate(faults):
            report = judge(breaks, seed, number, protocol, not args.no_encoder, not args.quick)
            right = bool(report.findings) and report.findings[0].code == code
            named += right and number < len(FAULTS)
            print(f"  {'named ' if right else 'MISSED'} {what:40} {_words(report)}")
        for number in range(100, 124):
            report = judge(None, seed, number, protocol, not args.no_encoder, not args.quick)
            alarms += report.worst == "error"
            warnings += report.worst == "warning"
            print(f"  {'ALARM ' if report.worst == 'error' else 'fine  '} {f'healthy {number - 99}':40} "
                  f"{_words(report)}")
        print(f"  named first: {named} of {len(FAULTS)} faults ({NEEDED} needed); healthy: {alarms} of 24 with an "
              f"error (0 allowed), {warnings} with a warning", flush=True)
        good &= named >= NEEDED and alarms == 0
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
