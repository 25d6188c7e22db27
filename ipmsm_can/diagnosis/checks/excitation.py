"""Whether the position shows in the samples at all: which of the paper's conditions hold, and what probing needs.

Of each window of WINDOW_S the level of C1, the smallest eigenvalue of int u u^T dt with u = v - R i - L_s p[i], is
compared with what the voltage may be wrong by, observer.voltage_uncertainty squared times the window: below that
the position does not show above the errors.  With the true angle C2 has the level of C1; a rotor that stands has it
from p[i] alone, and that is C3.  Rotating probing with V volts at standstill makes (L_0 V / (2 L_s))^2 / 2 a
second. """

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.config.build import probing_frequency
from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding
from ipmsm_can.experiments.conditions import window_levels

_MEAN_S = 2e-3
_MEANS_A_PERIOD = 5.0
_STANDS = math.radians(2.0)
_SCATTER = 3.0

Bools = NDArray[np.bool_]


def required(case: Case) -> float:
    """Level that a condition must have [V^2 s]."""
    return case.volts**2 * limits.WINDOW_S


def levels(case: Case) -> tuple[NDArray[np.float64], Bools, Bools]:
    """C1's level [V^2 s] of every window, whether the rotor stood in it, and whether the drive probed in it."""
    m, motor, x = case.m, case.motor, case.vectors
    found, stood, probed = [], [], []
    for begin, end in case.runs:
        span = slice(begin, end)
        injecting = bool(m.injecting[span].any())
        # Means keep the noise low, but must not average the probing signal away.
        size = _mean_samples(case, injecting)
        dt, n = size / m.sample_rate, max(2, round(limits.WINDOW_S * m.sample_rate / size))
        i, v = x.i[span], x.v[span]
        emf = v[1:] - 0.5 * motor.R * (i[1:] + i[:-1])
        whole = len(emf) // size * size
        if whole // size < n:
            continue
        mean = emf[:whole].reshape(-1, size).mean(axis=1)
        u = mean - motor.L_s * np.diff(i[:whole + 1:size]) / dt
        of_noise = _of_noise(case, dt, n)
        at = np.arange(0, u.size - n + 1, n)
        found.append(window_levels(u, dt, n)[at] - of_noise)
        theta = x.theta[span] if case.has_encoder else np.full(end - begin, np.nan)
        first, last = at * size, np.minimum((at + n) * size, end - begin - 1)
        stood.append(np.abs(theta[last] - theta[first]) < _STANDS if case.by_encoder
                     else np.full(at.size, case.has_encoder))
        probed.append(np.array([m.injecting[begin + a:begin + b].any() for a, b in zip(first, last, strict=True)],
                               np.bool_))
    if not found:
        return np.zeros(0), np.zeros(0, np.bool_), np.zeros(0, np.bool_)
    return np.concatenate(found), np.concatenate(stood), np.concatenate(probed)


def _mean_samples(case: Case, injecting: bool) -> int:
    frequency = probing_frequency(case.config, case.m.sample_rate)
    return max(1, int((1.0 / (_MEANS_A_PERIOD * frequency) if injecting else _MEAN_S) * case.m.sample_rate))


def _of_noise(case: Case, dt: float, n: int) -> float:
    """What the noise of the current alone can make of the level of n means over dt [s] each [V^2 s]."""
    motor = case.motor
    power = (motor.R**2 + 2.0 * (motor.L_s / dt) ** 2) * case.noise**2
    return power * n * dt * (1.0 + _SCATTER * math.sqrt(3.0 / n))


def probing_needed(case: Case) -> float:
    """Amplitude [V peak] of rotating probing that shows the position of a rotor at rest above noise and errors of
    the voltage; inf without saliency.  What dead time and the current control take of it comes on top."""
    motor = case.motor
    share = abs(motor.L_0) / (2.0 * motor.L_s)
    if share <= 1e-3:
        return math.inf
    dt = _mean_samples(case, True) / case.m.sample_rate
    level = required(case) + _of_noise(case, dt, max(2, round(limits.WINDOW_S / dt)))
    return math.sqrt(2.0 * level / limits.WINDOW_S) / share


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Excitation."""
    level, stood, probed = levels(case)
    name = "excitation"
    if not level.size:
        return [], [Checked(name, "untold", f"no {limits.WINDOW_S:g} s without a gap")]
    holds = level >= required(case)
    turning, c3 = float((holds & ~stood).mean()), float((holds & stood).mean())
    nothing = float((~holds).mean())
    words = (f"position observable {100 * (turning + c3):.0f} % of the time: C1 and C2 by rotation "
             f"{100 * turning:.0f} %, C3 at standstill {100 * c3:.0f} %")
    if nothing <= limits.UNEXCITED:
        return [], [Checked(name, "fine", words)]
    volts = probing_needed(case)
    injecting = bool(probed.any())
    advice = "Nothing in the samples can show it: the machine has no saliency. It has to turn."
    if math.isfinite(volts):
        now = " more than now" if injecting else ""
        advice = (f"Let the companion probe there: a rotating voltage of about {volts:.1f} V peak{now} makes C3 "
                  "hold (injection.amplitude, and --transmit).")
    return [Finding(
        "excitation.weak", "info", "the position does not show all the time",
        f"For {100 * nothing:.0f} % of the time neither rotation (C1, C2) nor a probing current (C3) shows the "
        f"rotor's position above the {case.volts:g} V that the voltage may be wrong by.", advice,
        (Evidence("C1 and C2 hold", 100 * turning, "% of the time"),
         Evidence("C3 holds at standstill", 100 * c3, "% of the time"),
         Evidence("none holds", 100 * nothing, "% of the time"),
         Evidence("rotating probing needed at standstill", volts, "V peak"),
         Evidence("level asked for", required(case), "V^2 s")), size=nothing / limits.UNEXCITED, order=6)], [
            Checked(name, "found", words)]
