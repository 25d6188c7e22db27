"""Whether one pair of inductances fits all the currents of a log: saturation in what a fit leaves over."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from ipmsm_can.identification import encoder_fit as fit
from ipmsm_can.identification.samples import Stretch
from ipmsm_can.identification.solve import product

Floats = NDArray[np.float64]

MATTERS = 0.02
"""Change of a flux linkage by saturation, as a share of L_q i_q at the log's current, that is told."""
_SURE = 4.0
"""By how many standard errors it must be there."""


def bend(pieces: Sequence[Stretch], rate: float, p: Floats, scatter: Floats) -> str:
    """A sentence where the inductances change with the current, "" where nothing shows it.

    The terms of the co-energy that come next after L_d and L_q (reciprocal: one term, both axes), each on top of
    the fit p: lambda_d += b i_q^2 with lambda_q += 2 b i_d i_q, and lambda_q += c i_q^3.
    """
    residual, columns, number = fit.rows(pieces, rate, p)
    weight = (1.0 / (p[[fit.L_D, fit.L_Q]] * scatter))[:, None]
    extra = np.concatenate([_columns(s, rate, p) for s in pieces], axis=2)
    base = (columns * weight).reshape(len(p), -1).T
    left = (residual * weight).ravel()
    i_q = np.concatenate([fit.clean_current(s, rate, p).imag for s in pieces])
    most = float(np.percentile(np.abs(i_q), 99.0))
    if most == 0.0:
        return ""
    gram = product(base, base)
    gram += np.diag(1e-9 * np.diag(gram) + 1e-300)
    for power, column in zip((2, 3), extra, strict=True):
        x = (column * weight).ravel()
        # What the parameters of the fit cannot take over of it.
        x = x - base @ np.linalg.solve(gram, product(base, x[:, None])[:, 0])
        size = float(x @ x)
        if size <= 0.0:
            continue
        value = -float(x @ left) / size
        block = np.tile(np.floor(number * 10.0 / rate).astype(np.int64), 2)
        block -= block.min()
        scores = np.bincount(block, weights=x * left)
        error = max(math.sqrt(float(scores @ scores)), math.sqrt(size * float(np.var(left)))) / size
        share = abs(value) * most**power / (p[fit.L_Q] * most)
        if abs(value) > _SURE * error and share > MATTERS:
            return (f"the inductances change with the current (by {100.0 * share:.0f} % of the flux at "
                    f"{most:.3g} A): L_d, L_q and psi_m are those that fit the currents of this log best, and hold "
                    "for such currents only")
    return ""


def _columns(s: Stretch, rate: float, p: Floats) -> Floats:
    """(2, 2, rows): prediction errors that either term with a coefficient of 1 would make, along d and q."""
    keep = math.exp(-fit.CORNER / rate)
    turn = np.exp(1j * (s.theta - p[fit.ENCODER_ZERO]))
    dq = fit.clean_current(s, rate, p)
    out = []
    for flux in (dq.imag**2 + 2j * dq.real * dq.imag, 1j * dq.imag**3):
        high = lfilter([1.0, -1.0], [1.0, -keep], turn * flux - (turn * flux)[0]) * turn.conj()
        out.append(np.stack([high.real, high.imag])[:, fit.used(s)])
    return np.stack(out)
