"""Field-oriented control of speed, torque and current, as a production drive would do it.

The step at t_k takes the current sampled at t_k and gives the voltage for the *next* control period,
t_(k+1) to t_(k+2).  That voltage is constant in the stationary frame, so it is turned by the angle the
rotor will have in the middle of that period: theta_e + 1.5 omega_e Ts.

Angle and speed are arguments, not read from the machine: an encoder or an estimate may give them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.drive.inverter import limit_voltage
from ipmsm_can.motor import Motor

# Control parameters, float64 (C_SIZE,)
C_PERIOD = 0  # s
C_POLE_PAIRS = 1
C_PSI = 2  # Wb
C_L_D = 3  # H
C_L_Q = 4  # H
C_KP_D = 5  # V/A
C_KP_Q = 6  # V/A
C_KI_D = 7  # V/(A s)
C_KI_Q = 8  # V/(A s)
C_KP_SPEED = 9  # N m s/rad mechanical
C_KI_SPEED = 10  # N m/rad mechanical
C_TORQUE_MAX = 11  # N m
C_V_MAX = 12  # V peak
C_MTPA = 13  # 1: maximum torque per ampere, 0: i_d = 0
C_SIZE = 14

# Control state, float64 (S_SIZE,): the integrators
S_V_D = 0  # V
S_V_Q = 1  # V
S_TORQUE = 2  # N m
S_SIZE = 3

_SLOWEST_INTEGRATOR = 0.1
"""Share of the current bandwidth below which the integrator's corner never falls: R/L, the corner that
cancels the winding's pole, is far too slow (zero without resistance) to take off a disturbance."""


@kernel
def _mtpa_root(i_q: float, psi_m: float, L_0: float) -> float:
    return math.sqrt(psi_m * psi_m + 4.0 * L_0 * L_0 * i_q * i_q)


@kernel
def mtpa_i_d(i_q: float, psi_m: float, L_0: float) -> float:
    """d-axis current [A] that gives the most torque per ampere at i_q [A]; 0 for L_0 = L_d - L_q = 0.

    Solves psi_m i_d + L_0 (i_d^2 - i_q^2) = 0, in the form that does not divide by L_0.
    """
    return 2.0 * L_0 * i_q * i_q / (psi_m + _mtpa_root(i_q, psi_m, L_0))


@kernel
def current_reference(
    torque: float, pole_pairs: float, psi_m: float, L_0: float, mtpa: bool
) -> tuple[float, float]:
    """(i_d, i_q) [A peak] for a torque [N m]: i_d = 0, or exactly on the maximum-torque-per-ampere line.

    On that line T = 0.75 p i_q (psi_m + sqrt(psi_m^2 + 4 L_0^2 i_q^2)), convex in |i_q|; Newton's method
    from the value at i_d = 0, which is never too small, therefore closes in from one side.
    """
    i_q = torque / (1.5 * pole_pairs * psi_m)
    if not mtpa or L_0 == 0.0:
        return 0.0, i_q
    wanted = torque / (0.75 * pole_pairs)
    for _ in range(20):
        root = _mtpa_root(i_q, psi_m, L_0)
        slope = psi_m + root + 4.0 * L_0 * L_0 * i_q * i_q / root
        change = (i_q * (psi_m + root) - wanted) / slope
        i_q -= change
        if abs(change) <= 1e-12 * abs(i_q):
            break
    return mtpa_i_d(i_q, psi_m, L_0), i_q


def pack_control(
    motor: Motor,
    period: float,
    current_bandwidth: float,
    speed_bandwidth: float,
    torque_max: float,
    v_max: float,
    mtpa: bool,
) -> NDArray[np.float64]:
    """Control parameters as the kernel takes them, with the gains of the asked bandwidths.

    The current loop is tuned to a_c = 2 pi current_bandwidth (Kp = a_c L), the speed loop to
    a_s = 2 pi speed_bandwidth with its integrator's corner a quarter of that (Kp = a_s J).
    """
    a_c = 2.0 * math.pi * current_bandwidth
    a_s = 2.0 * math.pi * speed_bandwidth
    c = np.zeros(C_SIZE)
    c[C_PERIOD] = period
    c[C_POLE_PAIRS] = motor.pole_pairs
    c[C_PSI] = motor.psi_m
    c[C_L_D] = motor.L_d
    c[C_L_Q] = motor.L_q
    c[C_KP_D] = a_c * motor.L_d
    c[C_KP_Q] = a_c * motor.L_q
    c[C_KI_D] = a_c * max(motor.R, _SLOWEST_INTEGRATOR * a_c * motor.L_d)
    c[C_KI_Q] = a_c * max(motor.R, _SLOWEST_INTEGRATOR * a_c * motor.L_q)
    c[C_KP_SPEED] = a_s * motor.J
    c[C_KI_SPEED] = 0.25 * a_s * a_s * motor.J
    c[C_TORQUE_MAX] = torque_max
    c[C_V_MAX] = v_max
    c[C_MTPA] = float(mtpa)
    return c


@kernel
def speed_step(
    s: NDArray[np.float64], c: NDArray[np.float64], omega_m: float, omega_reference: float
) -> float:
    """Torque reference [N m] of the speed loop, within the torque limit; speeds in rad/s mechanical."""
    error = omega_reference - omega_m
    wanted = c[C_KP_SPEED] * error + s[S_TORQUE]
    torque = max(-c[C_TORQUE_MAX], min(c[C_TORQUE_MAX], wanted))
    s[S_TORQUE] += c[C_PERIOD] * c[C_KI_SPEED] * (error + (torque - wanted) / c[C_KP_SPEED])
    return float(torque)


@kernel
def current_step(
    s: NDArray[np.float64],
    c: NDArray[np.float64],
    i_alpha: float,
    i_beta: float,
    theta_e: float,
    omega_e: float,
    torque: float,
    v_inj_alpha: float,
    v_inj_beta: float,
) -> tuple[float, float]:
    """`regulate_current` for a torque reference [N m], within the torque limit."""
    limited = max(-c[C_TORQUE_MAX], min(c[C_TORQUE_MAX], torque))
    ref_d, ref_q = current_reference(
        limited, c[C_POLE_PAIRS], c[C_PSI], c[C_L_D] - c[C_L_Q], c[C_MTPA] != 0.0
    )
    return regulate_current(s, c, i_alpha, i_beta, theta_e, omega_e, ref_d, ref_q, v_inj_alpha, v_inj_beta)


@kernel
def regulate_current(
    s: NDArray[np.float64],
    c: NDArray[np.float64],
    i_alpha: float,
    i_beta: float,
    theta_e: float,
    omega_e: float,
    ref_d: float,
    ref_q: float,
    v_inj_alpha: float,
    v_inj_beta: float,
) -> tuple[float, float]:
    """Commanded voltage (alpha, beta) [V] for the next control period, within the voltage limit.

    i_alpha, i_beta: sampled current [A].  theta_e [rad], omega_e [rad/s]: electrical angle and speed at
    the instant of the sample.  ref_d, ref_q: current reference [A peak].  v_inj: probing voltage, added before
    the limit.
    """
    cos_k = math.cos(theta_e)
    sin_k = math.sin(theta_e)
    i_d = cos_k * i_alpha + sin_k * i_beta
    i_q = cos_k * i_beta - sin_k * i_alpha
    e_d = ref_d - i_d
    e_q = ref_q - i_q
    v_d = c[C_KP_D] * e_d + s[S_V_D] - omega_e * c[C_L_Q] * i_q
    v_q = c[C_KP_Q] * e_q + s[S_V_Q] + omega_e * (c[C_L_D] * i_d + c[C_PSI])

    theta_v = theta_e + 1.5 * omega_e * c[C_PERIOD]
    cos_v = math.cos(theta_v)
    sin_v = math.sin(theta_v)
    want_alpha = cos_v * v_d - sin_v * v_q + v_inj_alpha
    want_beta = sin_v * v_d + cos_v * v_q + v_inj_beta
    v_alpha, v_beta = limit_voltage(want_alpha, want_beta, c[C_V_MAX])

    # Anti-windup: what the limit took away counts as a smaller error (back-calculation, gain 1/Kp).
    cut_d = cos_v * (v_alpha - want_alpha) + sin_v * (v_beta - want_beta)
    cut_q = cos_v * (v_beta - want_beta) - sin_v * (v_alpha - want_alpha)
    s[S_V_D] += c[C_PERIOD] * c[C_KI_D] * (e_d + cut_d / c[C_KP_D])
    s[S_V_Q] += c[C_PERIOD] * c[C_KI_Q] * (e_q + cut_q / c[C_KP_Q])
    return v_alpha, v_beta
