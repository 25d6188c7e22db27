"""Linear least squares of complex equations with real unknowns; residuals of one group may be alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]

_MOST_NOISE = 0.98
_NOISE_ERROR = 0.1
"""How well the noise's variance is known, 1-sigma as a share of it."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Values by name, their covariance, and what is left.

    residual: complex (W,).  rms: of it, per axis.  names in the order of `value` and `covariance`.
    """

    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    residual: Complexes
    rms: float

    def __getitem__(self, name: str) -> float:
        return float(self.value[self.names.index(name)])

    def sigma(self, name: str) -> float:
        """1-sigma of a value."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def pair(self, name: str) -> complex:
        """The complex value `name` stands for: its parts are `name`.x and `name`.y."""
        return complex(self[f"{name}.x"], self[f"{name}.y"])

    def pair_sigma(self, name: str) -> float:
        """1-sigma of the length of a complex value in its worst direction."""
        a, b = self.names.index(f"{name}.x"), self.names.index(f"{name}.y")
        part = self.covariance[np.ix_([a, b], [a, b])]
        return float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0)))


def solve(columns: dict[str, Complexes], left: Complexes, group: Ints,
          prior: dict[str, tuple[float, float]], noise: dict[str, float] | None = None) -> Solution:
    """Real unknowns x with sum of columns x = left, in the least squares sense.

    columns: complex (W,) by name of the unknown.  group: (W,), residuals of one group may be alike.
    prior: (value, 1-sigma) that is known of every unknown beforehand; what the equations say nothing of keeps it.
    noise: variance of the noise in a column itself, both axes together.  It would pull the unknown towards 0
    (errors in variables), so its share is taken off the normal equations.
    """
    names = tuple(columns)
    a = np.stack([np.concatenate([c.real, c.imag]) for c in columns.values()], axis=1)
    b = np.concatenate([left.real, left.imag])
    known, spread = (np.array([prior[n][k] for n in names]) for k in (0, 1))
    # In units of the prior, so that the normal equations are well scaled and the prior's matrix is 1.
    a = a * spread
    b0 = b - a @ (known / spread)
    n = len(left)
    blurred = np.array([(noise or {}).get(name, 0.0) for name in names]) * spread**2
    gram, right = a.T @ a, a.T @ b0 + n * blurred * known / spread
    # Never more than nearly all of it: the noise is known to some percent only.
    taken = np.minimum(n * blurred, _MOST_NOISE * np.diag(gram))
    gram -= np.diag(taken)
    dof = max(1, len(b) - len(names))
    variance = float(b0 @ b0) / dof
    x = np.zeros(len(names))
    for _ in range(3):
        x = np.linalg.solve(gram + variance * np.eye(len(names)), right)
        rest = b0 - a @ x
        variance = max(float(rest @ rest) / dof, 1e-30)
    inverse = np.linalg.inv(gram + variance * np.eye(len(names)))
    scores = a * rest[:, None] + 0.5 * blurred * (x + known / spread)
    number, where = np.unique(np.concatenate([group, group]), return_inverse=True)
    sums = np.zeros((number.size, len(names)))
    np.add.at(sums, where, scores)
    few = number.size / max(1, number.size - 1)
    meat = few * sums.T @ sums + variance**2 * np.eye(len(names))
    robust, plain = inverse @ meat @ inverse, variance * inverse
    # Never less than independent residuals would give: a handful of groups may agree by chance.
    scale = np.sqrt(np.maximum(1.0, np.diag(plain) / np.maximum(np.diag(robust), 1e-300)))
    covariance = robust * np.outer(scale, scale) * np.outer(spread, spread)
    # What was taken off may have been too much or too little.
    left_over = np.diag(inverse) * _NOISE_ERROR * taken * (x + known / spread)
    covariance += np.diag((left_over * spread) ** 2)
    residual = rest[:n] + 1j * rest[n:]
    return Solution(names, x * spread + known, covariance, residual, float(np.sqrt(variance)))
