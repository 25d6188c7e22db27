"""One run: drive, bus and companion in virtual time, and what is to be said of it as a flat record.

Judged is what the companion puts on the wire: every PositionEstimate, its flag and its angle, against the rotor at
the sample that it names; and, beside it, every sample of the estimate behind.  Whether such a frame then gets lost
makes no difference to whether it was true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import CoSimulation, Recording
from ipmsm_can.campaign.scenario import Scenario, draw
from ipmsm_can.companion import Companion
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.experiments.measure import rms
from ipmsm_can.experiments.rig import wrapped_degrees
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import NODES, MessageKind, Protocol

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

WRONG_DEG = 15.0
"""Error [deg electrical] above which an angle called valid is wrong."""
LOOK_S = 5e-3
"""How often both sides look at the bus."""
ERROR_BINS = tuple(float(v) for v in np.round(np.geomspace(0.01, 180.0, 33), 6))
"""Edges of the histogram of |error| [deg electrical]; what is below the first counts into the first bin."""
RATIO_BINS = tuple(float(v) for v in np.round(np.geomspace(0.01, 10.0, 31), 6))
"""Edges of the histogram of |error|/sigma; what is beyond counts into the first and the last bin."""
_COUNTER = 0x3FF


@dataclass(frozen=True, slots=True)
class Course:
    """A run over time.

    time [s], theta [rad electrical], speed [rad/s mechanical]: of the rotor at every sample.
    said_*: what the PositionEstimates said, in order: the sample they are for, error [deg electrical], 1-sigma
    [deg electrical], valid, locked.
    at, error, sigma, valid, locked: the same of every sample that the companion made of the frames, filled ones
    included.  not_finite: numbers among its results that are none.  lost_locks: how often the observer gave up.
    """

    scenario: Scenario
    time: Floats
    theta: Floats
    speed: Floats
    said_at: NDArray[np.int64]
    said_error: Floats
    said_sigma: Floats
    said_valid: Flags
    said_locked: Flags
    at: NDArray[np.int64]
    error: Floats
    sigma: Floats
    valid: Flags
    locked: Flags
    not_finite: int
    lost_locks: int
    lost_frames: int


@lru_cache(maxsize=1)
def _protocol() -> Protocol:
    return Protocol()


def simulate(scenario: Scenario) -> Course:
    """Run it, to the end."""
    s = scenario
    simulation = DriveSimulation(s.machine, s.parameters(), s.profile, s.theta_0, s.noise_seed)
    drive = DriveNode(_protocol(), 0, simulation, s.node_settings())
    companion = Companion([s.config()], _protocol(), transmit=True)
    faults = s.faults()
    cosim = CoSimulation([drive], companion, faults, LOOK_S, keep_frames=True)
    if s.begins:
        # The companion is not there yet: it hears nothing.
        cosim.to_companion.faults = replace(faults, loss=1.0)
        cosim.run(s.begins)
        cosim.to_companion.faults = faults
    recording = cosim.run(s.duration - s.begins)
    estimator = companion.nodes[0].estimator
    return _course(s, recording, estimator.lost_locks if estimator else 0, cosim.to_companion.lost)


def _course(s: Scenario, recording: Recording, lost_locks: int, lost_frames: int) -> Course:
    truth = recording.truth[0]
    theta = np.concatenate([part.theta_e for part in truth])
    omega = np.concatenate([part.omega_e for part in truth])
    said_at, said = _said(recording.frames, s.sample_rate)
    tracked = recording.tracked[0]
    at = np.concatenate([np.zeros(0, np.int64), *(t.run.counter for t in tracked)])
    angle = np.concatenate([np.zeros((speed.ROWS, 0)), *(t.estimate.angle for t in tracked)], axis=1)
    sigma = np.concatenate([np.zeros(0), *(t.estimate.sigma for t in tracked)])
    flags = np.concatenate([np.zeros(0, np.uint8), *(t.estimate.flags for t in tracked)])
    known = (at >= 0) & (at < theta.size)
    at = np.where(known, at, 0)
    # A claim about a sample that never was is as wrong as can be.
    error = np.where(known, wrapped_degrees(angle[speed.THETA_HAT] - theta[at]), 180.0)
    said_known = (said_at >= 0) & (said_at < theta.size)
    said_at = np.where(said_known, said_at, 0)
    said_error = np.where(said_known, wrapped_degrees(said["theta_e"] - theta[said_at]), 180.0)
    not_finite = int((~np.isfinite(angle)).sum() + (~np.isfinite(sigma)).sum())
    return Course(
        scenario=s, time=np.arange(theta.size) / s.sample_rate, theta=theta,
        speed=omega / s.machine.pole_pairs, said_at=said_at, said_error=np.nan_to_num(said_error, nan=180.0),
        said_sigma=said["sigma_theta"], said_valid=said["valid"] != 0.0, said_locked=said["locked"] != 0.0,
        at=at, error=np.nan_to_num(error, nan=180.0), sigma=np.degrees(sigma),
        valid=flags & confidence.VALID != 0, locked=flags & confidence.LOCKED != 0, not_finite=not_finite,
        lost_locks=lost_locks, lost_frames=lost_frames)


def _said(blocks: list[FrameBlock], rate: float) -> tuple[NDArray[np.int64], dict[str, Floats]]:
    """Samples that the PositionEstimates name, and their signals by name, as a receiver decodes them."""
    frames = FrameBlock.concat(blocks)
    protocol = _protocol()
    rows = np.flatnonzero(protocol.classify(frames.raw) == MessageKind.POSITION_ESTIMATE * NODES)
    values, intact, _ = protocol.decode(MessageKind.POSITION_ESTIMATE, 0, frames.raw, rows)
    rows, values = rows[intact], values[:, intact]
    index = protocol.codecs[MessageKind.POSITION_ESTIMATE].index
    said = {name: values[index[name]] for name in ("theta_e", "sigma_theta", "valid", "locked")}
    # Ten bits of the counter, and the drive's own counter when the frame was sent, tell which sample is meant.
    latest = np.ceil(frames.t_ns[rows] * (rate * 1e-9)).astype(np.int64) - 1
    age = (latest - values[index["sample_counter"]].astype(np.int64)) & _COUNTER
    return latest - age, said


def score(course: Course) -> dict[str, Any]:
    """What is to be said of a run, flat: times in s, angles in deg electrical; None for what never happened."""
    c, rate = course, course.scenario.sample_rate
    begins = course.scenario.begins
    said_wrong = c.said_valid & (np.abs(c.said_error) > WRONG_DEG)
    wrong = c.valid & (np.abs(c.error) > WRONG_DEG)
    error, sigma = np.abs(c.error[c.valid]), c.sigma[c.valid]
    said = np.abs(c.said_error[c.said_valid])
    any_valid = bool(error.size)
    return {
        "wrong": bool(said_wrong.any() or wrong.any()),
        "estimates": int(c.said_at.size), "estimates_valid": int(c.said_valid.sum()),
        "estimates_wrong": int(said_wrong.sum()),
        "worst_said": _float(said.max()) if said.size else None,
        "samples": int(c.at.size), "samples_valid": int(error.size), "samples_wrong": int(wrong.sum()),
        "samples_within_2_sigma": int((error < 2.0 * sigma).sum()),
        "wrong_longest": longest(wrong) / rate,
        "wrong_at": _float(c.at[wrong][0] / rate) if wrong.any() else None,
        "worst": _float(error.max()) if any_valid else None,
        "rms": _float(rms(error)) if any_valid else None,
        **{f"error_p{p}": _float(np.percentile(error, p)) if any_valid else None for p in (50, 95, 99)},
        "sigma_p50": _float(np.median(sigma)) if any_valid else None,
        "within_2_sigma": _float(np.mean(error < 2.0 * sigma)) if any_valid else None,
        "time_valid": float(c.valid.sum()) / rate,
        "valid_share": float(c.valid.sum()) / (rate * (course.scenario.duration - begins)),
        "time_to_lock": _first(c.at, c.locked, rate, begins), "time_to_valid": _first(c.at, c.valid, rate, begins),
        "valid_lost": int((c.valid[:-1] & ~c.valid[1:]).sum()), "lost_locks": c.lost_locks,
        "lost_frames": c.lost_frames, "not_finite": c.not_finite,
        "error_counts": _counts(error, ERROR_BINS),
        "ratio_counts": _counts(error / np.maximum(sigma, 1e-12), RATIO_BINS),
    }


def run(seed: int, number: int, kind: str) -> dict[str, Any]:
    """Draw, run and judge: one record.  An exception is a finding, and recorded as one."""
    scenario = draw(seed, number, kind)
    record: dict[str, Any] = {**scenario.as_dict(), "exception": None}
    try:
        return {**record, **score(simulate(scenario))}
    except Exception as error:  # whatever it is, the other runs go on
        return {**record, "exception": f"{type(error).__name__}: {error}", "wrong": False}


def longest(flags: Flags) -> int:
    """Length of the longest stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _first(at: NDArray[np.int64], flags: Flags, rate: float, begins: float) -> float | None:
    return _float(at[np.argmax(flags)] / rate - begins) if flags.any() else None


def _counts(values: Floats, edges: tuple[float, ...]) -> list[int]:
    inside = np.clip(values, edges[0], np.nextafter(edges[-1], 0.0))
    return [int(n) for n in np.histogram(inside, edges)[0]]


def _float(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None
