"""Whether the live view's memory stays flat: hours of 10 kHz sampling, in virtual time.

    python -m tools.monitor_hours [--hours 1]

A second of a simulated drive's frames and of the companion's estimates is handed to the live view again and again,
with the time moved on: in rounds of a tenth of a second, five statuses a second made and packed as for the drawing
process, the findings' thread and process played by hand.
"""

from __future__ import annotations

import argparse
import gc
import os
import pickle
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.simulated import SimulatedPort
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.control import Controls
from ipmsm_can.live_view.judging import Batch, BusSource, Judge, Plan
from ipmsm_can.live_view.sight import WireSight
from ipmsm_can.live_view.taking import FrameClock, LiveView
from ipmsm_can.live_view.watch import Watch
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import Protocol

RATE = 10_000.0
ROUND_S = 0.1
_PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


@dataclass(frozen=True, slots=True)
class Growth:
    """From the end of the warm-up on: resident memory [MB], Python objects; rounds and samples; took [s]."""

    resident_mb: float
    objects: int
    rounds: int
    samples: int
    took: float


def _resident() -> float:
    """[MB]; 0 where the system does not tell."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * _PAGE / 1e6 if statm.exists() else 0.0


def run(hours: float, warm_up_hours: float, thorough: bool = True) -> Growth:
    """Go through so many hours after the warm-up, and measure what they left behind.

    thorough: with the bus's health, and five statuses a second; else without, and one every second.
    """
    protocol = Protocol()
    config = config_from({"motor": {"preset": "m2"}})
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE), constant(600.0 * RPM, 1.0, 60.0))
    drive = DriveNode(protocol, 0, simulation, DriveNodeSettings(fd=True))
    companion = Companion([config], protocol, transmit=False)
    epoch = 1_760_000_000 * 10**9
    rounds: list[tuple[FrameBlock, list[Tracked]]] = []
    for _ in range(round(1.0 / ROUND_S)):
        block = drive.step(round(RATE * ROUND_S), epoch).frames
        rounds.append((block, companion.feed(block)))

    runner = LiveRunner(SimulatedPort([drive], "virtual time"), companion, 1e6, 5e6)
    clock = FrameClock(of_day=True)
    controls = Controls(companion, None, lambda: None, clock.now_ns, clock.words, threading.Event())
    judge = Judge({"the bus": BusSource(Plan((config,), (1_000_000, 5_000_000), True))} if thorough else {})
    watch = Watch(None, lambda: clock.words(clock.now_ns()), controls.note_finding)
    watch.begin(("the bus",))
    view = LiveView(WireSight(runner), controls, watch, clock)

    def second(k: int) -> None:
        shift = k * 10**9
        for n, (block, tracked) in enumerate(rounds):
            later = FrameBlock(block.raw, block.t_ns + shift)
            parts = [replace(t, run=replace(t.run, t_ns=t.run.t_ns + shift)) for t in tracked]
            view.observe(later, parts, _NOTHING, int(later.t_ns[-1]))
            if (n % 2 if thorough else n == 0):
                pickle.dumps(view.status())
            if n % 5 == 4:
                judge.feed(Batch(watch.take()))
        if k % 2:
            watch.accept(judge.findings())
        controls.press("m")

    warm = round(3600 * warm_up_hours)
    for k in range(warm):
        second(k)
    gc.collect()
    resident, objects = _resident(), len(gc.get_objects())
    begin = time.monotonic()
    whole = round(3600 * hours)
    for k in range(warm, warm + whole):
        second(k)
    took = time.monotonic() - begin
    gc.collect()
    samples = whole * sum(int(p.run.counter.size) for _, parts in rounds for p in parts)
    return Growth(_resident() - resident, len(gc.get_objects()) - objects, whole * len(rounds), samples, took)


_NOTHING = FrameBlock(np.zeros((0, 72), np.uint8), np.zeros(0, np.int64))


def main() -> int:
    """Print what grew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0, metavar="H", help="how long [h of virtual time]")
    growth = run(parser.parse_args().hours, 0.1)
    print(f"{growth.samples / 1e6:.1f} million samples in {growth.rounds} rounds: resident memory "
          f"{growth.resident_mb:+.1f} MB, Python objects {growth.objects:+d}; "
          f"{1e6 * growth.took / growth.rounds:.0f} us a round of 0.1 s, statuses and findings included")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
