"""An interface that goes down and up, or is taken away and made anew, while a companion answers.

Six times; 20 times where IPMSM_CAN_SECONDS is set.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.lane import Lap
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.port import BusError
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.bus.warmup import warm_up_companion
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import MessageKind, Protocol

PROTOCOL = Protocol()
REFERENCE = int(PROTOCOL.base_ids[MessageKind.DRIVE_REFERENCE])
OUTAGES = 20 if "IPMSM_CAN_SECONDS" in os.environ else 6
AWAY_S, THERE_S = 0.4, 1.0


def ip(*words: str) -> int:
    return subprocess.run(["ip", *words], check=False, stderr=subprocess.DEVNULL).returncode


@pytest.fixture
def vcan7() -> Iterator[str]:
    """An interface of our own; needs root, as inside the machine of tools/vcan/run."""
    if ip("link", "add", "dev", "vcan7", "type", "vcan"):
        pytest.skip("not allowed to make an interface")
    try:
        ip("link", "set", "vcan7", "up")
        yield "vcan7"
    finally:
        ip("link", "del", "vcan7")


def traffic(seconds: float) -> FrameBlock:
    """Samples of a drive at 2 kHz, with numbered frames in between that are easily told apart."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=2000.0, current_bandwidth=100.0),
                                 constant(600.0 * RPM, 1.0, seconds))
    frames = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings(reference_rate=200.0)).step(
        int(2000 * seconds)).frames
    rows = np.flatnonzero(frames.can_id == REFERENCE)
    frames.words[rows, 1] = np.arange(len(rows), dtype=np.uint64)
    return frames


class Sender:
    """Puts frames on the bus at their time, whatever becomes of the interface; sent: numbers that were taken, and
    when [ns]."""

    def __init__(self, frames: FrameBlock) -> None:
        self.frames = frames
        self.sent: dict[int, int] = {}
        self.stop = False
        self.thread = threading.Thread(target=self._work)

    def _work(self) -> None:
        at = 0
        begin = time.monotonic_ns()
        link = Link(SocketCanPort("vcan7"), lambda: SocketCanPort("vcan7"))
        with link:
            while not self.stop and at < len(self.frames):
                time.sleep(0.003)
                end = int(np.searchsorted(self.frames.t_ns, time.monotonic_ns() - begin))
                block = self.frames.take(slice(at, end))
                at = end
                try:
                    if (link.down and not link.retry()) or link.port.send(block) < len(block):
                        continue
                    now = time.time_ns()
                    link.port.receive(0.0)  # the companion's answers, lest they pile up
                except BusError as error:
                    link.lose(error)
                    continue
                for number in block.words[block.can_id == REFERENCE, 1].tolist():
                    self.sent[number] = now


def test_outages_while_answering(vcan7: str) -> None:
    config = config_from({"motor": {"preset": "m2"}})
    warm_up_companion([config], PROTOCOL)
    sender = Sender(traffic(12.0 * OUTAGES))  # taking an interface away may take seconds
    blocks: list[FrameBlock] = []
    tracked: list[Tracked] = []
    laps: list[int] = []
    port = SocketCanPort(vcan7)
    with Link(port, lambda: SocketCanPort(vcan7)) as link:
        runner = LiveRunner(port, Companion([config], PROTOCOL, transmit=True), 1e6, 5e6, link)
        find = runner._find_lane

        def watched() -> object:
            lane = find()
            assert lane is not None
            run = lane.run

            def counted(timeout_s: float, now_ns: int) -> Lap:
                lap = run(timeout_s, now_ns)
                if len(lap.taken):
                    laps.append(time.time_ns())
                return lap

            lane.run = counted  # type: ignore[method-assign]
            return lane

        runner._find_lane = watched  # type: ignore[method-assign, assignment]
        runner._lane = watched()  # type: ignore[assignment]
        stop = False

        def observe(block: FrameBlock, part: object, _sent: FrameBlock, _now: int) -> None:
            blocks.append(block)
            tracked.extend(part)  # type: ignore[arg-type]

        thread = threading.Thread(target=lambda: runner.run(lambda: stop, observe))
        thread.start()
        sender.thread.start()
        try:
            for k in range(OUTAGES):
                time.sleep(THERE_S)
                assert thread.is_alive()
                if k % 2:
                    ip("link", "del", vcan7)
                    time.sleep(AWAY_S)
                    assert link.down and link.words.startswith("no bus since "), (k, link.words)
                    ip("link", "add", "dev", vcan7, "type", "vcan")
                    ip("link", "set", vcan7, "up")
                else:
                    ip("link", "set", vcan7, "down")
                    time.sleep(AWAY_S)
                    assert link.down and f"{vcan7} is down" in link.words, (k, link.words)
                    ip("link", "set", vcan7, "up")
                deadline = time.monotonic() + 20
                while link.down and time.monotonic() < deadline:
                    time.sleep(0.05)
                assert not link.down, k
            time.sleep(2.0)
        finally:
            sender.stop = stop = True
            sender.thread.join(20)
            thread.join(20)
        assert link.outages == len(link.past) == OUTAGES
    received = FrameBlock.concat(blocks)
    numbers = received.words[received.can_id == REFERENCE, 1].tolist()
    assert numbers == sorted(set(numbers)), "nothing twice, and in order"
    # Complete but for the gaps; a frame that was under way when the interface went may be lost with it.
    gaps = [(o.began_ns - 100_000_000, o.ended_ns + 50_000_000) for o in link.past]
    missing = [t for n, t in sender.sent.items() if n not in set(numbers)]
    outside = [t for t in missing if not any(a <= t <= b for a, b in gaps)]
    # the last ones may not have been read when it ended
    assert [t for t in outside if t < max(sender.sent.values()) - 300_000_000] == []
    assert len(numbers) > 0.5 * len(sender.sent) > 50 * OUTAGES
    # The estimator hears of each gap, claims nothing right after it, and trusts itself again at the end; the
    # compiled loop serves again, too.
    t_ns, gap, doubt, flags = (np.concatenate(parts) for parts in zip(
        *((t.run.t_ns, t.run.gap, t.run.doubt, t.estimate.flags) for t in tracked), strict=True))
    for k, outage in enumerate(link.past):
        later = np.flatnonzero(t_ns > outage.began_ns + 50_000_000)
        assert later.size, k
        first = later[0]
        assert gap[first] > 100 or doubt[first], k
        assert not flags[first] & confidence.VALID, k
    assert tracked[-1].estimate.flags[-1] & confidence.VALID
    assert laps and laps[-1] > link.past[-1].ended_ns


def test_an_interface_made_anew_between_two_looks_is_noticed(vcan7: str) -> None:
    """The name is there and up, but it is another one; its old socket would wait for ever."""
    with SocketCanPort(vcan7) as port:
        port.check()
        ip("link", "del", vcan7)
        ip("link", "add", "dev", vcan7, "type", "vcan")
        ip("link", "set", vcan7, "up")
        with pytest.raises(BusError, match="vcan7 was taken away and another put in its place"):
            port.check()
        link = Link(port, lambda: SocketCanPort(vcan7))
        link.lose(BusError("test"))
        assert link.retry() and link.port is not port
        with link, SocketCanPort(vcan7) as sender:
            sender.send(FrameBlock.zeros(3))
            assert len(link.port.receive(1.0)) > 0


def test_the_commands_go_on_and_say_so(vcan7: str, tmp_path: Path) -> None:
    config = tmp_path / "drive.toml"
    config.write_text('[motor]\npreset = "m2"\n')
    base = [sys.executable, "-m", "ipmsm_can"]
    bus = ["-i", "socketcan", "-c", vcan7]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    for command, ends in ((["run", str(config), *bus], 1), (["bus", *bus], 1)):
        process = subprocess.Popen([*base, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                                   env=environment)
        assert process.stdout is not None
        lines: list[str] = []
        try:
            for line in process.stdout:
                lines.append(line)
                if line.startswith("0:00:") and len(lines) < 60:
                    if "no bus since" not in line and not any("no bus since" in x for x in lines):
                        ip("link", "set", vcan7, "down")
                    elif "no bus since" in line:
                        ip("link", "set", vcan7, "up")
                    else:
                        break
            process.send_signal(signal.SIGTERM)
            rest, _ = process.communicate(timeout=60)
        finally:
            if process.poll() is None:
                process.kill()
        said = "".join(lines) + rest
        assert "SILENT (listening only) no bus since" in said and f"{vcan7} is down" in said, said
        assert "went away once, for " in said, said
        assert process.returncode == ends, said  # no samples came; an outage is a finding of severity error


# <linux/can/error.h>: CAN_ERR_FLAG with CAN_ERR_BUSOFF, CAN_ERR_RESTARTED
BUS_OFF, RESTARTED = 0x20000040, 0x20000100


def error_frame(can_id: int) -> FrameBlock:
    block = FrameBlock.zeros(1)
    block.raw[0, :4] = np.frombuffer(can_id.to_bytes(4, "little"), np.uint8)
    block.raw[0, 4] = 8
    return block


def is_down(link: Link) -> bool:
    """Asked anew: a type checker takes an attribute to stay as it was asserted to be."""
    return link.down


@pytest.mark.parametrize("transmit", [True, False])
def test_bus_off_is_told_a_restart_tried_and_the_way_back_found(vcan7: str, transmit: bool) -> None:
    """A vcan has no controller to restart, and the kernel says so; the drive's samples stop with the bus-off."""
    config = config_from({"motor": {"preset": "m2"}})
    warm_up_companion([config], PROTOCOL)
    frames = traffic(4.0)
    laps: list[int] = []
    blocks: list[FrameBlock] = []
    port = SocketCanPort(vcan7)
    with Link(port, lambda: SocketCanPort(vcan7), transmits=transmit) as link, SocketCanPort(vcan7) as other:
        runner = LiveRunner(port, Companion([config], PROTOCOL, transmit=transmit), 1e6, 5e6, link)
        if runner._lane is not None:
            run = runner._lane.run

            def counted(timeout_s: float, now_ns: int) -> Lap:
                lap = run(timeout_s, now_ns)
                laps.append(len(lap.taken))
                return lap

            runner._lane.run = counted  # type: ignore[method-assign]
        stop = False

        def drive(seconds: float, at: int) -> int:
            begin = time.monotonic_ns() - int(frames.t_ns[at])
            until = int(frames.t_ns[at]) + round(1e9 * seconds)
            while int(frames.t_ns[at]) < until:
                time.sleep(0.003)
                end = int(np.searchsorted(frames.t_ns, min(time.monotonic_ns() - begin, until)))
                other.send(frames.take(slice(at, end)))
                other.receive(0.0)
                at = end
            return at

        thread = threading.Thread(target=lambda: runner.run(lambda: stop, lambda b, *_: blocks.append(b)))
        thread.start()
        try:
            at = drive(1.0, 0)
            assert not is_down(link) and (sum(laps) > 100) is transmit
            other.send(error_frame(BUS_OFF))
            time.sleep(0.6)
            sent = runner.sent
            assert is_down(link) and "the controller of vcan7 is bus-off" in link.words
            said = ("the kernel cannot restart a controller of this kind; `sudo ip link set vcan7 down`" if transmit
                    else "only listens and restarts nothing; `sudo ip link set vcan7 type can restart` does")
            assert said in link.words
            assert link.recovery.refused == int(transmit)
            time.sleep(0.3)
            assert runner.sent == sent and link.recovery.refused == int(transmit)
            other.send(error_frame(RESTARTED))
            deadline = time.monotonic() + 20
            while is_down(link) and time.monotonic() < deadline:
                time.sleep(0.02)
            assert not is_down(link)
            drive(1.0, at)
            time.sleep(0.3)
        finally:
            stop = True
            thread.join(20)
        assert link.port is port and len(link.past) == link.outages == 1 and "bus-off" in link.past[0].reason
        assert (runner.sent > sent) is transmit
    numbers = FrameBlock.concat(blocks)
    told = numbers.words[numbers.can_id == REFERENCE, 1].tolist()
    assert told == list(range(len(told))) and len(told) > 300  # 200 a second


def test_bus_off_ends_where_the_interface_is_taken_down_and_up(vcan7: str) -> None:
    """What an administrator does; there is no frame that tells of it."""
    with SocketCanPort(vcan7) as port, SocketCanPort(vcan7) as other, \
            Link(port, lambda: SocketCanPort(vcan7)) as link:
        other.send(error_frame(BUS_OFF))
        assert len(port.receive(1.0)) == 1
        with pytest.raises(BusError, match="bus-off") as off:
            port.receive(0.0)
        link.lose(off.value)
        assert not link.retry()
        ip("link", "set", vcan7, "down")
        link.take()
        assert not link.retry() and f"{vcan7} is down" in link.words
        ip("link", "set", vcan7, "up")
        link.take()
        assert link.retry() and link.port is port and port.send(FrameBlock.zeros(1)) == 1
