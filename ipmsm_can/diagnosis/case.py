"""What the checks share: the measurement with what is the wrong way round undone, and the equation fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis import model
from ipmsm_can.diagnosis.model import Vectors
from ipmsm_can.diagnosis.observer import Observed, observe
from ipmsm_can.diagnosis.regression import Solution
from ipmsm_can.diagnosis.slip import ZeroCourse, find_slips
from ipmsm_can.diagnosis.windows import Track, Windows, encoder_track, make_windows, stretches, window_length
from ipmsm_can.diagnosis.wiring import Wiring, find_wiring
from ipmsm_can.identification import identify
from ipmsm_can.motor import Motor

if TYPE_CHECKING:
    from ipmsm_can.analysis.measurement import Measurement
    from ipmsm_can.config.model import DriveConfig
    from ipmsm_can.identification.result import Identification

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_IDENTIFIED_S = 0.5
LEAST_WINDOWS = 60
"""Windows that a fit takes at least."""
LEAST_TURN = 4.0 * math.pi
"""Angle [rad electrical] that the rotor must turn for anything to be said of an encoder."""
CLEAR_EMF = 6.0
"""The back-EMF that counts as turning, in units of what the voltage may be wrong by."""
_MOST_WINDOWS = 10_000
_AROUND_SLIP_S = 0.03
_MOST_DELAY = 4.0
_ROUNDS, _SETTLED = 8, 1e-3
_MOST_VOLTS = 40.0
"""Largest error of the voltage that is thought of, in units of what it may be wrong by."""
_TOLD_OFFSET, _TOLD_GAIN, _TOLD_DELAY, _TOLD_ANGLE = 0.05, 0.05, 0.1, 0.05
"""Largest 1-sigma of what is undone: share of rated current, share, samples, rad."""


@dataclass(frozen=True, slots=True)
class Fit:
    """The equation fitted to a measurement whose wiring, slips and errors are undone.

    x: the vectors it was fitted to in the end: the angle turned to the magnet and without eccentricity, the voltage
    shifted, the current without offset and with equal gains.  known (N,): samples that count.
    solution: of the last round, in which what is undone is nearly 0.  zero: encoder minus rotor [rad electrical].
    delay: how late the voltage is [samples].  offset [A], gain (of the mirrored current), eccentricity
    [rad electrical]: undone altogether.
    dead_zone: current below which dead time fades out [A].
    """

    x: Vectors
    windows: Windows
    known: Bools
    solution: Solution
    zero: float
    delay: float
    offset: complex
    gain: complex
    eccentricity: complex
    dead_zone: float

    @property
    def zero_sigma(self) -> float:
        """1-sigma of the zero [rad electrical]."""
        psi = abs(self.solution.pair("psi"))
        return self.solution.sigma("psi.y") / psi if psi > 0.0 else math.pi


@dataclass(frozen=True, slots=True)
class _Undone:
    """What is taken off the vectors: units as in `Fit`."""

    turned: float = 0.0
    delay: float = 0.0
    offset: complex = 0j
    gain: complex = 0j
    eccentricity: complex = 0j

    def plus(self, step: _Undone) -> _Undone:
        return _Undone(math.remainder(self.turned + step.turned, 2.0 * math.pi),
                       float(np.clip(self.delay + step.delay, -_MOST_DELAY, _MOST_DELAY)),
                       self.offset + step.offset, self.gain + step.gain, self.eccentricity + step.eccentricity)

    def size(self, rated_current: float) -> float:
        """The largest of them, in its own unit: rad, ten samples, rated current, share."""
        return max(abs(self.turned), 0.1 * abs(self.delay), abs(self.offset) / rated_current, abs(self.gain),
                   abs(self.eccentricity))

    def apply(self, raw: Vectors, pole_pairs: int) -> Vectors:
        theta = raw.theta + self.turned
        shaft, ecc = theta / pole_pairs, self.eccentricity
        current = raw.i - self.offset
        return Vectors(current - self.gain * current.conj(), _shifted(raw.v, self.delay),
                       theta + ecc.real * np.cos(shaft) + ecc.imag * np.sin(shaft), raw.sample_rate)


class Case:
    """A measurement of a drive, and everything that several checks need of it, worked out once.

    measurement, config: what is judged, and what the drive is said to be.  thorough: the motor's parameters are
    those of `identification`, which takes a second or so, else those of the quick fit here.
    """

    def __init__(self, measurement: Measurement, config: DriveConfig, thorough: bool = True) -> None:
        self.thorough = thorough
        self.m = measurement
        self.config = config
        self.motor: Motor = config.build_motor()
        self.volts: float = max(config.observer.voltage_uncertainty, 1e-3)
        self.usable: Bools = measurement.usable & measurement.running

    @cached_property
    def track(self) -> Track:
        """The encoder at the samples, as reported."""
        return encoder_track(self.m)

    @cached_property
    def has_encoder(self) -> bool:
        """There are encoder reports to go by."""
        return int(np.count_nonzero(self.track.known & self.usable)) > 0

    @cached_property
    def seconds(self) -> float:
        """Time in which the drive ran and its samples can be used [s]."""
        return float(np.count_nonzero(self.usable)) / self.m.sample_rate if len(self.m) else 0.0

    @cached_property
    def turns(self) -> bool:
        """The rotor turned, by the encoder: far enough and, for a while, fast enough."""
        theta, omega = self.track.theta[self.usable], self.track.omega[self.usable]
        theta = theta[np.isfinite(theta)]
        fast = np.abs(omega[np.isfinite(omega)]) * self.motor.psi_m > CLEAR_EMF * self.volts
        return bool(theta.size and np.ptp(theta) > LEAST_TURN
                    and np.count_nonzero(fast) > 0.05 * self.m.sample_rate)

    def _windows(self, x: Vectors, known: Bools) -> Windows:
        omega = np.gradient(x.theta) * self.m.sample_rate if len(x.theta) > 1 else np.zeros(len(x.theta))
        fast = np.abs(omega[known & np.isfinite(omega)])
        top = float(np.quantile(fast, 0.99)) if fast.size else 0.0
        length = window_length(self.m, top)
        shifted = replace(self.m, i_alpha=x.i.real, i_beta=x.i.imag, v_alpha=x.v.real, v_beta=x.v.imag)
        return _thinned(make_windows(shifted, known, length))

    @cached_property
    def wiring(self) -> Wiring:
        """Which way round things are; as reported where nothing tells."""
        if not (self.has_encoder and self.turns):
            return self.observed.wiring
        x = model.vectors(self.m, self.track.theta)
        w = self._windows(x, self.usable & np.isfinite(x.theta))
        return find_wiring(w, x, self.motor) if len(w) >= LEAST_WINDOWS else Wiring()

    @cached_property
    def observed(self) -> Observed:
        """The project's own observer over the samples; without an encoder, with the wiring that it found undone."""
        return observe(self.m, self.config, search=not (self.has_encoder and self.turns))

    @cached_property
    def observed_as_reported(self) -> Observed:
        """The observer over the samples as they are."""
        return self.observed if self.observed.wiring.is_right else observe(self.m, self.config, search=False)

    @cached_property
    def by_encoder(self) -> bool:
        """The angle of the fit is the encoder's; else the observer's."""
        return self.has_encoder and self.turns

    @cached_property
    def vectors(self) -> Vectors:
        """The samples with their wiring undone; the angle is the encoder's where it turns, else the observer's."""
        if self.by_encoder:
            return self.wiring.undone(model.vectors(self.m, self.track.theta))
        x = self.wiring.undone(model.vectors(self.m, np.zeros(len(self.m))))
        return Vectors(x.i, x.v, self.observed.angle, self.m.sample_rate)

    @cached_property
    def noise(self) -> float:
        """Noise of the current samples [A rms per axis]; as drive.toml tells where the drive always probes."""
        found = model.current_noise(self.vectors, self.usable & ~self.m.injecting)
        return found if math.isfinite(found) else self.config.observer.current_noise

    @cached_property
    def zero_course(self) -> ZeroCourse | None:
        """The encoder's zero over time; None without an encoder that turns."""
        if not self.by_encoder:
            return None
        x = self._turned_to_magnet(self.vectors)
        w = self._windows(x, self.usable & np.isfinite(x.theta))
        return find_slips(w, x, self.motor, self.volts) if len(w) >= LEAST_WINDOWS else None

    def _turned_to_magnet(self, x: Vectors) -> Vectors:
        w = self._windows(x, self.usable & np.isfinite(x.theta))
        if len(w) < LEAST_WINDOWS:
            return x
        zero = np.angle(model.fit_core(w, x, self.motor).pair("psi"))
        return Vectors(x.i, x.v, x.theta + zero, x.sample_rate)

    @cached_property
    def fit(self) -> Fit | None:
        """The equation with everything in it; None where there is too little to fit it to."""
        x = self.vectors
        known = self.usable & np.isfinite(x.theta)
        course = self.zero_course
        if course is not None and course.slips:
            x = course.removed(x)
            for slip in course.slips:
                around = round(_AROUND_SLIP_S * self.m.sample_rate)
                known[max(0, slip.row - around):slip.row + around] = False
        w = self._windows(x, known)
        if len(w) < LEAST_WINDOWS:
            return None
        turned = 0.0
        if self.by_encoder:
            turned = float(np.angle(model.fit_core(w, x, self.motor).pair("psi")))
        return self._refined(x, known, turned)

    def _refined(self, raw: Vectors, known: Bools, turned: float) -> Fit:
        """The fit, with what it finds undone and fitted again, as long as that leaves less unexplained."""
        undone = _Undone(turned, self.m.voltage_delay)
        best: Fit | None = None
        zone = 0.0
        for _ in range(_ROUNDS):
            x = undone.apply(raw, self.motor.pole_pairs)
            w = self._windows(x, known)
            zone = zone or model.dead_zone(w, x, self.motor, _MOST_VOLTS * self.volts, self.noise)
            s = model.fit_all(w, x, self.motor, zone, _MOST_VOLTS * self.volts, self.noise)
            step = self._step(s)
            if best is not None and s.rms > best.solution.rms:
                break
            total = undone.plus(step)
            best = Fit(x, w, known, s, math.remainder(-total.turned, 2.0 * math.pi),
                       total.delay - self.m.voltage_delay, total.offset, total.gain, total.eccentricity, zone)
            if step.size(self.motor.rated_current) < _SETTLED:
                break
            undone = total
        assert best is not None
        return best

    def _step(self, s: Solution) -> _Undone:
        """What is still to be undone, as far as it is known well enough.

        Without an encoder the angle is the observer's, which has no zero and no eccentricity, and hides a delay.
        """
        step = _Undone()
        if s.pair_sigma("o") < _TOLD_OFFSET * self.motor.rated_current:
            step = replace(step, offset=s.pair("o"))
        if s.pair_sigma("g") < _TOLD_GAIN:
            step = replace(step, gain=s.pair("g"))
        if self.by_encoder:
            step = replace(step, turned=float(np.angle(s.pair("psi"))))
            if s.sigma("delay") < _TOLD_DELAY:
                step = replace(step, delay=s["delay"])
            if s.pair_sigma("ecc") < _TOLD_ANGLE:
                step = replace(step, eccentricity=s.pair("ecc"))
        return step

    @cached_property
    def identified(self) -> Identification | None:
        """The motor's parameters from the samples with everything undone; None where nothing can be told."""
        if not self.thorough or self.seconds < LEAST_IDENTIFIED_S:
            return None
        fit, m = self.fit, self.m
        if self.by_encoder and fit is None:
            return None
        x = self.vectors if fit is None else fit.x
        usable = m.usable if fit is None or not self.by_encoder else m.usable & fit.known
        rows = np.flatnonzero(usable & np.isfinite(x.theta)) if self.by_encoder else np.zeros(0, np.intp)
        found = identify(replace(
            m, i_alpha=x.i.real, i_beta=x.i.imag, v_alpha=x.v.real, v_beta=x.v.imag, usable=usable,
            encoder_sample=m.sample[rows], encoder_theta=x.theta[rows], encoder_omega=np.full(rows.size, np.nan),
            voltage_delay=m.voltage_delay if fit is None else 0.0), self.motor)
        return found if found.fits and found.told else None

    @cached_property
    def runs(self) -> list[tuple[int, int]]:
        """Rows [begin, end) of samples that follow each other."""
        return stretches(self.usable, self.m.sample)


def _shifted(v: NDArray[np.complex128], late: float) -> NDArray[np.complex128]:
    """The mean voltages that belong to the samples, from those reported `late` samples too late."""
    if late == 0.0:
        return v
    total = np.concatenate([[0.0], np.cumsum(v)])
    at = np.clip(np.arange(len(v) + 1) + late, 0.0, float(len(v)))
    grid = np.arange(len(v) + 1, dtype=np.float64)
    shifted = np.interp(at, grid, total.real) + 1j * np.interp(at, grid, total.imag)
    return np.asarray(np.diff(shifted))


def _thinned(w: Windows) -> Windows:
    """Of a very long log some stretches, spread over all of it: what stays in a group stays together."""
    if len(w) <= _MOST_WINDOWS:
        return w
    number, where = np.unique(w.group, return_inverse=True)
    step = -(-len(w) // _MOST_WINDOWS)
    kept = where % step == 0 if number.size > step else np.arange(len(w)) % step == 0
    return Windows(w.begin[kept], w.end[kept], w.group[kept], w.v[kept], w.i[kept], w.period)
