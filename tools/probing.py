"""What probing costs and brings, fixed against scheduled by sigma: `python -m tools.probing`.

Through the simulated drive and the wire, 5 kHz, 0.5 V of dead time, 0.02 A of noise, saturating machine, observer
riccati, from standstill at an unknown angle to a constant speed at a tenth of rated torque.  The figures are over
the last second:

    valid, sigma, error   share of the time; median [deg electrical]; rms [deg electrical]
    V                     amplitude that was injected in the median [V peak]
    ripple                torque at the probing frequency, rms and peak [N m] and as a share of rated torque
    loss                  copper loss of the current at that frequency [W]

Exit code 1 where scheduled probing makes more ripple than fixed, or is valid and off by 15 deg.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.motor import PRESETS
from ipmsm_can.wire.protocol import Protocol

Floats = NDArray[np.float64]

RATE = 5000.0
LOAD = 0.1
"""Share of rated torque."""
SPEEDS = (0.0, 5.0, 20.0, 50.0, 100.0, 300.0)
"""[rpm]"""
FULL = {"m1": 9.0, "m2": 4.2}
"""Amplitude [V peak] whose current at 400 Hz stays below 15 % of rated."""
ALL = {"m1": 25.0, "m2": 12.0}
"""The same at a sixth of the sample rate."""
_BAND = 60.0
"""Half the width of what counts as the probing frequency [Hz]."""


@dataclass(frozen=True, slots=True)
class Cost:
    """One line of the table; units as there."""

    valid: float
    sigma: float
    error: float
    worst_valid: float
    amplitude: float
    ripple: float
    ripple_peak: float
    loss: float


def start(motor: str, injection: dict[str, Any], profile: Profile, saturation: float = 0.2,
          **drive: Any) -> CoSimulation:
    """A drive at 0.7 rad electrical and the companion that does not know it."""
    settings = {"sample_rate": RATE, "dead_time_voltage": 0.5, "saturation": saturation, **drive}
    simulation = DriveSimulation(PRESETS[motor], DriveParameters(**settings), profile, 0.7, 1)
    config = config_from({"motor": {"preset": motor}, "observer": {"kind": "riccati"}, "injection": injection})
    protocol = Protocol()
    return CoSimulation([DriveNode(protocol, 0, simulation, DriveNodeSettings())],
                        Companion([config], protocol, True))


def to_speed(motor: str, rpm: float, seconds: float) -> Profile:
    """Half a second at rest, then to the speed within 0.2 s, the load from then on."""
    load = LOAD * PRESETS[motor].rated_torque
    return Profile(((0.0, 0.0), (0.5, 0.0), (0.7, rpm * RPM)), ((0.0, 0.0), (0.5, 0.0), (0.7, load)), seconds)


def errors(cosim: CoSimulation) -> tuple[Floats, Floats, Floats, NDArray[np.uint8]]:
    """(time [s], error [deg electrical], sigma [deg electrical], flags) of every sample estimated."""
    tracked, truth = cosim.recording.tracked[0], cosim.recording.truth[0]
    counter = np.concatenate([t.run.counter for t in tracked])
    theta = np.concatenate([t.estimate.angle[0] for t in tracked])
    true = np.concatenate([s.theta_e for s in truth])
    off = np.degrees((theta - true[counter] + np.pi) % (2.0 * np.pi) - np.pi)
    return (counter / RATE, off, np.degrees(np.concatenate([t.estimate.sigma for t in tracked])),
            np.concatenate([t.estimate.flags for t in tracked]))


def _at(frequency: float, x: Floats) -> Floats:
    """The part of x near the frequency [Hz]."""
    spectrum = np.fft.rfft(x)
    spectrum[np.abs(np.fft.rfftfreq(x.size, 1.0 / RATE) - frequency) > _BAND] = 0.0
    return np.fft.irfft(spectrum, x.size)


def cost(motor: str, rpm: float, injection: dict[str, Any], seconds: float = 3.0) -> Cost:
    """One run."""
    cosim = start(motor, injection, to_speed(motor, rpm, seconds))
    truth = cosim.run(seconds).truth[0]
    t, off, sigma, flags = errors(cosim)
    late = t >= seconds - 1.0
    valid = flags & confidence.VALID != 0
    last = {name: np.concatenate([getattr(s, name) for s in truth])[-round(RATE):]
            for name in ("torque", "i_d", "i_q", "injection_amplitude")}
    frequency = cosim.companion.nodes[0].scheduler.settings.frequency
    ripple = _at(frequency, last["torque"])
    current2 = np.mean(_at(frequency, last["i_d"]) ** 2 + _at(frequency, last["i_q"]) ** 2)
    return Cost(float(valid[late].mean()), float(np.median(sigma[late])), math.sqrt(np.mean(off[late] ** 2)),
                float(np.abs(off[valid]).max(initial=0.0)), float(np.median(last["injection_amplitude"])),
                math.sqrt(np.mean(ripple**2)), float(np.abs(ripple).max()),
                1.5 * PRESETS[motor].R * float(current2))


def main() -> int:
    """Print the table."""
    good = True
    print(f"{'':30s} {'valid':>6s} {'sigma':>6s} {'error':>6s} {'V':>6s} {'ripple rms':>17s} {'peak':>17s} "
          f"{'loss':>8s}")
    for motor, machine in (("m1", PRESETS["m1"]), ("m2", PRESETS["m2"])):
        ways: dict[str, dict[str, Any]] = {
            "fixed": {"amplitude": FULL[motor], "waveform": "rotating", "speed_on": 1e4, "speed_off": 2e4},
            "scheduled": {"amplitude": FULL[motor]},
            "scheduled, auto": {"amplitude": ALL[motor], "frequency": "auto"},
        }
        for rpm in SPEEDS:
            fixed: Cost | None = None
            for way, injection in ways.items():
                c = cost(motor, rpm, injection)
                fixed = fixed or c
                good &= c.ripple <= fixed.ripple and c.worst_valid < 15.0
                share = 100.0 / machine.rated_torque
                print(f"{motor} {rpm:4.0f} rpm  {way:17s} {100 * c.valid:5.0f}% {c.sigma:6.2f} {c.error:6.2f} "
                      f"{c.amplitude:6.2f} {c.ripple:8.4f} ({share * c.ripple:4.1f} %) {c.ripple_peak:8.4f} "
                      f"({share * c.ripple_peak:4.1f} %) {c.loss:8.4f}", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
