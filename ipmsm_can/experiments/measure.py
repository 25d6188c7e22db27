"""Numbers from a run, and the margins that the run itself puts on them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.experiments.conditions import window_levels
from ipmsm_can.experiments.model import Setup
from ipmsm_can.experiments.rig import Track, protocol
from ipmsm_can.wire.protocol import MessageKind

Floats = NDArray[np.float64]

LOCK_DEG = 5.0
"""Least error [deg electrical] that never counts as locked: one seventy-second of the axis of an angle plot."""
VISIBLE_DEG = 3.6
"""What can be seen in a plot of an angle: one percent of its axis of 360 degrees."""


def rms(error: Floats) -> float:
    """Root mean square; NaN for nothing."""
    return float(np.sqrt(np.mean(error**2))) if error.size else math.nan


def window(track: Track, begin: float = 0.0, end: float = math.inf) -> Floats:
    """Errors [deg electrical] from begin to before end [s]."""
    return track.error[(track.reference_time >= begin) & (track.reference_time < end)]


def largest(track: Track, begin: float = 0.0, end: float = math.inf) -> float:
    """Largest |error| [deg electrical] in a stretch of time [s]."""
    return float(np.abs(window(track, begin, end)).max(initial=0.0))


def lock_time(track: Track, within: float = LOCK_DEG, until: float = math.inf) -> float:
    """First time [s] from which |error| stays below `within` [deg electrical] up to `until`; inf if never."""
    seen = track.reference_time < until
    outside = np.flatnonzero(np.abs(track.error[seen]) >= within)
    if not outside.size:
        return 0.0
    after = int(outside[-1]) + 1
    return float(track.reference_time[after]) if after < int(seen.sum()) else math.inf


def _wire_step(setup: Setup, axis: str) -> float:
    kind = MessageKind.DRIVE_SAMPLE_BLOCK if setup.node.fd else MessageKind.DRIVE_SAMPLE
    codec = protocol().codecs[kind]
    return codec.layouts[codec.index[f"{axis}_0" if setup.node.fd else axis]].scale


def current_sigma(setup: Setup) -> float:
    """Standard deviation of a current sample [A], per axis: sensor noise, ADC steps and the wire's steps."""
    steps = setup.drive.adc_step**2 + _wire_step(setup, "i_alpha") ** 2
    return math.sqrt(setup.drive.current_noise**2 + steps / 12.0)


def voltage_step(setup: Setup) -> float:
    """Step of a voltage on the wire [V]."""
    return _wire_step(setup, "v_alpha")


def noise_deg(setup: Setup) -> float:
    """1 sigma [deg electrical] that the current samples and the encoder alone put on the angle error.

    x_hat = lambda_hat - L_q i: a current error e turns x_hat by L_q e / psi_m.  An encoder of N counts adds its
    step 360 p / N over sqrt(12).
    """
    m = setup.machine
    sigma = math.degrees(m.L_q * current_sigma(setup) / m.psi_m)
    counts = setup.node.encoder_counts if setup.against_encoder else 0
    step = 360.0 * m.pole_pairs / counts if counts else 0.0
    return math.hypot(sigma, step / math.sqrt(12.0))


def dead_time_deg(setup: Setup, omega_e: float) -> float:
    """Largest lasting angle error [deg electrical] that the dead time makes at omega_e [rad/s electrical].

    The space vector of the phases' losses has the length 4/3 V_dt and turns with the rotor; integrated it is
    a flux of 4/3 V_dt / omega, across the rotor at worst.
    """
    flux = 4.0 / 3.0 * setup.drive.dead_time_voltage / max(abs(omega_e), 1e-9)
    return math.degrees(math.atan2(flux, setup.machine.psi_m))


def margin_deg(setup: Setup, omega_e: float) -> float:
    """What a perfect observer may show [deg electrical]: four sigma of noise, and the dead time's error."""
    return 4.0 * noise_deg(setup) + dead_time_deg(setup, omega_e)


def flux_error(track: Track) -> Floats:
    """|x_hat - x| [Wb] at every sample."""
    return np.asarray(np.abs(track.x - track.truth.active_flux * np.exp(1j * track.truth.theta_e)))


def flux_time(track: Track, share: float = 0.05) -> float:
    """First time [s] at which |x_hat - x| is below `share` of psi_m for one electrical turn; inf if never."""
    turn = 2.0 * math.pi / max(abs(float(track.truth.omega_e[0])), 1e-9)
    n = max(1, round(turn * track.run.setup.drive.sample_rate))
    outside = flux_error(track) >= share * track.run.setup.machine.psi_m
    since = np.concatenate([[0], np.cumsum(outside)])
    quiet = np.flatnonzero(since[n:] == since[:-n])
    return float(track.time[quiet[0]]) if quiet.size else math.inf


def contraction_rate(track: Track, begin: float, floor: float) -> float:
    """Rate [1/s] at which |x_hat - x| falls, from a straight line through its logarithm.

    From begin [s] on, up to the first sample below `floor` [Wb], where noise and quantisation take over.
    """
    distance = flux_error(track)
    below = np.flatnonzero((distance < floor) & (track.time > begin))
    end = int(below[0]) if below.size else distance.size
    inside = slice(int(np.searchsorted(track.time, begin)), end)
    slope = np.polyfit(track.time[inside], np.log(distance[inside]), 1)[0]
    return float(-slope)


def smallest_pe(phi: NDArray[np.complex128], time: Floats, length: float, begin: float) -> float:
    """Smallest eigenvalue [V^2 s] of the integral of Phi Phi^T over any window of `length` [s] from `begin` on."""
    step = float(time[1] - time[0])
    return float(window_levels(phi[time >= begin], step, max(1, round(length / step))).min())


def phi_length(alpha: float, psi_m: float, omega_e: float) -> float:
    """|Phi| [V] of a rotor turning at omega_e [rad/s electrical], i_d = 0: 2 alpha psi w/sqrt(w^2 + alpha^2)."""
    return 2.0 * alpha * psi_m * abs(omega_e) / math.hypot(omega_e, alpha)


def slow_pole(gamma: float, phi: float, omega_e: float) -> float:
    """Rate [1/s] of the slower mode of s^2 + k s + w^2 = 0, k = gamma |Phi|^2."""
    k = gamma * phi**2
    return 0.5 * (k - math.sqrt(max(0.0, k * k - 4.0 * omega_e**2)))
