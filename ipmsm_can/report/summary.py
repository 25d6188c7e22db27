"""What a run amounts to: estimate against encoder, losses, timing, and whether anything was wrong."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.estimation import confidence
from ipmsm_can.node import Node
from ipmsm_can.report.recorder import Record
from ipmsm_can.wire.protocol import MessageKind

Floats = NDArray[np.float64]

MOVED = math.radians(1.0)
"""The rotor counts as moving once the encoder is this far [rad electrical] from where it was at first."""
LARGEST_VALID_ERROR = 15.0
"""A valid angle that is off by more than this [deg electrical] is a fault, whatever else went well."""
LARGEST_VALID_RMS = 2.0
"""Likewise for the rms error [deg electrical] of valid angles."""
QUANTILES = (0.5, 0.99, 0.999)
_COLUMNS = 80


@dataclass(frozen=True, slots=True)
class Comparison:
    """Estimate against encoder, wherever an encoder frame names a sample that was estimated.

    time (K,) [s]; error (K,): estimate minus encoder [deg electrical, -180..180]; valid (K,) bool.
    theta_encoder, theta_estimate (K,) [rad electrical]; omega_encoder (K,) [rad/s electrical].
    """

    time: Floats
    error: Floats
    valid: NDArray[np.bool_]
    theta_encoder: Floats
    theta_estimate: Floats
    omega_encoder: Floats


@dataclass(frozen=True, slots=True)
class BusFigures:
    """What the bus has to say.

    name: for people.  drops: frames the kernel lost before we read them.  unsent: frames the interface
    refused.  turnaround: quantiles [s] at QUANTILES, NaN where time is virtual.  rejected_commands: what the
    drive refused.
    """

    name: str
    drops: int = 0
    unsent: int = 0
    turnaround: tuple[float, ...] = (math.nan, math.nan, math.nan)
    rejected_commands: int = 0


@dataclass(frozen=True, slots=True)
class Summary:
    """The figures of a run.  Times [s]; errors [deg electrical]; NaN where there is nothing to tell.

    lock_time: from the drive's first sample to the first valid angle; motion_time: to the first motion of
    the rotor; lock_after_motion: between the two.  valid_share: of the time after the first valid angle.
    samples, lost, filled, gaps, duplicates, reordered, restarts, bad_frames, clipped: of the drive's samples.
    load_mean, load_peak: 0..1.  timing: how the voltage's timing was set right, "" where it was taken as it came.
    """

    bus: BusFigures
    duration: float
    sample_rate: float
    motion_time: float
    lock_time: float
    valid_share: float
    compared: int
    rms_valid: float
    worst_valid: float
    rms_after_lock: float
    worst_after_lock: float
    samples: int
    lost: int
    filled: int
    gaps: int
    duplicates: int
    reordered: int
    restarts: int
    bad_frames: int
    load_mean: float
    load_peak: float
    frames: dict[MessageKind, int]
    clipped: int = 0
    timing: str = ""

    @property
    def lock_after_motion(self) -> float:
        """Time [s] from the first motion to the first valid angle."""
        return self.lock_time - self.motion_time

    def faults(self) -> list[str]:
        """What was wrong, one sentence each; empty when all was well."""
        found = []
        if not self.samples:
            found.append("no sample of the drive arrived")
        elif math.isnan(self.lock_time):
            found.append("the angle never became valid")
        if self.gaps:
            found.append(f"the run of samples broke {self.gaps} times, and the filters started anew")
        if self.lost:
            found.append(f"{self.lost} samples were lost on the way")
        if self.bus.drops:
            found.append(f"the kernel dropped {self.bus.drops} frames because they were not read in time")
        if self.bus.unsent:
            found.append(f"{self.bus.unsent} frames could not be sent")
        if self.bad_frames:
            found.append(f"{self.bad_frames} frames were damaged")
        if self.clipped:
            found.append(f"{self.clipped} samples were cut off at the end of their range")
        if self.restarts:
            found.append(f"the drive's sample counter started anew {self.restarts} times")
        if self.bus.rejected_commands:
            found.append(f"the drive refused {self.bus.rejected_commands} injection commands")
        if self.samples and not self.compared:
            found.append("no encoder frame could be compared with an estimate")
        if self.worst_valid > LARGEST_VALID_ERROR:
            found.append(f"an angle called valid was off by {self.worst_valid:.1f} deg "
                         f"(allowed is {LARGEST_VALID_ERROR:g})")
        if self.rms_valid > LARGEST_VALID_RMS:
            found.append(f"valid angles were off by {self.rms_valid:.2f} deg rms "
                         f"(allowed is {LARGEST_VALID_RMS:g})")
        return found


def compare(record: Record) -> Comparison:
    """Match encoder frames with estimates by sample counter, in order of time."""
    order = np.argsort(record.counter, kind="stable")
    counter = record.counter[order]
    at = np.searchsorted(counter, record.reference_counter)
    known = at < counter.size
    known[known] = counter[at[known]] == record.reference_counter[known]
    rows = order[at[known]]
    sequence = np.argsort(record.counter[rows], kind="stable")
    rows = rows[sequence]
    encoder = record.reference_theta[known][sequence]
    estimate = record.theta[rows]
    error = np.degrees(np.remainder(estimate - encoder + np.pi, 2.0 * np.pi) - np.pi)
    return Comparison(record.time[rows], error, record.flags[rows] & confidence.VALID != 0, encoder, estimate,
                      record.reference_omega[known][sequence])


def first_motion(comparison: Comparison) -> float:
    """Time [s] at which the encoder first stands `MOVED` from its first angle; NaN if it never does."""
    theta = comparison.theta_encoder
    if not theta.size:
        return math.nan
    away = np.abs(np.remainder(theta - theta[0] + np.pi, 2.0 * np.pi) - np.pi) > MOVED
    return float(comparison.time[np.argmax(away)]) if away.any() else math.nan


def summarise(record: Record, node: Node, bus: BusFigures) -> Summary:
    """Work out the figures; `node` has the counts of the wire."""
    c = compare(record)
    valid = record.flags & confidence.VALID != 0
    lock = float(record.time[np.argmax(valid)]) if valid.any() else math.nan
    after = c.time >= lock
    count = node.receiver.sequencer.count
    load = record.load[record.load > 0.0]
    delay = node.estimator.voltage_delay if node.estimator is not None else None
    settled = load[10:] if load.size > 20 else load  # the first second's window is not full
    return Summary(
        bus=bus,
        duration=float(record.time[-1]) if record.time.size else 0.0,
        sample_rate=record.sample_rate,
        motion_time=first_motion(c),
        lock_time=lock,
        valid_share=float(valid[np.argmax(valid):].mean()) if valid.any() else math.nan,
        compared=c.error.size,
        rms_valid=_rms(c.error[c.valid]), worst_valid=_worst(c.error[c.valid]),
        rms_after_lock=_rms(c.error[after]), worst_after_lock=_worst(c.error[after]),
        samples=count("received"), lost=count("lost"), filled=count("filled"), gaps=count("gaps"),
        duplicates=count("duplicates"), reordered=count("reordered"), restarts=count("restarts"),
        bad_frames=node.bad_frames,
        load_mean=float(settled.mean()) if settled.size else math.nan,
        load_peak=float(settled.max()) if settled.size else math.nan,
        frames=record.frames,
        clipped=count("clipped"),
        timing=delay.words if delay is not None and delay.applied else "",
    )


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2))) if error.size else math.nan


def _worst(error: Floats) -> float:
    return float(np.abs(error).max()) if error.size else math.nan


def number(value: float, form: str, unit: str) -> str:
    """The value with its unit, or a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    return f"{value:{form}}{unit}" if unit == "°" else f"{value:{form}} {unit}"


def per_second(n: int, duration: float) -> str:
    """So many in so long [s], as a rate."""
    return number(n / duration, ".0f", "/s") if duration else "–"


def rows(s: Summary) -> list[tuple[str, str]]:
    """The summary as (what, figure) in plain words."""
    micro = [number(1e6 * q, ".0f", "µs") for q in s.bus.turnaround]
    timing = " / ".join(micro) if math.isfinite(s.bus.turnaround[0]) else "– (virtual time)"
    trouble = (f"{s.filled} filled in, {s.gaps} gaps, {s.duplicates} duplicates, {s.reordered} late, "
               f"{s.bad_frames} damaged, {s.clipped} cut off")
    return [
        ("bus", s.bus.name),
        ("first valid angle", f"{number(s.lock_time, '.2f', 's')} after the first sample, "
                              f"{number(s.lock_after_motion, '.2f', 's')} after the rotor first moved"),
        ("error once valid", f"{number(s.rms_valid, '.3f', 'deg')} rms, "
                             f"{number(s.worst_valid, '.2f', 'deg')} at worst "
                             f"(electrical, against the encoder, {s.compared} points)"),
        ("error since then", f"{number(s.rms_after_lock, '.3f', 'deg')} rms, "
                             f"{number(s.worst_after_lock, '.2f', 'deg')} at worst, valid or not "
                             f"(valid {number(100.0 * s.valid_share, '.1f', '%')} of the time)"),
        ("samples", f"{s.samples} at {number(s.sample_rate, 'g', 'Hz')} in {s.duration:.1f} s"),
        ("lost", f"{s.lost} samples ({trouble}), {s.bus.drops} frames dropped by the kernel, "
                 f"{s.bus.unsent} not sent"),
        *([("timing", s.timing)] if s.timing else []),
        ("bus load", f"{number(100.0 * s.load_mean, '.0f', '%')} on average, "
                     f"{number(100.0 * s.load_peak, '.0f', '%')} in the busiest second"),
        ("turnaround p50 / p99 / p99.9", timing),
    ]


def text(s: Summary) -> str:
    """The summary for a terminal."""
    lines = [textwrap.fill(f"  {what + ' ':.<29} {figure}", _COLUMNS, subsequent_indent=" " * 32,
                           break_long_words=False) for what, figure in rows(s)]
    lines.append("  frames:")
    for kind, n in s.frames.items():
        if n:
            lines.append(f"    {kind.message + ' ':.<27} {n:>8}  {per_second(n, s.duration)}")
    return "\n".join(lines)
