"""Steady-state quantities of a drive whose reports are too slow for the observer: the voltage equations in d and q.

With constant currents and speed, v_d = R i_d - w L_q i_q and v_q = R i_q + w (L_d i_d + psi_m); so each such sample
gives a psi_m, and a rest of v_d that ought to be zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.mapping.convert import spoils_dq
from ipmsm_can.mapping.mapper import MappedBlock
from ipmsm_can.mapping.model import InverterMap
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

STEADY_CURRENT, STEADY_SPEED = 0.05, 0.05
"""Change from one sample to the next that still counts as steady: of the rated current, and of the speed."""
LEAST_EMF = 2.0
"""Voltage of the magnets [V] below which the dead time decides, not they."""


@dataclass(slots=True)
class Mean:
    """Mean and standard deviation of what was added; NaN with nothing."""

    count: int = 0
    total: float = 0.0
    squares: float = 0.0

    def add(self, values: Floats) -> None:
        """Take in finite values."""
        values = values[np.isfinite(values)]
        self.count += values.size
        self.total += float(values.sum())
        self.squares += float(values @ values)

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else math.nan

    @property
    def deviation(self) -> float:
        return math.sqrt(max(self.squares / self.count - self.mean**2, 0.0)) if self.count else math.nan


@dataclass(frozen=True, slots=True)
class SteadyRows:
    """N samples: psi_m [Wb] and v_d_rest [V] are NaN where the drive was not steady or too slow; torque_model [N m]
    from the currents and the motor's parameters; power [W] into the motor."""

    time_s: Floats
    psi_m: Floats
    v_d_rest: Floats
    torque_model: Floats
    power: Floats
    steady: NDArray[np.bool_]


class SteadyState:
    """Takes the steady-state quantities of mapped samples, any partition the same.

    rows, steady: samples, and those that were steady and fast enough to judge by.
    """

    def __init__(self, motor: Motor, inverter: InverterMap) -> None:
        self.motor = motor
        self._spoils = spoils_dq(inverter)
        self.rows = self.steady = 0
        self.psi_m, self.v_d_rest, self.power, self.torque_rest = Mean(), Mean(), Mean(), Mean()
        self._before = np.full(3, np.nan)
        self._t0: int | None = None

    def feed(self, b: MappedBlock) -> SteadyRows:
        """Take in the next samples."""
        m = self.motor
        self._t0 = int(b.t_ns[0]) if self._t0 is None and len(b) else self._t0
        w = np.where(np.isfinite(b.omega_e), b.omega_e, b.turning)
        now = np.stack([b.i_d, b.i_q, w])
        step = np.abs(np.diff(np.concatenate([self._before[:, None], now], axis=1), axis=1))
        if len(b):
            self._before = now[:, -1].copy()
        small = STEADY_CURRENT * m.rated_current
        steady = (step[0] <= small) & (step[1] <= small) & (step[2] <= STEADY_SPEED * np.abs(w))
        # Below this the resistance and the dead time decide, not the magnets.
        steady &= np.abs(w) * m.psi_m > np.maximum(m.R * np.hypot(b.i_d, b.i_q), LEAST_EMF)
        steady &= b.quality & self._spoils == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            psi = np.where(steady, (b.v_q - m.R * b.i_q) / w - m.L_d * b.i_d, np.nan)
        rest = np.where(steady, b.v_d - m.R * b.i_d + w * m.L_q * b.i_q, np.nan)
        torque = 1.5 * m.pole_pairs * (m.psi_m + m.L_0 * b.i_d) * b.i_q
        power = 1.5 * (b.v_d * b.i_d + b.v_q * b.i_q)
        self.rows += len(b)
        self.steady += int(np.count_nonzero(np.isfinite(psi)))
        self.psi_m.add(psi)
        self.v_d_rest.add(rest)
        self.power.add(power)
        self.torque_rest.add(np.where(steady, b.torque - torque, np.nan))
        time_s = np.asarray(1e-9 * (b.t_ns - (self._t0 or 0)), np.float64)
        return SteadyRows(time_s, psi, rest, torque, power, steady)

    def figures(self) -> list[tuple[str, str]]:
        """What was found, as (name, words)."""
        m = self.motor
        found = []
        if self.steady:
            found += [("psi_m", f"{self.psi_m.mean:.4g} Wb, scatter {self.psi_m.deviation:.2g}; drive.toml has "
                       f"{m.psi_m:.4g}"),
                      ("v_d", f"{self.v_d_rest.mean:+.3g} V from what R, L_q and the speed explain, scatter "
                       f"{self.v_d_rest.deviation:.2g}")]
        if self.power.count:
            found.append(("power", f"{self.power.mean:.4g} W into the motor on average"))
        if self.torque_rest.count:
            found.append(("torque", f"reported is {self.torque_rest.mean:+.3g} N m off what the currents and "
                          "drive.toml give"))
        return found

    @property
    def judged(self) -> str:
        """How much there is to judge by, in words."""
        return f"{self.rows} samples, {self.steady} of them steady enough to judge by"

    def words(self) -> list[str]:
        """What was found, a line each."""
        return [self.judged, *(f"{name:11}{words}" for name, words in self.figures())]
