"""A bus that goes away and comes back: nothing lost that had arrived, silence told, and injection only on the
scheduler's say."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import Self

import numpy as np
import pytest

from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.listen import Listener
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.port import BusError, open_port
from ipmsm_can.bus.pythoncan import PythonCanPort
from ipmsm_can.cli import plain
from ipmsm_can.cli.monitor import RunMonitor
from ipmsm_can.cli.render import render
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import CompanionState, InjectionState, MessageKind, Protocol

PROTOCOL = Protocol()
CONFIG = config_from({"motor": {"preset": "m2"}, "wire": {"sample_rate": 5000.0},
                      "injection": {"speed_on": 40.0, "speed_off": 60.0}})
SECOND = 1_000_000_000
COMMAND = int(PROTOCOL.base_ids[MessageKind.INJECTION_COMMAND])
DOWN = BusError(errno.ENETDOWN, "can7 is down; bring it up")
GONE = BusError(errno.ENODEV, "can7 is gone: No such device")


class Air:
    """A bus in virtual time: frames by the time they are sent, stretches without a bus, a clock moved by waits."""

    def __init__(self, frames: FrameBlock, away: Sequence[tuple[int, int]], replaced: bool) -> None:
        self.frames = frames
        self.away = list(away)
        self.replaced = replaced
        self.now = 0
        self.opened = 0
        self.sent: list[tuple[int, FrameBlock]] = []

    def there(self) -> bool:
        return not any(a <= self.now < b for a, b in self.away)

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9)

    def open(self) -> AirPort:
        if not self.there():
            raise BusError(errno.ENODEV, "there is no CAN interface 'can7'")
        self.opened += 1
        return AirPort(self)


class AirPort:
    """What a socket on that bus does: it tells an outage once, before the frames that wait, and is dead for good
    where the interface is another one by then."""

    fd, drops = False, 0

    def __init__(self, air: Air) -> None:
        self.air = air
        self.closed = False
        self.unsent = 0
        self._at = int(np.searchsorted(air.frames.t_ns, air.now))
        self._told: set[int] = {k for k, (_, b) in enumerate(air.away) if b <= air.now}
        self._dead, self._died = False, 0

    @property
    def description(self) -> str:
        return "can7 (virtual time)"

    def _upto(self) -> int:
        """Rows that have arrived: none of those sent while there was no bus."""
        return int(np.searchsorted(self.air.frames.t_ns, self.air.now, side="right"))

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        assert not self.closed
        air = self.air
        for k, (a, _) in enumerate(air.away):
            if a <= air.now and k not in self._told:
                self._told.add(k)
                if air.replaced and not self._dead:
                    self._dead, self._died = True, a
                raise GONE if air.replaced else DOWN
        if self._at == self._upto() and timeout_s > 0.0:
            # time goes on up to the next frame, but not past the beginning of an outage
            rest = [a for a, b in air.away if a > air.now]
            upcoming = int(air.frames.t_ns[self._at]) if self._at < len(air.frames) else air.now + SECOND
            air.now = min([air.now + round(timeout_s * 1e9), max(upcoming, air.now) + 2_000_000, *rest])
        rows = np.arange(self._at, self._upto())
        self._at = self._upto()
        t = air.frames.t_ns[rows]
        heard = np.ones(len(rows), bool)
        for a, b in air.away:
            heard &= ~((t >= a) & (t < b))
        if self._dead:  # what had arrived before can still be read
            heard &= t < self._died
        return air.frames.take(rows[heard])

    def send(self, block: FrameBlock) -> int:
        if self._dead or not self.air.there():
            self.unsent += len(block)
            raise BusError(errno.ENETDOWN, "can7 is down; bring it up")
        self.air.sent.append((self.air.now, block))
        return len(block)

    def check(self) -> None:
        if self._dead:
            raise GONE
        if not self.air.there():
            raise DOWN

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> AirPort:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def traffic(rpm: float, seconds: float) -> FrameBlock:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(rpm * RPM, 1.0, seconds))
    return DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings()).step(int(5000 * seconds)).frames


def outages(count: int, every: float, length: float, first: float = 0.5) -> list[tuple[int, int]]:
    begin = [round(1e9 * (first + k * every)) for k in range(count)]
    return [(a, a + round(1e9 * length)) for a in begin]


class Run:
    """A companion on that bus until its frames are over."""

    def __init__(self, air: Air, transmit: bool) -> None:
        self.air = air
        port = air.open()
        self.link = Link(port, air.open, sleep=air.sleep, now_ns=lambda: air.now)
        self.runner = LiveRunner(port, Companion([CONFIG], PROTOCOL, transmit), 1e6, 5e6, self.link)
        self.monitor = RunMonitor(self.runner)
        self.blocks: list[FrameBlock] = []
        self.tracked: list[Tracked] = []
        self.during: list[tuple[CompanionState, bool, InjectionState, float, str]] = []

    def go(self, monkeypatch: pytest.MonkeyPatch) -> Run:
        monkeypatch.setattr("ipmsm_can.bus.live.time.sleep", self.air.sleep)
        end = int(self.air.frames.t_ns[-1])
        self.runner.run(lambda: self.air.now > end + 20_000_000, self.observe)
        return self

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], _sent: FrameBlock, now_ns: int) -> None:
        self.monitor.observe(block, tracked, _sent, now_ns)
        self.blocks.append(block)
        self.tracked += tracked
        if self.link.down and not len(block):
            node = self.runner.companion.nodes[0]
            status = self.monitor.status()
            self.during.append((node.view.state, status.nodes[0].valid, node.scheduler.state,
                                node.scheduler.amplitude, plain.line(status)))


@pytest.mark.parametrize("replaced", [False, True], ids=["down and up", "taken away and made anew"])
@pytest.mark.parametrize("transmit", [False, True], ids=["listening", "answering"])
def test_twenty_outages_in_a_run(replaced: bool, transmit: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = traffic(600.0, 17.0)
    away = outages(20, 0.8, 0.3)
    air = Air(frames, away, replaced)
    run = Run(air, transmit).go(monkeypatch)
    # Every time back by itself, each gap marked: it begins with the outage, and is over at most one pause after it.
    assert run.link.outages == len(run.link.past) == 20
    assert not run.link.down
    for outage, (a, b) in zip(run.link.past, away, strict=True):
        assert a <= outage.began_ns <= a + 60_000_000
        assert b <= outage.ended_ns <= b + 260_000_000
        assert ("gone" if replaced else "down") in outage.reason
    assert air.opened == (21 if replaced else 1)
    # Nothing lost that the bus carried while a port was open, and in order.
    received = FrameBlock.concat(run.blocks)
    t = frames.t_ns
    lost = np.zeros(len(t), bool)
    for (a, b), outage in zip(away, run.link.past, strict=True):
        lost |= (t >= a) & (t < (outage.ended_ns if replaced else b))
    assert np.array_equal(received.raw, frames.raw[~lost])
    # The estimator hears of each gap, and claims nothing right after it.
    starts = [k for k, block in enumerate(run.tracked) if (block.run.gap > 1000).any()]
    assert len(starts) == 20
    for k in starts:
        first = int(np.argmax(run.tracked[k].run.gap > 1000))
        assert not run.tracked[k].estimate.flags[first] & confidence.VALID
    # It finds back to a valid angle between the outages.
    assert run.tracked[-1].estimate.flags[-1] & confidence.VALID
    status = run.monitor.status()
    assert status.bus.outages == 20 and status.bus.no_bus == ""
    assert "the bus went away 20 times, for " in plain.summary(status)
    assert "it came back by itself" in plain.summary(status)
    if not transmit:
        assert air.sent == []


def test_the_state_is_shown_while_there_is_no_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    air = Air(traffic(600.0, 3.0), outages(1, 1.0, 1.2, first=1.0), False)
    run = Run(air, True).go(monkeypatch)
    assert len(run.during) >= 4
    for state, valid, _, _, line in run.during:
        assert state is CompanionState.STALE and not valid
        assert line.startswith("0:00:0") and " TRANSMITTING no bus since " in line
        assert line.endswith(": can7 is down; bring it up")


def test_the_picture_says_that_there_is_no_bus() -> None:
    air = Air(traffic(600.0, 0.1), [], False)
    run = Run(air, False)
    run.link.lose(DOWN)
    shown = render(run.monitor.status(), 80, 24).plain
    assert "no bus since" in shown and "can7 is down" in shown and "SILENT (listening only)" in shown
    assert len(shown.splitlines()) <= 24 and max(map(len, shown.splitlines())) <= 80


def test_injection_stops_and_only_the_scheduler_lets_it_begin_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow rotor is probed; the outage ends that, and afterwards it rises from nothing by the ramp."""
    a, b = SECOND, 2 * SECOND
    air = Air(traffic(20.0, 4.0), [(a, b)], False)
    run = Run(air, True).go(monkeypatch)

    def amplitudes(begin: int, end: int) -> list[float]:
        index = PROTOCOL.codecs[MessageKind.INJECTION_COMMAND].index["amplitude"]
        out: list[float] = []
        for t, block in air.sent:
            rows = np.flatnonzero(block.can_id == COMMAND)
            if rows.size and begin <= t < end:
                out += PROTOCOL.decode(MessageKind.INJECTION_COMMAND, 0, block.raw, rows)[0][index].tolist()
        return out

    before, meanwhile, after = amplitudes(0, a), amplitudes(a, b), amplitudes(b, 5 * SECOND)
    assert before[-1] > 1.0
    assert meanwhile == []
    assert [amplitude for _, _, _, amplitude, _ in run.during] == [0.0] * len(run.during)
    assert {state for _, _, state, _, _ in run.during} == {InjectionState.OFF}
    assert after and after[0] < 0.5 * before[-1]
    assert max(np.diff([0.0, *after])) < 0.5 * before[-1]


def test_the_compiled_loop_is_handed_the_new_port(monkeypatch: pytest.MonkeyPatch) -> None:
    over: list[object] = []
    monkeypatch.setattr("ipmsm_can.bus.lane.FastLane.over", lambda port, _: over.append(port))
    air = Air(traffic(600.0, 1.5), outages(1, 1.0, 0.3), replaced=True)
    run = Run(air, True).go(monkeypatch)
    assert len(over) == 2 and over[0] is not over[1]
    assert over[1] is run.runner.port is run.link.port


def test_without_a_link_a_run_ends() -> None:
    air = Air(traffic(600.0, 1.0), outages(1, 1.0, 0.2, first=0.3), False)
    runner = LiveRunner(air.open(), Companion([CONFIG], PROTOCOL, True), 1e6, 5e6)
    with pytest.raises(BusError, match="can7 is down"):
        runner.run(lambda: air.now > 2 * SECOND)


class Counting:
    """A port that counts, and whose adapter can be open only once."""

    description, fd = "adapter", False
    open_now = 0

    def __init__(self, drops: int, unsent: int) -> None:
        assert Counting.open_now == 0, "opened while it still was"
        Counting.open_now += 1
        self.drops, self.unsent = drops, unsent
        self.waiting = 5

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        if not self.waiting:
            return FrameBlock.zeros(0)
        self.waiting -= 1
        return FrameBlock.zeros(2)

    def send(self, block: FrameBlock) -> int:
        return len(block)

    def close(self) -> None:
        Counting.open_now -= 1
        raise RuntimeError("the vendor's library is upset")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def test_an_adapter_is_closed_before_it_is_opened_again_and_its_counts_are_kept() -> None:
    Counting.open_now = 0
    now = [0]
    attempts: list[int] = []

    def open_again() -> Counting:
        attempts.append(now[0])
        if len(attempts) < 3:
            raise BusError(errno.ENODEV, f"not yet ({len(attempts)})")
        return Counting(7, 8)

    def sleep(seconds: float) -> None:
        now[0] += round(1e9 * seconds)

    link = Link(Counting(3, 4), open_again, 0.5, sleep, lambda: now[0])
    assert (link.down, link.words, link.outage_time) == (False, "", 0.0)
    assert len(link.lose(GONE)) == 10  # what had arrived
    assert link.down and link.words.endswith(": can7 is gone: No such device")
    tries = []
    while not link.retry():
        tries.append(link.words.rpartition(": ")[2])
        assert link.pause() == pytest.approx(0.5)
    assert tries == ["not yet (1)", "not yet (2)"]
    assert attempts == [0, SECOND // 2, SECOND]
    assert (link.drops, link.unsent, link.outages, link.outage_time) == (10, 12, 1, 1.0)
    assert link.past[0].reason == "can7 is gone: No such device"
    assert Counting.open_now == 1


class Waiting(Counting):
    """A port whose socket still holds an error before the frames: the loss was told by something else."""

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        if self.drops:
            self.drops = 0
            raise GONE
        return super().receive(timeout_s, expect)


def test_frames_behind_a_pending_error_are_read() -> None:
    Counting.open_now = 0
    link = Link(Waiting(1, 0), lambda: Counting(0, 0))
    assert len(link.lose(DOWN)) == 10
    assert link.words.endswith("can7 is down; bring it up")


@pytest.mark.parametrize("reconnect", [False, True])
def test_a_listener_counts_what_had_arrived(reconnect: bool) -> None:
    """Also where it is to end with the bus: the frames that waited behind the error are in the report."""
    Counting.open_now = 0
    health = BusHealth(1e6, 1e6)
    link = Link(Waiting(1, 0), lambda: Counting(0, 0), sleep=lambda _: None)
    listener = Listener(link, health, True, reconnect)
    asked = iter([False] * 6 + [True] * 100)
    if reconnect:
        listener.run(lambda: next(asked))
    else:
        with pytest.raises(BusError, match="can7 is gone"):
            listener.run(lambda: next(asked))
    r = listener.report()
    # of six rounds one fails and one waits for the bus; the other four read the new port
    assert r.frames == (18 if reconnect else 10)
    assert r.outages == 1 and (r.no_bus == "") == reconnect


def test_a_python_can_bus_that_fails_is_opened_again() -> None:
    options = {"interface": "virtual", "channel": "ipmsm-link"}
    with open_port(options) as other, Link(open_port(options), lambda: open_port(options)) as link:
        other.send(FrameBlock.zeros(3))
        assert isinstance(link.port, PythonCanPort)
        link.port._bus.shutdown()  # as an adapter that is pulled out
        with pytest.raises(BusError) as lost:
            link.port.receive(0.0)
        link.lose(lost.value)
        assert link.retry() and not link.down
        other.send(FrameBlock.zeros(4))
        assert len(link.port.receive(1.0)) == 4


def test_a_clock_that_is_set_makes_no_long_pause() -> None:
    times = iter([0, -SECOND * 3600, 0, SECOND * 3600 * 24])
    link = Link(Counting.__new__(Counting), lambda: Counting(0, 0), 0.25, lambda _: None, lambda: next(times))
    assert link.pause() == 0.25
    assert link.pause() == 0.25
