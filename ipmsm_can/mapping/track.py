"""Mapped samples through the estimator: unusable ones count as lost, short gaps are filled by straight lines."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.bus.replay import NodeSummary
from ipmsm_can.bus.rows import RowBlock
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator, EstimatorSettings
from ipmsm_can.estimation.observers import ges
from ipmsm_can.mapping.convert import ANGLE_APART, CURRENT_APART, VOLTAGE_APART
from ipmsm_can.mapping.mapper import MappedBlock
from ipmsm_can.mapping.model import InverterMap
from ipmsm_can.node import Tracked
from ipmsm_can.wire.sequence import SampleRun
from ipmsm_can.wire.sequence_kernel import RESTARTED

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_STATE = np.dtype([("started", "i8"), ("index", "i8"), ("missing", "i8"), ("values", "f8", (4,))])


@kernel
def _fill(values: Floats, gap: Ints, usable: NDArray[np.bool_], max_gap: int, state: NDArray[np.void], out: Floats,
          source: Ints, index: Ints, left: Ints) -> int:
    """Samples (4, M) without a hole of up to max_gap; returns M.

    source: row of `values` each comes from, -1 where filled.  index: sample periods since the first.  left: samples
    missing before each that were not filled, as `Estimator.process` takes them.
    """
    st = state[0]
    m = 0
    for k in range(values.shape[1]):
        st.missing = min(st.missing + gap[k], RESTARTED)
        if not usable[k]:
            st.missing += 1
            continue
        lost = st.missing if st.started else 0
        st.missing = 0
        if 0 < lost <= max_gap:
            for j in range(lost):
                share = (j + 1) / (lost + 1)
                for r in range(4):
                    out[r, m] = st.values[r] + (values[r, k] - st.values[r]) * share
                source[m] = -1
                st.index += 1
                index[m] = st.index
                left[m] = 0
                m += 1
            lost = 0
        # After a new beginning the time between is not known.
        st.index += (1 + (lost if lost < RESTARTED else 0)) if st.started else 0
        st.started = 1
        for r in range(4):
            st.values[r] = values[r, k]
            out[r, m] = values[r, k]
        source[m] = k
        index[m] = st.index
        left[m] = lost
        m += 1
    return m


def settings_with(config: DriveConfig, inverter: InverterMap, sample_rate: float) -> EstimatorSettings:
    """The estimator's settings at this sample rate [Hz], with the voltage delay of the map unless the drive.toml
    gives one."""
    settings = estimator_settings(config, sample_rate)
    delay = inverter.voltage.delay if inverter.voltage is not None else 0.0
    return replace(settings, voltage_delay=delay) if settings.voltage_delay is None and delay else settings


class MappedTracking:
    """The estimator over the samples of a map, at a rate that allows it.

    summary: as of a native replay.  filled, unusable: how many samples.  sink: called with the next rows.
    observer: called with the next samples and their estimates, at the times of their arrival.
    latest: angle [rad electrical], speed [rad/s electrical], 1-sigma [rad electrical], flags of `confidence` and
    excitation [V^2 s] at the newest sample.
    Times of rows count sample periods from the first sample.
    """

    def __init__(self, config: DriveConfig, inverter: InverterMap, rate: float,
                 sink: Callable[[RowBlock], None] | None = None,
                 observer: Callable[[Tracked], None] | None = None) -> None:
        self.summary = NodeSummary(sample_rate=rate)
        self.filled = self.unusable = self.lost = 0
        self.estimator = Estimator(config.build_motor(), rate, settings_with(config, inverter, rate))
        self.latest = (math.nan, 0.0, math.pi, 0, 0.0)
        self._max_gap = config.wire.max_gap
        self._sink = sink
        self._observer = observer
        self._number = config.wire.node
        self._last = (-1, 0)
        """Index of the newest sample, and when it arrived [ns]."""
        self._rate = rate
        self._state = np.zeros(1, _STATE)

    def feed(self, block: MappedBlock) -> None:
        """Take in the next samples."""
        n = len(block)
        if not n:
            return
        values = np.stack([block.i_alpha, block.i_beta, block.v_alpha, block.v_beta])
        usable = np.isfinite(values).all(axis=0) & (block.quality & (CURRENT_APART | VOLTAGE_APART) == 0)
        self.unusable += n - int(np.count_nonzero(usable))
        room = n * (self._max_gap + 1)
        samples, source = np.empty((4, room)), np.empty(room, np.int64)
        index, left = np.empty(room, np.int64), np.empty(room, np.int64)
        m = _fill(values, block.gap, usable, self._max_gap, self._state, samples, source, index, left)
        if not m:
            return
        samples, source, index = np.ascontiguousarray(samples[:, :m]), source[:m], index[:m].copy()
        e = self.estimator.process(samples, left[:m].copy())
        self.latest = (float(e.angle[speed.THETA_HAT, -1]), float(e.angle[speed.OMEGA, -1]), float(e.sigma[-1]),
                       int(e.flags[-1]), float(e.excitation[-1]))
        filled = source < 0
        self.filled += int(np.count_nonzero(filled))
        self.lost += int(left[:m][left[:m] < RESTARTED].sum()) + int(np.count_nonzero(filled))
        if self._observer is not None:
            self._observer(self._tracked(block, samples, source, index, left[:m].copy(), e))
        self._note(block, source, index, RowBlock(
            index & 0xFFFFFFFF, filled.view(np.uint8), index / self._rate, e.angle[speed.THETA_HAT],
            e.angle[speed.OMEGA], (e.flags & confidence.VALID != 0).view(np.uint8),
            (e.flags & confidence.LOCKED != 0).view(np.uint8), np.zeros(m, np.uint8), e.excitation,
            e.flux[ges.LAMBDA_A], e.flux[ges.LAMBDA_B]))

    def _tracked(self, block: MappedBlock, samples: Floats, source: Ints, index: Ints, gap: Ints,
                 estimate: EstimateBlock) -> Tracked:
        filled = source < 0
        real = np.flatnonzero(~filled)
        t_ns = np.empty(source.size, np.int64)
        t_ns[real] = block.t_ns[source[real]]
        if real.size < source.size:
            # one that was filled stands evenly between the two that it joins; the first of all is never filled
            at, then = self._last
            base = int(block.t_ns[0])
            known = np.concatenate([[then], t_ns[real]]) - base if at >= 0 else t_ns[real] - base
            numbers = np.concatenate([[at], index[real]]) if at >= 0 else index[real]
            t_ns[filled] = base + np.rint(np.interp(index[filled], numbers, known)).astype(np.int64)
        self._last = int(index[-1]), int(t_ns[-1])
        none = np.zeros(source.size, np.uint8)
        run = SampleRun(self._rate, index & 0xFFFFFFFF, samples, filled.view(np.uint8), none, gap, t_ns)
        return Tracked(self._number, run, estimate, none)

    def _note(self, block: MappedBlock, source: Ints, index: Ints, rows: RowBlock) -> None:
        s = self.summary
        s.rows += len(rows)
        s.duration = float(rows.time_s[-1])
        for name, flag in (("locked", rows.locked), ("valid", rows.valid)):
            count = int(np.count_nonzero(flag))
            setattr(s, name, getattr(s, name) + count)
            if count and getattr(s, f"first_{name}") is None:
                setattr(s, f"first_{name}", float(rows.time_s[np.argmax(flag)]))
        real = np.flatnonzero(source >= 0)
        near = real[block.quality[source[real]] & ANGLE_APART == 0]
        s.encoder.reference(index[near], block.theta_encoder[source[near]])
        s.encoder.estimate(index, rows.theta_rad, rows.valid.view(np.bool_))
        if self._sink is not None:
            self._sink(rows)
