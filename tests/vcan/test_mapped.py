"""Another inverter through its map on a real interface: the live view, a recording and a diagnosis side by side."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import numpy as np

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import read_log
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol
from tests.vcan.test_record import PROGRAM, caught_up, filler, on_a_terminal, play, told, until

RATE = 1000.0
"""Of the samples [Hz]: with four bits of counter a computer that sends may be late by 15 ms."""
SECONDS = 8.0


def traffic() -> FrameBlock:
    """A drive of ours, which the map takes for another's, and strangers between."""
    to_and_fro = Profile(((0.0, 200.0 * RPM), (3.5, 200.0 * RPM), (4.5, -200.0 * RPM), (8.0, -200.0 * RPM)),
                         ((0.0, 2.0), (2.0, 4.0), (3.0, 1.0), (6.0, -3.0)), duration=SECONDS)
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, current_bandwidth=60.0, current_noise=0.02),
                                 to_and_fro)
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings(reference_rate=200.0))
    drive = node.step(int(RATE * SECONDS)).frames
    fill = filler(500, False, 0)
    fill.t_ns[:] = np.linspace(0, 1e9 * SECONDS, len(fill)).astype(np.int64)
    both = FrameBlock.concat([drive, fill])
    return both.take(np.argsort(both.t_ns, kind="stable"))


def test_live_view_recording_and_diagnosis_side_by_side_are_silent(tmp_path: Path) -> None:
    config, log, live, after = (tmp_path / name for name in ("drive.toml", "run.blf", "live.json", "after.json"))
    config.write_text('[motor]\npreset = "m2"\n')
    frames = traffic()
    bus = ("-i", "socketcan", "-c", "vcan0", "--map", "ipmsm_can")
    judge = ("diagnose", "--drive", str(config))
    with (SocketCanPort("vcan0") as witness,
          on_a_terminal(*judge, *bus, "--json", str(live)) as (diagnosis, words),
          on_a_terminal("monitor", str(config), *bus, "--record", str(log)) as (process, drawn)):
        until(words, b"listening only")
        until(drawn, b"REC ")
        play(frames)
        caught_up(log)
        for one in (process, diagnosis):
            one.send_signal(signal.SIGINT)
            one.wait(120)
        heard = 0
        while len(block := witness.receive(0.2)):
            heard += len(block)
    text = drawn.decode(errors="replace")
    print(words.decode(errors="replace")[-3000:], text[-1500:])
    assert heard + witness.drops == len(frames), "somebody else sent"
    assert told(r"(\d+) frames received", text) == told(r"recorded (\d+) frames in", text) == len(frames)
    assert "speed [rpm mech.]" in text
    assert process.returncode == 0
    back = FrameBlock.concat(read_log(log))
    assert np.array_equal(back.words, frames.words)
    again = subprocess.run([*PROGRAM, *judge, str(log), "--map", "ipmsm_can", "--json", str(after)], check=False,
                           stdout=subprocess.DEVNULL)
    assert diagnosis.returncode == again.returncode in (0, 1)
    # on a busy computer the frames go late, and the figures are poor: what matters is that both are the same
    reports = [json.loads(path.read_text()) for path in (live, after)]
    assert reports[0]["source"] == "vcan0 (SocketCAN, kernel time stamps) with the map ipmsm_can"
    assert reports[0]["facts"] == reports[1]["facts"]
    assert [f["code"] for f in reports[0]["findings"]] == [f["code"] for f in reports[1]["findings"]]
