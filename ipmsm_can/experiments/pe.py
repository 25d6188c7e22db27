"""The conditions C1, C2, C3 of Proposition 2 on the drive's runs, holding and failing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.experiments import panels
from ipmsm_can.experiments.conditions import Verdict as Check
from ipmsm_can.experiments.conditions import check_c1, check_c2, check_c3, check_phi
from ipmsm_can.experiments.draw import Plot
from ipmsm_can.experiments.measure import current_sigma, voltage_step
from ipmsm_can.experiments.model import (
    Experiment,
    Figure,
    Figures,
    Probing,
    Run,
    Setup,
    Status,
    Tracks,
    Verdict,
    Watcher,
)
from ipmsm_can.experiments.rig import Track

_WINDOW, _REQUIRED = 0.1, 0.01
_BEGIN = 1.0
"""Time [s] after which the transients of start and injection are over."""
_ALPHA = 10.0
_CLEAN = DriveParameters(sample_rate=5000.0, current_noise=0.0)
_LOCKED = replace(_CLEAN, rotor_locked=True)
_TWENTY = Probing(20.0, 400.0)


def _setup(rpm: float, probing: Probing | None) -> Setup:
    drive = _CLEAN if rpm else _LOCKED
    return Setup("m2", Profile(((0.0, rpm * RPM),), ((0.0, 2.0 if rpm else 0.0),), 1.6), drive, probing=probing,
                 theta_0=0.7)


_CASES = {
    "1000 rpm": (_setup(1000.0, None), {"C1", "C2", "A3"}),
    "standstill": (_setup(0.0, None), set[str]()),
    "standstill, rotating": (_setup(0.0, _TWENTY), {"C1", "C2", "C3", "A3"}),
    "standstill, pulsating": (_setup(0.0, replace(_TWENTY, waveform="pulsating")), set[str]()),
}
"""The run's drive, and the conditions that the theory says hold there."""
_SYMBOLS = {"C1": "C1: v − Ri − L_s p[i]", "C2": "C2: p[−(L0/2) i + (L0 iᵀc + ψ_m) c]",
            "C3": "C3: p[i], as (L0/2) p[i]",
            "A3": "Assumption 3: Φ"}


def _checks(t: Track) -> list[Check]:
    late = t.time >= _BEGIN
    m, rate, sigma = t.run.setup.machine, t.run.setup.drive.sample_rate, current_sigma(t.run.setup)
    i, v, theta = t.i[late], t.v[late], t.truth.theta_e[late]
    # What a signal at 400 Hz, or at the rotor's frequency, keeps of its level in Phi.
    w = max(abs(float(t.truth.omega_e[-1])), 2.0 * np.pi * 400.0 if t.run.setup.probing else 0.0, 1.0)
    phi_required = _REQUIRED * 4.0 * _ALPHA**2 / (w**2 + _ALPHA**2)
    # Steps of the voltage may not average out where the signal repeats itself: their rms counts as an offset.
    noise = np.hypot(2.0 * _ALPHA * m.L_s * sigma, 2.0 * voltage_step(t.run.setup) / np.sqrt(12.0))
    return [check_c1(i, v, rate, m, window=_WINDOW, required=_REQUIRED, current_noise=sigma),
            check_c2(i, theta, rate, m, window=_WINDOW, required=_REQUIRED, current_noise=sigma),
            check_c3(i, theta, rate, m, window=_WINDOW, required=_REQUIRED, current_noise=sigma),
            check_phi(t.phi[late], rate, window=_WINDOW, required=phi_required, noise=float(noise))]


def _figures(tracks: Tracks) -> list[Figure]:
    return [Figure(f"{_SYMBOLS[c.condition]}, {name}", c.level if c.applies else 0.0,
                   "V² s" if c.applies else "(does not apply: the rotor turns)", c.required + c.noise)
            for name, t in tracks.items() for c in _checks(t)]


def _judge(f: Figures) -> Verdict:
    wrong = []
    for name, (_, expected) in _CASES.items():
        for condition, symbol in _SYMBOLS.items():
            x = f[f"{symbol}, {name}"]
            if (x.value >= (x.margin or 0.0)) != (condition in expected):
                wrong.append(f"{condition} at {name}")
    if wrong:
        return Verdict(Status.NOT, f"Other than the theory says: {', '.join(wrong)}.")
    return Verdict(Status.REPRODUCED, "Turning, C1 and C2 hold, and Φ is PE; standing still all fail; with "
                   "rotating injection all hold; with injection along one axis all fail, for p[i] is then a line. "
                   "Wherever a condition holds, Φ is PE. C3 silently needs L0 ≠ 0.")


def _plots(tracks: Tracks) -> list[Plot]:
    return [panels.plane({name: tracks[name].phi[tracks[name].time >= _BEGIN]}, f"Φ, {name}", "Φ_α [V]", "Φ_β [V]",
                         dots=True)
            for name in ("1000 rpm", "standstill, rotating", "standstill, pulsating")]


EXPERIMENTS = (
    Experiment(
        "conditions", "Prop. 2", "The conditions C1, C2, C3",
        "Φ is PE if one of C1, C2, or, at standstill, C3 holds.",
        "M2 without noise at 5 kHz; smallest eigenvalue over any window of 0.1 s from 1 s on; a condition holds "
        "where it exceeds 0.01 V² s and what quantisation alone can make of it (the threshold); for Φ scaled by "
        "its filter. Injection of 20 V at 400 Hz.",
        tuple(Run(name, setup, Watcher(alpha=_ALPHA)) for name, (setup, _) in _CASES.items()),
        _figures, _judge, _plots),
)
