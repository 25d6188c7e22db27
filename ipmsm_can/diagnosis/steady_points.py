"""Operating points: what samples that are far apart in time tell while currents and speed hold still.

Which way round the reported speed and angle are comes first: they are held against each other, and the current that
the angle was used for is held against both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.mapping.steady import LEAST_EMF, STEADY_CURRENT, STEADY_SPEED

if TYPE_CHECKING:
    from ipmsm_can.analysis.steady import SteadySamples
    from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

CELL_S, LEAST_IN_CELL = 0.1, 4
"""A cell is so long [s], and longer where fewer samples would lie in it."""
_RIPPLE = 0.5
"""Scatter of the voltage within a cell, as a share of the magnets', from which on it is none in d and q: inverters
report line voltages there while they are off."""
_OFF = 2.0
"""Without current the voltage is that of the magnets; further off by this factor, the inverter is off."""
_MOST_POLE_PAIRS = 16
_TURN, _SHORTER = 1.0, 0.6
"""Angle [rad electrical] over which angle and speed are held against each other, and as a share the shorter one."""
_SAME, _LESS, _ALIKE = 0.03, 0.3, 2.0
"""How well they must agree [rad], what another ratio must leave of the difference, and how much more than the best
one a ratio may leave that fits as well."""
_NEARLY_ALL = 0.9
_LEAST_PAIRS, _MOST_PAIRS = 8, 20_000
_SOME_CURRENT = 0.1


@dataclass(frozen=True, slots=True)
class Points:
    """K operating points.  i [A], v [V] complex (K,): means; rise: of the current [A/s]; omega [rad/s electrical];
    torque: reported [N m], NaN where none was; time: of their first cell [s]; cells: how many each has."""

    i: Complexes
    v: Complexes
    rise: Complexes
    omega: Floats
    torque: Floats
    time: Floats
    cells: Ints

    def __len__(self) -> int:
        return len(self.omega)

    def fast(self, motor: Motor) -> Bools:
        """The magnets' voltage decides, not the resistance or the dead time."""
        return np.asarray(np.abs(self.omega) * motor.psi_m > np.maximum(motor.R * np.abs(self.i), LEAST_EMF))


@dataclass(frozen=True, slots=True)
class Turning:
    """ratio: how many times as fast the angle turns as the speed says, NaN where it cannot be told.
    angle_is_wrong: which of the two, by how the current turns; None where that does not tell.
    apart_deg: what is left between angle and speed at that ratio, over a radian [deg, median].
    several: more than one ratio fits, as at a single fast speed, where the angle turns by whole turns more from
    sample to sample; differ: 1 is not among them."""

    ratio: float
    angle_is_wrong: bool | None
    apart_deg: float
    differ: bool = False
    several: bool = False


def pole_pair_ratios(pole_pairs: int) -> list[float]:
    """What a quantity turns by if it was made with another number of pole pairs, or the wrong way; 1 first."""
    most = max(_MOST_POLE_PAIRS, 2 * pole_pairs)
    found = {n / pole_pairs for n in range(1, most + 1)} | {pole_pairs / n for n in range(1, most + 1)}
    return sorted((sign * r for r in found for sign in (1.0, -1.0)), key=lambda r: (abs(math.log(abs(r))), -r))


def turning(s: SteadySamples, motor: Motor) -> Turning:
    """The reported angle against the reported speed."""
    nothing = Turning(math.nan, None, math.nan)
    if not s.told_omega or len(s) < _LEAST_PAIRS:
        return nothing
    step = np.diff(s.time)
    turned = 0.5 * (s.omega[1:] + s.omega[:-1]) * step
    # the resolution of a slow speed is a large share of it
    slow = np.minimum(np.abs(s.omega[1:]), np.abs(s.omega[:-1])) * motor.psi_m < LEAST_EMF
    good = s.follows[1:] & (step > 0.0) & np.isfinite(turned) & ~slow
    fast = np.abs(turned[good])
    if not fast.size:
        return nothing
    lag = max(1, round(_TURN / float(np.quantile(fast, 0.75))))
    # a second, shorter one: turns by several ratios may differ by whole turns over one of them, not over both
    lags = sorted({lag, max(1, round(_SHORTER * lag))}, reverse=True)
    spans = [_spans(s, good, turned, n) for n in lags]
    if any(told.size < _LEAST_PAIRS for told, _, _ in spans):
        return nothing
    ratios = pole_pair_ratios(motor.pole_pairs)
    off = np.array([max(_left(by_angle, told, r) for told, by_angle, _ in spans) for r in ratios])
    fit = off <= max(_SAME, _ALIKE * float(off.min()))
    if off[0] > _SAME:
        fit &= off < _LESS * off[0]
    if np.count_nonzero(fit) > 1:
        # whole turns more between samples at the speed that was held longest: the other speeds decide
        at_most = np.array([max(_left(by_angle, told, r, _NEARLY_ALL) for told, by_angle, _ in spans)
                            if ok else np.inf for r, ok in zip(ratios, fit.tolist(), strict=True)])
        first, second = np.sort(at_most)[:2]
        if first < _LESS * second:
            fit = at_most == first
    if np.count_nonzero(fit) != 1:
        return Turning(math.nan, None, math.degrees(off[0]), differ=bool(off[0] > _SAME and fit.any()),
                       several=bool(fit.any()))
    best, left = ratios[int(np.argmax(fit))], float(off[fit][0])
    if best == 1.0 or not s.i_by_angle:
        return Turning(best, None, math.degrees(left))
    # the current in the stationary frame turns with the rotor, whatever the angle says
    i = s.i * np.exp(1j * s.theta)
    told, _, at = spans[0]
    flows = np.minimum(np.abs(i[at + lag]), np.abs(i[at])) > _SOME_CURRENT * motor.rated_current
    wrong = None
    if np.count_nonzero(flows) >= _LEAST_PAIRS:
        by_current = np.angle(i[at + lag] * i[at].conj())[flows]
        as_speed, as_angle = (_left(by_current, told[flows], r) for r in (1.0, best))
        wrong = True if as_speed < _LESS * as_angle else False if as_angle < _LESS * as_speed else None
    return Turning(best, wrong, math.degrees(left))


def _spans(s: SteadySamples, good: Bools, turned: Floats, lag: int) -> tuple[Floats, Floats, Ints]:
    """What speed and angle say was turned over `lag` samples that follow each other, and where they begin."""
    if lag >= len(s) - 1:
        return np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, turned, 0.0))])
    broken = np.concatenate([[0], np.cumsum(~good)])
    by_angle = s.theta[lag:] - s.theta[:-lag]
    at = np.flatnonzero((broken[lag:] == broken[:-lag]) & np.isfinite(by_angle))
    at = at[::max(1, at.size // _MOST_PAIRS)]
    return (total[lag:] - total[:-lag])[at], by_angle[at], at


def _left(by_angle: Floats, told: Floats, ratio: float, share: float = 0.5) -> float:
    """What is left between angle and speed at a ratio [rad], in so large a share of the samples."""
    off = by_angle - ratio * told
    return float(np.quantile(np.abs((off + math.pi) % (2.0 * math.pi) - math.pi), share))


def points(s: SteadySamples, motor: Motor, *, angle_reversed: bool = False) -> Points:
    """The operating points; empty where nothing held still.

    angle_reversed: what the map turned by the angle was turned the wrong way, which is undone.
    A cell counts where neither currents nor speed change by more than `mapping.steady` allows, and its samples
    scatter by no more around that change.
    """
    i, v = s.i, s.v
    if angle_reversed:
        back = np.exp(2j * s.theta)
        i, v = (i * back if s.i_by_angle else i), (v * back if s.v_by_angle else v)
    good = s.good & np.isfinite(i + v) & np.isfinite(s.omega)
    rows = np.flatnonzero(good)
    if rows.size < LEAST_IN_CELL:
        return _none()
    t = s.time[rows]
    step = np.diff(t)
    period = float(np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0
    new = (np.diff(rows) != 1) | ~s.follows[rows[1:]] | (step <= 0.0)
    length = max(CELL_S, LEAST_IN_CELL * period)
    begin = t[np.concatenate([[0], np.flatnonzero(new) + 1])]
    run = np.concatenate([[0], np.cumsum(new)])
    # the edges lie between the samples, so that it does not matter by how little arrival times jitter
    cell = np.floor((t - begin[run] + 0.5 * period) / length).astype(np.int64)
    edges = np.concatenate([[0], np.flatnonzero((np.diff(cell) != 0) | new) + 1])
    count = np.diff(np.append(edges, rows.size))
    c = _Cells(t, edges, count)
    w, t_mean = s.omega[rows], c.mean(t)
    i_mean, i_change, i_scatter = c.line(i[rows])
    v_mean, _, v_scatter = c.line(v[rows])
    w_mean, w_change, w_scatter = c.line(w.astype(np.complex128))
    omega, emf = w_mean.real, np.abs(w_mean) * motor.psi_m
    small_i = STEADY_CURRENT * motor.rated_current
    small_w = STEADY_SPEED * np.maximum(np.abs(omega), LEAST_EMF / motor.psi_m)
    keep = ((count >= LEAST_IN_CELL) & (np.abs(i_change.real) <= small_i) & (np.abs(i_change.imag) <= small_i)
            & (i_scatter <= small_i) & (np.abs(w_change) <= small_w) & (w_scatter <= small_w)
            & (v_scatter <= np.maximum(_RIPPLE * emf, LEAST_EMF)))
    idle = np.abs(i_mean) < small_i
    keep &= ~(idle & ((np.abs(v_mean) < emf / _OFF) | (np.abs(v_mean) > np.maximum(_OFF * emf, LEAST_EMF))))
    torque = c.mean(s.torque[rows])
    return _gathered(i_mean[keep], v_mean[keep], (i_change / c.length)[keep], omega[keep], torque[keep],
                     t_mean[keep], small_i, LEAST_EMF / motor.psi_m)


class _Cells:
    """Sums over cells that follow each other."""

    def __init__(self, t: Floats, edges: Ints, count: Ints) -> None:
        self._edges, self._count = edges, count
        self._dt = t - np.repeat(self.mean(t), count)
        self._squares = np.maximum(np.add.reduceat(self._dt**2, edges), 1e-30)
        last = np.append(edges[1:], len(t)) - 1
        self.length = np.maximum((t[last] - t[edges]) * count / np.maximum(count - 1, 1), 1e-9)

    def mean(self, x: Floats) -> Floats:
        """Of each cell."""
        return np.asarray(np.add.reduceat(x, self._edges) / self._count)

    def line(self, x: Complexes) -> tuple[Complexes, Complexes, Floats]:
        """Mean, change over the cell by the best straight line, and the scatter around that, rms."""
        mean = np.add.reduceat(x, self._edges) / self._count
        slope = np.add.reduceat(x * self._dt, self._edges) / self._squares
        rest = x - np.repeat(mean, self._count) - np.repeat(slope, self._count) * self._dt
        scatter = np.sqrt(np.add.reduceat(np.abs(rest)**2, self._edges) / self._count)
        return np.asarray(mean), np.asarray(slope * self.length), np.asarray(scatter, np.float64)


def _gathered(i: Complexes, v: Complexes, rise: Complexes, omega: Floats, torque: Floats, t: Floats,
              small_i: float, slow: float) -> Points:
    """Cells that are alike are one operating point: what is not quite right of the equation is alike in them."""
    if not omega.size:
        return _none()
    centre_i, centre_w = np.empty(omega.size, np.complex128), np.empty(omega.size)
    label = np.empty(omega.size, np.int64)
    found = 0
    for k in range(omega.size):
        off_i, off_w = i[k] - centre_i[:found], omega[k] - centre_w[:found]
        small_w = STEADY_SPEED * np.maximum(np.abs(centre_w[:found]), slow)
        far = np.maximum(np.maximum(np.abs(off_i.real), np.abs(off_i.imag)) / small_i, np.abs(off_w) / small_w)
        near = int(np.argmin(far)) if found else 0
        if not found or far[near] > 1.0:
            near = found
            centre_i[found], centre_w[found] = i[k], omega[k]
            found += 1
        label[k] = near
    cells = np.bincount(label, minlength=found)

    def mean(x: Floats) -> Floats:
        return np.asarray(np.bincount(label, x, found) / cells)

    def both(x: Complexes) -> Complexes:
        return np.asarray(mean(x.real) + 1j * mean(x.imag))

    first = np.full(found, np.inf)
    np.minimum.at(first, label, t)
    return Points(both(i), both(v), both(rise), mean(omega), mean(torque), first, cells)


def _none() -> Points:
    none = np.zeros(0)
    empty = np.zeros(0, np.complex128)
    return Points(empty, empty, empty, none, none, none, np.zeros(0, np.int64))
