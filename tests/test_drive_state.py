"""What the drive says of itself, and clocks that jump: no claim without a running drive, no needless silence."""

from __future__ import annotations

import numpy as np
import pytest

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import Database, default_dbc_path
from ipmsm_can.wire.protocol import (
    CompanionState,
    DriveMode,
    InjectionReason,
    MessageKind,
    Protocol,
    Waveform,
)

PROTOCOL = Protocol()


def traffic(seconds: float, rpm: float, **status: float) -> FrameBlock:
    """A drive that says these things of itself in DriveStatus in the second half."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(rpm * RPM, 0.5, seconds))
    frames = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings()).step(int(5000 * seconds), 10**9).frames
    rows = np.flatnonzero((frames.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_STATUS])
                          & (frames.t_ns > 10**9 + 0.5e9 * seconds))
    codec = PROTOCOL.codecs[MessageKind.DRIVE_STATUS]
    values = codec.decode_rows(frames.words, rows)
    for name, value in status.items():
        values[codec.index[name]] = value
    frames.raw[rows] = codec.encode(values)
    return frames


def run(frames: FrameBlock, block: int = 500) -> tuple[Companion, np.ndarray, FrameBlock]:
    """The companion afterwards, the flags of each sample, and what it sent."""
    companion = Companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL, transmit=True)
    flags, sent = [], []
    for begin in range(0, len(frames), block):
        part = frames.take(slice(begin, begin + block))
        tracked = companion.feed(part)
        flags += [t.estimate.flags for t in tracked]
        sent.append(companion.respond(tracked, int(part.t_ns[-1])))
    return companion, np.concatenate(flags), FrameBlock.concat(sent)


@pytest.mark.parametrize("mode", [DriveMode.OFF, DriveMode.READY, DriveMode.FAULT, DriveMode.SAFE_STOP])
def test_no_claim_for_a_drive_that_does_not_run(mode: DriveMode) -> None:
    companion, flags, _ = run(traffic(2.0, 600.0, mode=mode))
    valid = flags & confidence.VALID != 0
    assert valid[3000:4900].all()
    assert not valid[5600:].any()
    assert companion.nodes[0].scheduler.reason is InjectionReason.DRIVE_NOT_RUNNING


def test_no_probing_of_a_drive_that_does_not_run() -> None:
    companion, _, sent = run(traffic(2.0, 0.0, mode=DriveMode.FAULT), 50)
    codec = PROTOCOL.codecs[MessageKind.INJECTION_COMMAND]
    commands = np.flatnonzero(sent.can_id == PROTOCOL.base_ids[MessageKind.INJECTION_COMMAND])
    waveform = codec.decode_rows(sent.words, commands)[codec.index["waveform"]]
    assert (waveform == Waveform.ROTATING).any()
    assert (waveform[sent.t_ns[commands] > 10**9 + 1.2e9] == Waveform.OFF).all()
    assert companion.nodes[0].scheduler.amplitude == 0.0


def test_another_version_of_the_protocol_is_a_fault() -> None:
    companion, flags, _ = run(traffic(2.0, 600.0, protocol_version=9))
    assert not (flags[5600:] & confidence.VALID).any()
    now = int(companion.nodes[0].view.sample / 5000.0 * 1e9) + 10**9
    assert companion.nodes[0].update_state(now) is CompanionState.FAULT


@pytest.mark.parametrize("jump_ns", [-900_000_000, -3_600_000_000_000, 3_600_000_000_000])
def test_a_clock_that_jumps_does_not_silence_the_companion(jump_ns: int) -> None:
    frames = traffic(3.0, 0.0)
    later = frames.t_ns > 10**9 + 1.5e9
    shifted = FrameBlock(frames.raw, frames.t_ns + np.where(later, jump_ns, 0))
    _, _, sent = run(shifted, 50)
    after = sent.take(np.flatnonzero(np.arange(len(sent)) > 0.55 * len(sent)))
    for kind, least in ((MessageKind.COMPANION_STATUS, 10), (MessageKind.INJECTION_COMMAND, 50)):
        assert (after.can_id == PROTOCOL.base_ids[kind]).sum() >= least, kind


def test_an_absurd_sample_is_dropped_and_forgotten() -> None:
    """A DBC with float signals can say 1e30 A; the filters must never see it."""
    text = default_dbc_path().read_text()
    for name in ("i_alpha", "i_beta", "v_alpha", "v_beta"):
        for line in text.splitlines():
            if line.startswith(f" SG_ {name} : "):
                text = text.replace(line, line.replace("@1- (0.005,0) [-81.92|81.915]", "@1- (1e+28,0) [0|0]")
                                    .replace("@1- (0.025,0) [-409.6|409.575]", "@1- (1e+28,0) [0|0]"))
                break
    protocol = Protocol(Database.loads(text))
    config = config_from({"motor": {"preset": "m2"}, "wire": {"sample_rate": 5000.0}})
    companion = Companion([config], protocol, transmit=True)
    raw = protocol.encode(MessageKind.DRIVE_SAMPLE, 0, {
        "i_alpha": [0.0, 1e30, 0.0], "i_beta": 0.0, "v_alpha": 0.0, "v_beta": 0.0, "sample_counter": [1, 2, 3]})
    tracked = companion.feed(FrameBlock(raw, np.array([0, 200_000, 400_000])))
    values = np.concatenate([t.run.values for t in tracked], axis=1)
    assert np.abs(values).max() == 0.0
    assert companion.nodes[0].bad_frames == 1
