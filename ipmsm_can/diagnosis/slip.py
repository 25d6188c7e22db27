"""Steps of the encoder's zero: an encoder that slips on its shaft, or loses counts.

The magnet's direction is found anew from each few windows in a row, with the motor as told; where it stays, but for
a part that repeats with the turns of the shaft (an eccentric disc is no slip), the encoder holds.  A wrong L_q or
a late voltage turns it with load and speed, by a few degrees at most and not for good; hence LEAST, and a step has
to stand out of what is left without it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis.model import Vectors, motor_columns
from ipmsm_can.diagnosis.windows import Windows
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

LEAST = math.radians(4.0)
"""Step [rad electrical] that counts."""
_BLOCK_S = 0.012
_MOST_BLOCKS = 2000
"""Blocks are longer in a long log."""
_SHARE = 0.6
"""What a step must leave of the squares, at most."""
_EDGE = 3
"""Blocks before and after a step, and between two of them, at least."""
_SURE = 6.0
_MOST = 8


@dataclass(frozen=True, slots=True)
class Slip:
    """A step of the encoder's zero.  row: of the measurement, where it is first seen; angle: by how much the report
    changed [rad electrical]; sigma: of that."""

    row: int
    angle: float
    sigma: float


@dataclass(frozen=True, slots=True)
class ZeroCourse:
    """Encoder minus rotor over time: row of the measurement (B,), angle [rad electrical] (B,), 0 the usual one."""

    row: NDArray[np.int64]
    angle: Floats
    slips: tuple[Slip, ...]

    def removed(self, x: Vectors) -> Vectors:
        """The vectors without the slips."""
        theta = x.theta.copy()
        for slip in self.slips:
            theta[slip.row:] -= slip.angle
        return Vectors(x.i, x.v, theta, x.sample_rate)


def _courses(w: Windows, x: Vectors, motor: Motor, volts: float) -> tuple[NDArray[np.int64], Floats]:
    """Row and angle of the magnet against the encoder [rad], where it turns fast enough to tell."""
    c = motor_columns(w, x)
    rest = w.v - motor.R * c["R"] - motor.L_d * c["L_d"] - motor.L_q * c["L_q"]
    magnet = c["psi.x"]
    n = max(1, round(_BLOCK_S / w.period), -(-len(w) // _MOST_BLOCKS))
    blocks = len(w) // n
    cut = slice(0, blocks * n)
    along = (magnet.conj() * rest)[cut].reshape(blocks, n).sum(axis=1)
    power = (np.abs(magnet) ** 2)[cut].reshape(blocks, n).sum(axis=1)
    # The voltage may be off by `volts`: let that turn the magnet by no more than LEAST/2.
    clear = np.sqrt(power / n) * motor.psi_m > volts * w.period / (0.5 * LEAST)
    row = w.begin[cut].reshape(blocks, n)[:, 0]
    return row[clear], np.angle(along[clear])


def find_slips(w: Windows, x: Vectors, motor: Motor, volts: float) -> ZeroCourse:
    """The steps of the encoder's zero.  volts: what the voltage may be wrong by [V]."""
    row, angle = _courses(w, x, motor, volts)
    slips: list[Slip] = []
    if row.size >= 20:
        usual = np.angle(np.exp(1j * angle).mean())
        angle = np.unwrap(np.angle(np.exp(1j * (angle - usual))))
        # What may move the angle without a slip: the shaft's turns, a late voltage, a wrong L_q.
        shaft = x.theta[row] / motor.pole_pairs
        speed = np.gradient(x.theta)[row]
        load = (x.i * np.exp(-1j * x.theta)).imag[row]
        known = np.stack([np.ones(row.size), np.cos(shaft), np.sin(shaft), speed, load], axis=1)
        taken = np.zeros(row.size, np.bool_)
        taken[:_EDGE] = taken[row.size - _EDGE:] = True
        places: list[int] = []
        while len(places) < _MOST:
            found = _step(known, angle, taken)
            if found is None:
                break
            places.append(found)
            taken[max(0, found - _EDGE):found + _EDGE + 1] = True
            known = np.concatenate([known, (np.arange(row.size) >= found)[:, None]], axis=1)
        slips = _sizes(known, angle, row, places)
    # The magnet seems to turn one way where the encoder went the other.
    return ZeroCourse(row, -angle, tuple(sorted(slips, key=lambda s: s.row)))


def _step(known: Floats, angle: Floats, taken: NDArray[np.bool_]) -> int | None:
    """The block with the step that explains most beside what is known; None where none does."""
    n = angle.size
    q, _ = np.linalg.qr(known)
    rest = angle - q @ (q.T @ angle)
    before = float(rest @ rest)
    # Every step at once: each column H(k - c), freed from what is known already (Frisch-Waugh).
    steps = np.tril(np.ones((n, n)))
    free = steps - q @ (q.T @ steps)
    power = (free**2).sum(axis=0)
    size = np.divide(free.T @ rest, power, out=np.zeros(n), where=power > 1e-6)
    gain = np.where(taken, 0.0, size**2 * power)
    best = int(np.argmax(gain))
    left = max(before - float(gain[best]), 0.0)
    sigma = math.sqrt(left / max(1, n - known.shape[1] - 1) / max(float(power[best]), 1e-6))
    if abs(size[best]) < max(LEAST, _SURE * sigma) or left > _SHARE * before:
        return None
    return best


def _sizes(known: Floats, angle: Floats, row: NDArray[np.int64], places: list[int]) -> list[Slip]:
    """All steps fitted together; those that turn out too small are none."""
    if not places:
        return []
    x, *_ = np.linalg.lstsq(known, angle, rcond=None)
    rest = angle - known @ x
    spread = np.linalg.pinv(known.T @ known) * float(rest @ rest) / max(1, angle.size - known.shape[1])
    first = known.shape[1] - len(places)
    found = [Slip(int(row[at]), -math.remainder(x[first + k], 2.0 * math.pi),
                  math.sqrt(max(spread[first + k, first + k], 0.0))) for k, at in enumerate(places)]
    return [slip for slip in found if abs(slip.angle) >= LEAST]
