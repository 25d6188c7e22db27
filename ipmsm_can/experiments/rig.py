"""The test rig: a drive's run becomes frames, and frames become what an observer makes of them.

The drive and the observer meet only on the wire.  A run with injection goes through the co-simulation, where the
companion's InjectionCommand frames make the drive inject; the order comes from the operator, so the frames do not
depend on the observer and serve any number of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.simulation import DriveSamples, DriveSimulation
from ipmsm_can.estimation import confidence, regression, speed
from ipmsm_can.estimation.observers import ges
from ipmsm_can.experiments.model import Probing, Run, Setup, Watcher
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol

Floats = NDArray[np.float64]

_LOOK_S = 5e-3
"""How often drive and companion look at the bus in a run with injection, and how often commands come."""
_MOTOR_KEYS = ("pole_pairs", "psi_m", "L_d", "L_q", "R", "J", "rated_torque")


@dataclass(frozen=True)
class Recording:
    """Frames of a run as a bus logger would see them, and the simulated truth behind them."""

    frames: FrameBlock
    truth: DriveSamples


@dataclass(frozen=True)
class Track:
    """A run as the companion saw it; arrays (N,) over samples unless said otherwise.

    run.  time [s].  i, v: complex current [A peak] and mean voltage [V peak] as decoded.  theta: observer's angle
    [rad electrical].  x, phi: complex active flux [Wb] and regressor [V].  excitation [V^2 s].  sigma: 1-sigma of
    theta [rad electrical].  locked, valid: bool.
    truth: the drive's own values at these samples.
    reference_time [s], error [deg electrical]: estimate minus encoder where the encoder spoke, or minus the
    simulated rotor at every sample, as Setup.against_encoder says.
    """

    run: Run
    time: Floats
    i: NDArray[np.complex128]
    v: NDArray[np.complex128]
    theta: Floats
    x: NDArray[np.complex128]
    phi: NDArray[np.complex128]
    excitation: Floats
    sigma: Floats
    locked: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    truth: DriveSamples
    reference_time: Floats
    error: Floats

    @property
    def error_everywhere(self) -> Floats:
        """Error against the simulated rotor at every sample [deg electrical]."""
        return wrapped_degrees(self.theta - self.truth.theta_e)


def wrapped_degrees(angle: Floats) -> Floats:
    """The angle [rad] in -180..180 degrees."""
    return np.degrees(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


@lru_cache(maxsize=1)
def protocol() -> Protocol:
    """The project's own messages."""
    return Protocol()


def companion_config(setup: Setup, watcher: Watcher, probing: Probing | None = None) -> DriveConfig:
    """The drive.toml that an engineer would write for this observer on this drive."""
    motor: dict[str, Any] = {key: getattr(setup.machine, key) for key in _MOTOR_KEYS}
    for name, factor in watcher.scale:
        motor[name] *= factor
    observer: dict[str, Any] = {"kind": watcher.kind,
                                "initial_flux": watcher.start or _flux_near(setup, watcher.start_off)}
    if watcher.alpha is not None:
        observer["alpha"] = watcher.alpha
    if watcher.gamma is not None:
        observer["gamma"] = watcher.gamma
    injection: dict[str, Any] = {"enabled": False}
    if setup.probing is not None:
        injection["frequency"] = setup.probing.frequency
    if probing is not None:
        # What the paper injects is not negotiable: neither the current limit nor the speed shall cut it, and no
        # pulses go before.
        injection = {"waveform": probing.waveform, "amplitude": probing.amplitude, "frequency": probing.frequency,
                     "axis": probing.axis, "ramp": 1e6, "current_limit": 1e3, "period": _LOOK_S,
                     "polarity": False}
    return config_from({"motor": motor, "observer": observer, "injection": injection}, source=f"{watcher.kind}")


def _flux_near(setup: Setup, off: float) -> tuple[float, float]:
    angle = setup.theta_0 + math.radians(off)
    return setup.machine.psi_m * math.cos(angle), setup.machine.psi_m * math.sin(angle)


@lru_cache(maxsize=8)
def record(setup: Setup) -> Recording:
    """Run the drive; deterministic: the same setup gives the same frames."""
    simulation = DriveSimulation(setup.machine, setup.drive, setup.profile, setup.theta_0, setup.seed)
    node = DriveNode(protocol(), 0, simulation, setup.node)
    if setup.probing is None:
        step = node.step(simulation.samples_in_profile)
        return Recording(step.frames, step.samples)
    companion = Companion([companion_config(setup, Watcher(), setup.probing)], protocol(), transmit=True)
    scheduler = companion.nodes[0].scheduler
    cosim = CoSimulation([node], companion, period_s=_LOOK_S, keep_frames=True)
    scheduler.operator(False)
    cosim.run(setup.probing.begin)
    scheduler.operator(True)
    done = cosim.run(setup.profile.duration - setup.probing.begin)
    parts = done.truth[0]
    names = DriveSamples.__dataclass_fields__
    truth = DriveSamples(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
    return Recording(FrameBlock.concat(done.frames), truth)


def observe(run: Run) -> Track:
    """Decode the run's frames and let the observer have them.

    Raises RuntimeError when samples went missing on the wire, which in virtual time nothing may cause.
    """
    recording = record(run.setup)
    companion = Companion([companion_config(run.setup, run.watcher)], protocol(), transmit=False)
    parts = companion.feed(recording.frames)
    counter = np.concatenate([p.run.counter for p in parts])
    if not np.array_equal(counter, np.arange(counter.size)):
        raise RuntimeError(f"run {run.name}: samples went missing between drive and companion")
    values = np.concatenate([p.run.values for p in parts], axis=1)
    angle = np.concatenate([p.estimate.angle for p in parts], axis=1)
    flux = np.concatenate([p.estimate.flux for p in parts], axis=1)
    regressed = np.concatenate([p.estimate.regression for p in parts], axis=1)
    flags = np.concatenate([p.estimate.flags for p in parts])
    truth = DriveSamples(*(getattr(recording.truth, name)[counter] for name in DriveSamples.__dataclass_fields__))
    theta = angle[speed.THETA_HAT]
    at, reference = _reference(run.setup, recording, counter.size)
    return Track(
        run=run, time=counter / run.setup.drive.sample_rate, i=values[0] + 1j * values[1],
        v=values[2] + 1j * values[3], theta=theta, x=flux[ges.X_A] + 1j * flux[ges.X_B],
        phi=regressed[regression.PHI_A] + 1j * regressed[regression.PHI_B],
        excitation=np.concatenate([p.estimate.excitation for p in parts]),
        sigma=np.concatenate([p.estimate.sigma for p in parts]), locked=flags & confidence.LOCKED != 0,
        valid=flags & confidence.VALID != 0,
        truth=truth, reference_time=at / run.setup.drive.sample_rate, error=wrapped_degrees(theta[at] - reference))


def _reference(setup: Setup, recording: Recording, samples: int) -> tuple[NDArray[np.int64], Floats]:
    """(samples, rotor angle [rad electrical] there): the encoder's frames, or the simulated rotor."""
    if not setup.against_encoder:
        return recording.truth.sample[:samples], recording.truth.theta_e[:samples]
    raw = recording.frames.raw
    kind = MessageKind.DRIVE_REFERENCE
    rows = np.flatnonzero(protocol().classify(raw) == kind * 16)
    values, _, _ = protocol().decode(kind, 0, raw, rows)
    index = protocol().codecs[kind].index
    at = values[index["sample_counter"]].astype(np.int64)
    kept = at < samples
    return at[kept], values[index["theta_e"]][kept]
