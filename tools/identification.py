"""Identification of many simulated drives, through the wire: how far off it is, and whether its intervals hold.

    python -m tools.identification --runs 200

Every run is 5 s of ordinary running of another drive: speed ramps and load steps, no probing, no test signal.  Its
motor differs from the name plate that identification starts from: R by up to 20 %, L_d and L_q by up to 15 %,
psi_m by up to 8 %; dead time takes 0.3 to 1.5 V, the current sensors have 0.02 A noise and up to 0.02 A offset.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.identification import Identification, identify
from ipmsm_can.motor import PRESETS, Motor
from ipmsm_can.wire.protocol import Protocol

RATE = 5000.0
TOP_SPEED = {"m1": 500.0, "m2": 1000.0}
"""Speed of the profile [rpm]."""
LOAD = {"m1": 4.0, "m2": 6.2}
"""Largest load [N m]."""
LIMITS = {"R": 5.0, "L_d": 3.0, "L_q": 3.0, "psi_m": 1.0}
"""Largest error asked for [%]."""
COVERAGE = 95.0
"""Share of the intervals that is to hold the truth [%]."""


def running(name: str) -> Profile:
    """5 s of ordinary running: ramps between 10 % and full speed, load steps between 10 % and the full load."""
    w, load = TOP_SPEED[name] * RPM, LOAD[name]
    speed = ((0.0, 0.1), (0.5, 0.1), (0.8, 0.5), (1.8, 0.5), (2.3, 1.0), (3.5, 1.0), (4.2, 0.3))
    torque = ((0.0, 0.2), (0.9, 0.2), (0.9, 0.8), (1.4, 0.8), (1.4, 0.1), (2.6, 0.1), (2.6, 1.0), (3.1, 1.0),
              (3.1, 0.3), (4.4, 0.3), (4.4, 0.9), (4.7, 0.9), (4.7, 0.1))
    return Profile(tuple((t, x * w) for t, x in speed), tuple((t, x * load) for t, x in torque), 5.0, "ordinary")


@dataclass(frozen=True, slots=True)
class Drawn:
    """A drive of a run: its true motor, the name plate, and its voltage and current errors."""

    name: str
    seed: int
    motor: Motor
    plate: Motor
    parameters: DriveParameters
    theta_0: float


def drawn(name: str, seed: int, **parameters: object) -> Drawn:
    """The drive of run `seed` of a motor."""
    rng = np.random.default_rng([seed, *name.encode()])
    plate = PRESETS[name]

    def off(share: float) -> float:
        return 1.0 + share * rng.uniform(-1.0, 1.0)

    motor = replace(plate, R=plate.R * off(0.2), L_d=plate.L_d * off(0.15), L_q=plate.L_q * off(0.15),
                    psi_m=plate.psi_m * off(0.08))
    offset = 0.02 * rng.uniform(-1.0, 1.0, 2)
    given = {"sample_rate": RATE, "current_noise": 0.02, "dead_time_voltage": rng.uniform(0.3, 1.5),
             "current_offset": (float(offset[0]), float(offset[1]))}
    return Drawn(name, seed, motor, plate, DriveParameters(**{**given, **parameters}),  # type: ignore[arg-type]
                 float(rng.uniform(-math.pi, math.pi)))


def recorded(d: Drawn, protocol: Protocol, encoder: bool = True) -> Measurement:
    """What the wire carries of a run."""
    simulation = DriveSimulation(d.motor, d.parameters, running(d.name), d.theta_0, d.seed)
    node = DriveNode(protocol, 0, simulation, DriveNodeSettings(reference_rate=500.0 if encoder else 0.0))
    builder = MeasurementBuilder(config_from({"motor": {"preset": d.name}}), protocol)
    builder.feed(node.step(simulation.samples_in_profile, 1_700_000_000_000_000_000).frames)
    builder.finish()
    return builder.measurement()


def truth(d: Drawn) -> dict[str, float]:
    """The true values, by name."""
    p = d.parameters
    return {"R": d.motor.R, "L_d": d.motor.L_d, "L_q": d.motor.L_q, "psi_m": d.motor.psi_m,
            "dead_time_voltage": p.dead_time_voltage, "encoder_zero": 0.0, "voltage_delay": p.voltage_delay,
            "i_offset_alpha": p.current_offset[0], "i_offset_beta": p.current_offset[1]}


Row = tuple[float, float, bool]
"""(error, standard error, whether the interval holds the truth); NaN where not told."""


def one(task: tuple[str, int, bool]) -> dict[str, Row]:
    """One run."""
    name, seed, encoder = task
    d = drawn(name, seed)
    found: Identification = identify(recorded(d, Protocol(), encoder), d.plate)
    rows = {}
    for key, value in truth(d).items():
        p = found.parameters.get(key)
        if p is None or not p.told:
            rows[key] = (math.nan, math.nan, True)
        else:
            rows[key] = (p.value - value, p.standard_error, p.low <= value <= p.high)
    return rows


def table(name: str, runs: Sequence[dict[str, Row]], plate: Motor, encoder: bool) -> tuple[list[str], bool]:
    """(lines, whether what is asked for was met)."""
    lines = [f"{name}, {len(runs)} runs of 5 s, {'with encoder' if encoder else 'without encoder'}",
             f"  {'parameter':18} {'told':>5} {'rms error':>11} {'worst':>11} {'asked':>6} {'interval holds':>15}"]
    met = True
    for key in runs[0]:
        rows = [r[key] for r in runs if math.isfinite(r[key][0])]
        share = 100.0 * len(rows) / len(runs)
        if not rows:
            lines.append(f"  {key:18} {share:4.0f}%")
            met &= not encoder or key not in LIMITS
            continue
        error = np.array([r[0] for r in rows])
        holds = 100.0 * float(np.mean([r[2] for r in rows]))
        asked = ""
        if key in LIMITS:
            error = 100.0 * error / getattr(plate, key)
            asked = f"{LIMITS[key]:g} %"
            met &= not encoder or (float(np.abs(error).max()) <= LIMITS[key] and len(rows) == len(runs))
            met &= holds >= COVERAGE
        unit = " %" if key in LIMITS else ""
        lines.append(f"  {key:18} {share:4.0f}% {_figure(float(np.sqrt(np.mean(error**2))), unit):>11} "
                     f"{_figure(float(np.abs(error).max()), unit):>11} {asked:>6} {holds:13.1f} %")
    return lines, met


def _figure(value: float, unit: str) -> str:
    return f"{value:.3g}{unit}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run and print; returns 0 if all that is asked for was met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="runs per motor")
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--sensorless", action="store_true", help="without encoder")
    parser.add_argument("--motor", choices=sorted(TOP_SPEED), action="append")
    args = parser.parse_args(argv)
    met = True
    one(("m2", 0, not args.sensorless))  # compiles, once
    for name in args.motor or sorted(TOP_SPEED):
        tasks = [(name, seed, not args.sensorless) for seed in range(args.first, args.first + args.runs)]
        with ProcessPoolExecutor(args.processes) as pool:
            runs = list(pool.map(one, tasks, chunksize=4))
        lines, good = table(name, runs, PRESETS[name], not args.sensorless)
        print("\n".join(lines), flush=True)
        met &= good
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
