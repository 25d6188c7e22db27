"""What goes into `riccati` besides its samples: its state from before a gap, and an angle found elsewhere."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.estimation.observers.common import FLUX_STATES
from ipmsm_can.estimation.observers.covariance import correct
from ipmsm_can.estimation.observers.riccati import MODEL_ERROR

Floats = NDArray[np.float64]


def carry_over(old: NDArray[np.void], fresh: NDArray[np.void], turned: float, variance: float) -> None:
    """What a gap leaves: the covariance, turned [rad] with the rotor and widened [Wb^2], and the voltage errors.

    old, fresh: record arrays (1,) of `common.STATE` before and after the gap.
    """
    c, s = math.cos(turned), math.sin(turned)
    turn = np.eye(FLUX_STATES)
    turn[:2, :2] = [[c, -s], [s, c]]
    P = turn @ old["P"][0] @ turn.T
    P[0, 0] += variance
    P[1, 1] += variance
    fresh["P"][0] = 0.5 * (P + P.T)
    aa, ab, bb = old["clear"][0]
    clear = turn[:2, :2] @ np.array([[aa, ab], [ab, bb]]) @ turn[:2, :2].T
    fresh["clear"][0] = (clear[0, 0] + variance, clear[0, 1], clear[1, 1] + variance)
    for name in ("bias", "test", "polarity", "lost"):
        fresh[name] = old[name]


def take_angle(state: NDArray[np.void], psi_m: float, prior: Floats, x_hat: complex, measured: complex,
               sigma: float) -> complex:
    """Take in an active flux measured by its direction, polarity known: as `confidence.take_angle`.

    state: record array (1,) of `common.STATE`; prior: variances of the voltage errors, float64 (BIASES,); psi_m,
    x_hat, measured [Wb]; sigma: 1-sigma of the direction [rad
    electrical].  Returns what x_hat has to be put right by [Wb].
    """
    st = state[0]
    P = st["P"]
    north = measured / abs(measured)
    if not st["polarity"]:
        # What was learned of the voltage with the rotor taken to be elsewhere, by half a turn as a rule, is wrong.
        across2, along2 = (psi_m * sigma) ** 2, (MODEL_ERROR * psi_m) ** 2
        P[:] = 0.0
        P[2:, 2:] = np.diag(prior)
        st["bias"] = 0.0
        P[0, 0] = along2 * north.real**2 + across2 * north.imag**2
        P[1, 1] = along2 * north.imag**2 + across2 * north.real**2
        P[0, 1] = P[1, 0] = (along2 - across2) * north.real * north.imag
        st["polarity"], st["test"] = 1, 1.0
        return measured - x_hat
    row, gain = np.zeros(FLUX_STATES), np.zeros(FLUX_STATES)
    row[:2] = -north.imag, north.real
    off = (north * x_hat.conjugate()).imag  # how far x_hat would have to move across the measured direction
    correct(P, row, gain, (abs(x_hat) * sigma) ** 2 + 1e-24 * psi_m * psi_m)
    st["bias"] += gain[2:] * off
    return complex(gain[0], gain[1]) * off
