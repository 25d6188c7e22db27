"""Section 5.2, last part: the proposed observer against extraction of position from injection in v_alpha only."""

from __future__ import annotations

from ipmsm_can.config import OBSERVER_KINDS
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.experiments import panels
from ipmsm_can.experiments.bench import BENCH_WORDS, OMEGA_1000, on_bench
from ipmsm_can.experiments.measure import VISIBLE_DEG, largest, margin_deg, rms, window
from ipmsm_can.experiments.model import Experiment, Figure, Figures, Probing, Run, Status, Tracks, Verdict, Watcher

EXTRACTION = "injection_extraction"
_V_ALPHA = Probing(6.0, 400.0, waveform="pulsating", axis=0.0)
LOW = on_bench(Profile(((0.0, 20.0 * RPM),), ((0.0, 1.0),), 3.0, "20 rpm"), _V_ALPHA)
HIGH = on_bench(Profile(((0.0, 1000.0 * RPM),), ((0.0, 1.0),), 1.0, "1000 rpm"), _V_ALPHA)
_SETTLED = 0.5
_LOST_DEG = 45.0
"""An axis known modulo 180 degrees that is further off than this at worst could as well be guessed."""


def _runs() -> tuple[Run, ...]:
    kinds = [("ges", "proposed"), (EXTRACTION, "extraction")]
    return tuple(Run(f"{name}, {speed}", setup, Watcher(kind=kind, alpha=50.0, gamma=50.0, start_off=20.0))
                 for speed, setup in (("20 rpm", LOW), ("1000 rpm", HIGH))
                 for kind, name in kinds if kind in OBSERVER_KINDS)


def _figures(tracks: Tracks) -> list[Figure]:
    figures = []
    for name, t in tracks.items():
        omega = OMEGA_1000 if "1000" in name else 0.02 * OMEGA_1000
        margin = margin_deg(t.run.setup, omega)
        figures += [Figure(f"rms, {name}", rms(window(t, _SETTLED)), "°", margin),
                    Figure(f"largest, {name}", largest(t, _SETTLED), "°", margin)]
    return figures


def _judge(f: Figures) -> Verdict:
    if "rms, extraction, 20 rpm" not in f:
        return Verdict(Status.NOT, "This build has no observer that extracts position from the injected signal.")
    low, low_2 = f["rms, proposed, 20 rpm"], f["rms, extraction, 20 rpm"]
    high, high_2 = f["rms, proposed, 1000 rpm"], f["rms, extraction, 1000 rpm"]
    why = (f"At 20 rpm {low.value:.1f}° rms (proposed) and {low_2.value:.1f}° rms (extraction); at 1000 rpm "
           f"{high.value:.1f}° and {high_2.value:.0f}° rms.")
    similar = abs(low.value - low_2.value) <= VISIBLE_DEG
    fails = f["largest, extraction, 1000 rpm"].value > _LOST_DEG and high.value <= VISIBLE_DEG
    if similar and fails:
        return Verdict(Status.REPRODUCED, why)
    if fails:
        better = "proposed observer" if low.value < low_2.value else "extraction"
        return Verdict(Status.CONDITION, f"{why} Extraction fails at high speed as said; at low speed the {better} "
                       "is clearly better with this dead time.")
    return Verdict(Status.NOT, why)


EXPERIMENTS = (
    Experiment(
        "fig20", "Fig. 20", "Against extraction from the injected signal",
        "Performances are similar at low speed; at high speed the proposed observer works and extraction fails.",
        BENCH_WORDS + "6 V at 400 Hz in v_α only, α = 50, γ = 50, load 1 N m, starts 20° off. The paper used the "
        "motor of its reference, which it does not give; here it is M2. Extraction is reconstructed, see its "
        "docstring.",
        _runs(), _figures, _judge,
        lambda tracks: [panels.angle({n: t for n, t in tracks.items() if "20 rpm" in n}, 0.0, 2.0, "20 rpm"),
                        panels.error({n: t for n, t in tracks.items() if "20 rpm" in n}, title="Error at 20 rpm",
                                     most=30.0),
                        panels.error({n: t for n, t in tracks.items() if "1000 rpm" in n},
                                     title="Error at 1000 rpm",
                                     most=190.0)]),
)
