"""The call for scripts and notebooks: arrays in, an object of arrays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipmsm_can.config import config_from
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.estimation import confidence, regression, speed
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.estimation.observers import ges
from ipmsm_can.motor import PRESETS, Motor

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the observer made of N samples; every array has N entries in the order of the samples.

    time [s] from the first sample.
    theta: observer's angle [rad electrical, -pi..pi].  theta_smooth, omega: angle and speed of the
    phase-locked loop behind it [rad, rad/s electrical].
    flux (N, 2): estimated stator flux lambda_hat [Wb].  active_flux (N, 2): x_hat [Wb].
    phi (N, 2): the regression's Phi [V].  y: its left-hand side [V Wb].
    innovation: y - Phi^T x_hat - d_hat before each correction [V Wb].
    excitation: smallest eigenvalue of the windowed integral of Phi Phi^T [V^2 s].
    sigma_theta: 1-sigma of theta [rad electrical], pi = unknown.
    locked, polarity_known, valid: bool; see `ipmsm_can.estimation.confidence`.
    """

    time: Floats
    theta: Floats
    theta_smooth: Floats
    omega: Floats
    flux: Floats
    active_flux: Floats
    phi: Floats
    y: Floats
    innovation: Floats
    excitation: Floats
    sigma_theta: Floats
    locked: NDArray[np.bool_]
    polarity_known: NDArray[np.bool_]
    valid: NDArray[np.bool_]


def estimate(i: ArrayLike, v: ArrayLike, sample_rate: float, motor: Motor | str, observer: str | None = None,
             valid_sigma: float | None = None, injection_frequency: float | str | None = None,
             **gains: Any) -> Estimate:
    """Estimate rotor position from sampled currents and voltages.

    i: stator current at the sample instants [A peak], alpha-beta, shape (N, 2) or complex (N,).
    v: MEAN stator voltage over the interval that ended at each sample [V peak], same shape.
    sample_rate [Hz], 100..100000.  motor: a Motor, or the name of a preset ("m1", "m2").
    observer: its kind, see [observer] in drive.toml and docs/estimation.md; None for the default, riccati, or ges
    where gamma is given.
    valid_sigma: largest 1-sigma of a valid angle [deg electrical].
    injection_frequency: of the probing signal [Hz], for the kinds injection_extraction and injection_demodulation.
    gains: the other keys of [observer] in drive.toml: alpha, gamma, initial_flux, epsilon,
    excitation_window, speed_bandwidth, voltage_uncertainty, current_noise, voltage_delay; numbers in SI or strings
    with units.

    Raises ValueError with one sentence for shapes that do not fit, values that are not finite, an unknown
    motor, or a gain outside its range.
    """
    current, voltage = _vectors("i", i), _vectors("v", v)
    if current.shape != voltage.shape:
        raise ValueError(f"i has {current.shape[1]} samples and v {voltage.shape[1]}; allowed are equal numbers")
    if not isinstance(sample_rate, (int, float, np.integer, np.floating)) or not 100.0 <= sample_rate <= 100_000.0:
        raise ValueError(f"sample_rate is {sample_rate!r}; allowed is 100 to 100000 Hz")
    if isinstance(motor, str):
        if motor not in PRESETS:
            raise ValueError(f"motor is {motor!r}; allowed is a Motor or one of {', '.join(PRESETS)}")
        motor = PRESETS[motor]
    if not isinstance(motor, Motor):
        raise ValueError(f"motor is {motor!r}; allowed is a Motor or one of {', '.join(PRESETS)}")
    config = config_from({
        "motor": {name: getattr(motor, name) for name in ("pole_pairs", "psi_m", "L_d", "L_q", "R", "J",
                                                          "rated_torque")},
        "observer": {**({} if observer is None else {"kind": observer}), **gains},
        "estimate": {} if valid_sigma is None else {"valid_sigma": valid_sigma},
        "injection": {} if injection_frequency is None else {"frequency": injection_frequency},
        # The sample rate only matters for what the injection may be; other kinds do not look at that.
        "wire": {"sample_rate": float(sample_rate)} if str(observer).startswith("injection_") else {},
    }, source="estimate()")
    samples = np.ascontiguousarray(np.concatenate([current, voltage]))
    block = Estimator(motor, float(sample_rate), estimator_settings(config, float(sample_rate))).process(samples)
    return _as_estimate(block, np.arange(samples.shape[1]) / sample_rate)


def _vectors(name: str, given: ArrayLike) -> Floats:
    """(2, N) from (N, 2) or complex (N,)."""
    array = np.asarray(given)
    if array.ndim == 1 and np.iscomplexobj(array):
        array = np.stack([array.real, array.imag], axis=1)
    if array.ndim != 2 or array.shape[1] != 2 or np.iscomplexobj(array):
        raise ValueError(f"{name} has shape {array.shape}; allowed is (N, 2) with alpha and beta, or complex (N,)")
    try:
        values = array.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} holds {array.dtype}; allowed are numbers") from None
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise ValueError(f"{name}[{row}] is {values[row].tolist()}; allowed are finite numbers")
    return values.T


def _as_estimate(block: EstimateBlock, time: Floats) -> Estimate:
    return Estimate(
        time=time,
        theta=block.angle[speed.THETA_HAT],
        theta_smooth=block.angle[speed.THETA],
        omega=block.angle[speed.OMEGA],
        flux=block.flux[[ges.LAMBDA_A, ges.LAMBDA_B]].T,
        active_flux=block.flux[[ges.X_A, ges.X_B]].T,
        phi=block.regression[[regression.PHI_A, regression.PHI_B]].T,
        y=block.regression[regression.Y],
        innovation=block.flux[ges.INNOVATION],
        excitation=block.excitation,
        sigma_theta=block.sigma,
        locked=block.flags & confidence.LOCKED != 0,
        polarity_known=block.flags & confidence.POLARITY_KNOWN != 0,
        valid=block.flags & confidence.VALID != 0,
    )


