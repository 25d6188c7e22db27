"""Which way round things are: signs, order of phases, direction and pole pairs of the encoder.

These are discrete, and one of them wrong makes everything else look wrong.  So every combination is tried on the
equation of `model`, with nothing taken for granted about R, L_s, l and psi but that they do not change, not even
that they are real: a turned phase order comes out as a turned inductance, a reversed sign as a negative one.  Only
the mirrored order, and what the encoder's angle is multiplied by, have to be tried one by one:

    mirrored current, encoder as it is      two phases of the current are swapped
    current as it is, encoder backwards     the encoder counts backwards (or current and voltage are both swapped)
    mirrored current, encoder backwards     two phases of the voltage are swapped

The present wiring stays unless another one leaves much less unexplained.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis.model import Vectors, core_columns, core_prior
from ipmsm_can.diagnosis.regression import Solution, solve
from ipmsm_can.diagnosis.windows import Windows
from ipmsm_can.motor import Motor

Complexes = NDArray[np.complex128]

LESS = 0.5
"""What another wiring must leave unexplained, as a share of the power that the present one does."""
MORE = 4.0
"""How much more another wiring must leave unexplained for the present one to be confirmed."""
_WINDOWS = 1500
_MOST_POLE_PAIRS = 16
_CLEARER = 1.5
"""How much more every other turn of the current must leave unexplained."""
_OUTLIER = 8.0
_SIXTH = math.pi / 3.0
SWAPPED = {0: "b and c", 1: "a and b", 2: "a and c"}
"""Phases swapped, by the thirds of a turn that follow the mirroring."""


@dataclass(frozen=True, slots=True)
class Wiring:
    """What has to be undone so that the samples fit a motor.

    Current and voltage: mirrored (beta reversed) first, then turned by sixths of a turn; 3 of them are a sign.
    current_mirrored, current_sixths, voltage_mirrored, voltage_sixths: what was done to the true vectors.
    encoder_ratio: true electrical angle over reported one.
    order_known, sign_known, direction_known: whether the samples tell at all.
    rms, rms_as_is: what is left unexplained with it, and with the wiring as reported [V s a window].
    """

    current_mirrored: bool = False
    current_sixths: int = 0
    voltage_mirrored: bool = False
    voltage_sixths: int = 0
    encoder_ratio: float = 1.0
    order_known: bool = False
    sign_known: bool = False
    direction_known: bool = False
    rms: float = math.nan
    rms_as_is: float = math.nan

    @property
    def is_right(self) -> bool:
        """Nothing has to be undone."""
        return not (self.current_mirrored or self.current_sixths or self.voltage_mirrored or self.voltage_sixths
                    or self.encoder_ratio != 1.0)

    def undone(self, x: Vectors) -> Vectors:
        """The vectors as they would have been reported with everything the right way round."""
        def back(vector: np.ndarray[tuple[int], np.dtype[np.complex128]], mirrored: bool,
                 sixths: int) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
            turned = vector * cmath.rect(1.0, -_SIXTH * sixths) if sixths else vector
            return turned.conj() if mirrored else turned

        return Vectors(back(x.i, self.current_mirrored, self.current_sixths),
                       back(x.v, self.voltage_mirrored, self.voltage_sixths),
                       self.encoder_ratio * x.theta, x.sample_rate)


def _trial(w: Windows, x: Vectors, mirrored: bool, ratio: float, motor: Motor) -> Solution:
    current = x.i.conj() if mirrored else x.i
    columns = core_columns(w, Vectors(current, x.v, ratio * x.theta, x.sample_rate))
    charge = w.i.conj() if mirrored else w.i
    change = columns.pop("L_s")
    columns.pop("R")
    columns |= {"R.x": charge, "R.y": 1j * charge, "L.x": change, "L.y": 1j * change}
    wide = {"R": 3.0 * max(motor.R, 1e-3), "L": 3.0 * motor.L_s, "l": 3.0 * motor.L_s, "psi": 3.0 * motor.psi_m}
    return solve(columns, w.v, w.group, {name: (0.0, wide[name[:-2]]) for name in columns})


def _thinned(w: Windows) -> Windows:
    step = -(-len(w) // _WINDOWS)
    part = slice(None, None, step)
    return Windows(w.begin[part], w.end[part], w.group[part], w.v[part], w.i[part], w.period)


def _ratios(pole_pairs: int) -> list[float]:
    """True angle over reported one, for an encoder whose pole pairs are others; as it is first."""
    others = {pole_pairs / k for k in range(1, max(_MOST_POLE_PAIRS, 2 * pole_pairs) + 1)} - {1.0}
    return [sign * r for r in [1.0, *sorted(others)] for sign in (1.0, -1.0)]


def find_wiring(w: Windows, x: Vectors, motor: Motor) -> Wiring:
    """The wiring that the samples speak for."""
    few = _thinned(w)
    trials = {(mirrored, ratio): _trial(few, x, mirrored, ratio, motor)
              for mirrored in (False, True) for ratio in _ratios(motor.pole_pairs)}
    power = {key: s.rms**2 for key, s in trials.items()}
    as_is = power[False, 1.0]
    chosen = min(power, key=lambda key: power[key])
    if power[chosen] > LESS * as_is:
        chosen = (False, 1.0)
    mirrored, ratio = chosen
    here = power[chosen]
    best = trials[chosen]
    turn = _turn(few, x, mirrored, ratio, motor)
    sign_known, sixths = turn is not None, turn or 0
    zero = cmath.phase(best.pair("psi"))
    backwards = ratio < 0.0
    told = Wiring(
        encoder_ratio=ratio, sign_known=sign_known, rms=math.sqrt(here), rms_as_is=math.sqrt(as_is),
        order_known=power[not mirrored, ratio] > MORE * here,
        direction_known=all(power[mirrored, r] > MORE * here for r in _ratios(motor.pole_pairs) if r != ratio))
    return _named(told, mirrored, backwards, sixths, zero)


def _named(w: Wiring, mirrored: bool, backwards: bool, sixths: int, zero: float) -> Wiring:
    """The least that explains the trial: one thing wrong rather than two."""
    # The magnet's angle stays where it is if only the current is wrong, and goes with a voltage that is.
    with_voltage = abs(math.remainder(zero - _SIXTH * sixths, 2.0 * math.pi)) < abs(math.remainder(zero,
                                                                                                  2.0 * math.pi))
    if mirrored and backwards:
        return replace(w, voltage_mirrored=True, voltage_sixths=sixths, encoder_ratio=-w.encoder_ratio)
    if mirrored:
        return replace(w, current_mirrored=True, current_sixths=sixths)
    if with_voltage:
        return replace(w, voltage_sixths=sixths)
    return replace(w, current_sixths=-sixths % 6)


def _turn(w: Windows, x: Vectors, mirrored: bool, ratio: float, motor: Motor) -> int | None:
    """Sixths of a turn that the current has to be turned on by for the motor as told to explain the voltage; None
    where that makes no difference.

    R, L_s and the saliency are held to what was told: along a current that keeps its place to the magnet each of
    them, left free, would stand for a turn of it.
    """
    current, charge = (x.i.conj(), w.i.conj()) if mirrored else (x.i, w.i)
    prior = core_prior(motor)
    prior = {name: prior[name] for name in ("psi.x", "psi.y")}
    kept = np.ones(len(w), np.bool_)
    power: list[float] = []
    for sixth in range(6):
        turn = cmath.rect(1.0, _SIXTH * sixth)
        columns = core_columns(w, Vectors(turn * current, x.v, ratio * x.theta, x.sample_rate))
        magnet = {name: columns[name] for name in prior}
        rest = w.v - motor.R * turn * charge - motor.L_s * columns["L_s"]
        zero = cmath.phase(_fitted(magnet, rest, w, kept, prior).pair("psi"))
        rest = rest - 0.5 * motor.L_0 * cmath.rect(1.0, 2.0 * zero) * columns["l.x"]
        left = _fitted(magnet, rest, w, kept, prior)
        if sixth == 0:
            # A window in which the encoder slips would outweigh all that the current explains.
            kept = np.abs(left.residual) <= _OUTLIER * np.median(np.abs(left.residual))
            left = _fitted(magnet, rest, w, kept, prior)
        power.append(left.rms**2)
    best = int(np.argmin(power))
    others = min(p for k, p in enumerate(power) if k != best)
    return best if others > _CLEARER * power[best] else None


def _fitted(columns: dict[str, Complexes], left: Complexes, w: Windows, kept: NDArray[np.bool_],
            prior: dict[str, tuple[float, float]]) -> Solution:
    return solve({name: c[kept] for name, c in columns.items()}, left[kept], w.group[kept], prior)


def inductance_turn(w: Windows, x: Vectors, motor: Motor) -> int | None:
    """Sixths of a turn by which the current was turned before it was reported; None where nothing tells."""
    turn = _turn(_thinned(w), x, False, 1.0, motor)
    return None if turn is None else -turn % 6
