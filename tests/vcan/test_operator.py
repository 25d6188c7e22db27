"""The operator's orders where the compiled loop serves the drive: it hears of them soon enough."""

from __future__ import annotations

import threading
import time

import pytest

from ipmsm_can.bus.drive_runner import DriveRunner
from ipmsm_can.bus.lane import FastLane, Lap
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.bus.warmup import warm_up_companion, warm_up_drives
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol, Waveform

PROTOCOL = Protocol()
RATE = 2000.0
SOON = 0.6
"""[s] of the drive's time: a lap of the loop is a quarter of a second; then a command, and a tick of the drive."""


def build() -> DriveNode:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, current_bandwidth=100.0),
                                 constant(600.0 * RPM, 0.5, 600.0))
    return DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings())


def test_an_order_is_carried_out_within_a_fraction_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_from({"motor": {"preset": "m2"}})
    warm_up_companion([config], PROTOCOL)
    warm_up_drives([build()], PROTOCOL)
    laps: list[int] = []
    run = FastLane.run

    def counted(lane: FastLane, timeout_s: float, now_ns: int) -> Lap:
        lap = run(lane, timeout_s, now_ns)
        laps.append(len(lap.taken))
        return lap

    monkeypatch.setattr(FastLane, "run", counted)
    drive = build()
    companion = Companion([config], PROTOCOL, transmit=True)
    stop = threading.Event()
    with SocketCanPort("vcan0") as theirs, SocketCanPort("vcan0") as ours:
        runner, drives = LiveRunner(ours, companion, 1e6, 5e6), DriveRunner(theirs, [drive], 0.005)
        threads = [threading.Thread(target=lambda: runner.run(stop.is_set)),
                   threading.Thread(target=lambda: drives.run(stop.is_set))]
        for thread in threads:
            thread.start()
        try:
            took = []
            wait(lambda: drive.simulation.next_sample > 2 * RATE and companion.nodes[0].scheduler.rests)
            assert drive.waveform is Waveform.OFF, "at this speed nothing is injected by itself"
            for wanted in (True, False, True, None):
                before = sum(laps)
                ordered = drive.simulation.next_sample
                companion.order_injection(0, wanted)
                wait(lambda wanted=wanted: (drive.waveform is not Waveform.OFF) == bool(wanted))
                took.append((drive.simulation.next_sample - ordered) / RATE)
                settled = drive.simulation.next_sample + 0.5 * RATE
                wait(lambda settled=settled: drive.simulation.next_sample > settled)
                assert (drive.waveform is not Waveform.OFF) == bool(wanted)
                assert sum(laps) > before + 0.1 * RATE, "the compiled loop served meanwhile"
        finally:
            stop.set()
            for thread in threads:
                thread.join(10.0)
    print(f"orders took effect after {', '.join(f'{s:.2f}' for s in took)} s of the drive's time")
    assert max(took) < SOON


def wait(until: object, seconds: float = 60.0) -> None:
    """Until it is so."""
    assert callable(until)
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)
