"""Lemma 1: a linear regression y = Phi^T x + d for the active flux x, from sampled i and v alone.

With F = alpha/(p + alpha) and H = alpha p/(p + alpha) = alpha (1 - F):

    Omega_1 = F[v - R i] - L_q H[i]
    Omega_2 = Omega_1 - L_0 H[i]
    Phi     = Omega_1 + Omega_2
    y       = L_0 F[i]^T Omega_1 + |Omega_1|^2 / alpha + 1/(p + alpha) [Omega_2^T Omega_1]

No derivative of i is taken: H[i] = alpha (i - F[i]).

Sample k carries i at t_k and the mean voltage over the interval that ended at t_k, so
lambda_k - lambda_(k-1) = T_s (v_k - R (i_(k-1) + i_k)/2) up to the curvature of i: second order in T_s.

Clean start.  The filters start as if the machine had stood with the first sample's current for ever:
F[i] = i_0, F[v - R i] = 0, product filter 0.  For that fictitious past H[x] = H[i] = H[i_d] = 0, Lemma 1
holds exactly, and its exponentially decaying term epsilon_t is zero from the first sample on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation import timing
from ipmsm_can.estimation.filters import filter_coefficients
from ipmsm_can.motor import Motor

PARAMETERS = np.dtype([
    ("T_s", "f8"), ("R", "f8"), ("L_q", "f8"), ("L_0", "f8"),
    ("alpha", "f8"), ("decay", "f8"), ("previous", "f8"), ("present", "f8"),
])

STATE = np.dtype([
    ("started", "i8"),
    ("i_a", "f8"), ("i_b", "f8"),
    ("fe_a", "f8"), ("fe_b", "f8"),
    ("fi_a", "f8"), ("fi_b", "f8"),
    ("product", "f8"), ("f_product", "f8"),
    # What sets the samples right before they come here; it starts anew with the filters.
    ("timing", timing.STATE),
])

# Rows of the array that the regression hands to an observer.
Y, PHI_A, PHI_B, DL_A, DL_B, HI_A, HI_B = range(7)
ROWS = 7


def parameters(motor: Motor, alpha: float, sample_rate: float) -> NDArray[np.void]:
    """Record array (1,) of PARAMETERS for alpha [1/s] and sample_rate [Hz]."""
    f = filter_coefficients(alpha, 1.0 / sample_rate)
    p = np.zeros(1, PARAMETERS)
    p[0] = (1.0 / sample_rate, motor.R, motor.L_q, motor.L_0, alpha, f.decay, f.previous, f.present)
    return p


@kernel
def regression_block(samples: NDArray[np.float64], parameters: NDArray[np.void], state: NDArray[np.void],
                     out: NDArray[np.float64]) -> None:
    """Run Lemma 1 over a block.

    samples: float64 (4, N): i_alpha, i_beta [A peak], v_alpha, v_beta [V peak, mean of the interval].
    parameters, state: record arrays (1,) of PARAMETERS and STATE; the state is updated in place.
    out: float64 (7, N): y [V Wb], Phi [V], lambda increment [Wb], H[i] [A/s].
    """
    p = parameters[0]
    T_s = p.T_s
    R = p.R
    L_q = p.L_q
    L_0 = p.L_0
    alpha = p.alpha
    decay = p.decay
    previous = p.previous
    present = p.present
    held = 1.0 - decay
    s = state[0]
    i_a = s.i_a
    i_b = s.i_b
    fe_a = s.fe_a
    fe_b = s.fe_b
    fi_a = s.fi_a
    fi_b = s.fi_b
    product = s.product
    f_product = s.f_product
    started = s.started
    for k in range(samples.shape[1]):
        new_a = samples[0, k]
        new_b = samples[1, k]
        if started:
            e_a = samples[2, k] - 0.5 * R * (i_a + new_a)
            e_b = samples[3, k] - 0.5 * R * (i_b + new_b)
            fe_a = decay * fe_a + held * e_a
            fe_b = decay * fe_b + held * e_b
            fi_a = decay * fi_a + previous * i_a + present * new_a
            fi_b = decay * fi_b + previous * i_b + present * new_b
        else:
            started = 1
            e_a = 0.0
            e_b = 0.0
            fe_a = 0.0
            fe_b = 0.0
            fi_a = new_a
            fi_b = new_b
            product = 0.0
            f_product = 0.0
        i_a = new_a
        i_b = new_b
        h_a = alpha * (i_a - fi_a)
        h_b = alpha * (i_b - fi_b)
        om1_a = fe_a - L_q * h_a
        om1_b = fe_b - L_q * h_b
        om2_a = om1_a - L_0 * h_a
        om2_b = om1_b - L_0 * h_b
        new_product = om2_a * om1_a + om2_b * om1_b
        f_product = decay * f_product + previous * product + present * new_product
        product = new_product
        out[0, k] = (L_0 * (fi_a * om1_a + fi_b * om1_b)
                     + (om1_a * om1_a + om1_b * om1_b + f_product) / alpha)
        out[1, k] = om1_a + om2_a
        out[2, k] = om1_b + om2_b
        out[3, k] = T_s * e_a
        out[4, k] = T_s * e_b
        out[5, k] = h_a
        out[6, k] = h_b
    s.i_a = i_a
    s.i_b = i_b
    s.fe_a = fe_a
    s.fe_b = fe_b
    s.fi_a = fi_a
    s.fi_b = fi_b
    s.product = product
    s.f_product = f_product
    s.started = started
