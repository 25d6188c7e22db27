"""The paper's observer (Proposition 1): gradient search along Phi with the estimated disturbance d.

    lambda_hat' = v - R i + gamma Phi (y - Phi^T x_hat + l H[i^T sigma(x_hat)])
    x_hat       = lambda_hat - L_q i,      theta_hat = atan2(x_hat_2, x_hat_1),      l = psi_m L_0
    sigma(x)    = x/|x| where |x| >= epsilon, else 0

Discretisation.  lambda advances exactly by the regression's increment.  The correction acts only along
Phi, where it is linear, so it is integrated exactly: over a time h the residual falls by
exp(-gamma |Phi|^2 h).  Explicit Euler would need gamma |Phi|^2 T_s < 2 and diverges at the paper's own
gains and sample rate; this cannot diverge for any gamma.  Each interval gets half a correction with the
Phi of its beginning and half with the Phi of its end (Strang splitting), which makes the whole second
order in T_s.  The disturbance estimate depends on x_hat itself without delay; in the closing half it is
evaluated after the correction, by one fixed-point iteration, to keep the pair symmetric.

Scheduled gain.  gamma |Phi|^2 = 2 |omega| puts both poles of the rotating error dynamics at -|omega|, the fastest
there is: gamma = 2 |omega|/(|Phi|^2 + eps).  omega is that of a loop as in `speed`, up to the sample before; until
that has pulled in, half the speed that the length of Phi belongs to counts if it is larger.

Needs rotation, or saliency and a probing signal (Assumption 3); gamma [1/(V^2 s)].  Quoted from the paper.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.common import GAIN as GAIN
from ipmsm_can.estimation.observers.common import INNOVATION as INNOVATION
from ipmsm_can.estimation.observers.common import LAMBDA_A as LAMBDA_A
from ipmsm_can.estimation.observers.common import LAMBDA_B as LAMBDA_B
from ipmsm_can.estimation.observers.common import ROWS as ROWS
from ipmsm_can.estimation.observers.common import X_A as X_A
from ipmsm_can.estimation.observers.common import X_B as X_B
from ipmsm_can.estimation.observers.common import along
from ipmsm_can.estimation.speed import follow

_SLOWEST = 1.0
"""Speed [rad/s electrical] whose |Phi| keeps the scheduled gain finite at standstill."""


@kernel
def _turning(size2: float, alpha: float, psi_m: float) -> float:
    """Half the speed [rad/s electrical] at which |Phi|^2 is size2: for the time until the loop has pulled in."""
    share2 = min(size2 / (2.0 * alpha * psi_m) ** 2, 0.99)
    return 0.5 * alpha * math.sqrt(share2 / (1.0 - share2))


@kernel
def ges_block(samples: NDArray[np.float64], regression: NDArray[np.float64], parameters: NDArray[np.void],
              state: NDArray[np.void], out: NDArray[np.float64]) -> None:
    """Run the observer over a block.

    samples: float64 (4, N) as for the regression; only the currents are read.
    regression: float64 (7, N) from `regression_block`.
    parameters, state: record arrays (1,) of `common`; `lambda_a/b` holds the initial flux before the first sample.
    out: float64 (7, N), six rows of it: lambda_hat [Wb], x_hat [Wb], innovation y - Phi^T x_hat - d_hat before the
    correction [V Wb], and the total correction gain of the interval (1 - exp(-gamma |Phi|^2 T_s)) / |Phi|^2 [1/V^2].
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
    x_a = st.x_a
    x_b = st.x_b
    started = st.started
    shortest2 = (2.0 * p.psi_m * _SLOWEST) ** 2
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        y = regression[0, k]
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        if started:
            l_a += kick_a + regression[3, k]
            l_b += kick_b + regression[4, k]
        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        s_new = along(i_a, i_b, x_a, x_b, epsilon)
        if started:
            f_open = decay * f_s + previous * s
        else:
            # The same fictitious past as the regression's: H[i^T sigma] = 0 at the first sample.
            started = 1
            f_open = (1.0 - present) * s_new
        size2 = phi_a * phi_a + phi_b * phi_b
        if p.scheduled:
            half = p.T_s * max(abs(st.pll_omega), _turning(size2, p.alpha, p.psi_m)) / (size2 + shortest2)
        z = half * size2
        if z > 1e-12:
            shrink = math.expm1(-z)
            gain = -shrink / size2
        else:
            shrink = -z
            gain = half
        open_residual = y - (phi_a * x_a + phi_b * x_b)
        innovation = open_residual + ell_alpha * (s_new - (f_open + present * s_new))
        c = gain * innovation
        s = along(i_a, i_b, x_a + c * phi_a, x_b + c * phi_b, epsilon)
        f_s = f_open + present * s
        residual = open_residual + ell_alpha * (s - f_s)
        c = gain * residual
        l_a += c * phi_a
        l_b += c * phi_b
        # The opening half of the next interval starts from what this half left of the residual.
        c *= 1.0 + shrink
        kick_a = c * phi_a
        kick_b = c * phi_b
        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        if p.scheduled:
            angle = math.atan2(x_b, x_a)
            st.pll_theta, st.pll_omega, st.pll_difference = follow(
                angle, x_a * x_a + x_b * x_b < epsilon * epsilon, st.pll_started, st.pll_hat, st.pll_theta,
                st.pll_omega, st.pll_difference, p.T_s, p.pole)
            st.pll_started = 1
            st.pll_hat = angle
        out[0, k] = l_a
        out[1, k] = l_b
        out[2, k] = x_a
        out[3, k] = x_b
        out[4, k] = innovation
        out[5, k] = gain * (2.0 + shrink)
    st.lambda_a = l_a
    st.lambda_b = l_b
    st.kick_a = kick_a
    st.kick_b = kick_b
    st.s = s
    st.f_s = f_s
    st.x_a = x_a
    st.x_b = x_b
    st.started = started
