"""The drive's equation in the frame that is reported, fitted to operating points.

With the rotor at theta, the reported angle at theta + delta, and d + j q in the reported frame,

    v = R i + s i/|i| + (d/dt + j w) [L_s i + L_D e^(-2j delta) i* + psi_m e^(-j delta)],

L_s = (L_d + L_q)/2, L_D = (L_d - L_q)/2: the flux of the rotor's frame, L_s i + L_D i* + psi_m, with
i e^(j delta) for i and all of it turned back by delta.  s: the fundamental of what dead time takes, 4/pi of the
voltage that each phase loses.  A drive that computes its voltage for another instant than that of its angle turns v
by w times that time; where only one of current and voltage was turned by the reported angle, the current is turned
against the voltage by a constant and by w times a time as well.

R, L_d, L_q, the dead time and the times are known beforehand as far as drive.toml tells them; psi_m and delta are
not.  A sign that is wrong is a hypothesis of its own: with a reversed current R and the inductances come out
negative, with a reversed voltage psi_m as well, with a reversed speed the inductances and psi_m; delta, being free,
holds the sign of psi_m.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.diagnosis.limits import SURE, TOLERANCE, ZERO
from ipmsm_can.diagnosis.steady_points import Points
from ipmsm_can.mapping.steady import STEADY_CURRENT

if TYPE_CHECKING:
    from ipmsm_can.config.model import DriveConfig
    from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

NAMES = ("R", "L_d", "L_q", "psi_m", "delta", "dead_time", "late", "turned", "turned_late")
_R, _LD, _LQ, _PSI, _DELTA, _DEAD, _LATE, _TURNED, _TURNED_LATE = range(9)
LATE_S = 1.5e-4
"""1-sigma of the time between a drive's voltage and its angle [s]: a period and a half of a control at 10 kHz,
which is what lies between reading the angle and the middle of the voltage computed from it."""
LESS = 0.5
"""What another hypothesis must leave unexplained, as a share of what the plain one does (as in `wiring`)."""
_STARTS = 36
_ROUNDS, _SETTLED = 40, 1e-9
_NOISE_ROUNDS = 5
_BELIEF = 2.0
"""How many residuals observer.voltage_uncertainty counts for beside those of the fit."""


@dataclass(frozen=True, slots=True)
class SteadyFit:
    """The equation as fitted.  value, covariance: of NAMES, in ohm, H, Wb, rad electrical, V, s.
    prior: 1-sigma of each beforehand, inf where nothing was known.
    residual: complex (K,) [V].  noise: 1-sigma of a point's voltage, per axis [V].
    cost: what is left unexplained, in squares of observer.voltage_uncertainty and of what drive.toml allows.
    current_reversed, speed_factor: the hypothesis; the speed that was taken is the reported one times the factor.
    """

    value: Floats
    covariance: Floats
    prior: Floats
    residual: Complexes
    noise: float
    cost: float
    current_reversed: bool
    speed_factor: float

    def __getitem__(self, name: str) -> float:
        return float(self.value[NAMES.index(name)])

    def sigma(self, name: str) -> float:
        """1-sigma of a value."""
        k = NAMES.index(name)
        return math.sqrt(max(float(self.covariance[k, k]), 0.0))

    def beforehand(self, name: str) -> float:
        """1-sigma of a value before the fit."""
        return float(self.prior[NAMES.index(name)])


class Equation:
    """The equation with what is known beforehand.

    points: samples of which at least one turns fast.  mixed: only one of current and voltage was turned by the
    reported angle.  zero_unknown: and that angle was reversed, so that nobody knows where it begins.
    """

    def __init__(self, points: Points, motor: Motor, config: DriveConfig, mixed: bool,
                 zero_unknown: bool = False) -> None:
        self.points, self.motor, self.mixed = points, motor, mixed
        o = config.observer
        self.volts = max(o.voltage_uncertainty, 1e-3)
        load = float(np.abs(points.i).max(initial=0.0)) / motor.rated_current
        # iron that saturates does so with the load
        inductance = math.hypot(o.inductance_uncertainty, o.saturation_uncertainty * min(1.0, load)) / 100.0
        inductance = max(inductance, 1e-4)
        late, turned = LATE_S, math.pi if zero_unknown else TOLERANCE * ZERO
        self.prior = np.array([max(o.resistance_uncertainty / 100.0 * motor.R, 1e-6), inductance * motor.L_d,
                               inductance * motor.L_q, np.inf, np.inf, self.volts, late,
                               turned if mixed else 0.0, late if mixed else 0.0])
        self.centre = np.array([motor.R, motor.L_d, motor.L_q, motor.psi_m, 0.0, 0.0, 0.0, 0.0, 0.0])
        self._scale = np.array([max(motor.R, 1e-3), motor.L_d, motor.L_q, motor.psi_m, 1.0, self.volts, late, 1.0,
                                late])
        self._free = np.flatnonzero(self.prior > 0.0)

    def voltage(self, x: Floats, current_reversed: bool = False, factor: float = 1.0,
                at: Points | None = None) -> Complexes:
        """What the equation gives for the points' currents and speeds [V], complex (K,)."""
        p = self.points if at is None else at
        sign = -1.0 if current_reversed else 1.0
        w = factor * p.omega
        turn = sign * np.exp(1j * (x[_TURNED] + w * x[_TURNED_LATE]))
        i, rise = p.i * turn, p.rise * turn
        # around zero the phases' currents change sign all the time, and dead time takes nothing on average
        along = i / np.hypot(np.abs(i), STEADY_CURRENT * self.motor.rated_current)
        mean, half = 0.5 * (x[_LD] + x[_LQ]), 0.5 * (x[_LD] - x[_LQ])
        twice, once = cmath.exp(-2j * x[_DELTA]), cmath.exp(-1j * x[_DELTA])
        flux = mean * i + half * twice * i.conj() + x[_PSI] * once
        change = mean * rise + half * twice * rise.conj()
        v = x[_R] * i + 4.0 / math.pi * x[_DEAD] * along + change + 1j * w * flux
        return np.asarray(v * np.exp(1j * w * x[_LATE]))

    def fit(self, current_reversed: bool = False, factor: float = 1.0) -> SteadyFit:
        """The best fit of one hypothesis, of all angles delta."""
        def start(delta: float) -> Floats:
            x = self.centre.copy()
            x[_DELTA], x[_PSI] = delta, 0.0
            rest = self.points.v - self.voltage(x, current_reversed, factor)
            pull = factor * self.points.omega
            psi = float((-1j * rest * cmath.exp(1j * delta) * pull).real.sum() / np.maximum((pull**2).sum(), 1e-12))
            x[_PSI] = max(psi, 0.05 * self.motor.psi_m)
            return x

        starts = [start(2.0 * math.pi * k / _STARTS) for k in range(_STARTS)]
        best = min(starts, key=lambda x: self._cost(x, self.volts, current_reversed, factor))
        x = self._refined(best, self.volts, current_reversed, factor)
        cost = self._cost(x, self.volts, current_reversed, factor)
        noise = self.volts
        for _ in range(_NOISE_ROUNDS):
            x = self._refined(x, noise, current_reversed, factor)
            covariance, used = self._covariance(x, noise, current_reversed, factor)
            left = self.points.v - self.voltage(x, current_reversed, factor)
            squares = float((np.abs(left)**2).sum())
            noise = math.sqrt((_BELIEF * self.volts**2 + squares)
                              / max(_BELIEF + 2.0 * len(self.points) - used, 1.0))
        covariance, _ = self._covariance(x, noise, current_reversed, factor)
        x[_DELTA] = math.remainder(x[_DELTA], 2.0 * math.pi)
        left = self.points.v - self.voltage(x, current_reversed, factor)
        return SteadyFit(x, covariance, self.prior, left, noise, cost, current_reversed, factor)

    def _rows(self, x: Floats, noise: float, current_reversed: bool, factor: float) -> Floats:
        """Everything whose squares are to be small: residuals, and deviations from what is known beforehand."""
        left = (self.points.v - self.voltage(x, current_reversed, factor)) / noise
        known = np.isfinite(self.prior) & (self.prior > 0.0)
        return np.concatenate([left.real, left.imag, (x - self.centre)[known] / self.prior[known]])

    def _cost(self, x: Floats, noise: float, current_reversed: bool, factor: float) -> float:
        rows = self._rows(x, noise, current_reversed, factor)
        return float(rows @ rows) if x[_PSI] > 0.0 else math.inf

    def _jacobian(self, x: Floats, noise: float, current_reversed: bool, factor: float) -> Floats:
        out = []
        for k in self._free:
            step = np.zeros(x.size)
            step[k] = 1e-5 * self._scale[k]
            out.append((self._rows(x + step, noise, current_reversed, factor)
                        - self._rows(x - step, noise, current_reversed, factor)) / 2e-5)
        return np.stack(out, axis=1)

    def _refined(self, x: Floats, noise: float, current_reversed: bool, factor: float) -> Floats:
        """Gauss and Newton, half a step where a whole one does not help."""
        cost = self._cost(x, noise, current_reversed, factor)
        for _ in range(_ROUNDS):
            jacobian = self._jacobian(x, noise, current_reversed, factor)
            rows = self._rows(x, noise, current_reversed, factor)
            step = np.zeros(x.size)
            step[self._free] = -np.linalg.lstsq(jacobian, rows, rcond=None)[0] * self._scale[self._free]
            for _ in range(8):
                after = self._cost(x + step, noise, current_reversed, factor)
                if after < cost:
                    break
                step *= 0.5
            else:
                return x
            x, gain, cost = x + step, cost - after, after
            if gain < _SETTLED * (1.0 + cost):
                break
        return x

    def _covariance(self, x: Floats, noise: float, current_reversed: bool, factor: float) -> tuple[Floats, float]:
        """Of the values, and how many of them the points determine rather than what was known beforehand."""
        jacobian = self._jacobian(x, noise, current_reversed, factor)
        inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)
        scale = self._scale[self._free]
        out = np.zeros((x.size, x.size))
        out[np.ix_(self._free, self._free)] = inverse * np.outer(scale, scale)
        data = jacobian[:2 * len(self.points)]
        return out, float(np.trace(inverse @ (data.T @ data)))


def chosen(fits: list[SteadyFit]) -> tuple[SteadyFit, bool]:
    """The hypothesis that stands: the first, plain one unless another leaves much less unexplained; and whether the
    others are ruled out."""
    plain, best = fits[0], min(fits, key=lambda f: f.cost)
    if best is not plain and clearly_better(best, plain):
        return best, True
    return plain, all(clearly_better(plain, f) for f in fits[1:])


def clearly_better(a: SteadyFit, b: SteadyFit) -> bool:
    """a leaves so much less unexplained than b that chance is out of the question."""
    return a.cost < LESS * b.cost and b.cost - a.cost > SURE**2
