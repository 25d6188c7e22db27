"""Fit with an encoder: the flux of the currents against the integral of the voltage.

In the stationary frame, as complex vectors, with theta from the encoder and i_dq = exp(-j theta) i:

    flux of the currents    lambda_c = exp(j theta) (psi_m + L_d i_d + j L_q i_q)
    flux of the voltages    d lambda_v/dt = v + v_offset - R i - e(i)                e: dead time
    prediction error        e_k = lambda_c,k - lambda_v,k,    then lambda_v,k += (1 - a) e_k,    a = exp(-CORNER Ts)

The slow correction makes a high pass: the constant of the integral goes away, and so does what little errors of
the voltage add up to.  The integral of the voltage is exact, as the wire carries means over whole intervals; those
of R i and e(i) come with Runge and Kutta's steps.

The noise is in the currents, so on the side of lambda_c: least squares on columns made of the measured currents
would find inductances too small.  Columns are therefore made of the currents that the flux of the voltages explains
before the sample is seen; they hold next to nothing of the same sample's noise (Soederstroem and Stoica,
Instrumental Variable Methods for System Identification, 1983: an instrument that is refined until it fits).  R and
dead time act on those currents as well.  In units of current, e_d/L_d and e_q/L_q, it is an output error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.identification.samples import Stretch
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

CORNER = 10.0
"""Corner of the high pass [1/s]."""
NAMES = ("R", "L_d", "L_q", "psi_m", "dead_time_voltage", "dead_time_zone", "encoder_zero", "voltage_delay",
         "v_offset_alpha", "v_offset_beta", "i_offset_alpha", "i_offset_beta")
(R, L_D, L_Q, PSI_M, DEAD_TIME, ZONE, ENCODER_ZERO, DELAY, V_ALPHA, V_BETA, I_ALPHA, I_BETA) = range(12)
PARAMETERS = 12

_HALF_ROOT3 = 0.5 * math.sqrt(3.0)


def start(motor: Motor) -> tuple[Floats, Floats]:
    """(values, 1-sigma of what is believed beforehand) in the order of NAMES; ZONE is the logarithm of amperes.

    So wide that it tells nothing where the samples do, and keeps the arithmetic sound where they do not.
    """
    rated = motor.rated_current
    values = np.array([motor.R, motor.L_d, motor.L_q, motor.psi_m, 0.0, math.log(0.05 * rated), 0.0, 0.0, 0.0, 0.0,
                       0.0, 0.0])
    volts = motor.R * rated + 1.0
    return values, np.array([3.0 * motor.R + 0.1, 3.0 * motor.L_d, 3.0 * motor.L_q, 3.0 * motor.psi_m, 10.0 * volts,
                             1.0, 1.0, 2.0, volts, volts, 0.2 * rated, 0.2 * rated])


def bounds(values: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """(lowest, highest) values that are looked at, around those of `start`."""
    low, high = values - 4.0 * sigma, values + 4.0 * sigma
    low[[R, DEAD_TIME]] = 0.0
    low[[L_D, L_Q, PSI_M]] = 0.05 * values[[L_D, L_Q, PSI_M]]
    low[DELAY], high[DELAY] = -4.0, 4.0
    low[ENCODER_ZERO], high[ENCODER_ZERO] = -math.pi, math.pi
    return low, high


@kernel
def dead_time(i: complex, zone: float) -> tuple[complex, complex, float, float, float]:
    """(shape, its derivative by ln zone, and by the current: d alpha/d alpha, d alpha/d beta, d beta/d beta [1/A]).

    shape: voltage that dead time takes where each phase loses 1 V against its current, softened below `zone` [A] as
    in `drive.inverter`.
    """
    shape = 0.0 + 0.0j
    slope = 0.0 + 0.0j
    aa = 0.0
    ab = 0.0
    bb = 0.0
    for phase in range(3):
        a = 1.0 if phase == 0 else -0.5
        b = 0.0 if phase == 0 else (_HALF_ROOT3 if phase == 1 else -_HALF_ROOT3)
        x = (a * i.real + b * i.imag) / zone
        if abs(x) >= 1.0:
            shape += 2.0 / 3.0 * complex(a, b) * (1.0 if x > 0.0 else -1.0)
            continue
        shape += 2.0 / 3.0 * complex(a, b) * (0.5 * x * (3.0 - x * x))
        rise = 1.5 * (1.0 - x * x)
        slope -= 2.0 / 3.0 * complex(a, b) * (x * rise)
        aa += 2.0 / 3.0 * a * a * rise / zone
        ab += 2.0 / 3.0 * a * b * rise / zone
        bb += 2.0 / 3.0 * b * b * rise / zone
    return shape, slope, aa, ab, bb


@kernel
def _current(flux: complex, turn: complex, p: Floats) -> complex:
    dq = flux * turn.conjugate()
    return turn * complex((dq.real - p[PSI_M]) / p[L_D], dq.imag / p[L_Q])


@kernel
def _current_changes(flux_changes: Complexes, i: complex, turn: complex, p: Floats, out: Complexes) -> None:
    """out (PARAMETERS,): derivatives of the current that a flux explains, by way of the flux and directly."""
    dq = i * turn.conjugate()
    for j in range(PARAMETERS):
        change = flux_changes[j] * turn.conjugate()
        out[j] = turn * complex(change.real / p[L_D], change.imag / p[L_Q])
    out[L_D] -= turn * (dq.real / p[L_D])
    out[L_Q] -= turn * complex(0.0, dq.imag / p[L_Q])
    out[PSI_M] -= turn / p[L_D]
    back = _by_angle(dq, turn, p) * turn.conjugate()
    out[ENCODER_ZERO] += turn * complex(back.real / p[L_D], back.imag / p[L_Q])


@kernel
def _by_angle(dq: complex, turn: complex, p: Floats) -> complex:
    """Derivative of the flux of a current by the angle."""
    saliency = p[L_D] - p[L_Q]
    return turn * complex(saliency * dq.imag, p[PSI_M] + saliency * dq.real)


@kernel
def evaluate(i: Complexes, v: Complexes, theta: Floats, ts: float, corner: float, p: Floats, error: Complexes,
             columns: Complexes) -> None:
    """Prediction errors (N,) of a stretch [Wb] and their derivatives by the parameters (PARAMETERS, N), in the
    frame of the rotor: the real part along d, the imaginary one along q.

    i [A], v [V], theta [rad electrical] (N,).  p: in the order of NAMES.
    """
    n = i.shape[0]
    keep = math.exp(-corner * ts)
    # An explicit step of a sign that changes faster than the current would chatter.
    zone = max(math.exp(p[ZONE]), 3.0 * abs(p[DEAD_TIME]) * ts / min(p[L_D], p[L_Q]))
    whole = math.floor(p[DELAY])
    part = p[DELAY] - whole
    offset = complex(p[I_ALPHA], p[I_BETA])
    v_offset = complex(p[V_ALPHA], p[V_BETA])
    change = np.zeros(PARAMETERS, np.complex128)
    current = np.zeros(PARAMETERS, np.complex128)
    turn = np.exp(1j * (theta[0] - p[ENCODER_ZERO]))
    dq = (i[0] - offset) * turn.conjugate()
    flux = turn * complex(p[PSI_M] + p[L_D] * dq.real, p[L_Q] * dq.imag)
    before = i[0] - offset
    error[0] = 0.0
    columns[:, 0] = 0.0
    for k in range(1, n):
        at = min(max(k + whole, 0), n - 1)
        after = min(max(k + whole + 1, 0), n - 1)
        applied = (1.0 - part) * v[at] + part * v[after]
        turn_before = turn
        turn = np.exp(1j * (theta[k] - p[ENCODER_ZERO]))
        half_turn = np.exp(1j * (0.5 * (theta[k] + theta[k - 1]) - p[ENCODER_ZERO]))
        u = applied + v_offset
        # Runge and Kutta's step: the voltage stands still while the magnet turns, so the current's path is bent.
        begin, begin_slope, _, _, _ = dead_time(before, zone)
        middle = _current(flux + 0.5 * ts * (u - p[R] * before - p[DEAD_TIME] * begin), half_turn, p)
        centre, _, _, _, _ = dead_time(middle, zone)
        second = _current(flux + 0.5 * ts * (u - p[R] * middle - p[DEAD_TIME] * centre), half_turn, p)
        again, centre_slope, aa, ab, bb = dead_time(second, zone)
        ahead = _current(flux + ts * (u - p[R] * second - p[DEAD_TIME] * again), turn, p)
        end, end_slope, _, _, _ = dead_time(ahead, zone)
        drop = (before + 2.0 * middle + 2.0 * second + ahead) / 6.0
        shape = (begin + 2.0 * centre + 2.0 * again + end) / 6.0
        slope = (begin_slope + 4.0 * centre_slope + end_slope) / 6.0
        flux = flux + ts * (u - p[R] * drop - p[DEAD_TIME] * shape)
        predicted = _current(flux, turn, p)

        _current_changes(change, before, turn_before, p, current)
        for j in range(PARAMETERS):
            c = current[j]
            taken = complex(aa * c.real + ab * c.imag, ab * c.real + bb * c.imag)
            change[j] -= ts * (p[R] * c + p[DEAD_TIME] * taken)
        change[R] -= ts * drop
        change[DEAD_TIME] -= ts * shape
        change[ZONE] -= ts * p[DEAD_TIME] * slope
        change[DELAY] += ts * (v[after] - v[at])
        change[V_ALPHA] += ts
        change[V_BETA] += 1j * ts

        dq = (i[k] - offset) * turn.conjugate()
        e = turn * complex(p[PSI_M] + p[L_D] * dq.real, p[L_Q] * dq.imag) - flux
        clean = predicted * turn.conjugate()
        for j in range(PARAMETERS):
            columns[j, k] = -change[j]
        columns[L_D, k] += turn * clean.real
        columns[L_Q, k] += turn * complex(0.0, clean.imag)
        columns[PSI_M, k] += turn
        columns[ENCODER_ZERO, k] -= _by_angle(clean, turn, p)
        columns[I_ALPHA, k] -= turn * complex(p[L_D] * turn.real, -p[L_Q] * turn.imag)
        columns[I_BETA, k] -= turn * complex(p[L_D] * turn.imag, p[L_Q] * turn.real)
        for j in range(PARAMETERS):
            change[j] += (1.0 - keep) * columns[j, k]
            columns[j, k] *= turn.conjugate()
        error[k] = e * turn.conjugate()
        flux = flux + (1.0 - keep) * e
        before = _current(flux, turn, p)


def rows(stretches: Sequence[Stretch], sample_rate: float, p: Floats) -> tuple[Floats, Floats, Floats]:
    """(prediction error (2, M), columns (PARAMETERS, 2, M), number of the sample (M,)) of all stretches [Wb]."""
    residual, columns, number = [], [], []
    for s in stretches:
        error = np.empty(len(s), np.complex128)
        c = np.empty((PARAMETERS, len(s)), np.complex128)
        evaluate(s.i, s.v, s.theta, 1.0 / sample_rate, CORNER, p, error, c)
        use = used(s)
        residual.append(_split(error[use]))
        columns.append(np.stack([c.real[:, use], c.imag[:, use]], axis=1))
        number.append(s.first + np.flatnonzero(use))
    return (np.concatenate(residual, axis=1), np.concatenate(columns, axis=2),
            np.concatenate(number).astype(np.float64))


def clean_current(s: Stretch, sample_rate: float, p: Floats) -> Complexes:
    """dq current (N,) [A] that the flux of the voltages explains before each sample is seen: without its noise."""
    error = np.empty(len(s), np.complex128)
    evaluate(s.i, s.v, s.theta, 1.0 / sample_rate, CORNER, p, error, np.empty((PARAMETERS, len(s)), np.complex128))
    dq = (s.i - complex(p[I_ALPHA], p[I_BETA])) * np.exp(-1j * (s.theta - p[ENCODER_ZERO]))
    return np.asarray(dq - error.real / p[L_D] - 1j * error.imag / p[L_Q], np.complex128)


def used(stretch: Stretch) -> NDArray[np.bool_]:
    """Samples whose prediction error counts: not the first one, nor those that a delay would take from outside."""
    use = stretch.rows.copy()
    use[:2] = use[-2:] = False
    return use


def _split(x: Complexes) -> Floats:
    return np.stack([x.real, x.imag])
