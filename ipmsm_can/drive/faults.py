"""What may be wrong with a simulated drive beyond its settings: wiring, signs and the encoder.

These faults are of the *report*: the drive controls with the right values and puts wrong ones on the bus, as one
does whose firmware or map names a phase, a sign or an encoder's zero wrongly.  What is wrong with the sensors
themselves (offset, gain of a phase) or with the motor, the control suffers from, too; that is in `DriveParameters`
and `Motor`.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_ROTATION = 2.0 * math.pi / 3.0
_ORDERS = {"abc": (0, False), "cab": (1, False), "bca": (2, False),
           "acb": (0, True), "bac": (1, True), "cba": (2, True)}
"""Which true phases stand where a, b, c are reported: turns by 120 deg, after mirroring beta where True."""


@dataclass(frozen=True, slots=True)
class DriveFaults:
    """What the drive reports wrongly; the defaults are a drive without a fault.

    current_phases, voltage_phases: the true phases that are reported as a, b, c, such as "acb".
    current_sign, voltage_sign: 1 or -1.
    encoder_zero: added to the angle [rad electrical].  encoder_direction: 1 or -1.
    encoder_pole_pairs: by which the shaft's angle is multiplied; None for the motor's.
    eccentricity: amplitude of an error that repeats with each turn of the shaft [rad electrical].
    slip, slip_at: angle that the encoder loses [rad electrical], and when [s].

    Raises ValueError naming the setting, what it got and what it allows.
    """

    current_phases: str = "abc"
    voltage_phases: str = "abc"
    current_sign: int = 1
    voltage_sign: int = 1
    encoder_zero: float = 0.0
    encoder_direction: int = 1
    encoder_pole_pairs: int | None = None
    eccentricity: float = 0.0
    slip: float = 0.0
    slip_at: float = 0.0

    def __post_init__(self) -> None:
        for name in ("current_phases", "voltage_phases"):
            if getattr(self, name) not in _ORDERS:
                raise ValueError(f"{name} is {getattr(self, name)!r}; allowed is {', '.join(_ORDERS)}")
        for name in ("current_sign", "voltage_sign", "encoder_direction"):
            if getattr(self, name) not in (1, -1):
                raise ValueError(f"{name} is {getattr(self, name)!r}; allowed is 1 or -1")
        for name in ("encoder_zero", "eccentricity", "slip", "slip_at"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)!r}; allowed is a finite number")
        if self.encoder_pole_pairs is not None and self.encoder_pole_pairs < 1:
            raise ValueError(f"encoder_pole_pairs is {self.encoder_pole_pairs!r}; allowed is 1 or more")

    def samples(self, values: Floats) -> Floats:
        """What is reported for i_alpha, i_beta [A], v_alpha, v_beta [V], float64 (4, N)."""
        out = np.empty_like(values)
        for row, phases, sign in ((0, self.current_phases, self.current_sign),
                                  (2, self.voltage_phases, self.voltage_sign)):
            turns, mirrored = _ORDERS[phases]
            vector = values[row] + 1j * values[row + 1]
            if mirrored:
                vector = vector.conj()
            if turns:
                vector = vector * cmath.rect(1.0, turns * _ROTATION)
            out[row], out[row + 1] = sign * vector.real, sign * vector.imag
        return out


class FaultyEncoder:
    """The encoder as the faults make it, over successive blocks of samples.

    pole_pairs: of the motor.  sample_rate [Hz].
    """

    def __init__(self, faults: DriveFaults, pole_pairs: int, sample_rate: float) -> None:
        self._faults = faults
        self._pole_pairs = pole_pairs
        self._ratio = faults.encoder_direction * (faults.encoder_pole_pairs or pole_pairs) / pole_pairs
        self._slips = faults.slip_at * sample_rate
        self._last: float | None = None

    def read(self, sample: NDArray[np.int64], theta_e: Floats, omega_e: Floats) -> tuple[Floats, Floats]:
        """What it says at every sample, from the true angle and speed [rad, rad/s electrical], all (N,)."""
        if not len(theta_e):
            return theta_e, omega_e
        f = self._faults
        # The turns have to be counted: only the shaft's angle tells where an eccentric disc is wrong.
        before = theta_e[0] if self._last is None else self._last
        turned = np.unwrap(np.concatenate([[before], theta_e]))[1:]
        self._last = float(turned[-1])
        shaft = turned / self._pole_pairs
        theta = self._ratio * turned + f.encoder_zero + f.slip * (sample >= self._slips)
        return (np.asarray(theta + f.eccentricity * np.sin(shaft)),
                np.asarray(self._ratio * omega_e + f.eccentricity * np.cos(shaft) * omega_e / self._pole_pairs))
