"""The live view at work: its keys and orders, findings, where its frames come from, and what hours leave behind."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus import live
from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.playback import LogPort
from ipmsm_can.bus.simulated import SimulatedPort
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.control import Controls
from ipmsm_can.live_view.judging import Batch, Judge, Plan
from ipmsm_can.live_view.keys import TAB, decode
from ipmsm_can.live_view.recording import KeyRecording
from ipmsm_can.live_view.sight import WireSight
from ipmsm_can.live_view.status import FINDINGS, HELP, MonitorStatus, Told
from ipmsm_can.live_view.taking import FrameClock, LiveView
from ipmsm_can.live_view.watch import MOST_FRAMES, Watch
from ipmsm_can.logs import read_log
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.record.rotation import Rotation
from ipmsm_can.record.tap import Tap
from ipmsm_can.wire.protocol import CompanionState, MessageKind, Protocol, Waveform
from tests.live_view_status import samples

PROTOCOL = Protocol()


# Keys


def test_keys_are_single_and_escape_sequences_none() -> None:
    assert decode(b"rM\t?") == ["r", "m", TAB, "?"]
    assert decode(b"\x1b[A\x1b[1;5Cq\x1bOP\x1b") == ["q"]
    assert decode(b"\xff\x00\x03\xc3\xa4") == ["\ufffd", "ä"]
    assert decode(b"\x1b[200~rm\x1b[201~") == ["r", "m"]


class Stage:
    """A simulated drive, its companion and the live view, in a time of their own."""

    def __init__(self, transmit: bool, rpm: float = 600.0, fd: bool = True, **injection: object) -> None:
        self.now_ns = 1_760_000_000 * 10**9
        simulation = DriveSimulation(M2, DriveParameters(sample_rate=10_000.0 if fd else 5000.0),
                                     constant(rpm * RPM, 0.5, 600.0))
        self.drive = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings(fd=fd))
        self.port = SimulatedPort([self.drive], "simulated", lambda: self.now_ns, self._sleep)
        config = config_from({"motor": {"preset": "m2"}, "injection": injection})
        self.companion = Companion([config], PROTOCOL, transmit)
        self.runner = LiveRunner(self.port, self.companion, 1e6, 5e6)
        self.clock = FrameClock(True, lambda: 0.0)
        self.quits = 0
        self.passed = 0.0
        self.controls = Controls(self.companion, None, self._quit, self.clock.now_ns, self.clock.words,
                                 threading.Event(), lambda: self.passed)
        self.watch = Watch(None, lambda: "now")
        self.view = LiveView(WireSight(self.runner), self.controls, self.watch, self.clock)
        self.answers: list[FrameBlock] = []

    def _quit(self) -> None:
        self.quits += 1

    def _sleep(self, seconds: float) -> None:
        self.now_ns += round(1e9 * seconds) + 1

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        self.view.observe(block, tracked, answers, now_ns)
        self.answers.append(answers)

    def go(self, seconds: float) -> None:
        end = self.now_ns + round(1e9 * seconds)
        while self.now_ns < end:
            self.runner.round(self.observe)

    def press(self, keys: str) -> MonitorStatus:
        for key in keys:
            self.controls.press(key)
        return self.view.status()

    def injects(self) -> bool:
        """The drive does."""
        return self.drive.waveform is not Waveform.OFF

    def said(self, kind: MessageKind) -> int:
        together = FrameBlock.concat(self.answers)
        return int((together.can_id == PROTOCOL.base_ids[kind]).sum())


@pytest.fixture
def in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "GATHER_S", 0.0)


@pytest.mark.usefixtures("in_no_time")
def test_nothing_is_transmitted_whatever_is_pressed_without_transmit() -> None:
    stage = Stage(transmit=False, rpm=0.0)
    for _ in range(3):
        stage.go(0.3)
        for keys in ("iy", "i", "y", "o", "a", "oiy", "m", "r"):
            status = stage.press(keys)
            assert "injection ordered" not in status.notice and status.drives[0].order == ""
            assert not status.injectable
    assert status.run.nodes[0].injection == "disabled: --transmit was not given"
    assert stage.port.sent == 0 and not sum(map(len, stage.answers))
    assert not stage.injects()


@pytest.mark.usefixtures("in_no_time")
def test_the_operator_starts_and_stops_the_injection() -> None:
    """At this speed nothing is injected by itself; an order is carried out within a fifth of a second."""
    stage = Stage(transmit=True)
    stage.go(1.0)
    assert not stage.injects()
    already = stage.said(MessageKind.INJECTION_COMMAND)
    assert "into drive 0?" in stage.press("i").notice
    stage.go(0.3)
    assert not stage.injects(), "a question is not an order"
    assert stage.press("y").drives[0].order == "on"
    stage.go(0.2)
    assert stage.injects()
    assert stage.said(MessageKind.INJECTION_COMMAND) > already
    status = stage.press("o")
    assert status.drives[0].order == "off"
    stage.go(0.2)
    assert not stage.injects()
    stage.press("a")
    assert stage.view.status().drives[0].order == ""
    assert [e.words for e in stage.controls.events] == [
        f"drive 0: injection ordered {word}" for word in ("on", "off", "automatic")]


@pytest.mark.usefixtures("in_no_time")
def test_a_question_expires() -> None:
    stage = Stage(transmit=True)
    stage.go(0.5)
    stage.press("i")
    stage.passed = 6.0
    assert stage.view.status().notice == ""
    stage.press("y")
    stage.go(0.3)
    assert not stage.injects()


@pytest.mark.usefixtures("in_no_time")
def test_an_order_to_inject_ends_with_the_samples() -> None:
    """A drive that comes back must not be injected into for an order given before."""
    stage = Stage(transmit=True)
    stage.go(0.5)
    stage.press("iy")
    stage.go(0.3)
    assert stage.injects()
    receive = stage.port.receive

    def silent(timeout_s: float, expect: int = 1) -> FrameBlock:
        receive(timeout_s, expect)
        return FrameBlock.zeros(0)

    stage.port.receive = silent  # type: ignore[method-assign]
    stage.go(0.5)
    stage.port.receive = receive  # type: ignore[method-assign]
    stage.go(0.5)
    assert not stage.injects()
    assert stage.view.status().drives[0].order == ""
    assert any("the order to inject has ended" in e.words for e in stage.controls.events)
    assert "into drive 0?" in stage.press("i").notice


@pytest.mark.usefixtures("in_no_time")
def test_no_order_where_there_is_nothing_to_order() -> None:
    stage = Stage(transmit=True)
    assert "sends no samples" in stage.press("i").notice
    stage = Stage(transmit=True, enabled=False)
    stage.go(0.3)
    assert "injection.enabled = false" in stage.press("i").notice


@pytest.mark.usefixtures("in_no_time")
def test_the_other_keys() -> None:
    stage = Stage(transmit=False)
    stage.go(0.5)
    held = stage.press("p").drives[0]
    stage.go(0.3)
    assert stage.view.status().drives[0] is held and stage.view.status().paused
    assert stage.press("p").drives[0] is not held
    assert [stage.press("t").drives[0].course.column_s for _ in range(4)] == pytest.approx([0.8, 0.1, 0.2, 0.4])
    assert stage.press("h").page == HELP and stage.press("f").page == FINDINGS and stage.press("f").page == "main"
    assert stage.press("hx").page == "main", "any key leaves the help"
    assert stage.press("r").notice.startswith("nothing to record")
    assert stage.press("m").events[-1].words == "mark 1 (not recorded)"
    stage.press("q")
    assert stage.quits == 1


@dataclass
class Tape:
    """A recording that fails when told to."""

    running: bool = False
    trouble: str = ""
    path: str = "run.blf"
    refuses: bool = False
    marks: tuple[tuple[int, str], ...] = ()

    @property
    def words(self) -> str:
        return f"{self.path} 1 kB"

    def start(self) -> None:
        if self.refuses:
            raise OSError("no space left")
        self.running = True

    def stop(self) -> None:
        self.running = False

    def mark(self, t_ns: int, words: str) -> None:
        self.marks += ((t_ns, words),)

    def observe(self, *_: object) -> None:
        pass


@pytest.mark.usefixtures("in_no_time")
def test_record_and_mark() -> None:
    stage = Stage(transmit=False)
    tape = stage.controls.recording = Tape(refuses=True)
    stage.go(0.2)
    assert stage.press("r").notice == "cannot record: no space left" and not stage.view.status().recording
    tape.refuses = False
    assert stage.press("r").recording == "run.blf 1 kB"
    stage.press("m")
    assert tape.marks == ((stage.clock.now_ns(), "mark 1"),)
    tape.trouble = "no space left on the disk"
    assert stage.view.status().record_trouble == "no space left on the disk"
    assert stage.press("r").recording == ""
    assert [(e.words, e.severity) for e in stage.controls.events] == [
        ("cannot record: no space left", "error"), ("recording to run.blf", "notice"), ("mark 1", "notice"),
        ("no space left on the disk", "error")]


@pytest.mark.usefixtures("in_no_time")
def test_each_record_is_a_file_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three records within a second, a mark in each: nothing is overwritten, what lies between is in none."""
    monkeypatch.chdir(tmp_path)
    stage = Stage(transmit=True)
    link = Link(stage.port, lambda: stage.port)
    recording = KeyRecording(Tap(link), "can0", Path("first.log"), Rotation())
    stage.controls.recording = recording
    stage.go(0.2)
    written = []
    for _ in range(3):
        stage.press("rm")
        stage.go(0.2)
        stage.press("r")
        written.append(Path(recording.path))
        stage.go(0.2)
    assert written[0] == Path("first.log") and all(p.name.startswith("first-") for p in written[1:])
    assert len({*written}) == 3 == len(recording.summaries) and recording.whole
    for k, path in enumerate(written, 1):
        reader = read_log(path)
        block = FrameBlock.concat(reader)
        assert 0.15e9 < block.t_ns[-1] - block.t_ns[0] < 0.25e9
        assert [m.text for m in reader.marks] == [f"mark {k}"]
        assert {0x120, 0x200} <= set(block.can_id.tolist())
    unnamed = KeyRecording(Tap(link), "can0", None, Rotation())
    unnamed.start()
    unnamed.stop()
    assert re.fullmatch(r"ipmsm-can-\d{8}-\d{6}\.blf", unnamed.path)
    with pytest.raises(ValueError, match="exists"):
        KeyRecording(Tap(link), "can0", Path("first.log"), Rotation()).start()


def test_one_drive_after_the_other() -> None:
    configs = [config_from({"motor": {"preset": "m2"}, "wire": {"node": n}}) for n in (2, 5)]
    companion = Companion(configs, PROTOCOL, True)
    controls = Controls(companion, None, lambda: None, lambda: 0, str, threading.Event())
    companion.nodes[5].view.state = CompanionState.LOCKED
    controls.press(TAB)
    controls.press("i")
    assert "into drive 5?" in controls.notice
    controls.press("y")
    assert controls.orders == {5: True}
    assert companion.nodes[5].scheduler._operator is True and companion.nodes[2].scheduler._operator is None
    controls.press(TAB)
    assert controls.selected == 0


# Findings


class Grumbler:
    """A source that says what it is told to."""

    def __init__(self) -> None:
        self.fed = 0
        self.says: list[Told] = []
        self.fails = False

    def feed(self, batch: Batch) -> None:
        self.fed += len(batch.block)

    def findings(self) -> list[Told]:
        if self.fails:
            raise RuntimeError("out of order")
        return self.says


def test_the_gravest_comes_first_and_a_broken_check_ends_alone() -> None:
    one, other = Grumbler(), Grumbler()
    judge = Judge({"one": one, "the other": other})
    judge.feed(Batch(FrameBlock.zeros(8)))
    one.says = [Told("notice", "Load is 31.2 %."), Told("error", "Broken.", "Mend it.")]
    other.says = [Told("error", "Burnt.")]
    assert [f.sentence for f in judge.findings()] == ["Broken.", "Burnt.", "Load is 31.2 %."]
    other.fails = True
    assert [f.sentence for f in judge.findings()] == [
        "Broken.", "The check of the other failed and was ended: RuntimeError: out of order", "Load is 31.2 %."]
    judge.feed(Batch(FrameBlock.zeros(2)))
    assert (one.fed, other.fed) == (10, 8)


def test_a_finding_is_news_once_and_keeps_its_time() -> None:
    stamps = iter(f"t{k}" for k in range(100))
    news: list[Told] = []
    watch = Watch(None, lambda: next(stamps), news.append)
    watch.accept((Told("error", "Broken.", "Mend it."), Told("notice", "Load is 31.2 %.")))
    watch.accept((Told("notice", "Load is 32.9 %."), Told("notice", "Other.")))
    assert [(f.sentence, f.since) for f in watch.findings] == [("Load is 32.9 %.", "t1"), ("Other.", "t3")]
    assert [told.sentence for told in news] == ["Broken.", "Load is 31.2 %.", "Other."], "a new number is no news"


def test_frames_that_cannot_be_judged_in_time_are_left_out_and_that_is_said() -> None:
    watch = Watch(None, lambda: "")
    half = FrameBlock.zeros(MOST_FRAMES // 2)
    watch.offer(half)
    assert not len(watch.take()), "before anybody judges, nothing is kept"
    watch.begin(("the bus",))
    for _ in range(3):
        watch.offer(half)
    assert len(watch.take()) == MOST_FRAMES
    watch.accept(())
    assert f"{MOST_FRAMES // 2} frames were left out" in watch.findings[0].sentence
    watch.offer(half)
    assert len(watch.take()) == MOST_FRAMES // 2


def test_the_process_judges_bus_and_drive() -> None:
    """What BusHealth says of the same frames is what comes back; and a process that dies is told of."""
    config = config_from({"motor": {"preset": "m2"}})
    plan = Plan((config,), (1_000_000, 5_000_000), True)
    frames = samples(5_000)
    frames = frames.take(np.arange(len(frames)) % 97 != 3)  # samples are missing
    watch = Watch(plan, lambda: "now", note=lambda block: Batch(block, drops=17))
    with watch:
        until(lambda: watch.checked == "the bus, drive 0")
        watch.offer(frames)
        until(lambda: bool(watch.findings))
        told = " ".join(f.sentence for f in watch.findings)
        health = BusHealth(1e6, 5e6, protocol=PROTOCOL)
        health.note_port(17)
        health.update(frames)
        expected = [f.sentence for f in health.report().findings]
        assert len(expected) >= 2 and all(sentence in told for sentence in expected)
        assert watch._process is not None
        watch._process.kill()
        until(lambda: watch.checked == "nothing any more")
        assert "has ended" in watch.findings[0].sentence


def until(happens: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)


# Where the frames come from


class Time:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now += seconds


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_a_log_is_played_as_it_came(speed: float) -> None:
    rng = np.random.default_rng(3)
    frames = FrameBlock.zeros(3000)
    frames.t_ns[:] = 10**18 + np.cumsum(rng.integers(0, 2_000_000, 3000))
    frames.t_ns[2000:] += 3600 * 10**9  # nobody waits for an hour
    frames.t_ns[2500:] -= 7200 * 10**9  # nor for a clock that was set back
    clock = Time()
    port = LogPort((frames.take(slice(a, a + 700)) for a in range(0, 3000, 700)), speed, "x", clock, clock.sleep)
    got, at = [], []
    while not port.finished:
        block = port.receive(0.02)
        got.append(block)
        at += [clock.now] * len(block)
    assert np.array_equal(FrameBlock.concat(got).t_ns, frames.t_ns)
    for part in (slice(0, 2000), slice(2000, 2500), slice(2500, 3000)):
        log = 1e-9 * (frames.t_ns[part] - frames.t_ns[part.start])
        played = np.array(at[part]) - at[part.start]
        assert np.abs(played - log / speed).max() < 0.025
    assert port.skipped_ns == pytest.approx(3600e9, rel=1e-3)
    assert port.send(frames) == 0


def test_simulated_drives_keep_to_the_clock_and_rest_with_the_computer() -> None:
    now = 10**18

    def sleep(seconds: float) -> None:
        nonlocal now
        now += round(1e9 * seconds) + 1000

    drives = [DriveNode(PROTOCOL, n, DriveSimulation(M2, DriveParameters(
                  sample_rate=rate, current_bandwidth=100.0), constant(0.0, 0.0, 1.0)), DriveNodeSettings())
              for n, rate in ((0, 5000.0), (1, 2000.0))]
    port = SimulatedPort(drives, "x", lambda: now, sleep)
    blocks = []
    while now < 10**18 + 10**9:
        blocks.append(port.receive(0.02))
        assert not len(blocks[-1]) or now - blocks[-1].t_ns[-1] < 5_000_000
    frames = FrameBlock.concat(blocks)
    assert (np.diff(frames.t_ns) >= 0).all()
    for node, rate in ((0, 5000), (1, 2000)):
        assert abs(int((frames.can_id == 0x100 + node).sum()) - rate) <= rate // 100
    now += 3600 * 10**9
    late = port.receive(0.02)
    assert 0 < len(late) < 100 and now - late.t_ns[-1] < 5_000_000


# Hours


def test_an_hour_at_10_khz_leaves_nothing_behind() -> None:
    from tools.monitor_hours import run

    growth = run(hours=1.0, warm_up_hours=0.1, thorough=False)
    assert growth.rounds >= 36_000 and growth.samples == pytest.approx(36e6, rel=0.01)
    # a byte a sample would be 36 MB, an object a round 36,000; a few MB the allocator takes and gives as it likes
    assert growth.resident_mb < 12.0
    assert growth.objects < 3000


def test_the_bus_going_away_is_not_hidden_by_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(transmit=False)
    stage.go(0.1)
    stage.press("p")
    assert isinstance(stage.view.sight, WireSight)
    monkeypatch.setattr(stage.view.sight.monitor, "_no_bus", lambda: "no bus since 14:00:00: can0 is down")
    assert stage.view.status().run.bus.no_bus == "no bus since 14:00:00: can0 is down"
