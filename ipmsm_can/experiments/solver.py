"""The paper's observer as a plain explicit Euler integration of its equations, to see what a solver's step does.

Not for use: it exists to tell what belongs to the observer from what belongs to its discretisation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]


@kernel
def _euler(samples: Floats, T_s: float, R: float, L_q: float, L_0: float, psi_m: float, alpha: float,
           gamma: float, start_a: float, start_b: float, theta: Floats) -> None:
    l_a, l_b = start_a, start_b
    fi_a, fi_b = samples[0, 0], samples[1, 0]
    fe_a, fe_b = 0.0, 0.0
    f_product = 0.0
    f_s = 0.0
    first = True
    for k in range(samples.shape[1] - 1):
        i_a, i_b = samples[0, k], samples[1, k]
        e_a = samples[2, k + 1] - R * i_a
        e_b = samples[3, k + 1] - R * i_b
        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        theta[k] = math.atan2(x_b, x_a)
        size = math.hypot(x_a, x_b)
        s = (i_a * x_a + i_b * x_b) / size if size > 0.0 else 0.0
        if first:
            f_s = s
            first = False
        h_a = alpha * (i_a - fi_a)
        h_b = alpha * (i_b - fi_b)
        om1_a = fe_a - L_q * h_a
        om1_b = fe_b - L_q * h_b
        om2_a = om1_a - L_0 * h_a
        om2_b = om1_b - L_0 * h_b
        y = L_0 * (fi_a * om1_a + fi_b * om1_b) + (om1_a * om1_a + om1_b * om1_b) / alpha + f_product
        phi_a = om1_a + om2_a
        phi_b = om1_b + om2_b
        r = y - phi_a * x_a - phi_b * x_b + psi_m * L_0 * alpha * (s - f_s)
        l_a += T_s * (e_a + gamma * phi_a * r)
        l_b += T_s * (e_b + gamma * phi_b * r)
        fe_a += T_s * alpha * (e_a - fe_a)
        fe_b += T_s * alpha * (e_b - fe_b)
        f_product += T_s * (om2_a * om1_a + om2_b * om1_b - alpha * f_product)
        f_s += T_s * alpha * (s - f_s)
        fi_a += T_s * alpha * (i_a - fi_a)
        fi_b += T_s * alpha * (i_b - fi_b)
    theta[-1] = theta[-2]


def euler_angle(motor: Motor, samples: Floats, sample_rate: float, alpha: float, gamma: float,
                start: tuple[float, float]) -> Floats:
    """Angle [rad electrical] (N,) of explicit Euler with one step a sample; NaN after it has diverged.

    samples: float64 (4, N): i_alpha, i_beta [A], mean voltage of the interval that ended [V].  alpha [1/s],
    gamma [1/(V^2 s)], start: initial flux [Wb, Wb].
    """
    theta = np.empty(samples.shape[1])
    _euler(np.ascontiguousarray(samples), 1.0 / sample_rate, motor.R, motor.L_q, motor.L_0, motor.psi_m, alpha,
           gamma, start[0], start[1], theta)
    return theta
