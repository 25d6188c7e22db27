"""The course of a drive over the last minute and a half: tenths of a second, in a ring that never grows."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.estimation import speed
from ipmsm_can.live_view.course_kernel import BIN, BIN_NS, add_block
from ipmsm_can.live_view.status import Course
from ipmsm_can.mapping.mapper import MappedBlock
from ipmsm_can.node import Tracked

Floats = NDArray[np.float64]

BINS = 1024
SPEED_BINS = 3
"""Bins, the open one included, whose mean is shown as the speed."""
KNOWN = math.radians(90.0)
"""1-sigma [rad electrical] from which on there is no angle worth speaking of."""

@dataclass(frozen=True, slots=True)
class Present:
    """The newest tenths of a second.

    omega, omega_sigma [rad/s electrical]: mean speed and its 1-sigma; i_rms: phase current [A rms], i_peak: longest
    current vector [A peak]; i_d, i_q [A peak]; v_rms: phase voltage [V rms].  NaN where not known.
    """

    omega: float = math.nan
    omega_sigma: float = math.nan
    i_rms: float = math.nan
    i_peak: float = math.nan
    i_d: float = math.nan
    i_q: float = math.nan
    v_rms: float = math.nan


class CourseRing:
    """Course of one drive.

    `add` is the receiving thread's; the rest may be called from another one, where a number may be of a bin that is
    being written: it is right again in the next picture.
    """

    def __init__(self) -> None:
        self._bins = np.zeros(BINS, BIN)
        self._bins["key"] = -1
        self._newest = np.full(1, -1, np.int64)
        self._rate = math.nan
        self._axes = True
        """There is a d and a q, of the estimate or of the drive itself."""

    def add(self, part: Tracked) -> None:
        """Take in samples with their estimates; the same bits for any cut into blocks."""
        e = part.estimate
        self._rate, self._axes = part.run.sample_rate, True
        add_block(part.run.values, part.run.t_ns, e.angle[speed.THETA_HAT], e.angle[speed.OMEGA], e.sigma, KNOWN,
                  self._bins, self._newest)

    def add_reported(self, part: MappedBlock, spoils: int) -> None:
        """Take in samples as the drive reports them: its own speed, currents and voltages in its own d and q, and
        no angle.  spoils: bits of quality that make d and q doubtful (`convert.spoils_dq`)."""
        if not len(part):
            return
        in_dq = np.isfinite(part.i_d + part.i_q) & (part.quality & spoils == 0)
        values = np.where(in_dq, [part.i_d, part.i_q, part.v_d, part.v_q],
                          [part.i_alpha, part.i_beta, part.v_alpha, part.v_beta])
        self._axes = bool(in_dq[-1])
        use = np.isfinite(values[:2]).all(axis=0)
        values, t_ns = np.ascontiguousarray(values[:, use]), part.t_ns[use]
        omega = part.omega_e[use]
        # In their own frame they stand at angle 0, wherever that is: its 1-sigma is "unknown", and yet they count.
        theta = np.where(np.isfinite(omega), 0.0, np.nan)
        add_block(values, t_ns, theta, omega, np.full(t_ns.size, math.pi), math.inf, self._bins, self._newest)

    def clear(self) -> None:
        """Begin anew."""
        self._bins["key"] = -1
        self._newest[0] = -1

    def present(self) -> Present:
        """As of the newest samples.

        The speed is the mean over T of the last bins.  It is the turn between two angles over T; were their errors
        independent, which is the worst case, its variance would be (sigma_1^2 + sigma_2^2)/T^2.
        """
        newest = int(self._newest[0])
        bins = self._bins[(newest - np.arange(SPEED_BINS)) % BINS].copy()
        bins = bins[(bins["key"] > newest - SPEED_BINS) & (bins["n"] > 0)]
        n = int(bins["n"].sum())
        if newest < 0 or not n:
            return Present()
        span = n / self._rate
        begin, end = float(bins["sigma_max"][-1]), float(bins["sigma"][0])
        known = max(begin, end) < KNOWN
        aligned = int(bins["aligned"].sum())
        return Present(
            omega=float(bins["omega"].sum()) / aligned if aligned else math.nan,
            omega_sigma=math.hypot(begin, end) / span if known else math.nan,
            i_rms=math.sqrt(float(bins["i2"].sum()) / n / 2.0), i_peak=math.sqrt(float(bins["i2_max"].max())),
            i_d=float(bins["i_d"].sum()) / aligned if aligned and self._axes else math.nan,
            i_q=float(bins["i_q"].sum()) / aligned if aligned and self._axes else math.nan,
            v_rms=math.sqrt(float(bins["v2"].sum()) / n / 2.0))

    def columns(self, now_ns: int, count: int, bins_each: int, rpm_per_omega: float) -> Course:
        """The last `count` columns of `bins_each` bins up to now_ns; rpm_per_omega: mechanical rpm per rad/s."""
        bins = self._bins.copy()
        last = now_ns // BIN_NS // bins_each
        column = bins["key"] // bins_each - last + count - 1
        use = (bins["key"] >= 0) & (bins["n"] > 0) & (column >= 0) & (column < count)
        bins, at = bins[use], column[use]
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, at, rpm_per_omega * bins["omega_low"])
        np.maximum.at(high, at, rpm_per_omega * bins["omega_high"])
        sigma = np.full(count, -np.inf)
        np.maximum.at(sigma, at, np.degrees(bins["sigma_max"]))
        sigma[sigma >= np.degrees(KNOWN)] = -np.inf
        i2, n = np.zeros(count), np.zeros(count)
        np.add.at(i2, at, bins["i2"])
        np.add.at(n, at, bins["n"])
        current = np.full(count, np.nan)
        np.sqrt(np.divide(i2, 2.0 * n, out=current, where=n > 0), out=current)
        return Course(1e-9 * BIN_NS * bins_each, _packed(low), _packed(high), _packed(sigma), _packed(current))


def _packed(values: Floats) -> array[float]:
    packed = array("f")
    packed.frombytes(np.where(np.isfinite(values), values, np.nan).astype(np.float32).tobytes())
    return packed


def warm_up() -> None:
    """Compile or load the kernel before there is anything to lose."""
    none = np.zeros(0)
    add_block(np.zeros((4, 0)), np.zeros(0, np.int64), none, none, none, KNOWN, np.zeros(BINS, BIN),
              np.zeros(1, np.int64))
