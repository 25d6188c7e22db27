"""Speed and smoothed angle from the observer's angle: a type-2 phase-locked loop.

theta_pll and omega follow theta_hat with a double pole at exp(-omega_n T_s), placed in discrete time, so the
loop is stable for any bandwidth and sample rate.  A loop that starts at rest needs (Delta omega)^2/omega_n^3
to pull in, seconds for a fast machine; so a low-passed difference of theta_hat runs beside it and the loop is
set to that whenever its error exceeds SLIP.  While x_hat is shorter than epsilon it has no direction: the loop
rests at speed zero.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

SLIP = 2.0
"""Loop error [rad] beyond which the loop no longer follows and is set anew."""

STATE = np.dtype([
    ("started", "i8"), ("T_s", "f8"), ("pole", "f8"), ("epsilon2", "f8"),
    ("theta_hat", "f8"), ("theta", "f8"), ("omega", "f8"), ("omega_difference", "f8"),
])

THETA_HAT, THETA, OMEGA = range(3)
ROWS = 3

_TWO_PI = 2.0 * math.pi


def new_state(bandwidth: float, epsilon: float, sample_rate: float) -> NDArray[np.void]:
    """Record array (1,) of STATE; bandwidth: natural frequency of the loop [Hz]; epsilon [Wb]; sample_rate [Hz]."""
    state = np.zeros(1, STATE)
    state["T_s"] = 1.0 / sample_rate
    state["epsilon2"] = epsilon**2
    state["pole"] = pole(bandwidth, sample_rate)
    return state


def pole(bandwidth: float, sample_rate: float) -> float:
    """The loop's double pole; bandwidth, sample_rate [Hz]."""
    return math.exp(-_TWO_PI * bandwidth / sample_rate)


@kernel
def wrap(angle: float) -> float:
    """The angle [rad] brought into [-pi, pi)."""
    return angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI)


@kernel
def follow(new: float, rests: bool, started: int, theta_hat: float, theta: float, omega: float,
           omega_difference: float, T_s: float, pole: float) -> tuple[float, float, float]:
    """One step of the loop to the angle `new`: (theta, omega, omega_difference); rests: x_hat has no direction."""
    if rests:
        return new, 0.0, 0.0
    if not started:
        return new, omega, omega_difference
    omega_difference += (1.0 - pole) * (wrap(new - theta_hat) / T_s - omega_difference)
    theta += omega * T_s
    error = wrap(new - theta)
    if abs(error) > SLIP:
        return new, omega_difference, omega_difference
    return (wrap(theta + (1.0 - pole * pole) * error), omega + (1.0 - pole) * (1.0 - pole) / T_s * error,
            omega_difference)


@kernel
def speed_block(flux: NDArray[np.float64], state: NDArray[np.void], out: NDArray[np.float64]) -> None:
    """Angle, smoothed angle and speed for a block.

    flux: float64 (>= 4, N), rows 2 and 3 the active flux x_hat [Wb].
    out: float64 (3, N): theta_hat and smoothed theta [rad electrical, -pi..pi], omega [rad/s electrical].
    """
    st = state[0]
    T_s = st.T_s
    pole = st.pole
    theta_hat = st.theta_hat
    theta = st.theta
    omega = st.omega
    omega_difference = st.omega_difference
    started = st.started
    for k in range(flux.shape[1]):
        x_a = flux[2, k]
        x_b = flux[3, k]
        new = math.atan2(x_b, x_a)
        theta, omega, omega_difference = follow(new, x_a * x_a + x_b * x_b < st.epsilon2, started, theta_hat, theta,
                                                omega, omega_difference, T_s, pole)
        started = 1
        theta_hat = new
        out[0, k] = theta_hat
        out[1, k] = theta
        out[2, k] = omega
    st.theta_hat = theta_hat
    st.theta = theta
    st.omega = omega
    st.omega_difference = omega_difference
    st.started = started
