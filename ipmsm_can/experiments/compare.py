"""All observers on all drives of the experiments: the comparison that the authors leave as future work.

Every observer gets the same frames.  Where gamma means the same as in the paper's observer it is the experiment's
own; elsewhere it is the configuration's default for the kind.  Injection kinds see the rotor's axis modulo half a
turn; their errors count against the nearer end.
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
from ipmsm_can.experiments.measure import lock_time, rms
from ipmsm_can.experiments.model import Run, Setup, Watcher
from ipmsm_can.experiments.rig import Track, companion_config, observe

SAME_GAIN = ("ges", "spmsm_regression", "active_flux_regression", "chonam")
"""Kinds that take the paper's alpha and gamma."""
PROBING_KINDS = ("injection_extraction", "injection_demodulation")
"""Kinds that live on the injected signal and find the angle modulo half a turn."""
TITLES = {
    "ges": "proposed (GES)", "chonam": "with Λ (CHONAM)", "active_flux_regression": "d neglected (CHOetaltie)",
    "spmsm_regression": "linear regression, SPMSM (BOBetal)", "spmsm_gradient": "gradient, SPMSM (obsort)",
    "spmsm_gradient_max": "gradient, SPMSM, max{0, ·}", "injection_extraction": "extraction (YIetal)",
    "injection_demodulation": "demodulation (GARetal)",
}
"""What the page calls the kinds; one that is not here goes by its name."""


@dataclass(frozen=True)
class Scene:
    """A drive that all observers watch; watcher: gains and start of its experiment."""

    name: str
    title: str
    setup: Setup
    watcher: Watcher


@dataclass(frozen=True)
class Row:
    """One observer on one scene.  lock [s], inf = never; rms, largest [deg electrical] over the second half;
    opposite: |error| [deg] at the end after a start 180 degrees off, opposite_lock [s] its lock time."""

    scene: str
    kind: str
    lock: float
    rms: float
    largest: float
    opposite: float
    opposite_lock: float


_PAPER = Watcher(alpha=10.0, gamma=50.0, start_off=30.0)
SCENES = (
    Scene("ramp", "M1, ramp 10 to 100 rad/s (Fig. 2)", simulations.RAMP, Watcher(alpha=20.0, gamma=10.0, start_off=30.0)),
    Scene("load-step", "M1, load step (Fig. 4)", simulations.STEP, Watcher(alpha=20.0, gamma=10.0, start_off=30.0)),
    Scene("pulses", "M2, 1000 rpm, torque pulses (Fig. 9)", bench.PULSES, replace(_PAPER, alpha=5.0)),
    Scene("acceleration", "M2, 100–1000–100 rpm (Fig. 10)", bench.ACCELERATED, _PAPER),
    Scene("acceleration-probed", "the same with 4 V injected (Fig. 11)", bench.ACCELERATED_PROBED, _PAPER),
    Scene("20rpm", "M2, 20 rpm, 6 V injected (Fig. 13)", bench.SLOW_PROBED, _PAPER),
    Scene("reversal", "M2, ±20 rpm, no injection", bench.REVERSED, _PAPER),
    Scene("reversal-probed", "M2, ±20 rpm, 6 V injected (Fig. 14)", bench.REVERSED_PROBED, _PAPER),
    Scene("v-alpha-20rpm", "M2, 20 rpm, 6 V in v_α (Fig. 20)", extraction.LOW, replace(_PAPER, alpha=50.0)),
    Scene("v-alpha-1000rpm", "M2, 1000 rpm, 6 V in v_α (Fig. 20)", extraction.HIGH, replace(_PAPER, alpha=50.0)),
    Scene("standstill", "M2, standstill, 6 V injected", findings.STANDSTILL, _PAPER),
)


def gains_of(scene: Scene, kind: str) -> Watcher:
    """The scene's gains for this kind."""
    return replace(scene.watcher, kind=kind, gamma=scene.watcher.gamma if kind in SAME_GAIN else None)


def _modulo(track: Track, kind: str) -> Track:
    if kind not in PROBING_KINDS:
        return track
    return replace(track, error=(track.error + 90.0) % 180.0 - 90.0)


def rows_of(scene: Scene) -> list[Row]:
    """All kinds on one scene, in the order of the configuration."""
    rows = []
    for kind in OBSERVER_KINDS:
        watcher = gains_of(scene, kind)
        track = _modulo(observe(Run(kind, scene.setup, watcher)), kind)
        wrong = observe(Run(kind, scene.setup, replace(watcher, start_off=180.0)))
        late = track.error[track.reference_time >= 0.5 * track.time[-1]]
        end = float(np.median(np.abs(wrong.error[wrong.reference_time >= wrong.time[-1] - 0.1])))
        rows.append(Row(scene.name, kind, lock_time(track), rms(late), float(np.abs(late).max()), end, lock_time(wrong)))
    return rows


def cost_per_sample(kind: str, samples: int = 50_000, repeats: int = 5) -> float:
    """Seconds a sample of the whole estimator with this observer, in a block: the best of some repeats."""
    scene = SCENES[2]
    config = companion_config(scene.setup, gains_of(scene, kind))
    estimator = Estimator(config.build_motor(), scene.setup.drive.sample_rate, estimator_settings(config))
    angle = np.arange(samples) * 2.0 * math.pi / 100.0
    block = np.array([np.cos(angle), np.sin(angle), -100.0 * np.sin(angle), 100.0 * np.cos(angle)])
    best = math.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        estimator.process(block)
        best = min(best, time.perf_counter() - begin)
    return best / samples
