"""Where the drive's control takes its angle from: the encoder, the companion, or a current vector it turns itself.

    ENCODER    the encoder's angle, until the encoder fails
    COMPANION  theta + omega age of the last PositionEstimate, as long as it may be used
    HOLD       no angle yet: the inverter switches and holds the current at zero, so that the companion can look,
               and probe, at a rotor that stands or turns slowly
    OPEN_LOOP  no angle yet: a current vector of constant size is turned in the direction of the reference (I-f
               start), and takes the rotor along until the companion knows the angle
    STOPPED    the gates are off, for good: the encoder failed, or the companion's angle, and nothing replaced it

Whether an estimate may be used is decided by the rules of the C library for the drive's microcontroller
(firmware_stub/src/receiver.c): in sequence and intact, younger than its time to live by the drive's own sample
counter, locked, polarity known, 1-sigma within the limit, and valid to begin with; a control that runs on it
already goes on without the last.  An estimate says so itself; its age is asked anew at every sample.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.drive.machine import (
    M_FRICTION,
    M_INERTIA,
    M_POLE_PAIRS,
    M_PSI,
    X_LAMBDA_ALPHA,
    X_LAMBDA_BETA,
    X_OMEGA_M,
    X_THETA_M,
    wrap,
)
from ipmsm_can.drive.parameters import ANGLE_SOURCES, DriveParameters

Array = NDArray[np.float64]


class AngleVerdict(IntEnum):
    """Whether the companion's angle may be used; the C library's ipmsm_angle_verdict."""

    USABLE = 0
    MISSING = 1
    INVALID = 2
    UNCERTAIN = 3
    DOUBTFUL = 4
    """Not valid, but all the rest: good enough to go on with, not to begin."""


class AngleState(IntEnum):
    """What the control runs on; see the module."""

    ENCODER = 0
    COMPANION = 1
    HOLD = 2
    OPEN_LOOP = 3
    STOPPED = 4


ENCODER, COMPANION, HOLD, OPEN_LOOP, STOPPED = (int(state) for state in AngleState)
_MISSING = int(AngleVerdict.MISSING)
_USABLE = int(AngleVerdict.USABLE)
_DOUBTFUL = int(AngleVerdict.DOUBTFUL)
_ENCODER_ONLY, _COMPANION_ONLY, _BOTH = range(len(ANGLE_SOURCES))

# Settings, float64 (G_SIZE,)
G_SOURCE = 0
G_ENCODER_FAILS = 1  # sample from which the encoder says nothing any more
G_MAX_AGE = 2  # samples
G_OPEN_CURRENT = 3  # A peak; 0: hold
G_OPEN_OMEGA = 4  # rad/s electrical
G_OPEN_STEP = 5  # change of the vector's speed in a period, rad/s electrical
G_SIZE = 6

# State, float64 (A_SIZE,): what runs, the last estimate taken, and the vector turned open loop
A_STATE = 0
A_HELD = 1  # 1: there is an estimate
A_SAMPLE = 2  # the sample it belongs to
A_THETA = 3  # rad electrical
A_OMEGA = 4  # rad/s electrical
A_VERDICT = 5  # what it says of itself: an AngleVerdict, whatever its age
A_OPEN_THETA = 6  # rad electrical
A_OPEN_SPEED = 7  # rad/s electrical, signed
A_SIZE = 8

# What the control is told of the companion's angle at each sample, float64 (T_SIZE, n)
T_VERDICT = 0  # an AngleVerdict
T_THETA = 1  # rad electrical, at the sample; means nothing where it may not be used
T_OMEGA = 2  # rad/s electrical
T_SIZE = 3


def pack(p: DriveParameters) -> tuple[Array, Array]:
    """Settings and fresh state as the kernels take them."""
    g = np.zeros(G_SIZE)
    g[G_SOURCE] = ANGLE_SOURCES.index(p.angle_source)
    g[G_ENCODER_FAILS] = p.encoder_fails_sample
    g[G_MAX_AGE] = p.estimate_max_age
    g[G_OPEN_CURRENT] = p.open_loop_current
    g[G_OPEN_OMEGA] = p.open_loop_speed
    g[G_OPEN_STEP] = p.open_loop_speed / (p.open_loop_ramp * p.sample_rate)
    a = np.zeros(A_SIZE)
    a[A_STATE] = HOLD if g[G_SOURCE] == _COMPANION_ONLY else ENCODER
    return g, a


@kernel
def extrapolate(theta: float, omega: float, elapsed: float) -> float:
    """theta + omega elapsed in 0..2 pi, as ipmsm_extrapolate does; [rad], [rad/s], [s]."""
    angle = theta + omega * elapsed
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi))


@kernel
def verdict(a: Array, g: Array, sample: float) -> int:
    """AngleVerdict on the estimate held, at this sample."""
    if a[A_HELD] == 0.0 or sample - a[A_SAMPLE] > g[G_MAX_AGE]:
        return _MISSING
    return int(a[A_VERDICT])


@kernel
def tell(out: Array, first: int, a: Array, g: Array, period: float) -> None:
    """Fill out (T_SIZE, n) for the samples from `first` on, with the estimate held and no other coming in."""
    for j in range(out.shape[1]):
        sample = float(first + j)
        out[T_VERDICT, j] = verdict(a, g, sample)
        out[T_THETA, j] = extrapolate(a[A_THETA], a[A_OMEGA], (sample - a[A_SAMPLE]) * period)
        out[T_OMEGA, j] = a[A_OMEGA]


@kernel
def choose(a: Array, g: Array, sample: float, judged: int, wanted: float, may_turn: bool) -> int:
    """The AngleState of this sample, from the last one; a is moved on.

    judged: the AngleVerdict on the companion's angle.  wanted: speed reference, whose sign alone counts.
    may_turn: the shaft is free, so it can be turned open loop.
    """
    state = int(a[A_STATE])
    usable = judged == _USABLE
    if state == ENCODER:
        if sample >= g[G_ENCODER_FAILS]:
            state = COMPANION if g[G_SOURCE] == _BOTH and usable else STOPPED
    elif state == COMPANION:
        if not usable and judged != _DOUBTFUL:
            state = STOPPED
    elif state != STOPPED:
        if usable:
            state = COMPANION
        elif state == HOLD and may_turn and wanted != 0.0 and g[G_OPEN_CURRENT] > 0.0:
            state = OPEN_LOOP
            a[A_OPEN_THETA] = 0.0
            a[A_OPEN_SPEED] = 0.0
    a[A_STATE] = state
    return state


@kernel
def turn_open_loop(a: Array, g: Array, wanted: float, period: float) -> None:
    """Move the open-loop vector on by a period; with a reference of 0 it keeps its speed."""
    if wanted != 0.0:
        target = math.copysign(g[G_OPEN_OMEGA], wanted)
        change = target - a[A_OPEN_SPEED]
        a[A_OPEN_SPEED] += max(-g[G_OPEN_STEP], min(g[G_OPEN_STEP], change))
    a[A_OPEN_THETA] = wrap(a[A_OPEN_THETA] + a[A_OPEN_SPEED] * period)


@kernel
def coast(x: Array, load: float, period: float, substeps: int, free_shaft: bool, omega_end: float,
          m: Array) -> None:
    """Advance the machine's state x by one control period with all gates off.

    The diodes put v_dc against the current and take it to zero, at rated current within a control period; here it
    is zero at once.  Beyond v_dc between lines the magnets would drive current through them, which is left out.
    Arguments as for `machine.advance`.
    """
    h = period / substeps
    w = x[X_OMEGA_M]
    th = x[X_THETA_M]
    imposed = (omega_end - w) / period
    for _ in range(substeps):
        slope = (-load - m[M_FRICTION] * w) / m[M_INERTIA] if free_shaft else imposed
        middle = w + 0.5 * h * slope
        th += h * middle
        w += h * ((-load - m[M_FRICTION] * middle) / m[M_INERTIA] if free_shaft else imposed)
    x[X_OMEGA_M] = w if free_shaft else omega_end
    x[X_THETA_M] = wrap(th)
    theta_e = m[M_POLE_PAIRS] * x[X_THETA_M]
    x[X_LAMBDA_ALPHA] = m[M_PSI] * math.cos(theta_e)
    x[X_LAMBDA_BETA] = m[M_PSI] * math.sin(theta_e)
