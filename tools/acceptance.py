"""What the observer must show, through the simulated drive and the wire: `python -m tools.acceptance`.

Co-simulation in virtual time; errors are electrical degrees against the simulated rotor.  Exit code 1 when a
line does not hold.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.motor import PRESETS
from ipmsm_can.wire.protocol import Protocol

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One run: motor and observer, profile, faults of the bus, and settings of the drive."""

    name: str
    motor: str
    observer: dict[str, Any]
    track: Profile
    faults: BusFaults = field(default_factory=BusFaults)
    rate: float = 5000.0
    fd: bool = False
    drive: dict[str, Any] = field(default_factory=dict)


def run(case: Case, protocol: Protocol) -> tuple[Floats, Floats, Companion]:
    """(time of each sample [s], angle error [deg electrical], the companion afterwards)."""
    return run_with_flags(case, protocol)[:3]


def run_with_flags(case: Case, protocol: Protocol) -> tuple[Floats, Floats, Companion, NDArray[np.uint8]]:
    """What `run` gives, and the flags of each sample (bits of `estimation.confidence`)."""
    parameters = DriveParameters(sample_rate=case.rate, **case.drive)
    simulation = DriveSimulation(PRESETS[case.motor], parameters, case.track)
    config = config_from({"motor": {"preset": case.motor}, "observer": case.observer,
                          "injection": {"enabled": False}})
    companion = Companion([config], protocol, transmit=True)
    drive = DriveNode(protocol, 0, simulation, DriveNodeSettings(fd=case.fd))
    cosim = CoSimulation([drive], companion, case.faults)
    recording = cosim.run(case.track.duration)
    truth = np.concatenate([s.theta_e for s in recording.truth[0]])
    counter = np.concatenate([t.run.counter for t in recording.tracked[0]])
    theta = np.concatenate([t.estimate.angle[0] for t in recording.tracked[0]])
    error = np.degrees((theta - truth[counter] + np.pi) % (2.0 * np.pi) - np.pi)
    flags = np.concatenate([t.estimate.flags for t in recording.tracked[0]])
    return counter / case.rate, error, companion, flags


def rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def main() -> int:
    """Print the table."""
    protocol = Protocol()
    paper_m1 = {"alpha": 20, "gamma": 10, "initial_flux": [0.5, 2.0]}
    ramp, pulses = profile.paper_ramp(), profile.torque_pulses()
    start = [0.5, 2.0]
    held = True

    def line(case: Case, what: str, value: float, bound: float) -> None:
        nonlocal held
        good = bool(value < bound)
        held &= good
        print(f"{case.name:51s} {what:37s} {value:8.4f}   below {bound:<5g} {'holds' if good else 'FAILS'}",
              flush=True)

    case = Case("M1, ramp 10 to 100 rad/s, 5 kHz, no noise", "m1", paper_m1, ramp, drive={"current_noise": 0.0})
    t, error, _ = run(case, protocol)
    line(case, "largest error from 0.35 s on [deg]", float(np.abs(error[t >= 0.35]).max()), 2.0)
    line(case, "rms of the last 0.5 s [deg]", rms(error[t > t[-1] - 0.5]), 0.05)

    for alpha, gamma, fd in ((5, 50, False), (10, 50, False), (5, 200, False), (10, 200, False), (5, 50, True)):
        rate = 10_000.0 if fd else 5000.0
        case = Case(f"M2, 1000 rpm, pulses, alpha {alpha}, gamma {gamma}{', FD 10 kHz' if fd else ''}", "m2",
                    {"alpha": alpha, "gamma": gamma, "initial_flux": start}, pulses, rate=rate, fd=fd)
        t, error, _ = run(case, protocol)
        settled = t > 0.5
        line(case, "rms after lock (0.5 s) [deg]", rms(error[settled]), 0.2)
        line(case, "largest error after lock [deg]", float(np.abs(error[settled]).max()), 2.0)

    case = Case("M2, 1000 rpm, pulses, 5 % frame loss", "m2",
                {"alpha": 5, "gamma": 50, "initial_flux": start}, pulses, BusFaults(loss=0.05, seed=1))
    t, error, companion = run(case, protocol)
    line(case, "rms after lock (0.5 s) [deg]", rms(error[t > 0.5]), 0.3)
    sequencer = companion.nodes[0].receiver.sequencer
    print(f"{'':51s} lost {sequencer.count('lost')}, filled {sequencer.count('filled')}")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
