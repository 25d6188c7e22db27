"""The drive as an equation that is linear in everything that may be wrong with it.

With the encoder's angle theta, reported voltage v and current i, over a window from t_0 to t_1,

    int v = R int i + [L_s i + l e^(2j theta) i* + psi e^(j theta)] + what the errors add,

[] the change over the window.  Complex psi and l leave the encoder's zero open: with the rotor at theta + delta,
psi = psi_m e^(j delta) and l = (L_d - L_q)/2 e^(2j delta).  What the errors add, each linear in its size:

    voltage offset u            u T
    dead time, V a phase        V int s(i),  s = (2 s_a - s_b - s_c)/3 + j (s_b - s_c)/sqrt 3
    current offset o            -l o* [e^(2j theta)]          (R o cannot be told from u: it is in u)
    gain of single phases       i = i' - g i'*, so -g (R int i'* + L_s [i'*]) - g* l [e^(2j theta) i']
    voltage late by d samples   -d T_s [v]
    eccentric encoder           j psi [e^(j theta) (a cos phi + b sin phi)], phi the angle of its shaft

Only the current offset needs the saliency; a machine without any does not tell it while it runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis.regression import Solution, solve
from ipmsm_can.diagnosis.windows import Windows, make_windows
from ipmsm_can.motor import Motor

if TYPE_CHECKING:
    from ipmsm_can.analysis.measurement import Measurement

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_LEAST_DIFFERENCES = 200
_HALF_SQRT3 = 0.5 * math.sqrt(3.0)
_DEAD_ZONES = (0.02, 0.05, 0.1, 0.2)
"""Currents below which the sign of a phase's current may fade out, as shares of rated current."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """Current [A], voltage [V]: complex (N,); angle (N,) [rad electrical, unwrapped, NaN unknown]; rate [Hz]."""

    i: Complexes
    v: Complexes
    theta: Floats
    sample_rate: float


def vectors(m: Measurement, theta: Floats) -> Vectors:
    """Those of a measurement, with this angle."""
    return Vectors(m.i_alpha + 1j * m.i_beta, m.v_alpha + 1j * m.v_beta, theta, m.sample_rate)


def dead_time_direction(i: Complexes, zone: float) -> Complexes:
    """Voltage vector that dead time takes for 1 V a phase; the sign of a current fades out below zone [A]."""
    a, b, c = (0.5 * x * (3.0 - x * x) for x in (np.clip(phase / zone, -1.0, 1.0) for phase in (
        i.real, -0.5 * i.real + _HALF_SQRT3 * i.imag, -0.5 * i.real - _HALF_SQRT3 * i.imag)))
    return np.asarray((2.0 * a - b - c) / 3.0 + 1j * (b - c) / math.sqrt(3.0))


@dataclass(frozen=True, slots=True)
class _Edge:
    """Current [A], angle's direction and angle [rad] where windows begin, or where they end, all (W,)."""

    i: Complexes
    turn: Complexes
    theta: Floats


def _edges(w: Windows, x: Vectors) -> tuple[_Edge, _Edge]:
    """Begin and end.  Only what is needed of a long measurement is worked out."""
    begin, end = (_Edge(x.i[at], np.exp(1j * x.theta[at]), x.theta[at]) for at in (w.begin, w.end))
    return begin, end


def _change(edges: tuple[_Edge, _Edge], of: Callable[[_Edge], Complexes]) -> Complexes:
    return np.asarray(of(edges[1]) - of(edges[0]))


def core_columns(w: Windows, x: Vectors) -> dict[str, Complexes]:
    """R, L_s, the saliency l and the magnet's psi; complex unknowns as .x and .y."""
    edges = _edges(w, x)
    salient, magnet = _change(edges, lambda e: e.turn**2 * e.i.conj()), _change(edges, lambda e: e.turn)
    return {"R": w.i, "L_s": _change(edges, lambda e: e.i), "l.x": salient, "l.y": 1j * salient, "psi.x": magnet,
            "psi.y": 1j * magnet}


def current_noise(x: Vectors, quiet: NDArray[np.bool_]) -> float:
    """Noise of the current samples [A rms per axis], from their second differences in the rotor's frame; NaN where
    there are too few.  quiet (N,): samples that may be used, without a probing signal."""
    i = x.i * np.exp(-1j * np.where(np.isfinite(x.theta), x.theta, 0.0))
    second = np.diff(i, 2)[quiet[2:] & quiet[1:-1] & quiet[:-2]]
    if second.size < _LEAST_DIFFERENCES:
        return math.nan
    spread = np.median(np.abs(np.concatenate([second.real, second.imag])))
    return float(1.4826 * spread / math.sqrt(6.0))


def core_prior(motor: Motor) -> dict[str, tuple[float, float]]:
    """What may be taken for granted: next to nothing."""
    wide = 3.0
    return {"R": (motor.R, wide * max(motor.R, 1e-3)), "L_s": (motor.L_s, wide * motor.L_s),
            **dict.fromkeys(("l.x", "l.y"), (0.0, wide * motor.L_s)),
            **dict.fromkeys(("psi.x", "psi.y"), (0.0, wide * motor.psi_m))}


def motor_columns(w: Windows, x: Vectors) -> dict[str, Complexes]:
    """R, L_d, L_q and the magnet's psi, where the angle's zero is about right."""
    edges = _edges(w, x)
    magnet = _change(edges, lambda e: e.turn)
    return {"R": w.i, "L_d": _change(edges, lambda e: e.turn * (e.i * e.turn.conj()).real),
            "L_q": _change(edges, lambda e: 1j * e.turn * (e.i * e.turn.conj()).imag), "psi.x": magnet,
            "psi.y": 1j * magnet}


def motor_prior(motor: Motor) -> dict[str, tuple[float, float]]:
    """Within a factor of some, the motor is the one that was told."""
    return {"R": (motor.R, max(0.5 * motor.R, 1e-3)), "L_d": (motor.L_d, 0.25 * motor.L_d),
            "L_q": (motor.L_q, 0.25 * motor.L_q), "psi.x": (motor.psi_m, motor.psi_m), "psi.y": (0.0, motor.psi_m)}


def error_columns(w: Windows, x: Vectors, found: Solution, motor: Motor, zone: float) -> dict[str, Complexes]:
    """What each error of size 1 adds, around the motor as found; the saliency is the one that was told, as i_d may
    not have moved enough to tell."""
    T_s = 1.0 / x.sample_rate
    edges = _edges(w, x)
    R, psi = found["R"], found.pair("psi")
    L_s, half = motor.L_s, 0.5 * motor.L_0
    ones = np.full(len(w), w.period, np.complex128)
    mirrored = R * w.i.conj() + L_s * _change(edges, lambda e: e.i.conj())
    salient = half * _change(edges, lambda e: e.turn**2 * e.i)
    offset = -half * _change(edges, lambda e: e.turn**2)
    last = len(x.v) - 1
    late = -0.5 * T_s * (w.change(x.v) + x.v[np.minimum(w.end + 1, last)] - x.v[np.minimum(w.begin + 1, last)])
    signs = dead_time_direction(w.samples(x.i), zone)
    wave = [1j * psi * _change(edges, lambda e, f=f: e.turn * f(e.theta / motor.pole_pairs))  # type: ignore[misc]
            for f in (np.cos, np.sin)]
    return {
        "u.x": ones, "u.y": 1j * ones,
        # The mean of neighbours for each interval: the trapezoid again.
        "dead_time": T_s * (signs.sum(axis=1) - 0.5 * (signs[:, 0] + signs[:, -1])),
        "o.x": offset, "o.y": -1j * offset,
        "g.x": -(mirrored + salient), "g.y": -1j * (mirrored - salient),
        "delay": late,
        "ecc.x": wave[0], "ecc.y": wave[1],
    }


def error_prior(motor: Motor, volts: float) -> dict[str, tuple[float, float]]:
    """How large the errors may be at all; volts: of the voltage."""
    current = motor.rated_current
    return {"u.x": (0.0, volts), "u.y": (0.0, volts), "dead_time": (0.0, volts), "o.x": (0.0, current),
            "o.y": (0.0, current), "g.x": (0.0, 0.5), "g.y": (0.0, 0.5), "delay": (0.0, 4.0),
            "ecc.x": (0.0, 1.0), "ecc.y": (0.0, 1.0)}


def fit_core(w: Windows, x: Vectors, motor: Motor) -> Solution:
    """The motor alone, with nothing taken for granted, not even a sign."""
    return solve(core_columns(w, x), w.v, w.group, core_prior(motor))


def fit_all(w: Windows, x: Vectors, motor: Motor, zone: float, volts: float, sigma: float,
            rounds: int = 2) -> Solution:
    """Motor and errors together; some columns depend on the motor, so that a few rounds are needed.

    zone: current in which dead time fades out [A].  volts: largest error of the voltage thought of [V].
    sigma: noise of the current samples [A rms per axis].
    The angle's zero must be right to some 10 deg, and no sign or phase wrong.
    """
    noise = dict.fromkeys(("L_d", "L_q"), 2.0 * sigma**2)
    columns = motor_columns(w, x)
    found = solve(columns, w.v, w.group, motor_prior(motor), noise)
    prior = {**motor_prior(motor), **error_prior(motor, volts)}
    for _ in range(rounds):
        errors = error_columns(w, x, found, motor, zone)
        found = solve({**columns, **errors}, w.v, w.group, prior, noise)
    return found


def windows_of(m: Measurement, x: Vectors, length: int) -> Windows:
    """Windows where current, voltage and angle are all known."""
    return make_windows(m, m.usable & np.isfinite(x.theta), length)


def dead_zone(w: Windows, x: Vectors, motor: Motor, volts: float, sigma: float) -> float:
    """Current [A] below which dead time fades out: the one that leaves least unexplained."""
    zones = [share * motor.rated_current for share in _DEAD_ZONES]
    return min(zones, key=lambda zone: fit_all(w, x, motor, zone, volts, sigma).rms)
