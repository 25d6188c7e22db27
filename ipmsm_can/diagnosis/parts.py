"""What findings are put together from: numbers with their intervals, and the plot of what one term explains."""

from __future__ import annotations

import math

import numpy as np

from ipmsm_can.diagnosis import model
from ipmsm_can.diagnosis.case import Case, Fit
from ipmsm_can.diagnosis.finding import Evidence, Plot, Series
from ipmsm_can.diagnosis.limits import SIGMAS_95, SURE

DEGREES = 180.0 / math.pi
_BINS = 40


def evidence(label: str, value: float, sigma: float, unit: str, expected: str = "",
             factor: float = 1.0) -> Evidence:
    """A value and its 95 % interval; factor: into `unit`."""
    half = SIGMAS_95 * sigma * abs(factor)
    return Evidence(label, factor * value, unit, factor * value - half, factor * value + half, expected)


def told(value: float, sigma: float, limit: float) -> bool:
    """Whether a value is both there and large enough to matter."""
    return abs(value) > limit and abs(value) > SURE * sigma


def seen(sigma: float, limit: float) -> bool:
    """Whether a value at the limit would have been seen."""
    return SURE * sigma < 2.0 * limit


def explained(case: Case, fit: Fit, names: tuple[str, ...], what: str) -> Plot | None:
    """What only these terms explain of the voltage: a straight line through 0 where they are right.

    Across: the term as it was fitted [V].  Up: what the voltage has beyond all other terms [V], means of as many
    windows each.
    """
    columns = {**model.motor_columns(fit.windows, fit.x),
               **model.error_columns(fit.windows, fit.x, fit.solution, case.motor, fit.dead_zone)}
    # What was undone is the difference between the solution of the last round and the whole.
    whole = {"delay": fit.delay, "o.x": fit.offset.real, "o.y": fit.offset.imag, "g.x": fit.gain.real,
             "g.y": fit.gain.imag, "ecc.x": fit.eccentricity.real, "ecc.y": fit.eccentricity.imag}
    term = sum((whole.get(name, fit.solution[name]) * columns[name] for name in names),
               np.zeros(len(fit.windows), np.complex128))
    rest = fit.solution.residual + term
    x = np.concatenate([term.real, term.imag]) / fit.windows.period
    y = np.concatenate([rest.real, rest.imag]) / fit.windows.period
    if x.size < 2 * _BINS or not np.ptp(x) > 0.0:
        return None
    order = np.argsort(x)
    across = np.array([part.mean() for part in np.array_split(x[order], _BINS)])
    up = np.array([part.mean() for part in np.array_split(y[order], _BINS)])
    ends = np.array([across[0], across[-1]])
    return Plot(f"The voltage that only {what} explains", "as fitted [V]", "seen beyond everything else [V]",
                (Series("measured, means of windows", across, up, "error", dots=True),
                 Series("as fitted", ends, ends, "estimate")),
                "On the line: the explanation holds. A level row of dots: it does not.")
