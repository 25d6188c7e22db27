"""Distrust after samples that were cut off at the end of their range.

A current or voltage that left its range is reported too small, and the estimate built on it is wrong while it looks
consistent.  What it spoiled fades in two ways: the filters of the regression forget as exp(-alpha t), the observer
as its error contracts, at the rate of the slower pole of the rotating error dynamics (see `confidence`).  No angle
is valid until both have happened since the last such sample; at standstill the second never does.

Waiting for the filters alone is not enough: M2 at 20 rpm, alpha = 20, voltages cut off at 40 % of their peak for
0.3 s, is still 31 deg off after 5/alpha, and below 3 deg after both.

The Riccati observer has no fixed rate: what it has learned of voltage errors from such samples fades as the rotor
shows it every direction anew.  It is held until the filters have forgotten and the rotor has made TURNS electrical
turns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.confidence import POLARITY_CONTRACTION, VALID, WITHHELD
from ipmsm_can.estimation.observers.kinds import RICCATI

Floats = NDArray[np.float64]
_TWO_PI = 2.0 * np.pi

FILTERS_FORGET = 5.0
"""Time constants 1/alpha after which the filters have forgotten a sample: less than 1 % is left."""
CONTRACTION = POLARITY_CONTRACTION
"""Contraction of the observer, as an exponent, after which it has forgotten as well."""

TURNS = 3.0
"""Electrical turns after which the Riccati observer has forgotten."""

STATE = np.dtype([("holding", "i8"), ("faded", "f8"), ("contraction", "f8"), ("turned", "f8")])


def new_state() -> NDArray[np.void]:
    """Record array (1,) of STATE: nothing was cut off yet."""
    return np.zeros(1, STATE)


@kernel
def hold_block(clipped: NDArray[np.uint8], regression: Floats, flux: Floats, angle: Floats, alpha: float,
               T_s: float, kind: int, state: NDArray[np.void], flags: NDArray[np.uint8]) -> None:
    """Put WITHHELD for VALID into flags (N,) at each sample that was cut off, and while what it spoiled lasts.

    clipped: uint8 (N,), not 0 where the sample was cut off.  regression (7, N), flux (6, N), angle (3, N): as in
    EstimateBlock.  alpha [1/s]; T_s [s]; kind: of the observer.  Any partition into blocks gives the same bits.
    """
    st = state[0]
    for k in range(clipped.shape[0]):
        if clipped[k]:
            st.holding = 1
            st.faded = 0.0
            st.contraction = 0.0
            st.turned = 0.0
        elif st.holding:
            phi_a = regression[1, k]
            phi_b = regression[2, k]
            rate = flux[5, k] * (phi_a * phi_a + phi_b * phi_b) / T_s
            omega = angle[2, k]
            st.faded += alpha * T_s
            st.turned += omega * T_s
            if kind == RICCATI:
                forgotten = abs(st.turned) >= TURNS * _TWO_PI
            else:
                if rate > 0.0:
                    st.contraction += T_s * min(0.5 * rate, omega * omega / rate)
                forgotten = st.contraction >= CONTRACTION
            if st.faded >= FILTERS_FORGET and forgotten:
                st.holding = 0
        if st.holding:
            flags[k] = flags[k] & (0xFF ^ VALID) | WITHHELD
