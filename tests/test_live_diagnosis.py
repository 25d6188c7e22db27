"""Findings as they come: bounded, seldom, and those of the log."""

from __future__ import annotations

import pytest

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder
from ipmsm_can.config import DriveConfig
from ipmsm_can.diagnosis import Report, diagnose, live
from ipmsm_can.diagnosis.live import LiveDiagnosis
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import Protocol
from tools.faults import FAULTS, config, frames, healthy

PROTOCOL = Protocol()


@pytest.fixture(scope="module")
def reversed_current() -> tuple[FrameBlock, DriveConfig]:
    drive = next(breaks for words, _, breaks in FAULTS if words == "current reversed")(healthy(1, 6))
    return frames(drive, PROTOCOL), config(drive)


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_findings_are_those_of_the_log(reversed_current: tuple[FrameBlock, DriveConfig]) -> None:
    block, told = reversed_current
    watch = LiveDiagnosis(told, PROTOCOL, window_s=60.0)
    for begin in range(0, len(block), 1000):
        watch.feed(block.take(slice(begin, begin + 1000)))
    builder = MeasurementBuilder(told, PROTOCOL, source="live")
    builder.feed(block)
    report = diagnose(builder.measurement(), told, thorough=False)
    assert [f.to_dict() for f in watch.findings()] == [f.to_dict() for f in report.findings]
    assert watch.findings()[0].code == "wiring.current_sign"
    assert watch.report("can0").source == "can0"


def test_it_judges_only_every_few_seconds(reversed_current: tuple[FrameBlock, DriveConfig],
                                          monkeypatch: pytest.MonkeyPatch) -> None:
    block, told = reversed_current
    judged: list[int] = []

    def counting(m: Measurement, c: DriveConfig, thorough: bool) -> Report:
        judged.append(len(m))
        return diagnose(m, c, thorough=thorough)

    monkeypatch.setattr(live, "diagnose", counting)
    clock = Clock()
    watch = LiveDiagnosis(told, PROTOCOL, every_s=3.0, clock=clock)
    watch.feed(block)
    first = watch.findings()
    for _ in range(10):
        clock.now += 0.29
        assert watch.findings() is first
    assert len(judged) == 1
    clock.now += 0.2
    watch.findings()
    assert len(judged) == 2


def test_too_little_says_nothing_yet(reversed_current: tuple[FrameBlock, DriveConfig]) -> None:
    block, told = reversed_current
    watch = LiveDiagnosis(told, PROTOCOL)
    assert watch.findings() == ()
    watch = LiveDiagnosis(told, PROTOCOL)
    watch.feed(block.take(slice(0, 1000)))
    assert watch.findings() == ()


def test_memory_is_bounded_whether_anybody_asks_or_not(reversed_current: tuple[FrameBlock, DriveConfig],
                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    block, told = reversed_current
    monkeypatch.setattr(live, "MOST_FRAMES", 10_000)
    watch = LiveDiagnosis(told, PROTOCOL, window_s=0.5)
    for begin in range(0, len(block), 500):
        watch.feed(block.take(slice(begin, begin + 500)))
    assert sum(map(len, watch._waiting)) <= 10_000
    assert watch.left_out == len(block) - sum(map(len, watch._waiting))
    assert watch.samples <= 0.5 * 10_000 + 7 * 500  # whole blocks of frames, seven samples each
