"""Gradient search on a regression without a disturbance: kinds `spmsm_regression` and `active_flux_regression`.

    lambda_hat' = v - R i + gamma Phi (y - Phi^T x_hat),      x_hat = lambda_hat - L i

`spmsm_regression` (the paper's BOBetal, after Bobtsov et al. 2015: a linear regression of the flux made by
filtering, for surface-magnet machines).  It is Lemma 1 with L_0 = 0 and L = L_s: then d = 0 identically,
Phi = 2 Omega, y = |Omega|^2/alpha + 1/(p + alpha)[|Omega|^2], Omega = F[v - R i] - L_s H[i].  Reconstructed from
the paper, which only says that the procedure of BOBetal applied to the active flux gives Lemma 1.  Needs
rotation.  On a machine with L_d != L_q it finds the angle of lambda - L_s i, which is off by
atan((L_0/2) i_q / (psi_m + (L_0/2) i_d)) rad, opposite in sign to L_0 i_q.

`active_flux_regression` (the paper's CHOetaltie): Lemma 1 of the salient machine with L = L_q, the disturbance
d = -l H[i_d] neglected.  In a steady state H[i_d] = 0 and nothing is lost; whenever i_d changes, and while a
probing signal runs, d acts as an error of up to |l| |H[i]|.  At standstill y - Phi^T x = d, all of the
information is in what it neglects: it settles where y = Phi^T x_hat, not at the rotor.  Quoted from the paper's
introduction; the gains and filters of CHOetaltie itself were not at hand.

gamma [1/(V^2 s)].  Discretisation as in `ges`: the correction is integrated exactly along Phi, half of it with
the Phi of either end of the interval: bounded for any gamma, second order in T_s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel


@kernel
def linear_regression_block(samples: NDArray[np.float64], regression: NDArray[np.float64],
                            parameters: NDArray[np.void], state: NDArray[np.void],
                            out: NDArray[np.float64]) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`."""
    p = parameters[0]
    L = p.L_q
    half = 0.5 * p.gamma * p.T_s
    st = state[0]
    l_a = st.lambda_a
    l_b = st.lambda_b
    kick_a = st.kick_a
    kick_b = st.kick_b
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        # The first sample's increment is zero, and so is the kick before it.
        l_a += kick_a + regression[3, k]
        l_b += kick_b + regression[4, k]
        innovation = regression[0, k] - (phi_a * (l_a - L * i_a) + phi_b * (l_b - L * i_b))
        size2 = phi_a * phi_a + phi_b * phi_b
        z = half * size2
        if z > 1e-12:
            shrink = math.expm1(-z)
            gain = -shrink / size2
        else:
            shrink = -z
            gain = half
        c = gain * innovation
        l_a += c * phi_a
        l_b += c * phi_b
        c *= 1.0 + shrink
        kick_a = c * phi_a
        kick_b = c * phi_b
        out[0, k] = l_a
        out[1, k] = l_b
        out[2, k] = l_a - L * i_a
        out[3, k] = l_b - L * i_b
        out[4, k] = innovation
        out[5, k] = gain * (2.0 + shrink)
    st.lambda_a = l_a
    st.lambda_b = l_b
    st.kick_a = kick_a
    st.kick_b = kick_b
    if samples.shape[1] > 0:
        st.x_a = out[2, samples.shape[1] - 1]
        st.x_b = out[3, samples.shape[1] - 1]
