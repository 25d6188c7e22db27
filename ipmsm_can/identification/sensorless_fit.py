"""Fit without an encoder: the length of the active flux.

The flux of the voltages, lambda, minus L_q i points along the d-axis, wherever that is (the paper's x), so that

    r = |lambda - L_q i| - psi_m - (L_d - L_q) i_d = 0,    lambda = lambda_0 + integral of v + v_offset - R i - e(i)

holds at every sample for the right parameters, and nothing has to be known of the angle or assumed of its
smoothness.  Windows short enough for little errors of the voltage to add up to nothing have their own lambda_0,
which is fitted too.

A wrong L_q is a wrong angle, but hardly a wrong length: of L_q, r holds L_0 i_q^2/|x| only, and of L_d i_d only,
which is as much the sensors' noise as current, also because that noise turns x.  Both came out wrong by half when
they were fitted, so they are the name plate's, and their uncertainty goes into the intervals of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.identification.samples import Stretch
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

NAMES = ("R", "L_d", "L_q", "psi_m", "dead_time_voltage", "dead_time_zone", "v_offset_alpha", "v_offset_beta",
         "i_offset_alpha", "i_offset_beta")
(R, L_D, L_Q, PSI_M, DEAD_TIME, ZONE, V_ALPHA, V_BETA, I_ALPHA, I_BETA) = range(10)
PARAMETERS = 10
WINDOW_S = 0.5
"""Length of a window [s]."""
GIVEN_TO = 0.1
"""How well the name plate's inductances are believed, 1-sigma as a share of them."""
GIVEN = (L_D, L_Q)
"""Parameters that are not fitted but taken from the name plate."""
_SMOOTHED = 5


@dataclass(frozen=True, slots=True)
class Window:
    """A stretch whose rotor turns.  flux: lambda_0 [Wb] as an observer has it."""

    stretch: Stretch
    flux: complex


def windows(stretch: Stretch, flux: Complexes, trusted: NDArray[np.bool_], sample_rate: float) -> list[Window]:
    """Windows of a stretch.  flux (N,): an observer's [Wb]; trusted (N,): it has the angle, and the rotor turns."""
    length = round(WINDOW_S * sample_rate)
    return [Window(stretch.part(a, a + length), complex(flux[a]))
            for a in range(0, len(stretch) - length + 1, length) if trusted[a:a + length].all()]


def start(motor: Motor, chosen: Sequence[Window]) -> tuple[Floats, Floats]:
    """(values, 1-sigma of what is believed beforehand): NAMES, then lambda_0 of every window.

    L_d and L_q are the name plate's, to GIVEN_TO.
    """
    rated = motor.rated_current
    volts = motor.R * rated + 1.0
    values = [motor.R, motor.L_d, motor.L_q, motor.psi_m, 0.0, math.log(0.05 * rated), 0.0, 0.0, 0.0, 0.0]
    sigma = [3.0 * motor.R + 0.1, GIVEN_TO * motor.L_d, GIVEN_TO * motor.L_q, 3.0 * motor.psi_m,
             10.0 * volts, 1.0, volts, volts, 0.2 * rated, 0.2 * rated]
    for w in chosen:
        values += [w.flux.real, w.flux.imag]
        sigma += [2.0 * motor.psi_m] * 2
    return np.array(values), np.array(sigma)


def rows(chosen: Sequence[Window], sample_rate: float, p: Floats) -> tuple[Floats, Floats, Floats, Complexes]:
    """(r [Wb] (K,), its derivatives (K, P), number of the sample (K,), i_dq [A] (K,)) of all windows."""
    r, columns, number, dq = [], [], [], []
    for k, w in enumerate(chosen):
        here = _window(w, 1.0 / sample_rate, p, complex(*p[PARAMETERS + 2 * k:PARAMETERS + 2 * k + 2]))
        use = w.stretch.rows.copy()
        use[0] = False
        c = np.zeros((int(np.count_nonzero(use)), p.size))
        c[:, :PARAMETERS] = here[1][use, :PARAMETERS]
        c[:, PARAMETERS + 2 * k:PARAMETERS + 2 * k + 2] = here[1][use, PARAMETERS:]
        r.append(here[0][use])
        columns.append(c)
        number.append(w.stretch.first + np.flatnonzero(use))
        dq.append(here[2][use])
    return np.concatenate(r), np.concatenate(columns), np.concatenate(number), np.concatenate(dq)


def _window(w: Window, ts: float, p: Floats, flux_0: complex) -> tuple[Floats, Floats, Complexes]:
    measured = w.stretch.i
    i = measured - complex(p[I_ALPHA], p[I_BETA])
    shape, slope, rise_alpha, rise_beta = _dead_time(_smooth(i), math.exp(p[ZONE]))
    drop = _mean(measured)
    taken, faded = _mean(shape), _mean(slope)
    u = w.stretch.v + complex(p[V_ALPHA], p[V_BETA]) - p[R] * drop - p[DEAD_TIME] * taken
    flux = flux_0 + ts * _sum(u)
    x = flux - p[L_Q] * i
    length = np.abs(x)
    along = x / length
    dq = i * along.conj()
    saliency = p[L_D] - p[L_Q]
    r = length - p[PSI_M] - saliency * dq.real
    tilt = saliency * dq.imag / length

    def by_flux(change: Complexes) -> Floats:
        turned = change * along.conj()
        return np.asarray(turned.real - tilt * turned.imag, np.float64)

    n = i.size
    one, j = np.ones(n, np.complex128), np.full(n, 1j)
    columns = [by_flux(-ts * _sum(drop)), -(dq.real + r / p[L_D]), saliency * dq.imag**2 / length, -np.ones(n),
               by_flux(-ts * _sum(taken)), by_flux(-ts * p[DEAD_TIME] * _sum(faded)), by_flux(ts * _sum(one)),
               by_flux(ts * _sum(j)),
               by_flux(p[L_Q] * one + ts * p[DEAD_TIME] * _sum(_mean(rise_alpha))) + saliency * along.real,
               by_flux(p[L_Q] * j + ts * p[DEAD_TIME] * _sum(_mean(rise_beta))) + saliency * along.imag,
               by_flux(one), by_flux(j)]
    return r, np.stack(columns, axis=1), dq


def _sum(x: Complexes) -> Complexes:
    """Running sum over the intervals that end at samples 1, 2, ..., 0 at the first."""
    out = np.cumsum(x)
    return np.asarray(out - out[0], np.complex128)


def _mean(x: Complexes) -> Complexes:
    out = x.copy()
    out[1:] = 0.5 * (x[1:] + x[:-1])
    return out


def _smooth(i: Complexes) -> Complexes:
    """Mean over _SMOOTHED samples around each: near zero the sensor's noise would turn the sign."""
    total = np.concatenate([[0.0], np.cumsum(i)])
    at = np.arange(i.size)
    low, high = np.maximum(at - _SMOOTHED // 2, 0), np.minimum(at + _SMOOTHED // 2 + 1, i.size)
    return np.asarray((total[high] - total[low]) / (high - low), np.complex128)


def _dead_time(i: Complexes, zone: float) -> tuple[Complexes, Complexes, Complexes, Complexes]:
    """As `encoder_fit.dead_time` for many samples: shape, its derivative by ln zone, by i_alpha, and by i_beta."""
    shape, slope = np.zeros(i.size, np.complex128), np.zeros(i.size, np.complex128)
    alpha, beta = slope.copy(), slope.copy()
    for k in range(3):
        axis = complex(math.cos(2.0 * math.pi * k / 3.0), math.sin(2.0 * math.pi * k / 3.0))
        x = np.clip((i * axis.conjugate()).real / zone, -1.0, 1.0)
        rise = 1.5 * (1.0 - x * x)
        shape += 2.0 / 3.0 * axis * (0.5 * x * (3.0 - x * x))
        slope -= 2.0 / 3.0 * axis * (x * rise)
        alpha += 2.0 / 3.0 * axis * (axis.real * rise / zone)
        beta += 2.0 / 3.0 * axis * (axis.imag * rise / zone)
    return shape, slope, alpha, beta
