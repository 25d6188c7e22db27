"""The loop closed over a real SocketCAN interface, from standstill; the drive is a process of its own."""

from __future__ import annotations

import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.lane import Lap
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.bus.warmup import warm_up_companion
from ipmsm_can.companion import Companion
from ipmsm_can.config.load import load_config
from ipmsm_can.drive.node import NO_ANGLE
from ipmsm_can.frames import FrameBlock
from ipmsm_can.startup import Phase
from ipmsm_can.wire.protocol import MessageKind, Protocol, Waveform
from tests.vcan.test_end_to_end import BUS, ENVIRONMENT, PROGRAM

PROTOCOL = Protocol()
# The virtual machine has one processor for everybody: an angle lives as long as its ten bits of the counter allow.
CONFIG = """
[motor]
preset = "m2"
[observer]
kind = "riccati"
[injection]
amplitude = "4.2 V"
[simulation]
saturation = 0.2
angle_source = "companion"
estimate_time_to_live = "200 ms"
status_rate = 200
"""
PROFILE = "duration = 12.0\nspeed_rpm = [[0, 0], [6, 0], [8, 300], [12, 300]]\n"
RPM_AT_LAST = 300.0


def column(block: FrameBlock, kind: MessageKind, *names: str) -> tuple[np.ndarray, ...]:
    """Frame numbers of such messages, and signals in them."""
    rows = np.flatnonzero(block.can_id == PROTOCOL.base_ids[kind])
    values, _, _ = PROTOCOL.decode(kind, 0, block.raw, rows)
    return rows, *(values[PROTOCOL.codecs[kind].index[name]] for name in names)


@pytest.mark.timeout(600)
def test_from_standstill_to_speed(tmp_path: Path) -> None:
    """Axis, pulses, valid, the drive closes its loop and turns; the companion's compiled loop has taken over."""
    config, profile = tmp_path / "drive.toml", tmp_path / "profile.toml"
    config.write_text(CONFIG)
    profile.write_text(PROFILE)
    loaded = load_config(config)
    warm_up_companion([loaded], PROTOCOL)
    companion = Companion([loaded], PROTOCOL, transmit=True)
    frames: list[FrameBlock] = []
    phases: list[Phase] = []
    in_lane: list[tuple[Phase, int]] = []
    with SocketCanPort("vcan0") as port:
        runner = LiveRunner(port, companion, 1e6, 5e6)
        lane = runner._lane
        assert lane is not None
        run = lane.run

        def counted(timeout_s: float, now_ns: int) -> Lap:
            startup = companion.nodes[0].startup
            assert startup is not None
            phase = startup.phase
            lap = run(timeout_s, now_ns)
            in_lane.append((phase, len(lap.taken)))
            return lap

        def observe(block: FrameBlock, _part: object, sent: FrameBlock, _now: int) -> None:
            frames.extend((block, sent))
            startup = companion.nodes[0].startup
            if startup is not None and startup.phase not in phases[-1:]:
                phases.append(startup.phase)

        lane.run = counted  # type: ignore[method-assign]
        stop = False
        thread = threading.Thread(target=lambda: runner.run(lambda: stop, observe))
        thread.start()
        drive = [*PROGRAM, "drive", str(config), "--profile", str(profile), "--theta0", "200", "--quiet", *BUS]
        done = subprocess.run(drive, capture_output=True, text=True, timeout=300, env=ENVIRONMENT, check=False)
        stop = True
        thread.join(10)
    assert done.returncode == 0, done.stdout + done.stderr
    heard = FrameBlock.concat(frames)

    # The order of events, as frames on the bus.
    status, waveform, faults = column(heard, MessageKind.DRIVE_STATUS, "active_waveform", "faults")
    estimates, valid, sigma = column(heard, MessageKind.POSITION_ESTIMATE, "valid", "sigma_theta")
    told, rpm = column(heard, MessageKind.DRIVE_REFERENCE, "omega_e")
    rpm = rpm / 3.0 * 30.0 / np.pi
    pulses = status[waveform == Waveform.POLARITY_PULSES]
    without = faults.astype(int) & NO_ANGLE != 0
    closed = status[~without]
    assert len(closed) and len(pulses), (np.unique(faults, return_counts=True), valid.sum(), phases, done.stdout)
    turning = told[np.abs(rpm) > 30.0]
    first_valid = estimates[valid == 1.0][0]
    assert pulses[0] < first_valid < closed[0] < turning[0]
    assert without[0] and not without[-1]
    assert not (np.diff(without.astype(int)) > 0).any(), "the drive has lost its angle again"
    steps = iter(phases)
    assert all(phase in steps for phase in (Phase.AXIS, Phase.PULSES, Phase.KNOWN, Phase.WATCH)), phases
    assert phases[-1] is Phase.WATCH  # it turns: the observer sees more than the axis shows
    # To speed, on the companion's angle.
    assert np.abs(rpm[-500:] - RPM_AT_LAST).max() < 30.0
    assert sigma[-100:].max() < 10.0
    # The compiled loop waits while the start-up needs every sample, and then takes them all.
    assert {phase for phase, taken in in_lane if taken} == {Phase.WATCH}
    samples = np.count_nonzero(heard.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_SAMPLE])
    assert sum(taken for _, taken in in_lane) > 0.2 * samples
    sequencer = companion.nodes[0].receiver.sequencer
    assert sequencer.count("lost") == 0 and sequencer.count("received") == samples
