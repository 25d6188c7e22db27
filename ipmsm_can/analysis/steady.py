"""The samples of a drive whose map allows the steady-state checks only, as arrays, of a log or of live traffic."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.analysis.measurement import Measurement, log_problem, measure_mapped, surveyed
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import read_log
from ipmsm_can.mapping.check import abilities, missing, strange
from ipmsm_can.mapping.convert import ANGLE_APART, CURRENT_APART, QUALITY, VOLTAGE_APART, spoils_dq
from ipmsm_can.mapping.mapper import MappedBlock
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.mapping.survey import Survey

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

MOST_SAMPLES = 1 << 22
"""Samples that are held at most: a clock that stands still must not fill the memory."""


@dataclass(frozen=True, eq=False)
class SteadySamples:
    """What a log holds of one drive, for the steady-state checks.  Electrical, peak, per phase.

    t_ns (N,): arrival [ns].  i, v (N,): current [A] and voltage [V] as d + j q, in the frame that is reported.
    omega (N,): reported speed, else what the angle's turning tells [rad/s electrical].
    told_omega: the speed is reported.  by_pole_pairs: it is made of the shaft's with the pole pairs of drive.toml.
    theta (N,): reported angle [rad electrical].  torque [N m], v_dc [V] (N,): as reported.  NaN where nothing came.
    follows (N,): the sample comes right after the one before it.  good (N,): reported near enough in time.
    i_by_angle, v_by_angle: the map turns them into d and q by the reported angle; else the drive does.
    received, lost: samples.  apart: samples by words of what is too far apart in time.
    notes: sentences on signals that are missing or strange.  why_not_fast: why there is no fast observer.
    source: what it was read from.  problem: why reading ended before the end of the log, "" where it did not.
    """

    t_ns: NDArray[np.int64]
    i: Complexes
    v: Complexes
    omega: Floats
    theta: Floats
    torque: Floats
    v_dc: Floats
    follows: NDArray[np.bool_]
    good: NDArray[np.bool_]
    told_omega: bool
    by_pole_pairs: bool
    i_by_angle: bool
    v_by_angle: bool
    received: int
    lost: int
    apart: dict[str, int]
    notes: tuple[str, ...]
    why_not_fast: str
    source: str = ""
    problem: str = ""

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def time(self) -> Floats:
        """[s] from the first sample."""
        return np.asarray(1e-9 * (self.t_ns - self.t_ns[:1]), np.float64)

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(np.ptp(self.time)) if len(self) else 0.0


class SteadyBuilder:
    """Collects `SteadySamples` from blocks of frames; any partition of the same frames gives the same.

    plan: from `make_plan`.  rate: samples per second, which a survey found, and by which a gap shows.
    window_s: keep only so many of the last seconds [s], in bounded memory; None keeps `MOST_SAMPLES`.
    """

    def __init__(self, plan: Plan, rate: float, *, window_s: float | None = None, source: str = "") -> None:
        self.source = source
        self.problem = ""
        self.survey = Survey(plan, rate)
        self._window = None if window_s is None else round(1e9 * window_s)
        self._held: deque[MappedBlock] = deque()
        self._count = 0

    def feed(self, block: FrameBlock) -> None:
        """Take in the next frames; never raises for what is in them."""
        self._take(self.survey.feed(block))

    def finish(self) -> None:
        """Nothing more comes: samples count that wait for later reports."""
        self._take(self.survey.finish())

    def _take(self, new: MappedBlock) -> None:
        if not len(new):
            return
        # the distances in time are in the survey's figures; here they would be most of the memory
        self._held.append(replace(new, apart=np.zeros((0, len(new)))))
        self._count += len(new)
        while len(self._held) > 1 and (self._count - len(self._held[0]) >= MOST_SAMPLES
                                       or self._old(self._held[0]).all()):
            self._count -= len(self._held.popleft())

    def _old(self, block: MappedBlock) -> NDArray[np.bool_]:
        if self._window is None:
            return np.zeros(len(block), np.bool_)
        # a clock that was set back begins anew: what lies in its future is as old
        return np.asarray(np.abs(self._held[-1].t_ns[-1] - block.t_ns) > self._window)

    @property
    def samples(self) -> int:
        """How many are held."""
        return self._count

    def measurement(self) -> SteadySamples:
        """What was collected."""
        def joined(name: str) -> NDArray:  # type: ignore[type-arg]
            parts = [getattr(b, name) for b in self._held] or [np.zeros(0)]
            return np.concatenate(parts)[keep]

        keep: NDArray[np.bool_] | slice = slice(None)
        if self._held:
            keep = np.concatenate([~self._old(b) for b in self._held])
        survey, inverter = self.survey, self.survey.plan.map
        by_angle = [part is not None and part.form != "dq" for part in (inverter.current, inverter.voltage)]
        omega, turning = joined("omega_e"), joined("turning")
        apart = {QUALITY[bit]: survey.quality[bit] for bit in (CURRENT_APART, VOLTAGE_APART, ANGLE_APART)
                 if bit & spoils_dq(inverter)}
        speed = inverter.speed
        return SteadySamples(
            joined("t_ns").astype(np.int64), joined("i_d") + 1j * joined("i_q"),
            joined("v_d") + 1j * joined("v_q"), np.where(np.isfinite(omega), omega, turning),
            joined("theta_e"), joined("torque"), joined("v_dc"), joined("gap") == 0,
            joined("quality").astype(np.int64) & spoils_dq(inverter) == 0, speed is not None,
            speed is not None and speed.unit.endswith("shaft"), by_angle[0], by_angle[1], survey.rows,
            survey.missing, apart, (*missing(survey), *strange(survey)), abilities(survey)[0].why, self.source,
            self.problem)


def read_mapped(log: Path, config: DriveConfig, map_name: str, *, node: int | None = None,
                channel: str | None = None, progress: Callable[[float], None] | None = None,
                window_s: float | None = None) -> Measurement | SteadySamples:
    """What a log of another inverter holds: of the fast observer's samples where its signals allow that, else of
    the steady-state checks'.

    The arguments are those of `analysis.measurement.read_measurement`.
    Raises ValueError (LogError, MapError, DbcError) with one sentence, also where the signals allow neither.
    """
    log = Path(log)
    source = f"{log} with the map {map_name}"
    survey = surveyed(log, config, map_name, node, channel)
    fast, steady = abilities(survey)[:2]
    if fast.able:
        return measure_mapped(log, config, survey, channel, progress, window_s, source)
    if not steady.able:
        raise ValueError(f"{source} does not hold the samples that this takes: neither those of the fast observer "
                         f"({fast.why}) nor of the steady-state checks ({steady.why})")
    reader = read_log(log, channel=channel)
    builder = SteadyBuilder(survey.plan, survey.rate, window_s=window_s, source=source)
    for block in reader:
        builder.feed(block)
        if progress is not None:
            progress(reader.done)
    builder.finish()
    builder.problem = log_problem(reader.problem, reader.bad_lines, log)
    return builder.measurement()
