"""What the timing of the samples does to the angle: `python -m tools.sampling [--draws 4] [--only errors]`.

First table: rms angle error [deg electrical] at a steady speed, third of the rated load, 6 V at 400 Hz injected,
0.5 V dead time, 0.02 A noise, over the last 0.5 s of 1.5 s.  The voltage is late against the current by 0, half or
one sample (a mean over parts of two steps), or early by half a sample (the current is taken in the middle of a
period).  The observer takes it for right (0), finds it (auto), or is told.

Second table: the experiments with random motor errors as in tools.calibration.  How often a delay is found, how
long that takes from the first sample with injection on, and how good it is.

Exit code 1 when one was taken that is worse than none.
"""

from __future__ import annotations

import argparse
import math
import sys
import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.companion import Companion
from ipmsm_can.config import DriveConfig
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.estimation import speed
from ipmsm_can.estimation.confidence import VALID
from ipmsm_can.estimation.estimator import Estimator
from ipmsm_can.experiments.compare import SCENES, Scene
from ipmsm_can.experiments.measure import rms
from ipmsm_can.experiments.model import Probing, Setup, Watcher
from ipmsm_can.experiments.rig import companion_config, protocol, record, wrapped_degrees
from tools.calibration import CURRENT_NOISE, CURRENT_OFFSET, DEAD_TIME, SPREAD

Floats = NDArray[np.float64]

RATES = (2500.0, 5000.0, 10_000.0)
SPEEDS = (("m1", 95.5), ("m1", 955.0), ("m2", 100.0), ("m2", 1000.0))
TIMINGS = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.5))
"""voltage_delay and sampling_lead of the drive [samples]."""
KINDS = ("ges", "riccati")
LOOK = 50
"""Samples between two looks at the delay in use."""


@dataclass(frozen=True)
class Seen:
    """A run as an estimator saw it; error [deg electrical], flags (N,); taken: (sample, delay) at each change."""

    error: Floats
    flags: NDArray[np.uint8]
    taken: tuple[tuple[int, float], ...]


def observe(setup: Setup, watcher: Watcher, delay: float | str) -> Seen:
    """The frames of the drive, decoded, through an estimator whose observer.voltage_delay is `delay`."""
    recording = record(setup)
    config: DriveConfig = companion_config(setup, watcher)
    config = config.model_copy(update={"observer": config.observer.model_copy(update={"voltage_delay": delay})})
    parts = Companion([config], protocol(), transmit=False).feed(recording.frames)
    values = np.concatenate([p.run.values for p in parts], axis=1)
    rate = setup.drive.sample_rate
    estimator = Estimator(config.build_motor(), rate, estimator_settings(config, rate))
    angle, flags, taken = [], [], []
    last = estimator.voltage_delay.applied
    for begin in range(0, values.shape[1], LOOK):
        block = estimator.process(np.ascontiguousarray(values[:, begin:begin + LOOK]))
        angle.append(block.angle[speed.THETA_HAT])
        flags.append(block.flags)
        if estimator.voltage_delay.applied != last:
            last = estimator.voltage_delay.applied
            taken.append((begin + LOOK, last))
    theta = np.concatenate(angle)
    return Seen(wrapped_degrees(theta - recording.truth.theta_e[:theta.size]), np.concatenate(flags), tuple(taken))


def errors() -> None:
    """The first table."""
    print("rms error [deg electrical]: taken for right / found / told;  first order: omega T_s d")
    print(f"{'':24s} {'late by':>8s} {'omega T_s d':>12s}" + "".join(f"{kind:>26s}" for kind in KINDS))
    for motor, rpm in SPEEDS:
        for rate in RATES:
            for late, lead in TIMINGS:
                drive = DriveParameters(sample_rate=rate, current_noise=CURRENT_NOISE, dead_time_voltage=DEAD_TIME,
                                        voltage_delay=late, sampling_lead=lead, speed_imposed=True)
                node = DriveNodeSettings(fd=rate > 5000.0)
                setup = Setup(motor, constant(rpm * RPM, 0.0, 1.5), drive, node, Probing(6.0, 400.0))
                setup = replace(setup, profile=constant(rpm * RPM, setup.machine.rated_torque / 3.0, 1.5))
                first = math.degrees(rpm * RPM * setup.machine.pole_pairs / rate * (late - lead))
                line = f"{motor} {rpm:6.1f} rpm {rate / 1000.0:5.1f} kHz {late - lead:8.1f} {abs(first):12.2f}"
                for kind in KINDS:
                    watcher = Watcher(kind, None, None)
                    found = [rms(observe(setup, watcher, delay).error[-round(rate / 2):])
                             for delay in (0.0, "auto", late - lead)]
                    line += f"{found[0]:12.2f} /{found[1]:5.2f} /{found[2]:5.2f}"
                print(line, flush=True)


def draw(scene: Scene, number: int, seed: int, rate: float, late: float, lead: float) -> tuple[Seen, int]:
    """One run of a scene with random errors, and the first sample at which the injection is on (or 0)."""
    rng = np.random.default_rng([seed, zlib.crc32(scene.name.encode()), number])
    scale = tuple((key, 1.0 + float(rng.uniform(-most, most))) for key, most in SPREAD)
    offset = (float(rng.uniform(-1, 1)) * CURRENT_OFFSET, float(rng.uniform(-1, 1)) * CURRENT_OFFSET)
    drive = replace(scene.setup.drive, sample_rate=rate, current_noise=CURRENT_NOISE, dead_time_voltage=DEAD_TIME,
                    current_offset=offset, voltage_delay=late, sampling_lead=lead)
    setup = replace(scene.setup, drive=drive, seed=int(rng.integers(1, 2**31)),
                    node=replace(scene.setup.node, fd=rate > 5000.0))
    watcher = Watcher("riccati", None, None, start_off=float(rng.uniform(-180.0, 180.0)), scale=scale)
    begin = round(scene.setup.probing.begin * rate) if scene.setup.probing else 0
    return observe(setup, watcher, "auto"), begin


def detection(draws: int, seed: int) -> int:
    """The second table; returns how many wrong delays were taken."""
    print(f"\n{draws} draws, seed {seed}: a delay was found, or none, or one that is worse than none;  time to the "
          "first [ms];\nlargest error of the last [samples];  largest valid error after it [deg]")
    print(f"{'':20s} {'rate':>9s} {'late by':>8s} {'found':>6s} {'none':>6s} {'worse':>6s} {'median':>8s} "
          f"{'longest':>8s} {'off by':>8s} {'valid':>8s}")
    bad = 0
    for scene in SCENES:
        for rate in RATES if scene.setup.probing else (5000.0,):
            for late, lead in TIMINGS:
                true = late - lead
                worse, times, off, worst = 0, [], 0.0, 0.0
                for number in range(draws):
                    seen, begin = draw(scene, number, seed, rate, late, lead)
                    if not seen.taken:
                        continue
                    times.append(1e3 * (seen.taken[0][0] - begin) / rate)
                    worse += max(abs(delay - true) for _, delay in seen.taken) >= max(abs(true), 1e-9)
                    off = max(off, abs(seen.taken[-1][1] - true))
                    settled = seen.taken[-1][0] + round(0.3 * rate)
                    valid = seen.flags[settled:] & VALID != 0
                    worst = max(worst, float(np.abs(seen.error[settled:][valid]).max(initial=0.0)))
                bad += worse
                line = (f"{scene.name:20s} {rate / 1000.0:5.1f} kHz {true:8.1f} {len(times):6d} "
                        f"{draws - len(times):6d} {worse:6d}")
                if times:
                    line += f" {np.median(times):8.0f} {max(times):8.0f} {off:8.2f} {worst:8.2f}"
                print(line, flush=True)
    return bad


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=("errors", "detection"), help="one of the two tables")
    args = parser.parse_args()
    if args.only != "detection":
        errors()
    if args.only == "errors":
        return 0
    return 1 if detection(args.draws, args.seed) else 0


if __name__ == "__main__":
    sys.exit(main())
