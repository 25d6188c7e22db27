"""The motor's parameters from a measurement: choice of the fit, and what of it may be said."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.analysis.measurement import Measurement
from ipmsm_can.identification import encoder_fit as fit
from ipmsm_can.identification.encoder_fit import NAMES
from ipmsm_can.identification.result import MOTOR_PARAMETERS, Identification, Parameter
from ipmsm_can.identification.samples import Stretch, encoder_angle, stretches
from ipmsm_can.identification.solve import Solution, judge, minimise
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

MOST_SAMPLES = 300_000
"""Samples that a fit takes at most: evenly spread pieces of a longer log."""
LEAST_S = 0.2
"""Samples [s] below which nothing is said."""
TOLD_SHARE = 0.2
"""Half the width of an interval, as a share of the value, up to which a motor's parameter counts as told."""
MISFIT = 0.05
"""Residual, as a share of the magnet's flux, from which on the samples are not those of such a motor."""
_PIECE_S = 2.0
_NOISE = 0.02


def identify(m: Measurement, motor: Motor) -> Identification:
    """What a measurement tells of the motor and its drive, with intervals of 95 %.

    motor: the name plate, where the fit starts; its pole pairs do not matter, all angles are electrical.
    With encoder reports, those count; otherwise the currents and voltages alone.
    """
    angle = encoder_angle(m)
    with_encoder = _limited(stretches(m, angle), m.sample_rate)
    seconds = sum(map(len, with_encoder)) / m.sample_rate if with_encoder else 0.0
    if seconds >= LEAST_S:
        return _with_encoder(with_encoder, m.sample_rate, motor)
    return nothing("sensorless", motor, f"the log holds {seconds:.2g} s of unbroken samples with an encoder's "
                   f"angle; it takes {LEAST_S:g} s")


def nothing(method: str, motor: Motor, why: str) -> Identification:
    """Nothing can be told, for this reason."""
    empty = {n: Parameter(n, math.nan, math.nan, math.nan, math.nan, getattr(motor, n), False, why)
             for n in MOTOR_PARAMETERS}
    return Identification(empty, method, (), 0, 0.0, notes=(why,), fits=False, name_plate=motor)


def _limited(all_of_them: list[Stretch], rate: float) -> list[Stretch]:
    """Evenly spread pieces where there are more than MOST_SAMPLES."""
    total = sum(map(len, all_of_them))
    if total <= MOST_SAMPLES:
        return all_of_them
    length = max(8, round(_PIECE_S * rate))
    pieces = [s.part(a, a + length) for s in all_of_them for a in range(0, len(s), length)]
    every = math.ceil(total / MOST_SAMPLES)
    return pieces[::every]


def _bounds(motor: Motor, start: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    low, high = start - 4.0 * sigma, start + 4.0 * sigma
    low[fit.R] = 0.0
    low[[fit.L_D, fit.L_Q, fit.PSI_M]] = 0.05 * start[[fit.L_D, fit.L_Q, fit.PSI_M]]
    low[fit.DEAD_TIME] = 0.0
    low[fit.DELAY], high[fit.DELAY] = -4.0, 4.0
    low[fit.ENCODER_ZERO], high[fit.ENCODER_ZERO] = -math.pi, math.pi
    return low, high


def _with_encoder(pieces: list[Stretch], rate: float, motor: Motor) -> Identification:
    start, sigma = fit.start(motor)
    low, high = _bounds(motor, start, sigma)
    scatter = np.array([_NOISE, _NOISE])
    time = np.zeros(0)

    def model(p: Floats) -> tuple[Floats, Floats]:
        nonlocal time
        residual, columns, number = fit.rows(pieces, rate, p)
        weight = 1.0 / (p[[fit.L_D, fit.L_Q]] * scatter)
        time = np.tile(number / rate, 2)
        return (residual * weight[:, None]).ravel(), (columns * weight[:, None]).reshape(len(p), -1).T

    # Inductances last: while dead time is missing they would take its place.
    p, _ = minimise(model, start, sigma, low, high,
                    [fit.R, fit.PSI_M, fit.DEAD_TIME, fit.ENCODER_ZERO, fit.V_ALPHA, fit.V_BETA])
    good = False
    for _ in range(2):
        p, good = minimise(model, p, sigma, low, high, range(p.size))
        e = fit.rows(pieces, rate, p)[0]
        scatter = np.maximum(e.std(axis=1) / p[[fit.L_D, fit.L_Q]], 1e-6)
    solution = judge(model, p, sigma, time, good)
    i = np.concatenate([s.i * np.exp(-1j * (s.theta - p[fit.ENCODER_ZERO])) for s in pieces])
    speed = np.concatenate([np.gradient(s.theta) for s in pieces]) * rate
    out = Identification(
        _parameters(solution, motor, sigma, low, high), "encoder", tuple(scatter.tolist()), i.size, i.size / rate,
        _range(i.real), _range(i.imag), _range(speed), name_plate=motor)
    misfit = float(np.hypot(*e.std(axis=1))) / p[fit.PSI_M]
    if misfit > MISFIT or not good:
        return _refused(out, f"the samples are not those of such a motor: {100.0 * misfit:.0f} % of the magnet's "
                        "flux stays unexplained (wrong pole pairs, phases, signs, scalings, or a slipping encoder)")
    return out


def _refused(out: Identification, why: str) -> Identification:
    parameters = {n: replace(p, value=math.nan, standard_error=math.nan, low=math.nan, high=math.nan, told=False,
                             word="the samples do not fit") for n, p in out.parameters.items()}
    return replace(out, parameters=parameters, notes=(why,), fits=False)


def _range(x: Floats) -> tuple[float, float]:
    low, high = np.percentile(x, [1.0, 99.0])
    return float(low), float(high)


def _limits(motor: Motor) -> dict[str, float]:
    """Largest half-width of an interval at which a parameter other than the motor's counts as told."""
    volts = 0.2 * (motor.R * motor.rated_current + 1.0)
    amperes = 0.02 * motor.rated_current
    return {"dead_time_voltage": volts, "dead_time_zone": math.inf, "encoder_zero": math.radians(5.0),
            "voltage_delay": 0.25, "v_offset_alpha": volts, "v_offset_beta": volts, "i_offset_alpha": amperes,
            "i_offset_beta": amperes}


def _parameters(s: Solution, motor: Motor, sigma: Floats, low: Floats, high: Floats) -> dict[str, Parameter]:
    out = {}
    limits = _limits(motor)
    for k, name in enumerate(NAMES):
        value, error = float(s.values[k]), math.sqrt(s.covariance[k, k])
        reach = s.reach * error
        at_end = not low[k] < value < high[k] and name != "dead_time_voltage"
        most = TOLD_SHARE * value if name in MOTOR_PARAMETERS else limits[name]
        told = reach <= most and error < 0.5 * sigma[k] and not at_end
        plate = float(getattr(motor, name)) if name in MOTOR_PARAMETERS else 0.0
        if name == "dead_time_zone":
            value, plate = math.exp(value), math.nan
            error *= value
            reach *= value
        if told:
            out[name] = Parameter(name, value, error, value - reach, value + reach, plate, True)
        else:
            out[name] = Parameter(name, math.nan, math.nan, math.nan, math.nan, plate, False,
                                  "the log does not tell it")
    return out
