"""The compiled loop of the fast lane, over a UDP socket: the same system calls and time stamps as SocketCAN."""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.bus import lane as lanes
from ipmsm_can.bus.lane import FastLane, Lap
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.message_table import STATES, MessageTable
from ipmsm_can.bus.warmup import warm_up_companion
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_RTR_FLAG, FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the loop is for Linux only")

PROTOCOL = Protocol()
POSITION, FLUX = (int(PROTOCOL.base_ids[kind]) for kind in (MessageKind.POSITION_ESTIMATE,
                                                            MessageKind.ACTIVE_FLUX_ESTIMATE))
_SO_TIMESTAMPNS, _SO_RCVBUFFORCE, _SO_RCVBUF, _SO_RCVTIMEO = 35, 33, 8, 20


class Port:
    """What the loop needs of a port, over UDP; `put` is the other end."""

    def __init__(self) -> None:
        self._ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._theirs = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for one in (self._ours, self._theirs):
            one.bind(("127.0.0.1", 0))
            try:
                one.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 64 << 20)
            except OSError:
                one.setsockopt(socket.SOL_SOCKET, _SO_RCVBUF, 64 << 20)
        self._ours.connect(self._theirs.getsockname())
        self._theirs.connect(self._ours.getsockname())
        self._ours.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.tables = MessageTable(256, 10), MessageTable(256, 0)
        self.state = np.zeros(STATES, np.int64)

    def set_timeout(self, timeout_s: float) -> None:
        self._ours.setsockopt(socket.SOL_SOCKET, _SO_RCVTIMEO, struct.pack("@ll", 0, max(1, int(timeout_s * 1e6))))

    def fileno(self) -> int:
        return self._ours.fileno()

    def check(self) -> None:
        """Nothing to check."""

    def look(self, block: FrameBlock) -> None:
        """No controller to watch."""

    def put(self, raw: NDArray[np.uint8]) -> None:
        for frame in raw:
            self._theirs.send(frame[:16].tobytes())

    def close(self) -> None:
        self._ours.close()
        self._theirs.close()


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile first: samples that come after half a minute of silence are another matter."""
    warm_up_companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL)


@pytest.fixture
def port() -> Iterator[Port]:
    made = Port()
    yield made
    made.close()


def samples(first: int, n: int, stride: int = 1) -> NDArray[np.uint8]:
    k = first + stride * np.arange(n)
    turn = 0.06 * k
    return PROTOCOL.encode(MessageKind.DRIVE_SAMPLE, 0, {
        "i_alpha": np.cos(turn), "i_beta": np.sin(turn), "v_alpha": 100 * np.cos(turn),
        "v_beta": 100 * np.sin(turn), "sample_counter": k & 15})


def following(sections: Mapping[str, Any], rate: float, first: int = 0, n: int = 200) -> tuple[Companion, int]:
    """A companion that follows a drive since n samples, the last of them now; and the next sample's counter."""
    companion = Companion([config_from({"motor": {"preset": "m2"}, **sections})], PROTOCOL, transmit=True)
    timing = PROTOCOL.encode(MessageKind.DRIVE_TIMING, 0, {"sample_counter": float(first), "sample_rate": rate})
    t = time.time_ns() - ((n - np.arange(n + 1)) * 1e9 / rate).astype(np.int64)
    tracked = companion.feed(FrameBlock(np.concatenate([timing, samples(first, n)]), t))
    companion.respond(tracked, int(t[-1]))
    return companion, first + n


def refresh(companion: Companion, k: int, n: int, rate: float) -> int:
    """n more samples, the last of them now."""
    t = time.time_ns() + ((np.arange(n) - n + 1) * 1e9 / rate).astype(np.int64)
    companion.feed(FrameBlock(samples(k, n), t))
    return k + n


QUIET = {"injection": {"enabled": False}}
ONLY_POSITIONS = {**QUIET, "estimate": {"rate": 1000.0, "flux_rate": 1.0, "status_rate": 1.0}}


def turn(lane: FastLane, companion: Companion) -> Lap:
    """A lap, and the ordinary path for what it left."""
    lap = lane.run(0.001, time.time_ns())
    companion.feed(lap.left)
    return lap


def test_no_batch_can_overrun_the_sending_table(port: Port) -> None:
    """More flux answers than samples per position, and losses in between: that is not for the loop."""
    companion, _ = following({**QUIET, "estimate": {"rate": 100.0, "flux_rate": 20_000.0}}, 20e3)
    assert not FastLane(port, companion).ready(time.time_ns())
    companion, _ = following({**QUIET, "estimate": {"rate": 100.0, "flux_rate": 100.0}}, 20e3)
    assert FastLane(port, companion).ready(time.time_ns())


def test_a_lap_ends_before_its_buffers_do(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every sample with seven lost before it, as fast as they come: what is kept grows eight times as fast."""
    monkeypatch.setattr(lanes, "CAPACITY", 1400)
    companion, k = following({**QUIET, "estimate": {"rate": 100.0, "flux_rate": 100.0}}, 20e3)
    lane = FastLane(port, companion)
    kept, n = lane._kept, lane._kept.t_ns.size
    # With room behind it: what is written beyond the end shows there.
    flags = np.full(n + 4096, 0xAA, np.uint8)
    lane._kept = kept._replace(flags=flags[:n])
    turn(lane, companion)
    k = refresh(companion, k, 200 - k % 200 + 1, 20e3)
    port.put(samples(k - 1 + 8, 1000, 8))
    laps: list[Lap] = []
    while sum(len(lap.taken) + len(lap.left) for lap in laps) < 1000:
        laps.append(turn(lane, companion))
    assert max(sum(t.run.counter.size for t in lap.tracked) for lap in laps) > 500
    assert (flags[n:] == 0xAA).all()


@pytest.mark.parametrize("old_s", [0.05, 5.0, 12.0, 3600.0])
def test_samples_are_too_late_however_old_they_are(old_s: float) -> None:
    """A process that was stopped for longer than any plausible delay knows its clock from its first samples."""
    class Queue:
        description, fd, drops, unsent = "a queue", False, 0, 0

        def __init__(self) -> None:
            self.waiting: list[FrameBlock] = []
            self.sent: list[FrameBlock] = []

        def receive(self, _timeout_s: float, _expect: int = 1) -> FrameBlock:
            return self.waiting.pop(0)

        def send(self, block: FrameBlock) -> int:
            self.sent.append(block)
            return len(block)

    companion = Companion([config_from({"motor": {"preset": "m2"}, "wire": {"sample_rate": 1000.0}})], PROTOCOL,
                          transmit=True)
    queue = Queue()
    runner = LiveRunner(queue, companion, 1e6, 5e6)  # type: ignore[arg-type]
    queue.waiting.append(FrameBlock(samples(0, 1), np.array([time.time_ns()])))
    runner.round()
    answered = companion.nodes[0].view.estimates
    begin = time.time_ns() - round(1e9 * (old_s + 0.1))
    for k in range(1, 101):
        queue.waiting.append(FrameBlock(samples(k, 1), np.array([begin + 1_000_000 * k])))
    while queue.waiting:
        runner.round()
    assert companion.nodes[0].view.estimates == answered
    assert companion.late >= 100


@pytest.mark.parametrize("clock_every", [1, 8])
def test_a_backlog_over_many_laps_is_not_answered(port: Port, clock_every: int) -> None:
    """A stranger's frame every 50 samples ends a lap each time; the first answer of each is looked at."""
    companion, k = following(QUIET, 5000.0)
    lane = FastLane(port, companion)
    lane._clock_every = clock_every
    lane.run(0.001, time.time_ns())
    k = refresh(companion, k, 10, 5000.0)
    answered = companion.nodes[0].view.estimates
    stranger = FrameBlock.zeros(1)
    stranger.can_id[:] = 0x100 | CAN_RTR_FLAG
    stranger.length[:] = 8
    for _ in range(10):
        port.put(samples(k, 50))
        port.put(stranger.raw)
        k += 50
        time.sleep(0.01)
    time.sleep(0.05)
    laps = [turn(lane, companion) for _ in range(30)]
    assert sum(len(lap.taken) for lap in laps) > 400
    assert sum(lap.late for lap in laps) > 70
    assert companion.nodes[0].view.estimates == answered


def answers_of(lap: Lap) -> int:
    return int((lap.sent.can_id == POSITION).sum())


def test_frames_of_nobody_here_pass_through_the_loop(port: Port) -> None:
    """A bus with other traffic on it is the usual case; they are kept for who records, and counted."""
    companion, k = following(QUIET, 5000.0)
    lane = FastLane(port, companion)
    lane.run(0.001, time.time_ns())
    k = refresh(companion, k, 10, 5000.0)
    before = companion.counts.unknown, companion.counts.frames
    foreign = FrameBlock.zeros(2)
    foreign.can_id[:] = 0x5FF, 0x100 | CAN_EFF_FLAG
    foreign.length[:] = 8
    for _ in range(6):
        port.put(samples(k, 5))
        port.put(foreign.raw)
        k += 5
    laps = [turn(lane, companion) for _ in range(12)]
    taken = FrameBlock.concat([lap.taken for lap in laps])
    assert not sum(len(lap.left) for lap in laps)
    assert len(taken) == 42 and sum(lap.foreign for lap in laps) == 12
    assert np.isin(taken.can_id, foreign.can_id).sum() == 12
    assert sum(sum(lap.by_kind.values()) for lap in laps) == 30
    for lap in laps:
        companion.count_usual(lap.by_kind, lap.foreign)
    assert (companion.counts.unknown - before[0], companion.counts.frames - before[1]) == (12, 42)


def test_a_due_sample_ends_its_batch_beyond_the_counters_wrap(port: Port) -> None:
    """2**32 is no multiple of five: the count of samples so far must be taken as the counter is."""
    first = (1 << 32) - 203
    companion, k = following(ONLY_POSITIONS, 5000.0, first)
    lane = FastLane(port, companion)
    lane.run(0.001, time.time_ns())
    k = refresh(companion, k, 100, 5000.0)
    assert k > 1 << 32
    now = time.time_ns()
    companion.nodes[0].next_status = now + 9 * 10**8
    while (k & 0xFFFFFFFF) % 5 != 1:
        k = refresh(companion, k, 1, 5000.0)
    # The fifth is due, and its answer goes out when it has come, not with the four that follow.
    port.put(samples(k, 9))
    lap = lane.run(0.002, now)
    assert len(lap.taken) == 9
    assert answers_of(lap) == 1
    assert lap.sent.t_ns[0] == lap.taken.t_ns[4] < lap.taken.t_ns[8]


def test_commands_do_not_wait_for_a_rare_answer() -> None:
    """Ten estimates a second at 2 kHz: 200 samples apart, while a command is due every 20 ms."""
    companion, _ = following({"estimate": {"rate": 10.0}}, 2000.0)
    node = companion.nodes[0]
    now = node._last_arrival
    assert now is not None
    frames = node.frames_until_due(now)
    assert 0 < frames <= 41


def test_an_unsent_answer_keeps_its_time(port: Port) -> None:
    """Dated to 1970 it would empty the window of the bus load."""
    companion, k = following(ONLY_POSITIONS, 5000.0)
    lane = FastLane(port, companion)
    lane.run(0.001, time.time_ns())
    k = refresh(companion, k, 10, 5000.0)
    now = time.time_ns()
    companion.nodes[0].next_status = now + 9 * 10**8
    headers = port.tables[1].headers
    pointer = headers[0, 2]
    headers[0, 2] = 0  # sendmmsg fails at the first frame
    port.put(samples(k, 5))
    lap = lane.run(0.002, now)
    headers[0, 2] = pointer
    assert len(lap.unsent) == 1
    assert abs(int(lap.unsent.t_ns[0]) - now) < 10**9
    assert companion.nodes[0].view.estimates >= 1
