"""While the wire leaves open which sample a frame belongs to, no angle is called valid."""

from __future__ import annotations

from typing import Any

import cantools
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
from ipmsm_can.node import Tracked
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol

PROTOCOL = Protocol()
RATE = 5000.0


def traffic(rpm: float, seconds: float) -> tuple[FrameBlock, np.ndarray]:
    """Frames of a drive at constant speed, and the true angle of each sample."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE), constant(rpm * RPM, 1.0, seconds))
    step = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings(timing_rate=10.0, reference_rate=0.0)).step(
        int(seconds * RATE), t0_ns=1_000_000_000)
    return step.frames, step.samples.theta_e


def follow(frames: FrameBlock, wire: dict[str, float] | None = None) -> list[Tracked]:
    companion = Companion([config_from({"motor": {"preset": "m2"}, "wire": wire or {}})], PROTOCOL, transmit=False)
    return companion.feed(frames)


def worst_valid(tracked: list[Tracked], theta: np.ndarray) -> float:
    """Largest error [deg] while valid, against the angle of the sample the companion believes it is."""
    worst = 0.0
    for part in tracked:
        valid = part.estimate.flags & confidence.VALID != 0
        # What counts is the angle now: of the last sample that was really sent, by time.
        sent = np.round((part.run.t_ns - 1_000_000_000) * RATE / 1e9).astype(int)
        claimed = part.estimate.angle[0] + part.estimate.angle[2] * (sent - part.run.counter) / RATE
        error = np.degrees((claimed - theta[sent] + np.pi) % (2 * np.pi) - np.pi)
        worst = max(worst, float(np.abs(error[valid]).max(initial=0.0)))
    return worst


@pytest.mark.parametrize("missing", [16, 32, 48, 160, 800])
@pytest.mark.parametrize("begin", [7003, 7230, 7449])
def test_a_loss_of_whole_wraps_is_never_valid_and_wrong(missing: int, begin: int) -> None:
    """The counter goes on as if nothing had been lost; for all the receiver knows, samples came late."""
    frames, theta = traffic(1000.0, 2.0)
    is_sample = frames.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_SAMPLE]
    number = np.cumsum(is_sample) - 1
    lost = is_sample & (number >= begin) & (number < begin + missing)
    tracked = follow(frames.take(np.flatnonzero(~lost)))
    flags = np.concatenate([t.estimate.flags for t in tracked])
    doubt = np.concatenate([t.run.doubt for t in tracked])
    if begin == 7003 and missing < 497:  # no DriveTiming within the loss, which would leave nothing open
        assert doubt.any()
    assert not (flags[doubt != 0] & confidence.VALID).any()
    assert worst_valid(tracked, theta) < 15.0
    assert flags[-1] & confidence.VALID
    assert not doubt[-1]


@pytest.mark.parametrize("missing", [16, 32, 48, 160, 803, 3001])
@pytest.mark.parametrize("rpm", [300.0, 1000.0])
def test_a_drive_without_timing_is_not_believed_either_until_the_pace_settles_it(missing: int, rpm: float) -> None:
    frames, theta = traffic(rpm, 4.0)
    is_sample = frames.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_SAMPLE]
    number = np.cumsum(is_sample) - 1
    keep = is_sample & ~((number >= 7003) & (number < 7003 + missing))
    tracked = follow(frames.take(np.flatnonzero(keep)), {"sample_rate": RATE})
    flags = np.concatenate([t.estimate.flags for t in tracked])
    doubt = np.concatenate([t.run.doubt for t in tracked])
    counter = np.concatenate([t.run.counter for t in tracked])
    assert doubt.any()
    assert worst_valid(tracked, theta) < 15.0
    assert counter[-1] == theta.size - 1
    assert flags[-1] & confidence.VALID
    assert not doubt[-1]


def test_a_drive_cannot_go_on_with_an_angle_that_nobody_can_date() -> None:
    """It may with one that is not valid while sigma is within its limit; so sigma is unknown on the wire."""
    frames, _ = traffic(1000.0, 1.7)
    is_sample = frames.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_SAMPLE]
    number = np.cumsum(is_sample) - 1
    frames = frames.take(np.flatnonzero(~(is_sample & (number >= 7003) & (number < 7035))))
    companion = Companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL, transmit=True)
    database: Any = cantools.database.load_file(default_dbc_path())
    message = database.get_message_by_name("PositionEstimate")
    doubtful = sure = 0
    for begin in range(0, len(frames), 5):
        tracked = companion.feed(frames.take(slice(begin, begin + 5)))
        answers = companion.respond(tracked, int(frames.t_ns[min(begin + 4, len(frames) - 1)]))
        doubts = {int(c) & 0x3FF: (bool(d), float(np.degrees(s))) for t in tracked
                  for c, d, s in zip(t.run.counter, t.run.doubt, t.estimate.sigma, strict=True)}
        for row in np.flatnonzero(answers.can_id == message.frame_id):
            said = message.decode(answers.data[row, :8].tobytes(), decode_choices=False)
            doubted, sigma = doubts[said["sample_counter"]]
            if doubted:
                assert not said["valid"] and said["sigma_theta"] == 127.5
                doubtful += sigma < 5.0  # else nothing was at stake
            elif said["valid"]:
                assert abs(said["sigma_theta"] - sigma) < 0.26
                sure += 1
    assert doubtful > 5 and sure > 1000


def test_a_late_burst_is_believed_again_as_soon_as_it_has_caught_up() -> None:
    frames, theta = traffic(1000.0, 2.0)
    held_until = frames.t_ns[0] + int(7100 / RATE * 1e9)
    late = (frames.t_ns > frames.t_ns[0] + int(7003 / RATE * 1e9)) & (frames.t_ns < held_until)
    t_ns = np.where(late, held_until, frames.t_ns)
    tracked = follow(FrameBlock(frames.raw, t_ns))
    doubt = np.concatenate([t.run.doubt for t in tracked])
    flags = np.concatenate([t.estimate.flags for t in tracked])
    assert 80 <= doubt.sum() < 100
    assert not doubt[7110:].any()
    assert (flags[7110:] & confidence.VALID).all()
    del theta


def test_no_doubt_in_ordinary_traffic() -> None:
    frames, _ = traffic(300.0, 1.0)
    rng = np.random.default_rng(3)
    keep = rng.random(len(frames)) > 0.02
    jittered = FrameBlock(frames.raw, frames.t_ns + rng.integers(0, 500_000, len(frames)))
    tracked = follow(jittered.take(np.flatnonzero(keep)))
    assert not np.concatenate([t.run.doubt for t in tracked]).any()
