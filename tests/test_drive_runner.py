"""Simulated drives in real time, on a clock of the test's own: what is caught up with, and what is given up."""

from __future__ import annotations

from itertools import pairwise
from typing import Self

import pytest

from ipmsm_can.bus import drive_runner
from ipmsm_can.bus.drive_runner import DriveRunner
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol

RATE = 5000.0


class Clock:
    """Time passes only in sleep, and by what a stall takes."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Stalled:
    """A port without a bus, which takes so long [s] at the n-th look."""

    fd = False
    drops = unsent = 0
    description = "stalled"
    finished = False

    def __init__(self, clock: Clock, at: int, seconds: float) -> None:
        self.looks: list[float] = []
        self._clock, self._at, self._seconds = clock, at, seconds

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        self.looks.append(self._clock.now)
        if len(self.looks) == self._at:
            self._clock.now += self._seconds
        return FrameBlock.zeros(0)

    def send(self, block: FrameBlock) -> int:
        return len(block)

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def run(stall: float, monkeypatch: pytest.MonkeyPatch, *sources: str) -> tuple[int, list[int], int]:
    """(how often time was given up, samples of each drive after 1 s, looks without time between)"""
    clock = Clock()
    monkeypatch.setattr(drive_runner, "time", clock)
    drives = [DriveNode(Protocol(), k, DriveSimulation(M2, DriveParameters(
        sample_rate=RATE, angle_source=source), constant(0.0, 0.0, 1.0)), DriveNodeSettings())  # type: ignore[arg-type]
        for k, source in enumerate(sources)]
    port = Stalled(clock, 100, stall)
    runner = DriveRunner(port, drives)
    runner.run(lambda: clock.now >= 1.0)
    hurried = sum(later == earlier for earlier, later in pairwise(port.looks))
    return runner.slips, [d.simulation.next_sample for d in drives], hurried


def test_a_drive_on_its_encoder_catches_up(monkeypatch: pytest.MonkeyPatch) -> None:
    slips, samples, _ = run(0.4, monkeypatch, "encoder")
    assert slips == 0 and samples[0] == pytest.approx(RATE, abs=10)
    slips, samples, _ = run(0.6, monkeypatch, "encoder")
    assert slips == 1 and samples[0] == pytest.approx(0.4 * RATE, abs=10)


@pytest.mark.parametrize("source", ["companion", "encoder_then_companion"])
def test_a_drive_on_the_companions_angle_gives_the_companion_time_to_answer(
        monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    """It never simulates so much at once that the companion could not answer in time."""
    slips, samples, hurried = run(0.012, monkeypatch, "encoder", source)
    assert slips == 1 and samples[1] == pytest.approx(0.988 * RATE, abs=10)
    assert samples[0] == samples[1], "drives on one bus have one clock"
    assert hurried == 0
    slips, samples, hurried = run(0.002, monkeypatch, source)
    assert slips == 0 and samples[0] == pytest.approx(RATE, abs=10)
    assert hurried == pytest.approx(2, abs=1)
