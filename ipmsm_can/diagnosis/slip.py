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

from ipmsm_can.diagnosis.model import Vectors
from ipmsm_can.diagnosis.windows import Windows
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

LEAST = math.radians(4.0)
"""Step [rad electrical] that counts."""
_BLOCK_S = 0.012
_SHARE = 0.6
"""What a step must leave of the squares, at most."""
_EDGE = 8
"""Blocks before and after a step, at least."""
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
    turn = np.exp(1j * x.theta)
    dq = x.i * turn.conj()
    rest = w.v - motor.R * w.i - w.change(turn * (motor.L_d * dq.real + 1j * motor.L_q * dq.imag))
    magnet = w.change(turn)
    n = max(1, round(_BLOCK_S / w.period))
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
    if row.size >= 2 * _EDGE + 4:
        usual = np.angle(np.exp(1j * angle).mean())
        angle = np.unwrap(np.angle(np.exp(1j * (angle - usual))))
        shaft = x.theta[row] / motor.pole_pairs
        known = np.stack([np.ones(row.size), np.cos(shaft), np.sin(shaft)], axis=1)
        while len(slips) < _MOST:
            found = _step(known, angle)
            if found is None:
                break
            at, size, sigma = found
            slips.append(Slip(int(row[at]), -size, sigma))
            known = np.concatenate([known, (np.arange(row.size) >= at)[:, None]], axis=1)
    # The magnet seems to turn one way where the encoder went the other.
    return ZeroCourse(row, -angle, tuple(sorted(slips, key=lambda s: s.row)))


def _step(known: Floats, angle: Floats) -> tuple[int, float, float] | None:
    """The step that explains most beside what is known: (block, size, sigma), None where none does."""
    n = angle.size
    base, *_ = np.linalg.lstsq(known, angle, rcond=None)
    rest = angle - known @ base
    before = float(rest @ rest)
    # Every step at once: each column H(k - c), freed from what is known already (Frisch-Waugh).
    steps = np.tril(np.ones((n, n)))[:, _EDGE:n - _EDGE]
    q, _ = np.linalg.qr(known)
    free = steps - q @ (q.T @ steps)
    power = (free**2).sum(axis=0)
    size = np.divide(free.T @ rest, power, out=np.zeros(power.size), where=power > 1e-9)
    best = int(np.argmax(size**2 * power))
    left = before - float(size[best] ** 2 * power[best])
    if abs(size[best]) < LEAST or left > _SHARE * before:
        return None
    sigma = math.sqrt(left / max(1, n - known.shape[1] - 1) / power[best])
    return best + _EDGE, float(size[best]), sigma
