"""Persistence of excitation: the smallest eigenvalue of the windowed integral of Phi Phi^T (Assumption 3).

The window is kept as BINS sub-windows whose sums are closed one after another, so nothing is ever
subtracted and no rounding error accumulates over hours.  It spans the last BINS - 1 closed bins and the
open one: between (BINS - 1)/BINS and 1 times the length asked for.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

BINS = 16

STATE = np.dtype([
    ("bin_samples", "i8"), ("T_s", "f8"),
    ("count", "i8"), ("slot", "i8"),
    ("open", "f8", (3,)), ("closed", "f8", (3,)), ("bins", "f8", (BINS, 3)),
])


def new_state(window: float, sample_rate: float) -> NDArray[np.void]:
    """Record array (1,) of STATE for a window [s] at sample_rate [Hz]."""
    state = np.zeros(1, STATE)
    state["bin_samples"] = max(1, round(window * sample_rate / BINS))
    state["T_s"] = 1.0 / sample_rate
    return state


@kernel
def excitation_block(regression: NDArray[np.float64], state: NDArray[np.void], out: NDArray[np.float64]) -> None:
    """Write the smallest eigenvalue [V^2 s] after each sample into out (N,); regression as from Lemma 1."""
    st = state[0]
    T_s = st.T_s
    n_bin = st.bin_samples
    count = st.count
    aa = st.open[0]
    ab = st.open[1]
    bb = st.open[2]
    closed_aa = st.closed[0]
    closed_ab = st.closed[1]
    closed_bb = st.closed[2]
    for k in range(regression.shape[1]):
        if count == n_bin:
            slot = st.slot
            st.bins[slot, 0] = aa
            st.bins[slot, 1] = ab
            st.bins[slot, 2] = bb
            # The slot after it holds the oldest bin: it leaves the window now.
            slot = (slot + 1) % BINS
            st.slot = slot
            st.bins[slot, 0] = 0.0
            st.bins[slot, 1] = 0.0
            st.bins[slot, 2] = 0.0
            closed_aa = 0.0
            closed_ab = 0.0
            closed_bb = 0.0
            for j in range(BINS):
                closed_aa += st.bins[j, 0]
                closed_ab += st.bins[j, 1]
                closed_bb += st.bins[j, 2]
            aa = 0.0
            ab = 0.0
            bb = 0.0
            count = 0
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        aa += T_s * phi_a * phi_a
        ab += T_s * phi_a * phi_b
        bb += T_s * phi_b * phi_b
        count += 1
        m_aa = closed_aa + aa
        m_ab = closed_ab + ab
        m_bb = closed_bb + bb
        mean = 0.5 * (m_aa + m_bb)
        difference = 0.5 * (m_aa - m_bb)
        out[k] = max(0.0, mean - math.sqrt(difference * difference + m_ab * m_ab))
    st.count = count
    st.open[0] = aa
    st.open[1] = ab
    st.open[2] = bb
    st.closed[0] = closed_aa
    st.closed[1] = closed_ab
    st.closed[2] = closed_bb
