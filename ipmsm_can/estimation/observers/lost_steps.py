"""Lost samples: what the straight line that stands in for them may have left out.

Its currents are right, as its ends are.  Its voltage is the mean of the voltages at both ends; where a step of the
current fell into the gap, the volts that drove it are missing, up to the dc link for a period: 15 to 20 deg on
a motor with a weak magnet.  The currents tell: with x_hat known, so is the inductance, and

    what the flux moved by other than the voltage says      L di + j omega x T_s - (v - R i) T_s

is added up as long as the line lasts, for it all points one way, and counts as an error of the flux, in P and,
through the regression's filters, in y.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.covariance import ANGLE_KNOWN, across

Floats = NDArray[np.float64]

_SHARE = 0.25
"""What wrong inductances, speed and voltage may make of a step that was not lost, as a share of its parts."""
_STRAIGHT = 1e-9
"""What rounding makes of a straight line, relative."""
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
    before2 = st.off_a * st.off_a + st.off_b * st.off_b
    first = before2 == 0.0
    known = x2 > p.epsilon * p.epsilon and across(st.P, x_a, x_b) < ANGLE_KNOWN * x2
    if straight and known:
        salient = p.L_0 * (x_a * di_a + x_b * di_b) / x2
        turned = p.T_s * st.pll_omega
        off_a = moved_a - p.L_q * di_a - salient * x_a + turned * x_b
        off_b = moved_b - p.L_q * di_b - salient * x_b - turned * x_a
        drawn2 = p.L_q * p.L_q * (di_a * di_a + di_b * di_b)
        usual2 = (_SHARE * _SHARE * (drawn2 + moved_a * moved_a + moved_b * moved_b + turned * turned * x2)
                  + 2.0 * (4.0 * p.L_q * p.noise) ** 2)
        off2 = off_a * off_a + off_b * off_b
        if usual2 < off2 < _HUGE:
            # That it is a straight line shows at the second of its steps.
            share = 2.0 if first else 1.0
            st.off_a += share * off_a
            st.off_b += share * off_b
            return float(max(st.off_a * st.off_a + st.off_b * st.off_b - before2, 0.0))
    st.off_a = 0.0
    st.off_b = 0.0
    return 0.0
