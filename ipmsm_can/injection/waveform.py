"""Probing waveforms: the voltage a drive adds to its own, one value per control period.

The inverter holds a voltage for a whole control period, so what is applied is the waveform's mean over
that period: its integral, hence the flux it injects, is right at any ratio of frequency to sample rate.
The waveforms at phase phi (rad, 0 at the start) on the axis at the electrical angle a:

    rotating          A (cos(phi + a), sin(phi + a))
    pulsating         A cos(phi) (cos a, sin a)
    polarity_pulses   A sign(cos(phi)) (cos a, sin a)

Along one axis they start a quarter period before a zero, so the current they cause has no mean; the
polarity pulses drive equal triangles of current along +axis and -axis in turn, from zero and back to zero,
whose heights tell the magnet's north from its south in a machine that saturates.

A command lives for a counted number of samples; when they have run out the waveform is off with the
next sample, without a ramp, because then nobody is in charge of it any more.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

OFF = 0
ROTATING = 1
PULSATING = 2
POLARITY_PULSES = 3
WAVEFORM_NAMES = ("off", "rotating", "pulsating", "polarity_pulses")

# State, float64 (W_SIZE,).  First what is being put out ...
W_WAVEFORM = 0
W_AMPLITUDE = 1  # V peak, on its way to the target
W_FREQUENCY = 2  # Hz
W_AXIS = 3  # rad electrical
W_PHASE = 4  # rad, 0..2 pi
# ... then what was asked for last
W_ASKED_WAVEFORM = 5
W_ASKED_AMPLITUDE = 6
W_ASKED_FREQUENCY = 7
W_ASKED_AXIS = 8
W_TIME_TO_LIVE = 9  # samples left
W_SIZE = 10

_TWO_PI = 2.0 * math.pi
_RAMP_END = 0.01  # of a step


@kernel
def ask(
    state: NDArray[np.float64], waveform: int, amplitude: float, frequency: float, axis: float,
    ttl_samples: int,
) -> None:
    """Take a command into the state; it counts from the next `step` for ttl_samples steps.

    waveform 0..3, amplitude [V peak], frequency [Hz] above 0, axis [rad electrical].  A repeated command
    renews the time to live and moves amplitude, frequency and axis without a break in phase.
    """
    state[W_ASKED_WAVEFORM] = waveform
    state[W_ASKED_AMPLITUDE] = amplitude if waveform != OFF else 0.0
    state[W_ASKED_FREQUENCY] = frequency
    state[W_ASKED_AXIS] = axis
    state[W_TIME_TO_LIVE] = ttl_samples


@kernel
def _square_integral(phase: float) -> float:
    """Integral of sign(cos) from 0 to phase: a triangle between -pi/2 and pi/2."""
    return math.asin(math.sin(phase))


@kernel
def step(
    state: NDArray[np.float64], period: float, ramp: float, amplitude_limit: float
) -> tuple[float, float]:
    """Mean injection voltage (alpha, beta) [V] over the next control period; the state moves on by one.

    period: control period [s].  ramp: fastest change of amplitude [V/s].  amplitude_limit: the drive's
    own limit [V peak], above whatever was asked.  Before another waveform starts, the present one goes
    down along the ramp with its own frequency and axis.
    """
    if state[W_TIME_TO_LIVE] <= 0.0:
        state[W_WAVEFORM] = OFF
        state[W_AMPLITUDE] = 0.0
        return 0.0, 0.0
    state[W_TIME_TO_LIVE] -= 1.0

    change = ramp * period
    amplitude = state[W_AMPLITUDE]
    if state[W_WAVEFORM] != state[W_ASKED_WAVEFORM]:
        amplitude -= change
        # A ramp of n steps up is down after n steps, too, whatever rounding left of it: in any precision.
        if amplitude <= _RAMP_END * change:
            amplitude = 0.0
            state[W_WAVEFORM] = state[W_ASKED_WAVEFORM]
            state[W_PHASE] = 0.0
    if state[W_WAVEFORM] == state[W_ASKED_WAVEFORM]:
        state[W_FREQUENCY] = state[W_ASKED_FREQUENCY]
        state[W_AXIS] = state[W_ASKED_AXIS]
        target = max(0.0, min(state[W_ASKED_AMPLITUDE], amplitude_limit))
        amplitude = max(target, amplitude - change) if amplitude > target else min(target, amplitude + change)
    state[W_AMPLITUDE] = amplitude
    if state[W_WAVEFORM] == OFF or amplitude == 0.0:
        return 0.0, 0.0

    start = state[W_PHASE]
    width = _TWO_PI * state[W_FREQUENCY] * period
    end = start + width
    state[W_PHASE] = end - _TWO_PI * math.floor(end / _TWO_PI)
    axis = state[W_AXIS]
    if state[W_WAVEFORM] == POLARITY_PULSES:
        mean = amplitude * (_square_integral(end) - _square_integral(start)) / width
        return mean * math.cos(axis), mean * math.sin(axis)
    # mean of cos over [start, end] without the cancellation of (sin end - sin start)
    amplitude *= math.sin(0.5 * width) / (0.5 * width)
    middle = start + 0.5 * width
    if state[W_WAVEFORM] == ROTATING:
        return amplitude * math.cos(middle + axis), amplitude * math.sin(middle + axis)
    mean = amplitude * math.cos(middle)
    return mean * math.cos(axis), mean * math.sin(axis)
