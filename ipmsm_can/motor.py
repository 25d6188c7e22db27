"""Parameters of an interior permanent magnet synchronous motor, and the paper's two machines."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Motor:
    """Electrical and mechanical parameters; per phase, peak, amplitude-invariant transformation.

    pole_pairs: number of pole pairs, 1..100.
    psi_m: permanent-magnet flux linkage [Wb peak], > 0.
    L_d, L_q: d- and q-axis inductance [H], > 0.
    R: stator resistance per phase [ohm], >= 0.
    J: inertia at the shaft [kg m^2], > 0.
    rated_torque: [N m], > 0.

    Raises ValueError naming the parameter, what it got and what it allows.
    """

    pole_pairs: int
    psi_m: float
    L_d: float
    L_q: float
    R: float
    J: float = 0.01
    rated_torque: float = 6.2
    name: str = "custom"

    def __post_init__(self) -> None:
        if not (isinstance(self.pole_pairs, int) and 1 <= self.pole_pairs <= 100):
            raise ValueError(f"pole_pairs is {self.pole_pairs!r}; allowed is a whole number from 1 to 100")
        for name, unit in (("psi_m", "Wb"), ("L_d", "H"), ("L_q", "H"), ("J", "kg m^2"),
                           ("rated_torque", "N m")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value!r}; allowed is a finite number above 0, in {unit}")
        if not (math.isfinite(self.R) and self.R >= 0.0):
            raise ValueError(f"R is {self.R!r}; allowed is a finite number of 0 or more, in ohm")

    @property
    def L_0(self) -> float:
        """Inductance difference L_d - L_q [H]; negative for most interior-magnet machines."""
        return self.L_d - self.L_q

    @property
    def L_s(self) -> float:
        """Mean inductance (L_d + L_q) / 2 [H]."""
        return 0.5 * (self.L_d + self.L_q)

    @property
    def ell(self) -> float:
        """The paper's l = psi_m L_0 [Wb H]."""
        return self.psi_m * self.L_0

    def torque(self, i_d: float, i_q: float) -> float:
        """Air-gap torque [N m] for dq currents [A peak]: 1.5 p (psi_m + L_0 i_d) i_q."""
        return 1.5 * self.pole_pairs * (self.psi_m + self.L_0 * i_d) * i_q

    @property
    def rated_current(self) -> float:
        """q-axis current [A peak] that gives the rated torque at i_d = 0."""
        return self.rated_torque / (1.5 * self.pole_pairs * self.psi_m)


M1 = Motor(pole_pairs=6, psi_m=0.11, L_d=5.74e-3, L_q=8.68e-3, R=0.43, name="m1")
"""The paper's simulation motor (Table 1, first column)."""

M2 = Motor(pole_pairs=3, psi_m=0.59, L_d=7.6e-3, L_q=12.9e-3, R=1.059, name="m2")
"""The paper's experiment motor (Table 1, second column)."""

PRESETS = {"m1": M1, "m2": M2}
