"""Gradient search on the length of the flux: kinds `spmsm_gradient` and `spmsm_gradient_max`.

    lambda_hat' = v - R i - gamma e x_hat,      x_hat = lambda_hat - L_s i,      theta_hat = atan2(x_hat)
    e = |x_hat|^2 - psi_m^2              `spmsm_gradient`      (equation obsort)
    e = max{0, |x_hat|^2 - psi_m^2}      `spmsm_gradient_max`  (converges from everywhere)

gamma [1/(Wb^2 s)].  Both quoted from the paper, Section 2: ORTetalcst (Ortega, Praly, Astolfi, Lee, Nam 2011,
"Estimation of rotor position and speed of permanent magnet synchronous motors with guaranteed stability") and
MALetal.  Needs a machine with L_d = L_q, and rotation; no filter, no alpha.  Linearised, the error obeys
s^2 + k s + w^2 = 0 with k = 2 gamma psi_m^2; the max variant corrects only while the estimate is too long, half
of the time.  On a salient machine |lambda - L_s i| is not psi_m: the length is off by (L_0/2) i_d, which the
slow pole amplifies to k/w times that across the axis, and the direction is off by (L_0/2) i_q besides.

Discretisation.  With i held the correction keeps the direction of x_hat, and rho = |x_hat|^2 follows the logistic
equation rho' = 2 gamma (psi_m^2 - rho) rho, whose solution over h scales x_hat by
psi_m / sqrt(rho + (psi_m^2 - rho) exp(-2 gamma psi_m^2 h)): exact, bounded for any gamma, and never across
psi_m, so that max{0, .} needs a decision only at the start.  Half of it at either end of the interval (Strang
splitting): second order in T_s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.kinds import SPMSM_GRADIENT_MAX


@kernel
def _scale(rho: float, psi2: float, rest: float, only_longer: bool) -> float:
    """Factor on x_hat over a time h; rho = |x_hat|^2, psi2 = psi_m^2 [Wb^2], rest = exp(-2 gamma psi2 h)."""
    if rho < 1e-18 * psi2 or (only_longer and rho <= psi2):
        return 1.0  # a point has no direction to grow in
    return math.sqrt(psi2 / (rho * (1.0 - rest) + psi2 * rest))


@kernel
def spmsm_gradient_block(samples: NDArray[np.float64], regression: NDArray[np.float64],
                         parameters: NDArray[np.void], state: NDArray[np.void],
                         out: NDArray[np.float64]) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`.

    out row 4: |Phi| (psi_m - |x_hat|) before the correction; row 5: what the linearised correction is as a gain
    along 2 alpha psi_m x_hat/|x_hat|, the regressor that Lemma 1 has at high speed; 0 where max{0, .} is 0.
    """
    p = parameters[0]
    L = p.L_q
    psi_m = p.psi_m
    psi2 = psi_m * psi_m
    only_longer = p.kind == SPMSM_GRADIENT_MAX
    rest = math.exp(-p.gamma * psi2 * p.T_s)
    gain = (1.0 - rest * rest) / (4.0 * p.alpha * p.alpha * psi2)
    st = state[0]
    l_a = st.lambda_a
    l_b = st.lambda_b
    kick_a = st.kick_a
    kick_b = st.kick_b
    started = st.started
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        # The first sample's increment is zero, and so is the kick before it.
        x_a = l_a + kick_a + regression[3, k] - L * i_a
        x_b = l_b + kick_b + regression[4, k] - L * i_b
        rho = x_a * x_a + x_b * x_b
        phi = math.sqrt(regression[1, k] * regression[1, k] + regression[2, k] * regression[2, k])
        out[4, k] = phi * (psi_m - math.sqrt(rho))
        out[5, k] = 0.0 if only_longer and rho <= psi2 else gain
        # No interval has ended at the first sample: only the one that begins gets its half.
        m = _scale(rho, psi2, rest, only_longer) if started else 1.0
        started = 1
        x_a *= m
        x_b *= m
        l_a = x_a + L * i_a
        l_b = x_b + L * i_b
        m = _scale(m * m * rho, psi2, rest, only_longer) - 1.0
        kick_a = m * x_a
        kick_b = m * x_b
        out[0, k] = l_a
        out[1, k] = l_b
        out[2, k] = x_a
        out[3, k] = x_b
    st.lambda_a = l_a
    st.lambda_b = l_b
    st.kick_a = kick_a
    st.kick_b = kick_b
    st.started = started
    if samples.shape[1] > 0:
        st.x_a = out[2, samples.shape[1] - 1]
        st.x_b = out[3, samples.shape[1] - 1]
