"""Start-up at standstill: axis by the probing signal, north by polarity pulses, then the angle to the observer.

    WATCH    the observer knows the polarity, or nothing is wanted
    AXIS     polarity unknown: the probing signal's response gives the axis, modulo half a turn
    PULSES   the drive is asked for pulses along that axis; their answer tells north from south
    KNOWN    the rotor stands still and its angle is known: the axis goes on correcting the observer
    REFUSED  the answer is equal both ways: the polarity cannot be known at standstill, and nobody guesses

It advances by windows of unbroken samples, so any partition into blocks gives the same bits; a lost sample begins
its window anew, for nobody knows its voltage.  What it asks of the drive is `pulses`.  While the rotor turns fast
enough for its back-EMF to show, no pulses are wanted: then the observer tells north from south by itself.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.estimation import confidence, polarity
from ipmsm_can.estimation.estimator import FORGET_AFTER, EstimateBlock, Estimator
from ipmsm_can.estimation.polarity import Verdict, window_block
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
_LEAST_PERIOD = 4
_MOST_HALVINGS = 3
_AXIS_SIGMA = math.radians(7.0)
_WINDOW_SIGMA = math.radians(15.0)
_MODEL_SIGMA = math.radians(1.0)
"""What the axis of a window may be wrong by besides noise and voltage: saturation, inductances."""
_ASTRAY = math.radians(20.0)
"""1-sigma beyond which a window's axis could come back on the wrong branch."""
_LOADED = 0.05
"""Share of rated current from which on pulses tell nothing: across the axis it brings the iron past its knee, where
it bends the other way."""
_JUMP = math.radians(30.0)
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
    """frequency: highest of the pulses [Hz]; current: their largest peak [A peak]; amplitude: their largest voltage
    [V peak]."""

    frequency: float
    current: float
    amplitude: float


@dataclass(frozen=True, slots=True)
class Pulses:
    """What the drive is asked for: amplitude [V peak], frequency [Hz], axis [rad electrical]."""

    amplitude: float
    frequency: float
    axis: float


class StartUp:
    """The start-up of one drive.

    phase; angle [rad electrical], and its 1-sigma `sigma`: of the axis, in KNOWN of the north pole.
    """

    def __init__(self, motor: Motor, estimator: Estimator, settings: StartUpSettings) -> None:
        self.estimator = estimator
        self.settings = settings
        self.phase = Phase.WATCH
        self.angle, self.sigma = 0.0, math.inf
        self.evidence = polarity.Evidence(motor, settings.current)
        rate = estimator.sample_rate
        period = pulse_period(motor, settings, rate)
        self.frequency = rate / period if period else 0.0
        self.n = period * max(2, -(-_LEAST_SAMPLES // period)) if period else 0
        self._axis = 0.0
        self._amplitude = 0.0
        self._motor = motor
        self._rate = rate
        self._noise = estimator.settings.current_noise
        self._tilt = estimator.settings.uncertainty.tilt
        voltage_uncertainty = estimator.settings.voltage_uncertainty
        self._still_below = 2.0 * voltage_uncertainty
        # An error of the voltage turns the axis by at most half its share, times what b is smaller than a.  Dead
        # time, which goes against the current and so across the voltage, comes to that only where a load holds the
        # current at the dead time's corner.
        self._turned = 0.4 * voltage_uncertainty * motor.L_s / abs(0.5 * motor.L_0) if motor.L_0 else math.inf
        self._window = polarity.new_state(motor, rate, self.evidence.unit, self.n,
                                          estimator.settings.inductance_uncertainty)
        # 1-sigma of the speed [rad/s electrical] of a rotor that counts as standing.
        self._creep = voltage_uncertainty / motor.psi_m
        self._back_emf = 0j
        self._count = 0
        self._wasted = 0
        self._pause = 0
        self._tries = 0
        self._lost = 0
        self._last_peak = self._raised = 0.0
        self._begin_axis()

    @property
    def possible(self) -> bool:
        """Whether the samples are fast enough for the pulses, and the rotor has an axis to be seen."""
        return self.n > 0 and self._motor.L_0 != 0.0

    @property
    def busy(self) -> bool:
        """Whether it needs every sample as it comes."""
        # Asked of the estimator, which may have gone on without the start-up since the last window.
        return self.possible and self.phase is not Phase.REFUSED and not (
            self.phase is Phase.WATCH and self.estimator.polarity_known)

    @property
    def pulses(self) -> Pulses | None:
        """The pulses that the drive is to make now."""
        return Pulses(self._amplitude, self.frequency, self._axis) if self.phase is Phase.PULSES else None

    def process(self, samples: Floats, gap: NDArray[np.int64], filled: NDArray[np.uint8]) -> EstimateBlock:
        """Run the estimator over a block, as `Estimator.process`, and the start-up with it."""
        if not self.possible:
            return self.estimator.process(samples, gap)
        n = samples.shape[1]
        stops = np.append(np.union1d(np.flatnonzero(gap), np.flatnonzero(filled) + 1), n)
        parts = []
        begin = 0
        while begin < n:
            if gap[begin]:
                self._interrupt(int(gap[begin]))
            end = int(stops[np.searchsorted(stops, begin, side="right")])
            if self.phase is not Phase.REFUSED:
                end = min(end, begin + self.n - self._count)
            part = np.ascontiguousarray(samples[:, begin:end])
            parts.append(self.estimator.process(part, gap[begin:end]))
            begin, start = end, begin
            if self.phase is Phase.REFUSED:
                continue
            if self.phase is not Phase.WATCH:
                window_block(part, filled[start:end], self._window)
            self._count += end - start
            lost = bool(filled[end - 1])
            full = self._count == self.n and not lost
            self._wasted += self._count if lost else 0
            if full or self._wasted >= self.n:
                self._judge(int(parts[-1].flags[-1]), float(parts[-1].sigma[-1]))
                self._wasted = 0
            if full or lost:
                self._begin_window()
        return parts[0] if len(parts) == 1 else _joined(parts)

    def doubt(self) -> None:
        """The estimator's angle is in doubt, and so is what was found here."""
        if self.phase is not Phase.REFUSED:
            self._begin_window()
            self._to(Phase.WATCH)

    def resume(self, theta: float, sigma: float) -> None:
        """The rotor has come to a standstill with the probing signal on: its axis corrects the observer again.

        theta, sigma: the observer's angle, polarity known, and its 1-sigma [rad electrical].
        """
        if self.possible and self.phase is Phase.WATCH:
            self.angle, self.sigma = theta, sigma
            self._back_emf = 0j
            self._begin_window()
            self._to(Phase.KNOWN)

    @property
    def still_below(self) -> float:
        """Back-EMF [V peak] below which the rotor counts as standing still."""
        return self._still_below

    def _begin_window(self) -> None:
        self._count = 0
        polarity.begin_window(self._window)

    def _interrupt(self, missing: int) -> None:
        """Samples are missing: what was gathered so far does not go on behind the gap."""
        self._begin_window()
        self.sigma = math.hypot(self.sigma, self._creep * abs(missing) / self._rate)
        redated = missing < 0 and self.phase is not Phase.REFUSED
        astray = self.phase is Phase.KNOWN and self.sigma > _ASTRAY
        if missing > FORGET_AFTER * self._rate or redated or astray:
            self._to(Phase.WATCH)
        elif self.phase in (Phase.AXIS, Phase.PULSES):
            self._to(Phase.AXIS)

    # At the end of each window, and where as many samples went by without one

    def _judge(self, flags: int, known_to: float) -> None:
        known = flags & confidence.POLARITY_KNOWN != 0
        if self.phase is Phase.WATCH:
            self._pause = max(0, self._pause - 1)
            if not known and not self._pause:
                self._back_emf = 0j
                self._to(Phase.AXIS)
            return
        theta, sigma = polarity.axis(self._window, self._noise)
        # What the iron is driven with along d turns the axis as much as what loads it across.
        load = polarity.load(self._window)
        driven = max(load, float(self._window["peak"][0])) if self.phase is Phase.PULSES else load
        tilt = self._tilt * load * driven / self._motor.rated_current**2
        turned = self._turned / max(float(self._window["voltage"][0]), 1e-9)
        # A window tells where the axis was in its middle.
        sigma = math.hypot(sigma, _MODEL_SIGMA, tilt, turned, 0.5 * self._creep * self.n / self._rate)
        broken = bool(self._window["broken"][0])
        if not broken:
            self._back_emf += 0.25 * (polarity.back_emf(self._window, theta, self._motor) - self._back_emf)
        still = abs(self._back_emf) < self._still_below
        if self.phase is Phase.AXIS:
            if known:
                self._to(Phase.WATCH)
            elif still and sigma < _WINDOW_SIGMA:
                self._find_axis(theta, sigma)
            elif not broken:
                self._begin_axis()
        elif self.phase is Phase.PULSES:
            self._track(theta, sigma)
            self._judge_pulses(still)
            self._look_along(self.angle)  # the pulses show the axis much better than what went before
        else:
            self._judge_known(still, known_to if known else math.inf, theta, sigma)

    def _find_axis(self, theta: float, sigma: float) -> None:
        """Average the axes of successive windows until they are sure enough."""
        weight = 1.0 / sigma**2
        self._axis_windows += 1
        self._axis_weight += weight
        self._axis_sum += weight * cmath.exp(2j * theta)
        if (self._axis_windows >= _AXIS_WINDOWS and self._axis_weight * _AXIS_SIGMA**2 > 1.0
                and abs(self._axis_sum) > _COHERENT * self._axis_weight):
            self.angle = 0.5 * cmath.phase(self._axis_sum)
            self.sigma = sigma
            self._to(Phase.PULSES)

    def _track(self, theta: float, sigma: float) -> float | None:
        """Follow the axis from window to window on its branch; returns the window's angle, None if not believed.

        What windows are wrong by besides noise they have in common, so the angle never counts as better than the
        best of them.  The rotor may creep on meanwhile, always the same way.
        """
        self.sigma += self._creep * self.n / self._rate
        off = math.remainder(theta - self.angle, math.pi)
        if not (sigma < _WINDOW_SIGMA and abs(off) < _JUMP):
            return None
        measured = self.angle + off
        if sigma < self.sigma:
            self.angle = math.remainder(self.angle + (1.0 - (sigma / self.sigma) ** 2) * off, 2.0 * math.pi)
            self.sigma = sigma
        return measured

    def _judge_pulses(self, still: bool) -> None:
        self._windows_left -= 1
        if not still or self._windows_left <= 0:
            self._tries += still
            self._pause = round(_PAUSE_S * self._rate / self.n)
            self._to(Phase.REFUSED if self._tries >= _TRIES else Phase.WATCH)
            return
        if self._window["broken"][0]:
            return
        if polarity.load(self._window) < _LOADED * self._motor.rated_current:
            self.evidence.add(*polarity.curvature(self._window, self._noise))
        self._aim(float(self._window["peak"][0]), float(self._window["voltage"][0]))
        verdict = self.evidence.verdict
        if verdict is Verdict.EQUAL:
            self._to(Phase.REFUSED)
        elif verdict is not Verdict.OPEN:
            if not self.sigma < _AXIS_SIGMA:
                return  # of which end is north there is no doubt, but where it is now nobody knows yet
            if verdict is Verdict.SOUTH:
                self.angle = math.remainder(self.angle + math.pi, 2.0 * math.pi)
            self._to(Phase.KNOWN)
            self.estimator.take_angle(self.angle, self.sigma)

    def _aim(self, peak: float, voltage: float) -> None:
        """Bring the peak current to TARGET: the drive's own control has a part in what a voltage drives."""
        current, most = self.settings.current, self.settings.amplitude
        if peak > _TOO_MUCH * current:
            self._amplitude = min(self._amplitude, voltage) * TARGET * current / peak
        elif (abs(peak - self._last_peak) < _SETTLED * peak and voltage > _APPLIED * self._amplitude
              and self._raised < peak < 0.9 * TARGET * current):
            more = min(_LARGEST_STEP, TARGET * current / peak, most / self._amplitude)
            self._amplitude *= more
            # Until half of it shows, it is still on its way: a bus takes its time, and so does the drive's ramp.
            self._raised = peak * (0.5 + 0.5 * more)
        self._last_peak = peak

    def _judge_known(self, still: bool, known_to: float, theta: float, sigma: float) -> None:
        measured = self._track(theta, sigma)
        self._lost = 0 if measured is not None else self._lost + 1
        if not still or self._lost > _LOST_S * self._rate / self.n:
            # Turning, the observer sees more than the axis shows, which could come back on the wrong branch.
            self._to(Phase.WATCH)
        elif measured is not None and not math.isfinite(known_to):
            self.estimator.take_angle(self.angle, self.sigma)
        elif measured is not None and sigma < known_to:
            # The error of this window is that of the ones before: however many are taken in, they never come to
            # more than the best of them.
            self.estimator.take_angle(measured, sigma / math.sqrt(1.0 - (sigma / known_to) ** 2))

    # Changes of phase

    def _to(self, phase: Phase) -> None:
        self.phase = phase
        if phase is Phase.AXIS:
            self._begin_axis()
        elif phase is Phase.PULSES:
            self.evidence.forget()
            self._look_along(self.angle)
            triangle = 4.0 * self.frequency * self._motor.L_d  # V per A of its peak
            self._amplitude = min(self.settings.amplitude, _FIRST_TARGET * self.settings.current * triangle)
            # Until half of what they drive shows, it is still the probing signal, which may hold as still.
            self._last_peak, self._raised = 0.0, 0.5 * self._amplitude / triangle
            self._windows_left = round(_PULSES_S * self._rate / self.n)
        elif phase is Phase.KNOWN:
            self._tries = self._lost = 0

    def _look_along(self, axis: float) -> None:
        self._axis = axis
        self._window["axis"] = cmath.exp(1j * axis)

    def _begin_axis(self) -> None:
        self._axis_windows, self._axis_weight, self._axis_sum = 0, 0.0, 0j


def pulse_period(motor: Motor, settings: StartUpSettings, sample_rate: float) -> int:
    """Period of the pulses in samples, 0 where that would be too few: so long that the voltage allowed reaches the
    current aimed at, in whole octaves below the highest frequency, at most three.

    An even number, so that what is odd in the current, such as dead time, is so in the samples, too; an odd number
    would turn it into a difference between + and -.
    """
    frequency = settings.frequency
    for _ in range(_MOST_HALVINGS):
        if 4.0 * frequency * motor.L_d * TARGET * settings.current <= settings.amplitude:
            break
        frequency *= 0.5
    period = 2 * round(0.5 * sample_rate / frequency)
    return period if period >= _LEAST_PERIOD else 0


def _joined(parts: list[EstimateBlock]) -> EstimateBlock:
    return EstimateBlock(*(np.ascontiguousarray(np.concatenate([getattr(p, name) for p in parts], axis=-1))
                           for name in EstimateBlock.__dataclass_fields__))
