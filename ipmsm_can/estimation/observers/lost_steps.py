"""Lost samples: what the straight line that stands in for them may have left out.

Its currents are right, as its ends are.  Its voltage is the mean of the voltages at both ends; where a step of the
current fell into the gap, the volts that drove it are missing, up to the dc link for a period: 15 to 20 deg on
a motor with a weak magnet.  Of the probing signal a part of a period is missing, small, but many times a second.
The currents tell: with x_hat roughly known, so is the inductance, and

    what the flux moved by other than the voltage says      L di + j omega x T_s - (v - R i) T_s

is added up as long as the line lasts, for it all points one way, and counts as an error of the flux, in P and,
through the regression's filters, in y.  What wrong parameters and the noise of the line's ends make of it counts
with it: where samples are missing that much doubt is due.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.covariance import across

Floats = NDArray[np.float64]

_STRAIGHT = 1e-9
"""What rounding makes of a straight line, relative."""
_ROUGHLY = 1.0
"""Variance of the angle [rad^2] below which the inductance is known well enough."""
_HUGE = 1e100


@kernel
def straight_on(samples: Floats, k: int, st: Any) -> bool:
    """Whether sample k goes on from the two before in a straight line, as what stands in for lost ones does."""
    same = True
    moves = False
    for r in range(4):
        step = samples[r, k] - st.last[r]
        if not abs(step - st.step[r]) <= _STRAIGHT * (1.0 + abs(samples[r, k])):
            same = False
        moves = moves or step != 0.0
        st.step[r] = step
        st.last[r] = samples[r, k]
    return same and moves


@kernel
def left_out(di_a: float, di_b: float, moved_a: float, moved_b: float, straight: bool, st: Any, p: Any) -> float:
    """What lost samples may have taken with them: growth of the flux's variance [Wb^2] over this interval.

    The straight line that stands in for them has the right currents, but the volt-seconds of a step of the current
    may have been lost, all in one direction: what the current's change says of the flux other than the voltage.
    """
    x_a = st.x_a
    x_b = st.x_b
    x2 = x_a * x_a + x_b * x_b
    first = st.off_a == 0.0 and st.off_b == 0.0
    known = x2 > p.epsilon * p.epsilon and across(st.P, x_a, x_b) < _ROUGHLY * x2
    if straight and known:
        salient = p.L_0 * (x_a * di_a + x_b * di_b) / x2
        turned = p.T_s * st.pll_omega
        # That it is a straight line shows at the second of its steps.
        share = 2.0 if first else 1.0
        st.off_a += share * (moved_a - p.L_q * di_a - salient * x_a + turned * x_b)
        st.off_b += share * (moved_b - p.L_q * di_b - salient * x_b - turned * x_a)
        off2 = st.off_a * st.off_a + st.off_b * st.off_b
        if off2 < _HUGE:
            more = max(off2 - st.missed, 0.0)
            st.missed += more
            return float(more)
        return 0.0
    st.off_a = 0.0
    st.off_b = 0.0
    st.missed = 0.0
    return 0.0
