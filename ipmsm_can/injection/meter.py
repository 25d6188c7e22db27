"""How much high-frequency current the probing signal drives: a lock-in at its frequency.

The current vector without its slow part is turned by -w_h t and by +w_h t and averaged.  The two amplitudes
are the positive and the negative sequence; their sum is the major semi-axis of the ellipse that the current
describes, that is the largest instantaneous high-frequency current [A peak].
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

AVERAGE_PERIODS = 4.0
"""Time constant of the averages, in periods of the probing signal."""

STATE = np.dtype([
    ("step", "f8"), ("slow", "f8"), ("average", "f8"), ("phase", "f8"),
    ("low_a", "f8"), ("low_b", "f8"),
    ("pos_re", "f8"), ("pos_im", "f8"), ("neg_re", "f8"), ("neg_im", "f8"),
])

_TWO_PI = 2.0 * math.pi


def new_state(frequency: float, sample_rate: float) -> NDArray[np.void]:
    """Record array (1,) of STATE; frequency of the probing signal and sample_rate in Hz."""
    step = _TWO_PI * frequency / sample_rate
    state = np.zeros(1, STATE)
    state["step"] = step
    state["slow"] = 1.0 - math.exp(-step / 8.0)
    state["average"] = 1.0 - math.exp(-step / (_TWO_PI * AVERAGE_PERIODS))
    return state


@kernel
def meter_block(samples: NDArray[np.float64], state: NDArray[np.void]) -> float:
    """Run over samples (4, N); returns the high-frequency current [A peak] after the block."""
    st = state[0]
    phase = st.phase
    low_a = st.low_a
    low_b = st.low_b
    pos_re = st.pos_re
    pos_im = st.pos_im
    neg_re = st.neg_re
    neg_im = st.neg_im
    for k in range(samples.shape[1]):
        a = samples[0, k] - low_a
        b = samples[1, k] - low_b
        low_a += st.slow * a
        low_b += st.slow * b
        phase += st.step
        if phase > math.pi:
            phase -= _TWO_PI
        c = math.cos(phase)
        s = math.sin(phase)
        pos_re += st.average * (a * c + b * s - pos_re)
        pos_im += st.average * (b * c - a * s - pos_im)
        neg_re += st.average * (a * c - b * s - neg_re)
        neg_im += st.average * (b * c + a * s - neg_im)
    st.phase = phase
    st.low_a = low_a
    st.low_b = low_b
    st.pos_re = pos_re
    st.pos_im = pos_im
    st.neg_re = neg_re
    st.neg_im = neg_im
    return math.sqrt(pos_re * pos_re + pos_im * pos_im) + math.sqrt(neg_re * neg_re + neg_im * neg_im)
