"""What the paper's observer must do on the simulated drive, as data and assertions.

`tests/test_mutations.py` runs the same assertions twice: on the observer as it is, and on copies of it that were
broken on purpose.  A copy runs in a process of its own (`python -m tests.claims FILE`), uncompiled; so
this module needs nothing of the package but `estimate`, and the samples come out of a file.

Bounds come from the run.  Current noise s_i shows in x_hat = lambda_hat - L_q i at once and turns it by
L_q s_i / psi_m rms.  It also stands in Phi, as 2 alpha L_s s_i, and moves lambda_hat: error and correction are
in balance at alpha L_s s_i sqrt(gamma T_s) rms (at standstill, whatever the strength of the injection).  The
error may be twice what both make of it: the noise at standstill has a correlation time of 1/20 s, and a second of
it is no more than twenty draws.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can import estimate
from ipmsm_can.motor import PRESETS

Floats = NDArray[np.float64]

RATE = 5000.0
CURRENT_NOISE = 0.02
"""[A rms per axis]"""
INJECTION = (20.0, 400.0)
"""[V peak, Hz], rotating."""


@dataclass(frozen=True)
class Run:
    """Angle error of one run: time [s], error [deg electrical], and what noise alone makes of it [deg rms]."""

    time: Floats
    error: Floats
    noise: float

    def rms(self, begin: float) -> float:
        """Root mean square of the error [deg] from `begin` [s] on; infinite if it is not a number any more."""
        value = float(np.sqrt(np.mean(self.error[self.time >= begin] ** 2)))
        return value if math.isfinite(value) else math.inf

    def locked_at(self) -> float:
        """Time [s] after which |error| stays below 2 deg; infinite if never."""
        outside = np.flatnonzero(~(np.abs(self.error) < 2.0))
        if outside.size == 0:
            return 0.0
        return math.inf if outside[-1] + 1 == self.time.size else float(self.time[outside[-1] + 1])


def ramp(run: Run) -> None:
    """Fig. 2: locks within 0.35 s from lambda_hat(0) = (0.5, 2) and follows the ramp with nothing but noise."""
    assert run.locked_at() < 0.35, f"locked at {run.locked_at():.3f} s"
    assert run.rms(0.6) < 2.0 * run.noise, f"rms {run.rms(0.6):.3g} deg, noise alone {run.noise:.3g}"


def pulses(run: Run) -> None:
    """1000 rpm with torque pulses: locks before the first pulse; the pulses do not show."""
    assert run.locked_at() < 0.4, f"locked at {run.locked_at():.3f} s"
    assert run.rms(0.45) < 2.0 * run.noise, f"rms {run.rms(0.45):.3g} deg, noise alone {run.noise:.3g}"


def standstill(run: Run) -> None:
    """Locked rotor, rotating injection from 0.05 s on: from 60 deg to the rotor axis within 0.5 s, and stays."""
    assert abs(run.error[int(0.04 * RATE)]) > 55.0, "moved before there was an injection"
    assert run.locked_at() < 0.5, f"locked at {run.locked_at():.3f} s"
    assert run.rms(0.5) < 2.0 * run.noise, f"rms {run.rms(0.5):.3g} deg, noise alone {run.noise:.3g}"


@dataclass(frozen=True)
class Claim:
    """An assertion, the motor's preset, and the observer's alpha, gamma and initial flux."""

    check: Callable[[Run], None]
    motor: str
    alpha: float
    gamma: float
    initial_flux: tuple[float, float]


_SIXTY = PRESETS["m1"].psi_m * np.exp(1j * (0.7 + math.pi / 3))

CLAIMS = {
    "ramp": Claim(ramp, "m1", 20.0, 10.0, (0.5, 2.0)),
    "pulses": Claim(pulses, "m2", 10.0, 50.0, (0.5, 2.0)),
    "standstill": Claim(standstill, "m1", 20.0, 5000.0, (float(_SIXTY.real), float(_SIXTY.imag))),
}


def run_claim(claim: Claim, samples: Floats) -> Run:
    """samples (5, N): i_alpha, i_beta [A], v_alpha, v_beta [V], true theta [rad electrical]."""
    motor = PRESETS[claim.motor]
    with np.errstate(all="ignore"):
        found = estimate(samples[:2].T, samples[2:4].T, RATE, motor, alpha=claim.alpha, gamma=claim.gamma,
                         initial_flux=claim.initial_flux)
        error = np.degrees((found.theta - samples[4] + np.pi) % (2 * np.pi) - np.pi)
    through_phi = claim.alpha * motor.L_s * CURRENT_NOISE * math.sqrt(claim.gamma / RATE)
    noise = math.hypot(motor.L_q * CURRENT_NOISE / motor.psi_m, through_phi)
    return Run(found.time, error, math.degrees(noise))


def verdicts(samples: dict[str, Floats]) -> dict[str, str]:
    """For each claim what was wrong, or an empty text."""
    found = {}
    for name, claim in CLAIMS.items():
        run = run_claim(claim, samples[name])
        try:
            claim.check(run)
        except AssertionError as problem:
            found[name] = str(problem).splitlines()[0] or "failed"
        else:
            found[name] = ""
    return found


if __name__ == "__main__":
    with np.load(Path(sys.argv[1])) as file:
        print(json.dumps(verdicts({name: file[name] for name in CLAIMS})))
