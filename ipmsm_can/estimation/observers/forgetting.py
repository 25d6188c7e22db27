"""What `riccati` gives up: after a loss of lock all it has learned, after an absurd sample the flux as well.

Short of that it doubts what it took the voltage's errors for, once it turns out where north is (`distrust`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.common import FLUX_STATES
from ipmsm_can.estimation.observers.voltage_errors import BIASES

Floats = NDArray[np.float64]


@kernel
def forget(P: Floats, st: Any, p: Any, ceiling: float) -> None:
    """Nothing is known any more but the priors, and the flux to the variance `ceiling` [Wb^2]."""
    for a in range(FLUX_STATES):
        for b in range(FLUX_STATES):
            P[a, b] = 0.0
    P[0, 0] = ceiling
    P[1, 1] = ceiling
    for j in range(BIASES):
        P[2 + j, 2 + j] = p.prior[j]
        st.bias[j] = 0.0
    st.clear[0] = ceiling
    st.clear[1] = 0.0
    st.clear[2] = ceiling
    st.test = 0.0
    st.polarity = 0


@kernel
def distrust(P: Floats, test: float, p: Any) -> None:
    """The voltage's errors may be anything that their priors allow, whatever they are taken for.

    test: mean square of the innovations over their variance.  If they are larger than they should be, so is the
    flux's error.
    """
    wider = math.sqrt(max(test, 1.0))
    for a in range(2):
        for b in range(FLUX_STATES):
            P[a, b] *= wider
            P[b, a] *= wider
    for j in range(BIASES):
        P[2 + j, 2 + j] = max(P[2 + j, 2 + j], p.prior[j])


@kernel
def start_over(P: Floats, st: Any, p: Any, ceiling: float) -> None:
    """As `forget`, and no filter remembers anything: there is no angle."""
    forget(P, st, p, ceiling)
    st.s = 0.0
    st.f_s = 0.0
    st.u_a = 0.0
    st.u_b = 0.0
    st.f_u_a = 0.0
    st.f_u_b = 0.0
    st.square = 0.0
    st.f_square = 0.0
    for j in range(BIASES):
        st.product[j] = 0.0
        st.f_product[j] = 0.0
    st.x_a = 0.0
    st.x_b = 0.0
    st.pll_omega = 0.0
    st.pll_difference = 0.0


@kernel
def doubt(parameters: NDArray[np.void], state: NDArray[np.void]) -> None:
    """Nothing is known any more but the flux itself, as after a loss of lock; arguments as for `riccati_block`."""
    p = parameters[0]
    st = state[0]
    forget(st.P, st, p, 4.0 * p.psi_m * p.psi_m)
