"""The simulated machine: stator flux, shaft and their exact-in-the-limit integration.

States are the stator flux in the stationary frame and the shaft, as in the paper (Section 2):

    lambda' = v - R i,          i of lambda and theta_e as in `magnetics`, linear or saturating
    J omega_m' = T - T_load - B omega_m,      theta_m' = omega_m,      theta_e = p theta_m
    T = 1.5 p (lambda_alpha i_beta - lambda_beta i_alpha)

With flux as the state the voltage integral has no inductance derivative in it, whatever the flux map.
Integrated with classical Runge-Kutta (RK4); the commanded voltage is constant in the stationary frame
during a control period.  Peak, amplitude-invariant quantities throughout.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.drive.inverter import dead_time_error
from ipmsm_can.drive.magnetics import M_L_D as M_L_D
from ipmsm_can.drive.magnetics import M_L_Q as M_L_Q
from ipmsm_can.drive.magnetics import M_PSI as M_PSI
from ipmsm_can.drive.magnetics import current_from_flux, saturation_parameters
from ipmsm_can.motor import Motor

# Machine parameters, float64 (M_SIZE,)
M_POLE_PAIRS = 0
M_R = 4
M_INERTIA = 5
M_FRICTION = 6
M_SIZE = 10

# Machine state, float64 (X_SIZE,): flux [Wb], speed [rad/s mechanical], angle [rad mechanical]
X_LAMBDA_ALPHA = 0
X_LAMBDA_BETA = 1
X_OMEGA_M = 2
X_THETA_M = 3
X_SIZE = 4

_TWO_PI = 2.0 * math.pi


def pack_machine(motor: Motor, friction: float = 0.0, saturation: float = 0.0) -> NDArray[np.float64]:
    """Machine parameters as the kernels take them.

    friction: viscous [N m s/rad mechanical].  saturation: share by which L_d falls at rated positive i_d, 0..0.5;
    raises ValueError as `magnetics.saturation_parameters`.
    """
    return np.array([motor.pole_pairs, motor.psi_m, motor.L_d, motor.L_q, motor.R, motor.J, friction,
                     *saturation_parameters(motor, saturation)])


def initial_state(motor: Motor, theta_e: float = 0.0, omega_m: float = 0.0) -> NDArray[np.float64]:
    """State with no current at the electrical angle theta_e [rad] and shaft speed omega_m [rad/s]."""
    flux = motor.psi_m * np.array([math.cos(theta_e), math.sin(theta_e)])
    return np.array([flux[0], flux[1], omega_m, wrap(theta_e) / motor.pole_pairs])


@kernel
def wrap(angle: float) -> float:
    """The same angle in -pi..pi [rad]."""
    # the quotient of an angle one rounding error below pi rounds to 1: never below -pi all the same
    return max(-math.pi, angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI))


@kernel
def stationary_current(
    lambda_alpha: float, lambda_beta: float, theta_e: float, machine: NDArray[np.float64]
) -> tuple[float, float]:
    """Current (i_alpha, i_beta) [A] of the stationary-frame flux [Wb] at the angle theta_e [rad]."""
    c = math.cos(theta_e)
    s = math.sin(theta_e)
    i_d, i_q = current_from_flux(
        c * lambda_alpha + s * lambda_beta, c * lambda_beta - s * lambda_alpha, machine
    )
    return c * i_d - s * i_q, s * i_d + c * i_q


@kernel
def air_gap_torque(
    lambda_alpha: float, lambda_beta: float, i_alpha: float, i_beta: float, machine: NDArray[np.float64]
) -> float:
    """Air-gap torque [N m]: 1.5 p (lambda x i)."""
    return float(1.5 * machine[M_POLE_PAIRS] * (lambda_alpha * i_beta - lambda_beta * i_alpha))


@kernel
def _derivative(
    lambda_alpha: float,
    lambda_beta: float,
    omega_m: float,
    theta_m: float,
    v_alpha: float,
    v_beta: float,
    load: float,
    dead_time_voltage: float,
    dead_time_zone: float,
    machine: NDArray[np.float64],
) -> tuple[float, float, float]:
    """(lambda_alpha', lambda_beta', omega_m') of the free shaft; theta_m' is omega_m itself."""
    i_alpha, i_beta = stationary_current(lambda_alpha, lambda_beta, machine[M_POLE_PAIRS] * theta_m, machine)
    if dead_time_voltage > 0.0:
        e_alpha, e_beta = dead_time_error(i_alpha, i_beta, dead_time_voltage, dead_time_zone)
        v_alpha += e_alpha
        v_beta += e_beta
    torque = air_gap_torque(lambda_alpha, lambda_beta, i_alpha, i_beta, machine)
    return (
        v_alpha - machine[M_R] * i_alpha,
        v_beta - machine[M_R] * i_beta,
        (torque - load - machine[M_FRICTION] * omega_m) / machine[M_INERTIA],
    )


@kernel
def advance(
    x: NDArray[np.float64],
    v_alpha: float,
    v_beta: float,
    load: float,
    period: float,
    substeps: int,
    free_shaft: bool,
    omega_end: float,
    dead_time_voltage: float,
    dead_time_zone: float,
    machine: NDArray[np.float64],
) -> None:
    """Advance the state x, in place, by one control period with the voltage held.

    v_alpha, v_beta: commanded voltage [V]; the dead-time error is taken off inside, from the current of
    the moment.  load: torque against positive speed [N m], held.  period [s], cut into `substeps` RK4
    steps.  free_shaft: inertia decides the speed; otherwise the speed runs in a straight line from its
    present value to omega_end [rad/s mechanical] (equal values: a rotor held at that speed).
    """
    h = period / substeps
    a = x[X_LAMBDA_ALPHA]
    b = x[X_LAMBDA_BETA]
    w = x[X_OMEGA_M]
    th = x[X_THETA_M]
    imposed = (omega_end - w) / period
    for _ in range(substeps):
        a1, b1, w1 = _derivative(a, b, w, th, v_alpha, v_beta, load,
                                 dead_time_voltage, dead_time_zone, machine)
        if not free_shaft:
            w1 = imposed
        wb = w + 0.5 * h * w1
        a2, b2, w2 = _derivative(a + 0.5 * h * a1, b + 0.5 * h * b1, wb, th + 0.5 * h * w,
                                 v_alpha, v_beta, load, dead_time_voltage, dead_time_zone, machine)
        if not free_shaft:
            w2 = imposed
        wc = w + 0.5 * h * w2
        a3, b3, w3 = _derivative(a + 0.5 * h * a2, b + 0.5 * h * b2, wc, th + 0.5 * h * wb,
                                 v_alpha, v_beta, load, dead_time_voltage, dead_time_zone, machine)
        if not free_shaft:
            w3 = imposed
        wd = w + h * w3
        a4, b4, w4 = _derivative(a + h * a3, b + h * b3, wd, th + h * wc,
                                 v_alpha, v_beta, load, dead_time_voltage, dead_time_zone, machine)
        if not free_shaft:
            w4 = imposed
        a += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        b += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        th += h / 6.0 * (w + 2.0 * wb + 2.0 * wc + wd)
        w += h / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
    x[X_LAMBDA_ALPHA] = a
    x[X_LAMBDA_BETA] = b
    x[X_OMEGA_M] = w if free_shaft else omega_end
    # One mechanical turn is a whole number of electrical ones, so wrapping here keeps theta_e exact and
    # its resolution constant over any length of run.
    x[X_THETA_M] = wrap(th)
