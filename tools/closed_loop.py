"""The loop closed over CAN: `python -m tools.closed_loop`.

The simulated drive (5 kHz) controls speed and current with the angle that comes back from the companion as
PositionEstimate at 1 kHz.  Both look at the bus in every control period, so that a delay means what it says; frames
are delayed and lost in both directions.  Each case is run once with the encoder in the loop throughout and once for
each observer; the speed error after a rated load step is compared.  Then come starts from angles all around: at
standstill, by injection and polarity pulses, and open loop.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.angle_source import AngleState
from ipmsm_can.drive.firmware import FirmwareNode
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSamples, DriveSimulation
from ipmsm_can.motor import M2, PRESETS
from ipmsm_can.wire.protocol import Protocol

RATE = 5000.0
AFTER_STEP = 0.4
"""Time after a load step in which the largest speed error counts [s]."""
SOURCES: dict[str, dict[str, Any]] = {
    "encoder": {}, "ges": {"kind": "ges"}, "riccati": {"kind": "riccati"},
    "ges, 20 Hz": {"kind": "ges", "speed_bandwidth": 20.0},
    "riccati, 20 Hz": {"kind": "riccati", "speed_bandwidth": 20.0},
    "ges, 60 Hz": {"kind": "ges", "speed_bandwidth": 60.0},
    "riccati, 60 Hz": {"kind": "riccati", "speed_bandwidth": 60.0},
}
"""Settings of the observer; the natural frequency of its speed loop is to be well above the drive's 15 Hz."""
LINEAR = {"saturation_uncertainty": 0.0}
"""What a companion is told of a machine that does not saturate; of one that does it knows no more than usual."""
BUS = {
    "ideal": BusFaults(),
    "0.5 ms": BusFaults(loss=0.01, delay_ns=500_000, seed=1),
    "2 ms": BusFaults(loss=0.01, delay_ns=2_000_000, seed=1),
    "0.5-2 ms": BusFaults(loss=0.01, delay_ns=500_000, jitter_ns=1_500_000, seed=1),
}
"""Transport delay each way and, but for the first, 1 % of all frames lost."""

_T = M2.rated_torque
STEPS = Profile(
    ((0.0, 0.0), (0.2, 0.0), (1.2, 1000.0 * RPM), (2.4, 1000.0 * RPM), (4.4, -1000.0 * RPM), (5.6, -1000.0 * RPM)),
    ((0.0, 0.0), (1.6, 0.0), (1.6, _T), (2.0, _T), (2.0, 0.0), (4.8, 0.0), (4.8, -_T), (5.2, -_T), (5.2, 0.0)), 5.6)
LOADED = Profile(((0.0, 1000.0 * RPM), (1.0, 1000.0 * RPM), (3.0, -1000.0 * RPM), (4.0, -1000.0 * RPM)),
                 ((0.0, 0.0), (0.6, 0.0), (0.6, _T)), 4.0)
SLOW = Profile(((0.0, 1000.0 * RPM), (1.0, 1000.0 * RPM), (11.0, -1000.0 * RPM), (12.0, -1000.0 * RPM)),
               ((0.0, 0.0),), 12.0)
CRAWL = Profile(((0.0, 200.0 * RPM), (0.6, 200.0 * RPM), (1.0, 20.0 * RPM), (5.0, -20.0 * RPM), (6.0, -200.0 * RPM),
                 (6.4, -200.0 * RPM)), ((0.0, 0.0), (0.7, 0.0), (0.7, 0.5 * _T)), 6.4)
STANDSTILL = Profile(((0.0, 1000.0 * RPM), (0.6, 1000.0 * RPM), (1.6, 0.0), (4.0, 0.0)),
                     ((0.0, 0.0), (2.2, 0.0), (2.2, _T), (3.0, _T), (3.0, 0.0)), 4.0)
FROM_REST = Profile(
    ((0.0, 0.0), (0.4, 0.0), (0.9, 1000.0 * RPM), (1.4, 1000.0 * RPM), (2.4, -1000.0 * RPM), (2.9, -1000.0 * RPM),
     (3.4, 0.0), (3.6, 0.0)),
    ((0.0, 0.0), (1.0, 0.0), (1.0, _T), (1.3, _T), (1.3, 0.0), (2.5, 0.0), (2.5, -_T), (2.8, -_T), (2.8, 0.0)), 3.6)
"""Standstill, to speed, load step, through zero, load step, and back to rest."""
LOADED_REST = Profile(((0.0, 0.0), (0.6, 0.0), (1.1, 1000.0 * RPM), (1.4, 1000.0 * RPM)), ((0.0, _T),), 1.4)
RUNNING = {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.5}


@dataclass(frozen=True)
class Case:
    """What the drive is to do, on which bus, with which motor.

    drive: settings of the sensorless drive.  rough: what the drive has that the companion does not know of.
    scale: the companion's motor parameters by the true ones.  mute_at: time at which the companion dies [s].
    motor: preset.  firmware: the drive speaks, and takes its angle, through the C library.
    """

    name: str
    profile: Profile
    drive: dict[str, Any]
    bus: str = "0.5-2 ms"
    rough: dict[str, Any] = field(default_factory=dict)
    scale: dict[str, float] = field(default_factory=dict)
    injection: bool = True
    mute_at: float | None = None
    theta_0: float = 2.5
    seed: int = 0
    motor: str = "m2"
    firmware: bool = False


FAILS = {"angle_source": "encoder_then_companion", "encoder_fails_at": 1.3}
START = {"angle_source": "companion", "open_loop_current": M2.rated_current}
WAITS = {"angle_source": "companion"}
LIGHT = {"m1": 0.5, "m2": 1.0}
"""Load of the starts from rest, as a share of rated.  At rated torque the incremental L_q of the saturating M1 is a
third smaller than the companion is told; the angle then swings with the torque, and the speed with the angle."""
MACHINES = tuple((motor, share) for motor in ("m1", "m2") for share in (0.2, 0.1))


def loaded(profile: Profile, share: float) -> Profile:
    """The profile with so much of its load."""
    return replace(profile, load=tuple((t, share * torque) for t, torque in profile.load))


def from_rest(motor: str, saturation: float, **more: Any) -> Case:
    """A start at standstill by injection and pulses, through zero and back to rest."""
    share = LIGHT[motor]
    return Case(f"from rest, {motor.upper()}, L_d down {100 * saturation:.0f} %", loaded(FROM_REST, share), WAITS,
                motor=motor, rough={"saturation": saturation, "torque_limit": (0.5 + share) * _T}, **more)


CASES = (
    *(Case("load steps and reversal, encoder fails at 1.3 s", STEPS, FAILS, bus) for bus in BUS),
    Case("the same, started open loop", STEPS, START),
    Case("the same, without injection", STEPS, START, injection=False),
    Case("the same, dead time 0.5 V, R +20 %, L -10 %", STEPS, START, rough={"dead_time_voltage": 0.5},
         scale={"R": 1.0 / 1.2, "L_d": 1.0 / 0.9, "L_q": 1.0 / 0.9}),
    Case("rated load through zero, 1000 rpm/s", LOADED, RUNNING),
    Case("no load through zero, 200 rpm/s", SLOW, RUNNING),
    Case("no load through zero, 200 rpm/s, dead time 0.5 V", SLOW, RUNNING, rough={"dead_time_voltage": 0.5}),
    Case("half load, from 20 to -20 rpm in 4 s", CRAWL, RUNNING),
    *(Case("to standstill, rated load there", STANDSTILL, RUNNING, seed=seed) for seed in range(3)),
    Case("companion dies at 1.8 s under rated load", STEPS, FAILS, mute_at=1.8),
    Case("standstill, wait for the companion", Profile(((0.0, 0.0),), ((0.0, 0.0),), 1.0), WAITS),
    Case("the same drive with the C library, load steps and reversal", STEPS, FAILS, firmware=True),
    *(from_rest(motor, share) for motor, share in MACHINES),
    replace(from_rest("m2", 0.2, firmware=True), name="from rest, M2, L_d down 20 %, with the C library"),
    Case("from rest under 50 % load, brake, M2", loaded(LOADED_REST, 0.5), {**WAITS, "brake": True},
         rough={"saturation": 0.2}),
    Case("from rest under 35 % load, brake, M1", loaded(LOADED_REST, 0.35), {**WAITS, "brake": True}, motor="m1",
         rough={"saturation": 0.2, "torque_limit": _T}),
)


@lru_cache(maxsize=1)
def _protocol() -> Protocol:
    return Protocol()


@dataclass(frozen=True)
class Run:
    """One case with one source of the angle, and the drive's samples."""

    case: Case
    source: str
    truth: DriveSamples

    @property
    def states(self) -> list[tuple[float, AngleState]]:
        """When the control went over to what."""
        state = self.truth.angle_state
        return [(k / RATE, AngleState(int(state[k]))) for k in np.flatnonzero(np.diff(state, prepend=-1.0))]

    @property
    def speed_error(self) -> NDArray[np.float64]:
        """Reference minus speed [rpm mechanical], at every sample."""
        return (self.truth.speed_reference - self.truth.omega_e / PRESETS[self.case.motor].pole_pairs) / RPM

    @property
    def angle_error(self) -> NDArray[np.float64]:
        """Angle the control took minus the rotor's [deg electrical], where it took the companion's; 0 elsewhere."""
        error = np.degrees(np.angle(np.exp(1j * (self.truth.control_theta - self.truth.theta_e))))
        return np.where(self.truth.angle_state == AngleState.COMPANION, error, 0.0)

    def dip(self) -> float:
        """Largest speed error in AFTER_STEP after a load step [rpm], 0 without a step."""
        load = self.case.profile.load
        steps = [a[0] for a, b in pairwise(load) if a[0] == b[0]]
        error = np.abs(self.speed_error)
        return max((float(error[int(t * RATE):int((t + AFTER_STEP) * RATE)].max()) for t in steps), default=0.0)

    def kept(self) -> bool:
        """The rotor was never lost: no stop, the angle never off by 30 deg, and the speed as asked at the end."""
        return bool(self.states[-1][1] in (AngleState.ENCODER, AngleState.COMPANION)
                    and np.abs(self.angle_error).max() < 30.0 and abs(self.speed_error[-1]) < 20.0)


def run(case: Case, source: str) -> Run:
    """Run a case with the encoder or an observer of SOURCES in the loop."""
    plant = PRESETS[case.motor]
    motor = {"preset": case.motor, **{name: factor * getattr(plant, name) for name, factor in case.scale.items()}}
    injection: dict[str, Any] = {"enabled": case.injection}
    observer = {**({} if "saturation" in case.rough else LINEAR), **SOURCES[source]}
    config = config_from({"motor": motor, "observer": observer, "injection": injection})
    drive = {} if source == "encoder" else case.drive
    parameters = DriveParameters(sample_rate=RATE, **case.rough, **drive)
    simulation = DriveSimulation(plant, parameters, case.profile, case.theta_0, case.seed)
    node = (FirmwareNode if case.firmware else DriveNode)(_protocol(), 0, simulation, DriveNodeSettings())
    companion = Companion([config], _protocol(), transmit=True)
    cosim = CoSimulation([node], companion, replace(BUS[case.bus], seed=case.seed + 1), period_s=1.0 / RATE)
    before = case.profile.duration if case.mute_at is None else case.mute_at
    done = cosim.run(before)
    if before < case.profile.duration:
        cosim.to_drives.faults = replace(cosim.to_drives.faults, loss=1.0)
        done = cosim.run(case.profile.duration - before)
    names = DriveSamples.__dataclass_fields__
    truth = DriveSamples(*(np.concatenate([getattr(part, name) for part in done.truth[0]]) for name in names))
    return Run(case, source, truth)


def line(result: Run, encoder_dip: float) -> str:
    """One line of the table."""
    dip = result.dip()
    last = result.states[-1][1]
    ratio = f"{dip / encoder_dip:5.2f}" if encoder_dip and last is not AngleState.STOPPED else "    -"
    outcome = {AngleState.STOPPED: "stopped", AngleState.HOLD: "waits"}.get(last)
    outcome = outcome or ("kept" if result.kept() else "lost")
    states = " ".join(f"{state.name.lower()}@{t:.3f}" for t, state in result.states)
    worst = np.abs(result.angle_error).max()
    return (f"  {result.source:15s} {dip:7.1f} rpm {ratio}  {worst:6.2f} deg  "
            f"{outcome:8s} {states}")


def _work(job: tuple[Case, str]) -> Run:
    return run(*job)


def starts_at_rest(sources: Sequence[str], count: int, workers: int) -> None:
    """Starts at standstill from `count` angles, each with its own noise and losses."""
    jobs = [(replace(from_rest(motor, share), theta_0=math.tau * k / count, seed=k), source)
            for motor, share in MACHINES for source in sources for k in range(count)]
    print(f"{count} starts at standstill, 1 % lost, 0.5 to 2 ms; load steps, through zero, and back")
    with ProcessPoolExecutor(workers) as pool:
        done = pool.map(_work, jobs)
        for case, source in jobs[::count]:
            own = [next(done) for _ in range(count)]
            print(_starts(case, source, own), flush=True)


def _starts(case: Case, source: str, own: list[Run]) -> str:
    swapped = [t for r in own for t, state in r.states if state is AngleState.COMPANION]
    worst, dip = max(float(np.abs(r.angle_error).max()) for r in own), max(r.dip() for r in own)
    return (f"  {case.name:32s} {source:10s} kept {sum(r.kept() for r in own)} of {len(own)}, loop closed after "
            f"{min(swapped, default=math.inf):.3f} to {max(swapped, default=math.inf):.3f} s, angle off by "
            f"{worst:.1f} deg at most, speed after a step by {dip:.0f} rpm")


def start_angles(sources: Sequence[str], count: int, workers: int) -> None:
    """Open-loop starts from `count` angles, each with its own noise and losses."""
    until = Profile(((0.0, 0.0), (0.2, 0.0), (1.2, 1000.0 * RPM), (2.0, 1000.0 * RPM)), ((0.0, 0.0),), 2.0)
    jobs = [(Case("start", until, START, theta_0=math.tau * k / count, seed=k), source)
            for source in sources for k in range(count)]
    print(f"{count} open-loop starts to 1000 rpm, no load")
    with ProcessPoolExecutor(workers) as pool:
        done = list(pool.map(_work, jobs))
    for source in sources:
        own = [r for r in done if r.source == source]
        swapped = [t for r in own for t, state in r.states if state is AngleState.COMPANION]
        worst = max(float(np.abs(r.angle_error).max()) for r in own)
        print(f"  {source:15s} kept {sum(r.kept() for r in own)} of {count}, companion in the loop after "
              f"{min(swapped):.2f} to {max(swapped):.2f} s, largest angle error while used {worst:.1f} deg")


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 0."""
    parser = argparse.ArgumentParser(prog="python -m tools.closed_loop", description=__doc__)
    parser.add_argument("--sources", nargs="+", default=["ges", "riccati"], metavar="NAME",
                        choices=[s for s in SOURCES if s != "encoder"], help=f"among {', '.join(SOURCES)}")
    parser.add_argument("--cases", default="", metavar="TEXT", help="only cases whose name holds this text")
    parser.add_argument("--starts", type=int, default=24, metavar="N", help="starts of each kind (default: 24)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default: 2)")
    args = parser.parse_args(argv)
    cases = [case for case in CASES if args.cases in case.name]
    jobs = [(case, source) for case in cases for source in ["encoder", *args.sources]]
    print("speed error after a load step, over the encoder's; largest angle error while the companion's is used")
    with ProcessPoolExecutor(args.workers) as pool:
        dip = 0.0
        for result in pool.map(_work, jobs):
            if result.source == "encoder":
                dip = result.dip()
                print(f"{result.case.name}; bus {result.case.bus}")
            print(line(result, 0.0 if result.source == "encoder" else dip), flush=True)
    if args.starts:
        starts_at_rest(args.sources, args.starts, args.workers)
        start_angles(args.sources, args.starts, args.workers)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
