"""All observers on all drives of the experiments: the comparison that the authors leave as future work.

Every observer gets the same frames.  Kinds that take the paper's alpha and gamma run twice, with the experiment's
gains and with the configuration's defaults; the others with the defaults.  Injection kinds see the rotor's axis
modulo half a turn; their errors count against the nearer end, and after a start 180 degrees off they stay there.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from ipmsm_can.config import OBSERVER_KINDS
from ipmsm_can.config.build import estimator_settings
from ipmsm_can.estimation.estimator import Estimator
from ipmsm_can.experiments import bench, extraction, findings, simulations
from ipmsm_can.experiments.measure import LOCK_DEG, lock_time, rms
from ipmsm_can.experiments.model import Run, Setup, Watcher
from ipmsm_can.experiments.rig import Track, companion_config, observe

SAME_GAIN = ("ges", "spmsm_regression", "active_flux_regression", "chonam")
"""Kinds that take the paper's alpha and gamma."""
PROBING_KINDS = ("injection_extraction", "injection_demodulation")
"""Kinds that live on the injected signal and find the angle modulo half a turn."""
TITLES = {
    "ges": "proposed (GES)", "riccati": "regression, Kalman filter",
    "chonam": "with Λ (CHONAM)", "active_flux_regression": "d neglected (CHOetaltie)",
    "spmsm_regression": "linear regression, SPMSM (BOBetal)", "spmsm_gradient": "gradient, SPMSM (obsort)",
    "spmsm_gradient_max": "gradient, SPMSM, max{0, ·}", "injection_extraction": "extraction (YIetal)",
    "injection_demodulation": "demodulation (GARetal)",
}
"""What the page calls the kinds; one that is not here goes by its name."""


@dataclass(frozen=True)
class Scene:
    """A drive that all observers watch.

    title; short: for the head of a table's column.  watcher: gains and start of its experiment.  within: what
    counts as locked [deg electrical], 5 or, where the dead time alone may make more, twice that.
    """

    name: str
    title: str
    short: str
    setup: Setup
    watcher: Watcher
    within: float = LOCK_DEG


@dataclass(frozen=True)
class Row:
    """One observer on one scene.

    published: with the experiment's gains, else the configuration's.  lock [s], inf = never.  rms, largest [deg
    electrical] over the second half of the run.  opposite: |error| [deg] at the end after a start 180 degrees off,
    opposite_lock [s]: its lock time.
    """

    scene: str
    kind: str
    published: bool
    lock: float
    rms: float
    largest: float
    opposite: float
    opposite_lock: float


_PAPER = Watcher(alpha=10.0, gamma=50.0, start_off=30.0)
_START = Watcher(alpha=20.0, gamma=10.0, start_off=30.0)
_SLOW_DEG = 2.0 * LOCK_DEG
SCENES = (
    Scene("ramp", "M1, ramp from 10 to 100 rad/s", "Fig. 2", simulations.RAMP, _START),
    Scene("load-step", "M1, the same with a load step", "Fig. 4", simulations.STEP, _START),
    Scene("pulses", "M2, 1000 rpm, torque pulses", "Fig. 9", bench.PULSES, replace(_PAPER, alpha=5.0)),
    Scene("acceleration", "M2, 100–1000–100 rpm", "Fig. 10", bench.ACCELERATED, _PAPER),
    Scene("acceleration-probed", "M2, 100–1000–100 rpm, 4 V injected", "Fig. 11", bench.ACCELERATED_PROBED, _PAPER),
    Scene("20rpm", "M2, 20 rpm, 6 V injected", "Fig. 13", bench.SLOW_PROBED, _PAPER, _SLOW_DEG),
    Scene("reversal-probed", "M2, reversal at ±20 rpm, 6 V injected", "Fig. 14", bench.REVERSED_PROBED, _PAPER,
          _SLOW_DEG),
    Scene("reversal", "M2, the same without injection", "Fig. 14, quiet", bench.REVERSED, _PAPER, _SLOW_DEG),
    Scene("v-alpha-20rpm", "M2, 20 rpm, 6 V in v_α", "Fig. 20, slow", extraction.LOW, replace(_PAPER, alpha=50.0),
          _SLOW_DEG),
    Scene("v-alpha-1000rpm", "M2, 1000 rpm, 6 V in v_α", "Fig. 20, fast", extraction.HIGH,
          replace(_PAPER, alpha=50.0)),
    Scene("standstill", "M2, standstill, 6 V injected", "standstill", findings.STANDSTILL, _PAPER, _SLOW_DEG),
)


def variants() -> list[tuple[str, bool]]:
    """(kind, published gains) in the order of the tables."""
    return [(kind, published) for kind in OBSERVER_KINDS for published in (True, False)
            if not published or kind in SAME_GAIN]


def gains_of(scene: Scene, kind: str, published: bool) -> Watcher:
    """The scene's start, with its gains or the configuration's (gamma fitted to the motor)."""
    if published:
        return replace(scene.watcher, kind=kind)
    return replace(scene.watcher, kind=kind, alpha=None, gamma=None)


def _modulo(track: Track, kind: str) -> Track:
    if kind not in PROBING_KINDS:
        return track
    return replace(track, error=(track.error + 90.0) % 180.0 - 90.0)


def rows_of(scene: Scene) -> list[Row]:
    """All kinds on one scene, in the order of the configuration."""
    rows = []
    for kind, published in variants():
        watcher = gains_of(scene, kind, published)
        track = _modulo(observe(Run(kind, scene.setup, watcher)), kind)
        wrong = observe(Run(kind, scene.setup, replace(watcher, start_off=180.0)))
        late = track.error[track.reference_time >= 0.5 * track.time[-1]]
        end = float(np.median(np.abs(wrong.error[wrong.reference_time >= wrong.time[-1] - 0.1])))
        rows.append(Row(scene.name, kind, published, _lock(track, scene), rms(late), float(np.abs(late).max()), end,
                        _lock(wrong, scene)))
    return rows


def _lock(track: Track, scene: Scene) -> float:
    """Lock time [s]; a lock that holds for less than a fifth of the run is none."""
    lock = lock_time(track, scene.within)
    return lock if lock < 0.8 * float(track.time[-1]) else math.inf


def cost_per_sample(kind: str, samples: int = 50_000, repeats: int = 5) -> float:
    """Seconds a sample of the whole estimator with this observer, in a block: the best of some repeats."""
    scene = SCENES[2]
    config = companion_config(scene.setup, gains_of(scene, kind, False))
    rate = scene.setup.drive.sample_rate
    estimator = Estimator(config.build_motor(), rate, estimator_settings(config, rate))
    angle = np.arange(samples) * 2.0 * math.pi / 100.0
    block = np.array([np.cos(angle), np.sin(angle), -100.0 * np.sin(angle), 100.0 * np.cos(angle)])
    best = math.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        estimator.process(block)
        best = min(best, time.perf_counter() - begin)
    return best / samples
