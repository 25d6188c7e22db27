"""The samples themselves: lost, cut off, repeated; a drive that did not run; a log that was cut off."""

from __future__ import annotations

import numpy as np

from ipmsm_can.diagnosis import limits
from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding


def check(case: Case) -> tuple[list[Finding], list[Checked]]:
    """Losses, clipping, and what did not run."""
    m, count = case.m, case.m.counts.get
    findings: list[Finding] = []
    received, lost = count("received", len(m)), count("lost", 0)
    findings += lost_finding(received, lost, (Evidence("gaps too long to fill", count("gaps", 0)),))
    clipped = int(np.count_nonzero(m.clipped))
    if clipped:
        findings.append(Finding(
            "samples.clipped", "warning", "samples are cut off",
            f"{clipped} samples stand at the end of their signal's range: the real value was larger.",
            "Give the signals a larger factor in the DBC (docs/wire.md).",
            (Evidence("cut off", clipped, "samples"),), size=1.0 + clipped / max(1, len(m)), order=4))
    bad = count("bad_frames", 0) + count("wrong_length", 0)
    if bad > 0.001 * max(1, received):
        findings.append(Finding(
            "samples.bad_frames", "warning", "frames are damaged",
            f"{bad} frames of the drive had a wrong length, a wrong checksum or impossible content.",
            "Check that no other sender uses the same identifiers, and that the DBC is the drive's.",
            (Evidence("bad frames", bad),), size=1.0 + bad / max(1, received), order=4))
    restarts = count("restarts", 0)
    if restarts:
        findings.append(Finding(
            "samples.restarts", "info", "the drive restarted",
            f"The drive's sample counter began anew {restarts} times.", "Check its supply, and its log.",
            (Evidence("restarts", restarts),), order=6))
    words = f"{received} received, {lost} lost, {clipped} cut off"
    return findings, [Checked("samples", "found" if findings else "fine", words), *_running(case)]


def lost_finding(received: int, lost: int, more: tuple[Evidence, ...] = ()) -> list[Finding]:
    """That samples did not arrive, where it was more than a few."""
    share = lost / max(1, received + lost)
    if share <= limits.LOST:
        return []
    return [Finding(
        "samples.lost", "warning" if share > limits.LOST_MUCH else "info", "samples are lost",
        f"{100 * share:.1f} % of the drive's samples did not arrive.",
        "See `ipmsm-can bus` for where they get lost: on the bus, in the kernel, or in the adapter.",
        (Evidence("lost", lost, "samples"), *more), size=share / limits.LOST, order=5)]


def _running(case: Case) -> list[Checked]:
    m = case.m
    still = float((~m.running).mean()) if len(m) else 0.0
    if still == 0.0:
        return []
    return [Checked("time in which the drive ran", "fine" if still < 1.0 else "untold",
                    f"{100 * (1.0 - still):.0f} % of the log; the rest tells of the current's offset only")]
