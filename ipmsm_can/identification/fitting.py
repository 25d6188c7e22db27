"""The motor's parameters from a measurement: choice of the fit, and what of it may be said."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.analysis.measurement import Measurement
from ipmsm_can.config import config_from
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.estimation import confidence
from ipmsm_can.estimation.estimator import Estimator
from ipmsm_can.estimation.observers import ges
from ipmsm_can.estimation.speed import OMEGA
from ipmsm_can.identification import encoder_fit as fit
from ipmsm_can.identification import sensorless_fit as free
from ipmsm_can.identification.result import MOTOR_PARAMETERS, Identification, Parameter
from ipmsm_can.identification.samples import Stretch, encoder_angle, stretches
from ipmsm_can.identification.saturation import bend
from ipmsm_can.identification.solve import Solution, Unsolvable, judge, memory, minimise, partial
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

MOST_SAMPLES = 150_000
"""Samples that a fit takes at most: evenly spread pieces of a longer log."""
LEAST_S = 0.2
"""Samples [s] below which nothing is said."""
TOLD_SHARE = 0.2
"""Half the width of an interval, as a share of the value, up to which a motor's parameter counts as told."""
MISFIT = 0.05
"""Residual, as a share of the magnet's flux, from which on the samples are not those of such a motor."""
_PIECE_S = 2.0
_NOISE = 0.02
"""Scatter of the currents [A] that a fit starts from."""
_CLEAR_EMF = 2.0
"""Back-EMF [V] from which on the observer's angle is trusted."""
_MOST_WINDOWS = 60
_NO_END = "nothing can be told: the search for the parameters did not come to an end"


def identify(m: Measurement, motor: Motor) -> Identification:
    """What a measurement tells of the motor and its drive, with intervals of 95 %.

    motor: the name plate, where the fit starts; its pole pairs do not matter, all angles are electrical.
    With encoder reports, those count; otherwise the currents and voltages alone.  Never raises for what the samples
    are: where they tell nothing, `Identification.notes` says why.
    """
    pieces = _limited(stretches(m, encoder_angle(m)), m.sample_rate)
    encoder = sum(map(len, pieces)) >= LEAST_S * m.sample_rate
    try:
        return _with_encoder(pieces, m.sample_rate, motor) if encoder else _sensorless(m, motor)
    except Unsolvable:
        return _nothing("encoder" if encoder else "sensorless", motor, _NO_END)


def _nothing(method: str, motor: Motor, why: str) -> Identification:
    empty = {n: Parameter(n, math.nan, math.nan, math.nan, math.nan, getattr(motor, n), False, "not from this log")
             for n in MOTOR_PARAMETERS}
    return Identification(empty, method, (), 0, 0.0, notes=(why,), fits=False, name_plate=motor)


def _limited(found: list[Stretch], rate: float) -> list[Stretch]:
    """Evenly spread pieces where there are more than MOST_SAMPLES."""
    total = sum(map(len, found))
    if total <= MOST_SAMPLES:
        return found
    length = max(8, round(_PIECE_S * rate))
    pieces = [s.part(a, a + length) for s in found for a in range(0, len(s), length)]
    return pieces[::math.ceil(total / MOST_SAMPLES)]


def _with_encoder(pieces: list[Stretch], rate: float, motor: Motor) -> Identification:
    start, sigma = fit.start(motor)
    low, high = fit.bounds(start, sigma)
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
    solution = judge(model, p, sigma, time, p.size)
    _doubt(solution, model(p), time)
    i = np.concatenate([s.i * np.exp(-1j * (s.theta - p[fit.ENCODER_ZERO])) for s in pieces])
    speed = np.concatenate([np.gradient(s.theta) for s in pieces]) * rate
    parameters = _parameters(solution, motor, fit.NAMES, sigma, low, high)
    if max(float(np.ptp(s.theta)) for s in pieces) < 2.0 * math.pi:
        for name in _NEEDS_TURNING:
            parameters[name] = _untold(parameters[name], "the rotor does not turn")
    notes = [_CANNOT[n] for n in MOTOR_PARAMETERS if not parameters[n].told]
    out = Identification(parameters, "encoder", tuple(scatter.tolist()), i.size, i.size / rate, _range(i.real),
                         _range(i.imag), _range(speed), tuple(notes), name_plate=motor)
    misfit = float(np.hypot(*e.std(axis=1))) / p[fit.PSI_M]
    if misfit > MISFIT or not good:
        return _refused(out, _why(misfit, good, "pole pairs, phases, signs, scalings, or a slipping encoder"))
    bent = bend(pieces, rate, p, scatter)
    return replace(out, notes=(*out.notes, bent)) if bent else out


_OWN_SENSORLESS = {free.R: 4e-3, free.PSI_M: 8e-5, free.DEAD_TIME: 8e-3}
_OWN_OFFSET = 4e-4
"""The same as _OWN without an encoder; of the offsets of the currents, as a share of rated current."""
_NEEDS_TURNING = ("psi_m", "encoder_zero", "voltage_delay", "v_offset_alpha", "v_offset_beta")
_OWN = {fit.R: 3e-4, fit.L_D: 3e-4, fit.L_Q: 1e-4, fit.PSI_M: 2e-5}
"""Error of the fit itself, as a share of the parameter: what the wire's steps and the path of the current between
two samples leave; 1-sigma, from simulated runs (tools.identification)."""
_OWN_BETWEEN = {fit.R: 5e-3, fit.L_D: 0.03, fit.L_Q: 3e-3, fit.PSI_M: 5e-4}
"""The same where the voltage steps halfway between two samples."""


def _doubt(s: Solution, at: tuple[Floats, Floats], time: Floats) -> None:
    """Widen a solution's covariance by what the fit cannot know of itself.

    Residuals that remember the ones before come from errors of the flux: lost samples, an encoder's steps,
    saturation.  They are in the currents that the columns are made of as well, where they pass for current: an
    inductance along an axis with little current comes out too large by their ratio.
    """
    residual, columns = at
    half = time.size // 2
    for axis, k in ((slice(0, half), fit.L_D), (slice(half, None), fit.L_Q)):
        kept = memory(residual[axis]) * s.values[k] ** -2.0
        error = 2.0 * kept / max(partial(columns[axis], k), 1e-300) * s.values[k]
        s.covariance[k, k] += error * error
    between = s.values[fit.DELAY] - math.floor(s.values[fit.DELAY])
    between = 4.0 * between * (1.0 - between)
    for k in _OWN:
        s.covariance[k, k] += (s.values[k] * math.hypot(_OWN[k], _OWN_BETWEEN[k] * between**2)) ** 2


_CANNOT = {
    "R": "R cannot be told from this log: it holds too little current, or one current only, where dead time "
         "looks the same",
    "L_d": "L_d cannot be told from this log: the current along d changes too little beside what else disturbs the "
           "samples (noise, losses, steps of the encoder, saturation)",
    "L_q": "L_q cannot be told from this log: it holds no load, or one load only, where the encoder's zero looks "
           "the same",
    "psi_m": "psi_m cannot be told from this log: the rotor hardly turns"}


def _sensorless(m: Measurement, motor: Motor) -> Identification:
    chosen, speed = _windows(m, motor)
    if len(chosen) < 2:
        return _nothing("sensorless", motor, "nothing can be told: the log holds no encoder, and less than "
                        f"{2.0 * free.WINDOW_S:g} s of a rotor so fast that its back-EMF shows the angle")
    p, sigma = free.start(motor, chosen)
    low, high = p - 4.0 * sigma, p + 4.0 * sigma
    low[free.R] = low[free.DEAD_TIME] = 0.0
    low[free.PSI_M] = 0.05 * motor.psi_m
    scatter, time = _NOISE, np.zeros(0)

    def model(p: Floats) -> tuple[Floats, Floats]:
        nonlocal time
        r, columns, number, _ = free.rows(chosen, m.sample_rate, p)
        time = number / m.sample_rate
        return r / (p[free.L_D] * scatter), columns / (p[free.L_D] * scatter)

    fitted = [k for k in range(p.size) if k not in free.GIVEN]
    p, _ = minimise(model, p, sigma, low, high, [k for k in fitted if k != free.ZONE])
    good = False
    for _ in range(2):
        p, good = minimise(model, p, sigma, low, high, fitted)
        r, _, _, i = free.rows(chosen, m.sample_rate, p)
        scatter = max(float(r.std()) / p[free.L_D], 1e-6)
    solution = judge(model, p, sigma, time, free.PARAMETERS, free.GIVEN)
    for k, share in _OWN_SENSORLESS.items():
        solution.covariance[k, k] += (share * p[k]) ** 2
    for k in (free.I_ALPHA, free.I_BETA):
        solution.covariance[k, k] += (_OWN_OFFSET * motor.rated_current) ** 2
    parameters = _parameters(solution, motor, free.NAMES, sigma, low, high, free.GIVEN)
    notes = [_CANNOT[n] for n in ("R", "psi_m") if not parameters[n].told]
    notes.append("L_d and L_q cannot be told without an encoder: a wrong L_q is a wrong angle that nothing "
                 "contradicts, and L_d shows only where current flows along d; the intervals of the others allow "
                 f"for {100.0 * free.GIVEN_TO:.0f} % (1 sigma) of error in them")
    out = Identification(parameters, "sensorless", (scatter,), i.size, i.size / m.sample_rate, _range(i.real),
                         _range(i.imag), _range(speed), tuple(notes), name_plate=motor)
    misfit = float(r.std()) / p[free.PSI_M]
    if misfit > MISFIT or not good:
        return _refused(out, _why(misfit, good, "phases, signs or scalings"))
    return out


def _windows(m: Measurement, motor: Motor) -> tuple[list[free.Window], Floats]:
    """(windows in which the name plate's observer has the angle, its speed there [rad/s electrical])."""
    config = config_from({"motor": {n: getattr(motor, n) for n in ("pole_pairs", "psi_m", "L_d", "L_q", "R", "J",
                                                                   "rated_torque")}})
    chosen: list[free.Window] = []
    speed: list[Floats] = []
    for s in _limited(stretches(m, None), m.sample_rate):
        samples = np.ascontiguousarray([s.i.real, s.i.imag, s.v.real, s.v.imag])
        e = Estimator(motor, m.sample_rate, estimator_settings(config, m.sample_rate)).process(samples)
        omega = e.angle[OMEGA]
        trusted = (e.flags & confidence.LOCKED != 0) & (np.abs(omega) * motor.psi_m > _CLEAR_EMF)
        trusted &= np.abs(omega) * free.WINDOW_S > 2.0 * math.pi
        here = free.windows(s, e.flux[ges.LAMBDA_A] + 1j * e.flux[ges.LAMBDA_B], trusted, m.sample_rate)
        speed += [omega[w.stretch.first - s.first:][:len(w.stretch)] for w in here]
        chosen += here
    every = max(1, math.ceil(len(chosen) / _MOST_WINDOWS))
    return chosen[::every], np.concatenate(speed) if speed else np.zeros(1)


def _why(misfit: float, good: bool, wrong: str) -> str:
    if misfit <= MISFIT:
        return _NO_END
    return (f"the samples are not those of such a motor: {100.0 * misfit:.0f} % of the magnet's flux stays "
            f"unexplained (wrong {wrong})")


def _refused(out: Identification, why: str) -> Identification:
    parameters = {n: _untold(p, "the samples do not fit") for n, p in out.parameters.items()}
    return replace(out, parameters=parameters, notes=(why,), fits=False)


def _untold(p: Parameter, word: str) -> Parameter:
    return replace(p, value=math.nan, standard_error=math.nan, low=math.nan, high=math.nan, told=False, word=word)


def _range(x: Floats) -> tuple[float, float]:
    low, high = np.percentile(x, [1.0, 99.0])
    return float(low), float(high)


def _limits(motor: Motor) -> dict[str, float]:
    """Largest half-width of an interval at which a parameter other than the motor's counts as told."""
    volts = 0.2 * (motor.R * motor.rated_current + 1.0)
    amperes = 0.02 * motor.rated_current
    return {"dead_time_voltage": volts, "dead_time_zone": 0.5, "encoder_zero": math.radians(5.0),
            "voltage_delay": 0.25, "v_offset_alpha": volts, "v_offset_beta": volts, "i_offset_alpha": amperes,
            "i_offset_beta": amperes}


def _parameters(s: Solution, motor: Motor, names: Sequence[str], sigma: Floats, low: Floats, high: Floats,
                given: Sequence[int] = ()) -> dict[str, Parameter]:
    out = {}
    limits = _limits(motor)
    for k, name in enumerate(names):
        value, error = float(s.values[k]), math.sqrt(s.covariance[k, k])
        reach = s.reach * error
        # A dead time of nothing is an answer; every other end of a range is none.
        inside = low[k] < value < high[k] or name == "dead_time_voltage"
        most = TOLD_SHARE * value if name in MOTOR_PARAMETERS else limits[name]
        told = k not in given and inside and reach <= most and error < 0.5 * sigma[k]
        plate = float(getattr(motor, name)) if name in MOTOR_PARAMETERS else 0.0
        if name == "dead_time_zone":
            value, plate = math.exp(value), math.nan
            error *= value
            reach *= value
        found = Parameter(name, value, error, value - reach, value + reach, plate, True)
        if told:
            out[name] = found
        else:
            out[name] = _untold(found, "not without an encoder" if k in given else "not from this log")
    return out
