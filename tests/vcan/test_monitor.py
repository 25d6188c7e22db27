"""The live view on a real interface: a full bus, and orders where the compiled loop serves the drive."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from pathlib import Path

import numpy as np
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
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import read_log
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol, Waveform
from tests.vcan.test_record import FILLER, SECONDS, cpu_s, full_bus, on_a_terminal, play, told, until

PROTOCOL = Protocol()
RATE = 2000.0
CASES = [(False, 1.0), (True, 0.6)] if "IPMSM_CAN_SECONDS" in os.environ else [(False, 1.0)]
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


def shown(drawn: bytearray) -> int:
    """Frames received and dropped so far, as the screen says."""
    text = drawn.decode(errors="replace")
    return sum(int(found[-1]) for found in (re.findall(r"(\d+) so far", text), re.findall(r"drops (\d+)", text)))


@pytest.mark.parametrize(("fd", "load"), CASES)
def test_no_frame_is_lost_with_the_screen_on(fd: bool, load: float, tmp_path: Path) -> None:
    """As `run` in test_record: answering and recording; here with curves and findings, too."""
    config, log = tmp_path / "drive.toml", tmp_path / "run.blf"
    config.write_text('[motor]\npreset = "m2"\n')
    frames = full_bus(0.5 * SECONDS, fd, load)
    with on_a_terminal("monitor", str(config), "-i", "socketcan", "-c", "vcan0", "--transmit", "--record",
                       str(log)) as (process, drawn):
        until(drawn, b"REC ")
        used = cpu_s(process.pid)
        took = play(frames)
        used = cpu_s(process.pid) - used
        # on a busy computer it may be behind by now; what waits in the kernel is not lost
        wait(lambda: shown(drawn) >= len(frames), 120.0)
        process.send_signal(signal.SIGINT)
        process.wait(60)
    text = drawn.decode(errors="replace")
    drops = told(r"kernel drops (\d+)", text.rsplit("TRANSMITTING for", 1)[1])
    received = told(r"(\d+) frames received", text)
    recorded = told(r"recorded (\d+) frames in", text)
    back = FrameBlock.concat(read_log(log))
    print(f"\n{len(frames)} frames in {took:.2f} s ({len(frames) / took:.0f}/s), {drops} dropped by the kernel, "
          f"{received} received, {recorded} recorded, {used / took:.0%} of the processor")
    assert received == len(frames) - drops
    assert recorded == len(back) == received + told(r"frames received, (\d+) sent", text)
    numbers = back.words[back.can_id == FILLER, 1].astype(np.int64)
    assert (np.diff(numbers) > 0).all(), "nothing twice, and in order"
    assert "speed [rpm mech.]" in text
    assert process.returncode == 0
