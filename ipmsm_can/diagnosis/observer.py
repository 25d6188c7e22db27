"""The project's own observer over a measurement: whether it locks, and which wiring lets it.

Without an encoder the wiring has to be found from the observer: each way round is tried, and the one that keeps its
angle valid stands.  Where several do - a rotor that turns steadily needs no current to be found - the sign of the
inductance decides that the equation of `model` finds along the observer's angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.config.build import estimator_settings
from ipmsm_can.diagnosis import model
from ipmsm_can.diagnosis.model import Vectors
from ipmsm_can.diagnosis.windows import make_windows, window_length
from ipmsm_can.diagnosis.wiring import Wiring, inductance_turn
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.estimation.estimator import Estimator

if TYPE_CHECKING:
    from ipmsm_can.analysis.measurement import Measurement
    from ipmsm_can.config.model import DriveConfig

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_BETTER, _GOOD = 0.3, 0.5
"""By how much more of the time another wiring must let the angle be valid, and for how much of it."""
_LOST = 0.02
"""What a lost lock counts, as a share of the time."""
_LEAST_WINDOWS = 60


@dataclass(frozen=True, slots=True)
class Observed:
    """What the observer made of the samples, all (N,).

    angle: unwrapped [rad electrical], NaN where not valid.  omega [rad/s electrical].  sigma [rad].
    locked, valid.  excitation [V^2 s].  lost_locks: how often it gave up.  wiring: that was undone for it.
    """

    angle: Floats
    omega: Floats
    sigma: Floats
    locked: Bools
    valid: Bools
    excitation: Floats
    lost_locks: int
    wiring: Wiring

    @property
    def score(self) -> float:
        """How well the observer fared; 1 is best."""
        return float(self.valid.mean()) - _LOST * self.lost_locks if self.valid.size else 0.0


def _run(m: Measurement, config: DriveConfig, x: Vectors, wiring: Wiring) -> Observed:
    n = len(m.sample)
    good = np.isfinite(x.i) & np.isfinite(x.v)
    rows = np.flatnonzero(good)
    gap = np.diff(m.sample[rows], prepend=m.sample[rows[0]] - 1) - 1 if rows.size else rows
    settings = estimator_settings(config, m.sample_rate)
    if m.voltage_delay and settings.voltage_delay is None:
        settings = replace(settings, voltage_delay=m.voltage_delay)
    estimator = Estimator(config.build_motor(), m.sample_rate, settings)
    i, v = x.i[rows], x.v[rows]
    e = estimator.process(np.ascontiguousarray(np.stack([i.real, i.imag, v.real, v.imag])), gap)

    def spread(values: Floats, missing: float) -> Floats:
        out = np.full(n, missing)
        out[rows] = values
        return out

    locked, valid = (spread((e.flags & bit != 0).astype(np.float64), 0.0) > 0.0
                     for bit in (confidence.LOCKED, confidence.VALID))
    valid &= m.running
    angle = spread(np.unwrap(e.angle[speed.THETA_HAT]), np.nan)
    return Observed(np.where(valid, angle, np.nan), spread(e.angle[speed.OMEGA], np.nan), spread(e.sigma, math.pi),
                    locked, valid, spread(e.excitation, 0.0), estimator.lost_locks, wiring)


def observe(m: Measurement, config: DriveConfig, *, search: bool) -> Observed:
    """Run the observer of the configuration; search: try every way round of the current and take the best."""
    x = Vectors(m.i_alpha + 1j * m.i_beta, m.v_alpha + 1j * m.v_beta, np.zeros(len(m.sample)), m.sample_rate)
    here = _run(m, config, x, Wiring())
    if not search or not len(m.sample):
        return here
    trials = {(mirrored, sixths): here if not (mirrored or sixths) else _tried(m, config, x, mirrored, sixths)
              for mirrored in (False, True) for sixths in range(6)}
    score = {key: trial.score for key, trial in trials.items()}
    best = max(score, key=lambda key: score[key])
    if score[best] < max(score[False, 0] + _BETTER, _GOOD):
        best = (False, 0)
    chosen = trials[best]
    other_order = max(score[not best[0], k] for k in range(6))
    sign = _sign(m, config, x, chosen)
    if sign is not None and sign != 0:
        turned = _tried(m, config, x, best[0], (best[1] + (-sign if best[0] else sign)) % 6)
        again = _sign(m, config, x, turned)
        if again == 0 and turned.score > max(chosen.score - 0.05, _GOOD):
            chosen, sign = turned, 0
    told = replace(chosen.wiring, order_known=score[best] > max(other_order + _BETTER, _GOOD), sign_known=sign == 0)
    return replace(chosen, wiring=told)


def _tried(m: Measurement, config: DriveConfig, x: Vectors, mirrored: bool, sixths: int) -> Observed:
    wiring = Wiring(current_mirrored=mirrored, current_sixths=sixths)
    return _run(m, config, wiring.undone(x), wiring)


def _sign(m: Measurement, config: DriveConfig, x: Vectors, o: Observed) -> int | None:
    """Sixths of a turn by which the current is turned beyond what was undone; None where nothing tells."""
    motor = config.build_motor()
    y = o.wiring.undone(x)
    known = m.usable & o.valid
    if not known.any():
        return None
    top = float(np.quantile(np.abs(o.omega[known]), 0.99))
    w = make_windows(replace(m, i_alpha=y.i.real, i_beta=y.i.imag, v_alpha=y.v.real, v_beta=y.v.imag), known,
                     window_length(m, top))
    if len(w) < _LEAST_WINDOWS:
        return None
    return inductance_turn(w, model.Vectors(y.i, y.v, o.angle, m.sample_rate), motor)
