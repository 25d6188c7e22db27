"""The observer with Lambda of the paper's concluding remarks (equation newobs): kind `chonam`.

    lambda_hat' = v - R i + gamma (Phi + Lambda) (y - Phi^T x_hat - d_hat),      x_hat = lambda_hat - L_q i
    d_hat  = -l H[i^T sigma(x_hat)],      Lambda = -l H[u],      H = alpha p/(p + alpha),      l = psi_m L_0
    u      = (|x_hat|^2 I - x_hat x_hat^T) i / |x_hat|^3 = (c_q^T i) c_q / |x_hat|,  0 where |x_hat| < epsilon

c_q is the unit vector across x_hat: u is the gradient of i^T x_hat/|x_hat|.  Quoted from the paper, which takes it
from CHONAM (Choi, Nam et al.): for small alpha, -2 (Phi + Lambda)(y - ...) is the gradient of the squared
residual, so this is the true gradient search; the paper prints it without the factor -2.  gamma [1/(V^2 s)].
Needs rotation, or saliency and a probing signal, as `ges` does; beside a turning Phi, Lambda is small, about
L_0 i_q/(2 psi_m) of it.

Discretisation as in `ges`: half a correction at either end of the interval, along Phi + Lambda of the corrected
state, the closing half by one fixed-point iteration; second order in T_s.  Along that direction the residual
changes at the rate gamma Phi^T (Phi + Lambda) and, through d_hat, by what is left to the iteration.  Neither is
certain to be positive while Phi is no longer than Lambda; there the step is limited to what the iteration
bears, so that no gain makes it diverge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.common import along

_LARGEST_STEP = 0.5
"""Share of the residual that a correction may change through d_hat or against the gradient."""


@kernel
def _across(i_a: float, i_b: float, x_a: float, x_b: float, epsilon: float) -> tuple[float, float]:
    """u: the gradient of i^T x/|x| [A/Wb]."""
    size2 = x_a * x_a + x_b * x_b
    if size2 < epsilon * epsilon:
        return 0.0, 0.0
    # i^T c_q / |x|^2, times x turned by a right angle
    share = (x_a * i_b - x_b * i_a) / (size2 * math.sqrt(size2))
    return -share * x_b, share * x_a


@kernel
def chonam_block(samples: NDArray[np.float64], regression: NDArray[np.float64], parameters: NDArray[np.void],
                 state: NDArray[np.void], out: NDArray[np.float64]) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`.

    out row 5: the gain along Phi + Lambda.
    """
    p = parameters[0]
    L_q = p.L_q
    ell_alpha = p.ell * p.alpha
    half = 0.5 * p.gamma * p.T_s
    epsilon = p.epsilon
    decay = p.decay
    previous = p.previous
    present = p.present
    st = state[0]
    l_a = st.lambda_a
    l_b = st.lambda_b
    kick_a = st.kick_a
    kick_b = st.kick_b
    s = st.s
    f_s = st.f_s
    u_a = st.u_a
    u_b = st.u_b
    f_u_a = st.f_u_a
    f_u_b = st.f_u_b
    started = st.started
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        if started:
            l_a += kick_a + regression[3, k]
            l_b += kick_b + regression[4, k]
        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        s_new = along(i_a, i_b, x_a, x_b, epsilon)
        new_a, new_b = _across(i_a, i_b, x_a, x_b, epsilon)
        if started:
            open_s = decay * f_s + previous * s
            open_a = decay * f_u_a + previous * u_a
            open_b = decay * f_u_b + previous * u_b
        else:
            # The same fictitious past as the regression's: H[.] = 0 at the first sample.
            started = 1
            open_s = (1.0 - present) * s_new
            open_a = (1.0 - present) * new_a
            open_b = (1.0 - present) * new_b
        residual = regression[0, k] - (phi_a * x_a + phi_b * x_b)
        innovation = residual + ell_alpha * (s_new - (open_s + present * s_new))
        s = s_new
        u_a = new_a
        u_b = new_b
        # First with u and d of the state before the correction, then with those of the state it leads to.
        c = 0.0
        shrink = 0.0
        gain = half
        d_a = 0.0
        d_b = 0.0
        for turn in range(2):
            if turn > 0:
                to_a = x_a + c * d_a
                to_b = x_b + c * d_b
                s = along(i_a, i_b, to_a, to_b, epsilon)
                u_a, u_b = _across(i_a, i_b, to_a, to_b, epsilon)
            d_a = phi_a - ell_alpha * (u_a - (open_a + present * u_a))
            d_b = phi_b - ell_alpha * (u_b - (open_b + present * u_b))
            slope = phi_a * d_a + phi_b * d_b
            z = max(half * slope, -_LARGEST_STEP)
            shrink = math.expm1(-z)
            gain = -shrink / slope if abs(z) > 1e-12 else half
            through_d = abs(ell_alpha * (u_a * d_a + u_b * d_b))
            if gain * through_d > _LARGEST_STEP:
                gain = _LARGEST_STEP / through_d
                shrink = -gain * slope
            c = gain * (residual + ell_alpha * (s - (open_s + present * s)))
        f_s = open_s + present * s
        f_u_a = open_a + present * u_a
        f_u_b = open_b + present * u_b
        l_a += c * d_a
        l_b += c * d_b
        # The opening half of the next interval starts from what this half left of the residual.
        c *= 1.0 + shrink
        kick_a = c * d_a
        kick_b = c * d_b
        out[0, k] = l_a
        out[1, k] = l_b
        out[2, k] = l_a - L_q * i_a
        out[3, k] = l_b - L_q * i_b
        out[4, k] = innovation
        out[5, k] = gain * (2.0 + shrink)
    st.lambda_a = l_a
    st.lambda_b = l_b
    st.kick_a = kick_a
    st.kick_b = kick_b
    st.s = s
    st.f_s = f_s
    st.u_a = u_a
    st.u_b = u_b
    st.f_u_a = f_u_a
    st.f_u_b = f_u_b
    st.started = started
    if samples.shape[1] > 0:
        st.x_a = out[2, samples.shape[1] - 1]
        st.x_b = out[3, samples.shape[1] - 1]
