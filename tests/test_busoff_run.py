"""A whole run with a controller that goes bus-off, in virtual time: restarted, not hammered, nothing sent late."""

from __future__ import annotations

import errno
import heapq
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from ipmsm_can.bus.busoff import PAUSES_NS, OffWatch
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.port import BusOffError
from ipmsm_can.cli import plain
from ipmsm_can.cli.monitor import RunMonitor
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.record.tap import Tap
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tests.test_busoff import BUS_OFF, MS, RESTARTED, SECOND, frame

PROTOCOL = Protocol()
CONFIG = config_from({"motor": {"preset": "m2"}, "wire": {"sample_rate": 5000.0},
                      "injection": {"speed_on": 40.0, "speed_off": 60.0}})
COMMAND = int(PROTOCOL.base_ids[MessageKind.INJECTION_COMMAND])


class Wire:
    """A bus whose controller goes bus-off where something is sent during a fault; frames that come while it is off
    are not heard.  restart: what the kernel answers."""

    def __init__(self, frames: FrameBlock, faults: Sequence[tuple[int, int]], answer: int = 0,
                 by_itself: int | None = None) -> None:
        self.frames, self.faults, self.answer, self.by_itself = frames, faults, answer, by_itself
        self.now = 0
        self.at = 0
        self.dead = False
        self.offs: list[int] = []
        self.restarts: list[int] = []
        self.asked: list[int] = []
        self.tried: list[int] = []
        self.sent: list[tuple[int, FrameBlock]] = []
        self.heard: list[FrameBlock] = []
        self._news: list[tuple[int, int, int]] = []
        self._plan = [(a, self.break_down) for a, _ in faults]
        self._later: list[tuple[int, Callable[[], None]]] = list(self._plan)

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9)

    def faulty(self) -> bool:
        return any(a <= self.now < b for a, b in self.faults)

    def break_down(self) -> None:
        self.dead = True
        self.offs.append(self.now)
        heapq.heappush(self._news, (self.now, len(self.offs), BUS_OFF))
        if self.by_itself is not None:
            self._later.append((self.now + self.by_itself, self.revive))

    def revive(self) -> None:
        self.dead = False
        self.restarts.append(self.now)
        heapq.heappush(self._news, (self.now, -1, RESTARTED))
        if self.faulty():  # the first frame kills it again
            self._later.append((self.now + 3 * MS, self.break_down))

    def restart(self) -> int:
        self.asked.append(self.now)
        if not self.answer:
            self.revive()
        return self.answer

    def collect(self) -> FrameBlock:
        """What arrived up to now."""
        blocks = []
        while True:
            step = min([t for t, _ in self._later if t <= self.now], default=self.now)
            end = int(np.searchsorted(self.frames.t_ns, step, side="right"))
            if not self.dead:
                blocks.append(self.frames.take(slice(self.at, end)))
                self.heard.append(blocks[-1])
            self.at = max(self.at, end)
            ready = [x for x in self._later if x[0] <= self.now]
            if not ready:
                break
            first = min(ready, key=lambda x: x[0])
            self._later.remove(first)
            now, self.now = self.now, first[0]
            first[1]()
            self.now = now
        while self._news and self._news[0][0] <= self.now:
            t, _, can_id = heapq.heappop(self._news)
            blocks.append(frame(can_id, t))
        block = FrameBlock.concat(blocks)
        return block.take(np.argsort(block.t_ns, kind="stable"))


class WirePort:
    """As a SocketCAN port tells it."""

    description, fd, drops = "can7 (virtual time)", False, 0

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.unsent = 0
        self.watch = OffWatch()
        self.watched = self.untold = False

    def watch_bus_off(self) -> None:
        self.watched = True

    def error(self) -> BusOffError:
        self.untold = False
        return BusOffError("the controller of can7 is bus-off", "can7")

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        if self.untold:
            raise self.error()
        self.wire.sleep(min(timeout_s, 0.002))
        block = self.wire.collect()
        was = self.watch.off
        self.watch.update(block)
        self.untold = self.watched and self.watch.off and (self.untold or not was)
        return block

    def send(self, block: FrameBlock) -> int:
        self.wire.tried.append(self.wire.now)
        if self.watch.off:
            self.unsent += len(block)
            raise self.error()
        self.wire.sent.append((self.wire.now, block))
        return len(block)

    def check(self) -> None:
        if self.watch.off:
            raise self.error()

    def restart(self) -> int:
        return self.wire.restart()

    def close(self) -> None:
        """Nothing to close."""

    def __enter__(self) -> WirePort:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to close."""


class Marks:
    """A recording that keeps its marks."""

    def __init__(self) -> None:
        self.marks: list[str] = []

    def take(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock) -> None:
        """Not looked at."""

    def mark(self, mark: object) -> None:
        self.marks.append(str(getattr(mark, "text", mark)))

    def close(self) -> None:
        """Nothing to finish."""


class Run:
    def __init__(self, wire: Wire, transmit: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wire = wire
        port = WirePort(wire)
        self.link = Link(port, lambda: pytest.fail("it is opened again"), sleep=wire.sleep, now_ns=lambda: wire.now,
                         transmits=transmit)
        self.runner = LiveRunner(port, Companion([CONFIG], PROTOCOL, transmit), 1e6, 5e6, self.link)
        self.monitor = RunMonitor(self.runner)
        self.recording = Marks()
        self.tap = Tap(self.link, [self.recording])  # type: ignore[list-item]
        self.blocks: list[FrameBlock] = []
        self.tracked: list[Tracked] = []
        self.lines: list[str] = []
        monkeypatch.setattr("ipmsm_can.bus.live.time.sleep", wire.sleep)
        end = int(wire.frames.t_ns[-1])
        self.runner.run(lambda: wire.now > end, self.observe)

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock, now_ns: int) -> None:
        self.monitor.observe(block, tracked, sent, now_ns)
        self.tap.observe(block, tracked, sent, now_ns)
        self.blocks.append(block)
        self.tracked += tracked
        if self.link.down:
            self.lines.append(plain.line(self.monitor.status()))

    def commands(self, begin: int, end: int) -> list[float]:
        index = PROTOCOL.codecs[MessageKind.INJECTION_COMMAND].index["amplitude"]
        out: list[float] = []
        for t, block in self.wire.sent:
            rows = np.flatnonzero(block.can_id == COMMAND)
            if rows.size and begin <= t < end:
                out += PROTOCOL.decode(MessageKind.INJECTION_COMMAND, 0, block.raw, rows)[0][index].tolist()
        return out


def traffic(rpm: float, seconds: float) -> FrameBlock:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(rpm * RPM, 1.0, seconds))
    return DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings()).step(int(5000 * seconds)).frames


def test_a_short_fault_is_over_after_one_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(traffic(600.0, 3.0), [(SECOND, SECOND + 20 * MS)])
    run = Run(wire, True, monkeypatch)
    assert len(wire.asked) == 1 and 100 * MS <= wire.asked[0] - SECOND <= 160 * MS
    assert run.link.outages == len(run.link.past) == run.link.recovery.restarts == 1 and not run.link.down
    assert run.link.past[0].ended_ns - wire.restarts[0] <= 60 * MS
    # Nothing that arrived is lost, and nothing was given to the port while it was off.
    received = FrameBlock.concat(run.blocks)
    ordinary = received.take(np.flatnonzero(received.can_id < 0x20000000))
    assert np.array_equal(ordinary.raw, FrameBlock.concat(wire.heard).raw)
    assert not [t for t, _ in wire.sent if wire.offs[0] + 4 * MS < t < wire.restarts[0]]
    assert len([t for t in wire.tried if wire.offs[0] < t < wire.restarts[0]]) <= 2
    # An outage like any other: shown, counted, marked; the estimator hears of the gap and claims nothing after it.
    status = run.monitor.status()
    assert status.bus.outages == 1 and status.bus.no_bus == ""
    assert 0.1 < status.bus.outage_time < 0.25
    assert "the bus went away once, for 0." in plain.summary(status)
    assert "s in all; it came back by itself" in plain.summary(status)
    assert run.lines and all("no bus since" in line and "can7 is bus-off" in line for line in run.lines)
    assert len(run.recording.marks) == 2 and "bus-off" in run.recording.marks[0]
    gap = np.concatenate([t.run.gap for t in run.tracked])
    flags = np.concatenate([t.estimate.flags for t in run.tracked])
    (first,) = np.flatnonzero(gap > 300)
    assert not flags[first] & confidence.VALID and flags[-1] & confidence.VALID


def test_a_bus_that_stays_faulty_is_not_hammered(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(traffic(600.0, 14.0), [(SECOND, 12 * SECOND)])
    run = Run(wire, True, monkeypatch)
    pauses = np.diff([wire.offs[0], *wire.asked])
    assert np.allclose(pauses[:4] - np.array(PAUSES_NS), 60 * MS, atol=60 * MS)
    assert len(wire.asked) == 5
    assert not run.link.down and run.link.recovery.restarts == 5
    assert run.tracked[-1].estimate.flags[-1] & confidence.VALID


@pytest.mark.parametrize("code", [errno.EPERM, errno.EOPNOTSUPP])
def test_not_allowed_to_restart_it_goes_on_and_says_so(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody restarts it by hand; asked was once."""
    wire = Wire(traffic(600.0, 5.0), [(SECOND, SECOND + MS)], code, by_itself=3 * SECOND)
    run = Run(wire, True, monkeypatch)
    assert len(wire.asked) == 1 and run.link.recovery.refused == 1
    assert not run.link.down and run.link.outages == 1
    said = "`sudo ip link set can7 " + ("type can restart`" if code == errno.EPERM else "down` and `up` does")
    assert run.lines[-1].endswith(said)
    assert run.tracked[-1].estimate.flags[-1] & confidence.VALID


def test_restart_ms_is_not_interfered_with(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(traffic(600.0, 3.0), [(SECOND, SECOND + MS)], errno.EINVAL, by_itself=50 * MS)
    run = Run(wire, True, monkeypatch)
    assert wire.asked == [] and not run.link.down and run.link.outages == 1


def test_who_only_listens_restarts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(traffic(600.0, 5.0), [(SECOND, SECOND + MS)], by_itself=2 * SECOND)
    run = Run(wire, False, monkeypatch)
    assert wire.asked == [] and wire.tried == []
    assert "only listens and restarts nothing" in run.lines[-1]
    assert not run.link.down and run.link.outages == 1 and len(run.link.past) == 1


def test_no_command_from_before_is_sent_after(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow rotor is probed; the outage ends that, and afterwards it rises from nothing."""
    wire = Wire(traffic(20.0, 4.0), [(SECOND, SECOND + 20 * MS)])
    run = Run(wire, True, monkeypatch)
    before, after = run.commands(0, SECOND), run.commands(wire.restarts[0], 4 * SECOND)
    assert before[-1] > 1.0 and after[0] < 0.5 * before[-1]
    assert run.commands(SECOND + 4 * MS, wire.restarts[0]) == []
    ages = [t - int(block.t_ns.min()) for t, block in wire.sent]
    assert max(ages) < 60 * MS
