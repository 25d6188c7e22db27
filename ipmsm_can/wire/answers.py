"""Which samples get an answer, and what PositionEstimate and ActiveFluxEstimate say of them: compiled, so that the
ordinary path and the compiled loop on SocketCAN say the same."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.confidence import LOCKED, POLARITY_KNOWN, VALID, WITHHELD
from ipmsm_can.wire.protocol import CompanionState

POSITION_SIGNALS = ("theta_e", "omega_e", "sigma_theta", "sample_counter", "valid", "locked", "polarity_known",
                    "injecting")
"""Signals of PositionEstimate in the order that `position_values` takes their rows."""
FLUX_SIGNALS = ("x_alpha", "x_beta", "excitation_level", "innovation")
"""Signals of ActiveFluxEstimate in the order that `flux_values` takes their rows."""
_FAINTEST = 1e-30
_LOCKED, _TRACKING, _STARTING = (int(s) for s in (CompanionState.LOCKED, CompanionState.TRACKING,
                                                  CompanionState.STARTING))

_TWO_PI = 2.0 * math.pi


@kernel
def due_among(counter: NDArray[np.int64], every: int, oldest: int, out: NDArray[np.intp]) -> int:
    """Rows that are due, into out; returns how many.  See `due_rows`."""
    newest = counter[counter.shape[0] - 1]
    n = 0
    for k in range(counter.shape[0]):
        if counter[k] % every == 0 and (newest - counter[k]) & 0xFFFFFFFF <= oldest:
            out[n] = k
            n += 1
    return n


def due_rows(counter: NDArray[np.int64], every: int, oldest: int) -> NDArray[np.intp]:
    """Rows whose sample counter is a multiple of `every` and at most `oldest` samples behind the last one."""
    out = np.empty(counter.size, np.intp)
    return out[:due_among(counter, every, oldest, out)]


@kernel
def position_values(counter: NDArray[np.int64], angle: NDArray[np.float64], sigma: NDArray[np.float64],
                    flags: NDArray[np.uint8],
                    injecting: NDArray[np.uint8], due: NDArray[np.intp], step: float,
                    rows: NDArray[np.intp], out: NDArray[np.float64]) -> None:
    """Physical values of PositionEstimate for the rows `due`, into out (n_signals, len(due)).

    angle (3, N): theta_hat, smoothed theta, omega [rad, rad/s electrical].  sigma (N,) [rad]; on the wire it is
    unknown where flags (N,) say WITHHELD.  step: resolution
    of theta_e on the wire [rad]; what would round up to a whole turn becomes 0.  rows: where in `out` each of
    POSITION_SIGNALS belongs.
    """
    for m in range(due.shape[0]):
        k = due[m]
        theta = angle[0, k] - _TWO_PI * math.floor(angle[0, k] / _TWO_PI)
        out[rows[0], m] = theta if theta < _TWO_PI - 0.5 * step else 0.0
        out[rows[1], m] = angle[2, k]
        out[rows[2], m] = 180.0 if flags[k] & WITHHELD else math.degrees(sigma[k])
        out[rows[3], m] = counter[k] & 0x3FF
        out[rows[4], m] = 1.0 if flags[k] & VALID else 0.0
        out[rows[5], m] = 1.0 if flags[k] & LOCKED else 0.0
        out[rows[6], m] = 1.0 if flags[k] & POLARITY_KNOWN else 0.0
        out[rows[7], m] = injecting[k]


@kernel
def flux_values(regression: NDArray[np.float64], flux: NDArray[np.float64], excitation: NDArray[np.float64],
                due: NDArray[np.intp], rows: NDArray[np.intp], out: NDArray[np.float64]) -> None:
    """Physical values of ActiveFluxEstimate for the rows `due`, into out (n_signals, len(due)).

    regression (7, N), flux (6, N), excitation (N,) [V^2 s] as in EstimateBlock.  rows: where in `out` each of
    FLUX_SIGNALS belongs.  The innovation is divided by |Phi|: what it means in flux [Wb].
    """
    for m in range(due.shape[0]):
        k = due[m]
        phi = math.sqrt(regression[1, k] * regression[1, k] + regression[2, k] * regression[2, k])
        out[rows[0], m] = flux[2, k]
        out[rows[1], m] = flux[3, k]
        out[rows[2], m] = 10.0 * math.log10(max(excitation[k], _FAINTEST))
        out[rows[3], m] = flux[4, k] / phi if phi > 0.0 else 0.0


@kernel
def tracking_state(flags: int, sigma: float) -> int:
    """CompanionStatus.state while samples flow: locked, tracking or still starting; sigma [rad]."""
    if flags & LOCKED:
        return _LOCKED
    return _TRACKING if sigma < math.pi else _STARTING
