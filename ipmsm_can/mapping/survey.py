"""What a log holds of a map: rates, jitter, ranges, distances in time, gathered in memory that does not grow."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, FrameBlock
from ipmsm_can.mapping.convert import ANGLE_APART, QUALITY, spoils_dq
from ipmsm_can.mapping.mapper import MappedBlock, Mapper
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.wire.sequence_kernel import RESTARTED

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PER_DECADE = 64
_LOWEST = 1e-7
_BINS = 12 * _PER_DECADE
_IDS_KEPT = 1000
_SLOPE_BELOW = 1.0
"""Turning between two samples [rad] up to which the angle's own speed can be told without doubt."""


class Spread:
    """The distribution of a positive quantity in logarithmic bins, 3.7 % wide, with the mean of each bin."""

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0.0
        self._bins = np.zeros(_BINS, np.int64)
        self._sums = np.zeros(_BINS)

    def add(self, values: Floats) -> None:
        """Take in values; NaN is left out."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        place = np.floor(_PER_DECADE * np.log10(np.maximum(values, _LOWEST) / _LOWEST)).astype(np.int64)
        place = np.clip(place, 0, _BINS - 1)
        self._bins += np.bincount(place, minlength=_BINS)
        self._sums += np.bincount(place, weights=values, minlength=_BINS)
        self.count += values.size
        self.largest = max(self.largest, float(values.max()))

    def percentile(self, share: float) -> float:
        """The value below which this share (0..1) lies: the mean of the bin it falls into; NaN without values."""
        if not self.count:
            return math.nan
        at = int(np.searchsorted(np.cumsum(self._bins), max(1.0, share * self.count)))
        return float(self._sums[at] / self._bins[at])

    @property
    def typical(self) -> float:
        """The mean of the values within 0.5 to 1.5 of the median: of periods, that without gaps."""
        median = self.percentile(0.5)
        if not math.isfinite(median) or median <= _LOWEST:
            return median
        low, high = (int(_PER_DECADE * math.log10(f * median / _LOWEST)) for f in (0.5, 1.5))
        window = slice(max(low, 0), high + 1)
        return float(self._sums[window].sum() / self._bins[window].sum())


@dataclass(slots=True)
class SignalFigures:
    """What was found of one channel: how often it came, its range in the units of the mapping, the time between two
    reports [s], and how far its reports are from the current's [s]."""

    count: int = 0
    low: float = math.inf
    high: float = -math.inf
    period: Spread = field(default_factory=Spread)
    apart: Spread = field(default_factory=Spread)
    last_t: int = 0

    @property
    def rate(self) -> float:
        """Reports per second, gaps left out; NaN with fewer than two."""
        period = self.period.typical
        return 1.0 / period if period > 0.0 else math.nan

    @property
    def jitter(self) -> float:
        """Width of the middle 90 % of the time between two reports [s]."""
        return self.period.percentile(0.95) - self.period.percentile(0.05)


class Survey:
    """Goes through a log once.

    signals: SignalFigures by channel.  rows: samples; quality: of them with each bit of `convert.QUALITY`.
    missing: samples that the counter or the pace of arrival says are missing.  turning: |speed| [rad/s electrical];
    current [A], voltage [V]: length of the vectors; ratio: angle's own speed over the reported one (see `slope`).
    usable: samples with everything that the fast observer needs; dq: with all that steady-state checks need.
    """

    def __init__(self, plan: Plan, rate: float | None = None) -> None:
        self.plan = plan
        self.mapper = Mapper(plan, rate, self._reports)
        self.signals = {c.number: SignalFigures() for c in plan.channels}
        self.rows = self.usable = self.dq = self.encoder = self.missing = 0
        self.quality = dict.fromkeys(QUALITY, 0)
        self.turning, self.current, self.voltage = Spread(), Spread(), Spread()
        self.over_dc = Spread()
        """Length of the voltage over the dc voltage."""
        self.begin_ns = self.end_ns = 0
        self.identifiers: set[int] = set()
        self._spoils_dq = spoils_dq(plan.map)
        self._slope = np.zeros(2)
        self._last: tuple[int, float] | None = None

    @property
    def duration(self) -> float:
        """From the first to the last frame [s]."""
        return 1e-9 * (self.end_ns - self.begin_ns)

    @property
    def found(self) -> int:
        """Frames of the map's messages."""
        return int(self.mapper.frames.sum())

    @property
    def rate(self) -> float:
        """Samples per second: as the map or the drive says, else found from the arrival times."""
        if self.mapper.rate > 0.0:
            return self.mapper.rate
        return self.signals[self.plan.lead].rate

    @property
    def slope(self) -> float:
        """Speed of the angle over the speed reported: 1 where they fit, NaN where it cannot be told."""
        return float(self._slope[0] / self._slope[1]) if self._slope[1] > 0.0 else math.nan

    def run(self, blocks: Iterable[FrameBlock]) -> None:
        """Take in a whole log."""
        for block in blocks:
            self.feed(block)
        self.finish()

    def feed(self, block: FrameBlock) -> MappedBlock:
        """Take in the next frames; the samples that they complete."""
        if len(block):
            self.begin_ns = self.begin_ns or int(block.t_ns[0])
            self.end_ns = int(block.t_ns[-1])
            if len(self.identifiers) < _IDS_KEPT:
                ids = block.can_id[(block.can_id & np.uint32(CAN_ERR_FLAG)) == 0]
                self.identifiers.update(np.unique(ids & np.uint32(CAN_EFF_FLAG | CAN_EFF_MASK)).tolist())
        return self._samples(self.mapper.feed(block))

    def finish(self) -> MappedBlock:
        """Nothing more comes; the samples that waited for later reports."""
        return self._samples(self.mapper.flush())

    def _reports(self, t_ns: Ints, frames: Floats) -> None:
        for number, s in self.signals.items():
            values = frames[number]
            here = np.flatnonzero(~np.isnan(values))
            if not here.size:
                continue
            values, t = values[here], t_ns[here]
            step = 1e-9 * np.diff(t, prepend=s.last_t if s.count else t[0])
            s.period.add(step[(0 if s.count else 1):])
            s.last_t = int(t[-1])
            s.count += here.size
            finite = values[np.isfinite(values)]
            s.low = min(s.low, float(finite.min(initial=math.inf)))
            s.high = max(s.high, float(finite.max(initial=-math.inf)))

    def _samples(self, b: MappedBlock) -> MappedBlock:
        if not len(b):
            return b
        self.rows += len(b)
        self.missing += int(b.gap[b.gap < RESTARTED].sum())
        for bit in self.quality:
            self.quality[bit] += int(np.count_nonzero(b.quality & bit))
        for number, s in self.signals.items():
            s.apart.add(1e-9 * b.apart[number])
        usable = np.isfinite(b.i_alpha + b.i_beta + b.v_alpha + b.v_beta)
        self.usable += int(np.count_nonzero(usable))
        dq = np.isfinite(b.i_d + b.i_q + b.v_d + b.v_q + b.turning) & (b.quality & self._spoils_dq == 0)
        self.dq += int(np.count_nonzero(dq))
        self.encoder += int(np.count_nonzero(np.isfinite(b.theta_encoder) & (b.quality & ANGLE_APART == 0)))
        self.turning.add(np.abs(b.turning))
        self.current.add(np.fmax(np.hypot(b.i_alpha, b.i_beta), np.hypot(b.i_d, b.i_q)))
        length = np.fmax(np.hypot(b.v_alpha, b.v_beta), np.hypot(b.v_d, b.v_q))
        self.voltage.add(length)
        good = b.v_dc > 0.0
        self.over_dc.add(length[good] / b.v_dc[good])
        self._follow(b)
        return b

    def _follow(self, b: MappedBlock) -> None:
        """Hold the angle's own speed against the reported one, where the turn between two samples is small."""
        theta = b.theta_encoder
        before = (b.t_ns[0], math.nan) if self._last is None else self._last
        dt = 1e-9 * np.diff(b.t_ns, prepend=before[0])
        turned = (np.diff(theta, prepend=before[1]) + math.pi) % (2.0 * math.pi) - math.pi
        expected = b.omega_e * dt
        good = np.isfinite(turned) & (np.abs(expected) < _SLOPE_BELOW) & (dt > 0.0)
        self._slope += (float(turned[good] @ expected[good]), float(expected[good] @ expected[good]))
        self._last = (int(b.t_ns[-1]), float(theta[-1]))
