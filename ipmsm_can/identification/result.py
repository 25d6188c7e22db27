"""What identification gives: parameters with their intervals, and what cannot be told."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ipmsm_can.motor import Motor

UNITS = {"R": "ohm", "L_d": "H", "L_q": "H", "psi_m": "Wb", "dead_time_voltage": "V", "dead_time_zone": "A",
         "encoder_zero": "rad electrical", "voltage_delay": "samples", "v_offset_alpha": "V", "v_offset_beta": "V",
         "i_offset_alpha": "A", "i_offset_beta": "A"}
MOTOR_PARAMETERS = ("R", "L_d", "L_q", "psi_m")
"""Those that a motor is made of; the others are errors of the drive and the encoder."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter.  value, standard_error, low, high (interval of 95 %): in the unit of UNITS.

    told: the measurement tells it; where it does not, value and the rest are NaN and `word` says why.
    name_plate: what the drive.toml says, NaN where it says nothing.
    """

    name: str
    value: float
    standard_error: float
    low: float
    high: float
    name_plate: float
    told: bool
    word: str = ""

    @property
    def unit(self) -> str:
        """SI, peak, electrical."""
        return UNITS[self.name]

    @property
    def difference(self) -> float:
        """Relative to the name plate, NaN where it says nothing or 0."""
        return self.value / self.name_plate - 1.0 if self.name_plate else math.nan

    @property
    def contradicts(self) -> bool:
        """The name plate lies outside the interval."""
        return self.told and not self.low <= self.name_plate <= self.high


@dataclass(frozen=True, slots=True)
class Identification:
    """What a measurement tells of a motor and its drive.

    parameters: by name, in the order of `result.UNITS`; those that were not part of the fit are missing.
    method: "encoder" or "sensorless".  residual: what the fit leaves of the current [A rms, d, q]; sensorless only
    along d.  samples, seconds: what it rests on.
    i_d, i_q: currents in the measurement [A], the middle 98 %; speed [rad/s electrical]: the same.
    notes: sentences on what is doubtful or cannot be told.  fits: the samples are those of such a motor at all.
    """

    parameters: Mapping[str, Parameter]
    method: str
    residual: tuple[float, ...]
    samples: int
    seconds: float
    i_d: tuple[float, float] = (math.nan, math.nan)
    i_q: tuple[float, float] = (math.nan, math.nan)
    speed: tuple[float, float] = (math.nan, math.nan)
    notes: tuple[str, ...] = ()
    fits: bool = True
    name_plate: Motor | None = field(default=None, repr=False)

    @property
    def told(self) -> frozenset[str]:
        """Names of the parameters that the measurement tells."""
        return frozenset(name for name, p in self.parameters.items() if p.told)

    def value(self, name: str) -> float:
        """A parameter, NaN where it cannot be told."""
        p = self.parameters.get(name)
        return p.value if p is not None and p.told else math.nan

    def motor(self, name_plate: Motor) -> Motor:
        """The name plate's motor with what is told in its place."""
        values = {n: self.value(n) for n in MOTOR_PARAMETERS if n in self.told}
        return replace(name_plate, name=f"{name_plate.name}, identified", **values)  # type: ignore[arg-type]
