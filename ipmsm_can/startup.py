"""Start-up at standstill: axis by the probing signal, north by polarity pulses, then the angle to the observer.

    WATCH    the observer knows the polarity, or nothing is wanted
    AXIS     polarity unknown: the probing signal's response gives the axis, modulo half a turn
    PULSES   the drive is asked for pulses along that axis; their answer tells north from south
    KNOWN    the rotor stands still and its angle is known: the axis goes on correcting the observer
    REFUSED  the answer is equal both ways: the polarity cannot be known at standstill, and nobody guesses

It advances by windows of samples, whole periods of the probing signal, counted from the first sample on, so any
partition into blocks gives the same bits; what it asks of the drive is `pulses`.  While the rotor turns fast
enough for its back-EMF to show, no pulses are wanted: then the observer tells north from south by itself.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.estimation import confidence, polarity, regression
from ipmsm_can.estimation.estimator import FORGET_AFTER, EstimateBlock, Estimator
from ipmsm_can.estimation.observers import common
from ipmsm_can.estimation.observers.injection_extraction import injection_extraction_block
from ipmsm_can.estimation.observers.kinds import INJECTION_EXTRACTION
from ipmsm_can.estimation.polarity import Verdict, window_block
from ipmsm_can.estimation.regression import regression_block
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

TARGET = 0.8
"""Peak current of the pulses that is aimed at, as a share of what is allowed; the rest is for surprises."""
_FIRST_TARGET = 0.45
_TOO_MUCH = 0.9
_LARGEST_STEP = 2.0
_SETTLED = 0.03
_APPLIED = 0.5
_LEAST_SAMPLES = 16
_AXIS_SIGMA = math.radians(4.0)
_WINDOW_SIGMA = math.radians(15.0)
_AXIS_WINDOWS = 3
_COHERENT = 0.9
_PULSES_S = 0.4
_PAUSE_S = 1.0
_TRIES = 3
_LOST_S = 0.2


class Phase(Enum):
    """Where the start-up stands."""

    WATCH = 0
    AXIS = 1
    PULSES = 2
    KNOWN = 3
    REFUSED = 4


@dataclass(frozen=True, slots=True)
class StartUpSettings:
    """frequency [Hz] of the probing signal and the pulses; current: largest peak of the pulses [A peak];
    amplitude: largest voltage of the pulses [V peak]."""

    frequency: float
    current: float
    amplitude: float


class StartUp:
    """The start-up of one drive, with its estimator of the axis.

    phase; pulses: (amplitude [V peak], axis [rad electrical]) to be asked of the drive, or None.
    """

    def __init__(self, motor: Motor, estimator: Estimator, settings: StartUpSettings) -> None:
        self.estimator = estimator
        self.settings = settings
        self.phase = Phase.WATCH
        self.amplitude = 0.0
        self.axis = 0.0
        self.evidence = polarity.Evidence(motor, settings.current)
        s, rate = estimator.settings, estimator.sample_rate
        window = common.window_length(settings.frequency, rate)
        self.n = window * -(-_LEAST_SAMPLES // window) if window else 0
        self._motor = motor
        self._rate = rate
        self._noise = s.current_noise
        self._still_below = 2.0 * s.voltage_uncertainty
        self._regression_parameters = regression.parameters(motor, s.alpha, rate)
        self._axis_parameters = common.parameters(INJECTION_EXTRACTION, motor, s.alpha, 0.0, s.epsilon, rate,
                                                  settings.frequency, s.current_noise)
        self._window = polarity.new_state(self.evidence.unit, self.n)
        self._count = 0
        self._pause = 0
        self._tries = 0
        self._restart_axis()
        self._begin_axis()

    @property
    def possible(self) -> bool:
        """Whether samples are fast enough for the frequency."""
        return self.n > 0

    @property
    def busy(self) -> bool:
        """Whether it needs every sample now."""
        return self.possible and self.phase is not Phase.REFUSED and not (
            self.phase is Phase.WATCH and self._last_flags & confidence.POLARITY_KNOWN)

    @property
    def pulses(self) -> tuple[float, float] | None:
        """Amplitude [V peak] and axis [rad electrical] of the pulses that the drive is to make now."""
        return (self.amplitude, self.axis) if self.phase is Phase.PULSES else None

    _last_flags = 0

    def process(self, samples: Floats, gap: NDArray[np.int64], filled: NDArray[np.uint8]) -> EstimateBlock:
        """Run the estimator over a block, as `Estimator.process`, and the start-up with it."""
        if not self.possible or self.phase is Phase.REFUSED:
            out = self.estimator.process(samples, gap)
            if gap.max() > FORGET_AFTER * self._rate:
                self._to(Phase.WATCH)
            return out
        n = samples.shape[1]
        breaks = set(np.flatnonzero(gap).tolist())
        parts = []
        begin = 0
        while begin < n:
            if begin in breaks:
                self._interrupt(int(gap[begin]))
            end = min([n, begin + self.n - self._count, *(k for k in breaks if k > begin)])
            part = np.ascontiguousarray(samples[:, begin:end])
            parts.append(self.estimator.process(part, gap[begin:end]))
            self._follow(part, filled[begin:end])
            self._count += end - begin
            if self._count == self.n:
                self._count = 0
                self._judge(int(parts[-1].flags[-1]))
            begin = end
        return parts[0] if len(parts) == 1 else _joined(parts)

    def _interrupt(self, missing: int) -> None:
        """Samples are missing: what was gathered so far does not go on behind the gap."""
        self._count = 0
        polarity.begin_window(self._window)
        theta, known = float(self._axis_state["theta"][0]), int(self._axis_state["known"][0])
        self._restart_axis()
        if missing > FORGET_AFTER * self._rate or missing < 0:
            self._to(Phase.WATCH)
        elif self.phase is Phase.KNOWN:
            self._axis_state["theta"], self._axis_state["known"] = theta, known
        elif self.phase in (Phase.AXIS, Phase.PULSES):
            self._to(Phase.AXIS)

    def _follow(self, samples: Floats, filled: NDArray[np.uint8]) -> None:
        """The axis, and the sums of the window."""
        if self.phase is Phase.WATCH:
            return
        n = samples.shape[1]
        regressed = np.empty((regression.ROWS, n))
        axis = np.empty((common.ROWS, n))
        regression_block(samples, self._regression_parameters, self._regression, regressed)
        injection_extraction_block(samples, regressed, self._axis_parameters, self._axis_state, axis)
        window_block(samples, regressed, filled, self._window)
        self._theta = float(self._axis_state["theta"][0])
        self._sigma = float(axis[common.GAIN, -1])

    # At the end of each window

    def _judge(self, flags: int) -> None:
        self._last_flags = flags
        if self.phase is Phase.WATCH:
            self._pause = max(0, self._pause - 1)
            if not self._last_flags & confidence.POLARITY_KNOWN and not self._pause:
                self._restart_axis()
                self._to(Phase.AXIS)
            return
        still = self._stands_still()
        if self.phase is Phase.AXIS:
            self._judge_axis(still)
        elif self.phase is Phase.PULSES:
            self._judge_pulses(still)
        else:
            self._judge_known(still)
        polarity.begin_window(self._window)

    def _stands_still(self) -> bool:
        """Whether no back-EMF stands out from what the reported voltage may be wrong by."""
        w = self._window[0]
        if not w["broken"]:
            di = complex(w["last_a"] - w["first_a"], w["last_b"] - w["first_b"])
            turn = cmath.exp(2j * self._theta)
            change = self._motor.L_s * di + 0.5 * self._motor.L_0 * turn * di.conjugate()
            voltage = (complex(w["sum_a"], w["sum_b"]) - change) * self._rate / (self.n - 1)
            self._back_emf += 0.25 * (voltage - self._back_emf)
        return abs(self._back_emf) < self._still_below

    def _judge_axis(self, still: bool) -> None:
        if self._last_flags & confidence.POLARITY_KNOWN:
            self._to(Phase.WATCH)
            return
        if not still or not self._sigma < _WINDOW_SIGMA:
            self._begin_axis()
            return
        weight = 1.0 / self._sigma**2
        self._axis_windows += 1
        self._axis_weight += weight
        self._axis_sum += weight * cmath.exp(2j * self._theta)
        if (self._axis_windows >= _AXIS_WINDOWS and self._axis_weight * _AXIS_SIGMA**2 > 1.0
                and abs(self._axis_sum) > _COHERENT * self._axis_weight):
            axis = 0.5 * cmath.phase(self._axis_sum)
            self.axis = axis + math.pi * round((self._theta - axis) / math.pi)
            self._to(Phase.PULSES)

    def _judge_pulses(self, still: bool) -> None:
        w = self._window[0]
        self._windows_left -= 1
        if not still or self._windows_left <= 0:
            self._tries += still
            self._pause = round(_PAUSE_S * self._rate / self.n)
            self._to(Phase.REFUSED if self._tries >= _TRIES else Phase.WATCH)
            return
        self.evidence.add(*polarity.curvature(self._window, self._noise))
        self._aim(float(w["peak"]), float(w["voltage"]))
        verdict = self.evidence.verdict
        if verdict is Verdict.EQUAL:
            self._to(Phase.REFUSED)
        elif verdict is not Verdict.OPEN:
            if verdict is Verdict.SOUTH:
                self._axis_state["theta"] += math.pi
            self._to(Phase.KNOWN)
            self._tries = 0

    def _aim(self, peak: float, voltage: float) -> None:
        """Bring the peak current to TARGET: the drive's own control has a part in what a voltage drives."""
        current, most = self.settings.current, self.settings.amplitude
        if peak > _TOO_MUCH * current:
            self.amplitude = min(self.amplitude, voltage) * TARGET * current / peak
        elif (abs(peak - self._last_peak) < _SETTLED * peak and voltage > _APPLIED * self.amplitude
              and peak < 0.9 * TARGET * current):
            self.amplitude = min(most, self.amplitude * min(_LARGEST_STEP, TARGET * current / peak))
            peak = 0.0  # the next two windows are on their way
        self._last_peak = peak

    def _judge_known(self, still: bool) -> None:
        if not self._sigma < math.pi:
            self._lost += 1
            if self._lost > _LOST_S * self._rate / self.n:
                self._to(Phase.WATCH)
            return
        self._lost = 0
        if still:
            self.estimator.take_angle(float(self._axis_state["theta"][0]), self._sigma)

    # Changes of phase

    def _to(self, phase: Phase) -> None:
        self.phase = phase
        if phase is Phase.AXIS:
            self._begin_axis()
        elif phase is Phase.PULSES:
            self.evidence.forget()
            polarity.set_axis(self._window, self.axis)
            triangle = 4.0 * self.settings.frequency * self._motor.L_d  # V per A of its peak
            self.amplitude = min(self.settings.amplitude, _FIRST_TARGET * self.settings.current * triangle)
            self._last_peak = 0.0
            self._windows_left = round(_PULSES_S * self._rate / self.n)
        elif phase is Phase.KNOWN:
            self._lost = 0

    def _begin_axis(self) -> None:
        self._axis_windows, self._axis_weight, self._axis_sum = 0, 0.0, 0j

    def _restart_axis(self) -> None:
        self._regression = np.zeros(1, regression.STATE)
        self._axis_state = common.new_state(0.0, 0.0, 0.0)
        self._theta, self._sigma, self._back_emf = 0.0, math.pi, 0j
        polarity.begin_window(self._window)


def _joined(parts: list[EstimateBlock]) -> EstimateBlock:
    return EstimateBlock(*(np.ascontiguousarray(np.concatenate([getattr(p, name) for p in parts], axis=-1))
                           for name in EstimateBlock.__dataclass_fields__))
