"""Least squares on a model's prediction errors, and how far the solution can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import t as student

Floats = NDArray[np.float64]

BLOCK_S = 0.1
"""Length of a block [s]: longer than residuals remember."""
_BLOCKS = 50
_LEAST_BLOCK_S = 0.02
_MOST_STEPS = 60
_SMALL_STEP = 0.02
"""Step, in standard errors, at which the search ends."""
_NO_WORSE = 1e-9
_FEWEST = 6
"""Least degrees of freedom that an interval is made with."""

Model = Callable[[Floats], tuple[Floats, Floats]]
"""p -> (residuals (K,) in units of their scatter, columns (K, P): their derivatives)."""


class Unsolvable(ArithmeticError):
    """The samples are such that the search for the parameters has left where anything can be computed."""


@dataclass(frozen=True, slots=True)
class Solution:
    """values (P,), covariance (P, P), and by how many of its standard errors an interval of 95 % reaches."""

    values: Floats
    covariance: Floats
    reach: float


def minimise(model: Model, values: Floats, sigma: Floats, low: Floats, high: Floats,
             free: Sequence[int]) -> tuple[Floats, bool]:
    """(the values that leave the least residuals, whether they were reached); only those at `free` move.

    sigma: what is believed of `values` beforehand, 1-sigma; keeps sound what the samples do not tell.
    Levenberg and Marquardt's damping.  The end is a step far below the standard errors, which no library's solver
    asks for, and no later: columns that are instruments are not quite the derivatives of the cost.
    Raises Unsolvable.
    """
    at = np.array(free)
    believed = sigma[at] ** -2.0
    p = values.copy()

    def cost_of(x: Floats, residual: Floats) -> float:
        return float(residual @ residual + believed @ (x[at] - values[at]) ** 2)

    residual, columns = model(p)
    cost = cost_of(p, residual)
    damping, moved = 1e-3, math.inf
    for _ in range(_MOST_STEPS):
        c = columns[:, at]
        information = product(c, c) + np.diag(believed)
        slope = product(c, residual[:, None])[:, 0] + believed * (p[at] - values[at])
        curvature = np.diag(information)
        step = -inverse(information + damping * np.diag(curvature)) @ slope
        trial = p.copy()
        trial[at] = np.clip(p[at] + np.clip(step, -sigma[at], sigma[at]), low[at], high[at])
        error = np.sqrt(np.diag(inverse(information)))
        moved = float(np.max(np.abs(trial - p)[at] / error))
        with np.errstate(over="ignore", invalid="ignore"):
            residual_there, columns_there = model(trial)
            cost_there = cost_of(trial, residual_there)
        if cost_there <= cost * (1.0 + _NO_WORSE):
            p, residual, columns, cost = trial, residual_there, columns_there, cost_there
            if moved < _SMALL_STEP:
                return p, True
            damping = max(0.1 * damping, 1e-9)
        else:
            damping *= 10.0
            if damping > 1e6:
                return p, moved < 1.0
    return p, moved < 1.0


def partial(columns: Floats, k: int) -> float:
    """Mean square of column k after the others have taken over what they can of it."""
    others = np.delete(np.arange(columns.shape[1]), k)
    c = columns[:, others]
    gram = product(c, c)
    gram += np.diag(1e-12 * np.diag(gram) + 1e-300)
    x = columns[:, k] - np.einsum("ki,i->k", c, np.linalg.solve(gram, product(c, columns[:, [k]])[:, 0]))
    return float(np.mean(x * x))


def memory(residual: Floats) -> float:
    """Mean square of what residuals (K,) remember of the one before; 0 where it cannot be told from nothing.

    White noise remembers nothing but for its own chance.
    """
    kept = float(np.mean(residual[1:] * residual[:-1]))
    nothing = 2.0 * float(np.var(residual)) / math.sqrt(residual.size)
    return max(0.0, kept - nothing)


def product(a: Floats, b: Floats) -> Floats:
    """a^T b of tall arrays, on one core: on a busy machine the threads of a BLAS wait for each other, and took
    a hundred times as long."""
    return np.asarray(np.einsum("ki,kj->ij", a, b), np.float64)


def inverse(a: Floats) -> Floats:
    """Of a positive definite matrix.  Raises Unsolvable where rounding leaves it none: columns beyond bounds."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.sqrt(np.diag(a))
        scaled = a / np.outer(scale, scale)
    try:
        return np.asarray(cho_solve(cho_factor(scaled), np.eye(scale.size)) / np.outer(scale, scale), np.float64)
    except ValueError:  # what is not finite, too
        raise Unsolvable("the parameters cannot be told apart") from None


def judge(model: Model, values: Floats, sigma: Floats, time: Floats, first: int,
          given: Sequence[int] = ()) -> Solution:
    """The covariance of a solution.  time (K,): of each residual [s].  first: how many of the parameters matter to
    all of the samples; those after them are initial values of single windows.

    The larger one, parameter by parameter, of what white residuals give and of what blocks of them give: residuals
    that remember what came before make the first too small, and few excited blocks the second.
    Raises Unsolvable.
    """
    residual, columns = model(values)
    fitted = np.setdiff1d(np.arange(values.size), given)
    c = columns[:, fitted]
    bread = inverse(product(c, c) + np.diag(sigma[fitted] ** -2.0))
    white = bread * float(np.var(residual))
    span = float(time.max() - time.min()) if time.size else 0.0
    length = min(BLOCK_S, max(_LEAST_BLOCK_S, span / _BLOCKS))
    block = np.floor((time - time.min()) / length).astype(np.int64)
    block = np.unique(block, return_inverse=True)[1]
    scores = np.stack([np.bincount(block, weights=residual * x) for x in c.T])
    blocks = scores.shape[1]
    freedom = max(blocks - first, _FEWEST)
    with np.errstate(over="ignore", invalid="ignore"):
        clustered = bread @ (scores @ scores.T) @ bread * (blocks / freedom)
    scale = np.sqrt(np.maximum(np.diag(clustered) / np.diag(white), 1.0))
    covariance = np.diag(sigma**2.0)
    covariance[np.ix_(fitted, fitted)] = white * np.outer(scale, scale)
    if len(given):
        carried = bread @ product(c, columns[:, list(given)]) * sigma[list(given)]
        covariance[np.ix_(fitted, fitted)] += carried @ carried.T
    return Solution(values, covariance, float(student.ppf(0.975, freedom)))
