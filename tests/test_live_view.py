"""The live view without a terminal: its picture, curves, keys, findings, and what it keeps in memory."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from ipmsm_can.bus import live
from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.playback import LogPort
from ipmsm_can.bus.simulated import SimulatedPort
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view import chart
from ipmsm_can.live_view.control import Controls
from ipmsm_can.live_view.course import CourseRing
from ipmsm_can.live_view.judging import Batch, Judge, Plan
from ipmsm_can.live_view.keys import TAB, decode
from ipmsm_can.live_view.picture import picture
from ipmsm_can.live_view.status import FINDINGS, HELP, MonitorStatus, Told
from ipmsm_can.live_view.taking import FrameClock, LiveView
from ipmsm_can.live_view.watch import MOST_FRAMES, Watch
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import CompanionState, MessageKind, Protocol, Waveform
from tests.live_view_status import DRIVE, EVENTS, NODE, STATUS

PROTOCOL = Protocol()
SIZES = [(80, 24), (120, 40), (40, 10), (200, 60), (20, 5), (1, 1)]


def shown(status: MonitorStatus, width: int = 80, height: int = 24) -> list[str]:
    return [str(line) for line in picture(status, width, height)]


# The picture


def test_everything_is_on_the_screen() -> None:
    text = "\n".join(shown(STATUS, 120, 40))
    for words in (
            " SILENT (listening only) ", "● REC", "run.blf 12.3 MB", "0:01:23", "can0 (SocketCAN", "drive 3  m2",
            "[x] valid  [x] locked  [x] polarity", "330.0° ± 0.60° electrical", "VALID",
            "+999.9 ± 0.41 rpm mechanical", "+314.2 rad/s electrical", "2.34 A rms, 3.61 A peak",
            "i_d -0.52  i_q +3.27 A peak", "87.6 V rms to neutral", "141 % of rated current",
            "on, 6.0 V: low speed", "the drive injects, 0.35 A peak", "9999/s of 10000 Hz", "excitation 5.83 V^2 s",
            "lost 7", "gaps 1", "bad frames 8", "speed [rpm mech.], last 25 s", "1 sigma of the angle [deg el.]",
            "phase current [A rms]", "57.3 %", "5560 frames/s", "kernel drops 15", "error frames 2",
            "unknown ids 12",
            "error       The frames take 97 %", "warning     Samples of drive 3", "14:03:11    mark 1",
            "r stop rec  m mark  p pause", "h help  q quit"):
        assert words in text, words
    assert "TRANSMITTING" not in text and "inject  " not in text and "answers" not in text
    loud = "\n".join(shown(replace(STATUS, injectable=True, run=replace(STATUS.run, transmit=True)), 120, 40))
    assert "TRANSMITTING" in loud and "SILENT" not in loud
    assert "99 sent  after p50 120 us  p99 240 us  unsent 11  too late 9" in loud
    assert "i o a injection" in loud


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("nodes", [1, 2, 16])
@pytest.mark.parametrize("page", ["main", FINDINGS, HELP])
@pytest.mark.parametrize("ascii_only", [False, True])
def test_it_fits_every_window(width: int, height: int, nodes: int, page: str, ascii_only: bool) -> None:
    many = replace(STATUS, page=page, ascii=ascii_only, selected=nodes - 1,
                   drives=tuple(replace(DRIVE, node=replace(NODE, node=k)) for k in range(nodes)))
    lines = shown(many, width, height)
    assert len(lines) == height
    assert max(map(len, lines)) <= width
    assert not ascii_only or "".join(lines).isascii()
    if width >= 40:
        assert "SILENT (listening only)" in lines[0]
    if width >= 40 and height >= 10 and page == "main":
        assert any("VALID" in line for line in lines), "the verdict on the angle is never cut off"
        assert "q quit" in lines[-1]


def test_nothing_of_the_numbers_is_cut_off_at_80_columns() -> None:
    narrow, wide = shown(STATUS), shown(STATUS, 200, 60)

    def numbers(lines: list[str]) -> list[str]:
        at = [next(k for k, line in enumerate(lines) if line.startswith(word))
              for word in ("drive", "        speed", "bus load", "error")]
        return " ".join(lines[at[0]:at[1]] + lines[at[2]:at[3]]).split()

    assert numbers(narrow) == numbers(wide) and len(numbers(narrow)) > 80


@pytest.mark.parametrize(("change", "words"), [
    ({"live": False, "state": "no samples any more"}, "no estimate"),
    ({"sigma": math.pi, "valid": False, "locked": False}, "NOT VALID: angle unknown"),
    ({"valid": False, "polarity_known": False}, "NOT VALID: may be half a turn off"),
])
def test_an_angle_is_never_shown_as_more_than_it_is(change: dict[str, object], words: str) -> None:
    status = replace(STATUS, drives=(replace(DRIVE, node=replace(NODE, **change)),))  # type: ignore[arg-type]
    for width in (40, 80, 120):
        text = "\n".join(shown(status, width, 40))
        assert (words if width >= 80 else words[:20]) in text
        assert " VALID" not in text.replace("NOT VALID", "")
        if not change.get("live", True) or change.get("sigma") == math.pi:
            assert "330" not in text and "i_d -0.52" not in text


def test_what_is_grave_is_told_in_words() -> None:
    gone = replace(STATUS.run, bus=replace(STATUS.run.bus, no_bus="no bus since 14:03:12: can0 is down"))
    assert any("no bus since 14:03:12: can0 is down" in line for line in shown(replace(STATUS, run=gone)))
    full = replace(STATUS, record_trouble="no space left on the disk of run.blf")
    assert " NOT RECORDING " in shown(full)[0] and "no space left" in shown(full)[1]
    assert " PAUSED " in shown(replace(STATUS, paused=True))[0]
    assert shown(replace(STATUS, keys=False))[-1].startswith("no keys: standard input is not a terminal")
    for checked, words in (("the bus, drive 3", "none so far  looked at: the bus, drive 3"),
                           ("starting", "the checks are starting"), ("", "nobody looks for any")):
        for page in ("main", FINDINGS):
            assert words in "\n".join(shown(replace(STATUS, findings=(), checked=checked, page=page)))


def test_what_others_say_is_put_into_ascii_where_there_is_no_more() -> None:
    told = (Told("error", "The coil has 3 Ω ± 1, at 20 °C, says Jürgen."),)
    text = "\n".join(shown(replace(STATUS, ascii=True, findings=told)))
    assert text.isascii() and "3 ohm +/- 1, at 20  degC, says J?rgen." in text


def test_lines_for_pipes_tell_the_gravest_finding() -> None:
    from ipmsm_can.cli.live_view import _line

    assert _line(STATUS).endswith("lost 7 bad 8 | error: The frames take 97 % of the bus time, so others wait.")
    assert _line(replace(STATUS, findings=STATUS.findings[2:])).endswith("lost 7 bad 8")


def test_findings_have_a_page_with_advice() -> None:
    few = "\n".join(shown(STATUS))
    assert "(+" in few and "more: f)" in few and "Send less" not in few
    page = "\n".join(shown(replace(STATUS, page=FINDINGS)))
    assert "Send less. (since 14:03:12)" in " ".join(page.split()) and all(event.words in page for event in EVENTS)
    assert "The frames take" not in "\n".join(shown(replace(STATUS, page=HELP)))


def test_the_drawing_process_loads_next_to_nothing() -> None:
    code = ("import sys, ipmsm_can.live_view.drawing\n"
            "print([m for m in ('numpy', 'numba', 'can', 'cantools', 'pydantic') if m in sys.modules])")
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


# Curves


def dots(lines: list[str]) -> np.ndarray:
    """The dots of a braille chart without its axis, as rows of booleans, top first; an independent reading."""
    width = max(map(len, lines)) - 8
    cells = np.array([[ord(c) - 0x2800 if c != " " else 0 for c in line[8:].ljust(width)] for line in lines])
    bits = [[0, 3], [1, 4], [2, 5], [6, 7]]
    out = np.zeros((4 * cells.shape[0], 2 * cells.shape[1]), bool)
    for y in range(4):
        for x in range(2):
            out[y::4, x::2] = cells >> bits[y][x] & 1
    return out


def test_a_curve_is_where_its_values_are() -> None:
    values = np.linspace(0.0, 100.0, chart.points(48, False))
    lines = chart.chart(values.tolist(), values.tolist(), 48, 5, 1.0, False)
    assert lines[0].startswith("    100│") and lines[-1].startswith("      0│")
    drawn = dots(lines)
    expected = 19 - np.minimum((values / 100.0 * 20).astype(int), 19)
    assert np.array_equal(drawn.argmax(axis=0), expected)
    assert drawn.sum(axis=0).max() == 1


def test_a_curve_has_no_holes_but_where_nothing_was() -> None:
    values = [0.0, 100.0, math.nan, 100.0, 0.0]
    width = 8 + 3
    drawn = dots(chart.chart(values, values, width, 4, 1.0, False))
    assert drawn.sum(axis=0).tolist() == [0, 1, 15, 0, 1, 15]
    plain = chart.chart(values, values, 8 + 5, 4, 1.0, True)
    assert [line[8:] for line in plain] == [" * * ", " *  *", " *  *", "*   *"]


@pytest.mark.parametrize("low, high, least, expected", [
    (0.0, 0.0, 10.0, (0.0, 10.0)), (-990.0, 1005.0, 10.0, (-1000.0, 1500.0)), (19.9, 20.1, 10.0, (15.0, 25.0)),
    (math.nan, math.nan, 10.0, (0.0, 10.0)), (0.02, 0.03, 0.1, (0.0, 0.1))])
def test_axes_are_round_and_hold_the_data(low: float, high: float, least: float,
                                          expected: tuple[float, float]) -> None:
    assert chart.scale(low, high, least) == pytest.approx(expected)


# Course


def samples(n: int, rate: float = 10_000.0, t0_ns: int = 10**18, rpm: float = 600.0) -> FrameBlock:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=rate, current_noise=0.02),
                                 constant(rpm * RPM, 1.0, 60.0))
    return DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings(fd=True)).step(n, t0_ns).frames


@pytest.fixture(scope="module")
def tracked() -> list[Tracked]:
    companion = Companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL, transmit=False)
    frames = samples(12_000)
    edges = [0, *np.sort(np.random.default_rng(1).choice(len(frames), 40, False)).tolist(), len(frames)]
    out = []
    for a, b in pairwise(edges):
        out += companion.feed(frames.take(slice(a, b)))
    return out


def columns(part: list[Tracked], name: str) -> np.ndarray:
    return np.concatenate([getattr(p.estimate, name) for p in part], axis=-1)


def test_the_course_is_that_of_the_samples(tracked: list[Tracked]) -> None:
    ring, whole = CourseRing(), CourseRing()
    for part in tracked:
        ring.add(part)
    values = np.concatenate([p.run.values for p in tracked], axis=1)
    t = np.concatenate([p.run.t_ns for p in tracked])
    last = tracked[-1]
    together = replace(last, run=replace(
        last.run, values=values, t_ns=t, counter=np.concatenate([p.run.counter for p in tracked])),
        estimate=replace(last.estimate, angle=columns(tracked, "angle"), sigma=columns(tracked, "sigma")))
    whole.add(together)
    assert ring._bins.tobytes() == whole._bins.tobytes(), "the cut into blocks must not matter"
    use = t // 10**8 > t[-1] // 10**8 - 3
    angle, sigma = columns(tracked, "angle"), columns(tracked, "sigma")
    i = values[0, use] + 1j * values[1, use]
    i_dq = i * np.exp(-1j * angle[0, use])
    p = ring.present()
    assert p.i_rms == pytest.approx(np.sqrt((np.abs(i) ** 2).mean() / 2.0), rel=1e-9)
    assert p.i_peak == pytest.approx(np.abs(i).max(), rel=1e-12)
    assert (p.i_d, p.i_q) == pytest.approx((i_dq.real.mean(), i_dq.imag.mean()), rel=1e-9, abs=1e-12)
    assert p.omega == pytest.approx(angle[2, use].mean(), rel=1e-9)
    assert p.omega == pytest.approx(600.0 * RPM * M2.pole_pairs, rel=1e-3)
    first = (t // 10**8 == t[-1] // 10**8 - 2)
    expected = math.hypot(sigma[first].max(), sigma[-1]) / (use.sum() / 10_000.0)
    assert p.omega_sigma == pytest.approx(expected, rel=1e-9)
    c = whole.columns(int(t[-1]), 8, 2, 2.0)
    for k in range(8):
        own = t // 2 // 10**8 == t[-1] // 2 // 10**8 - 7 + k
        known = own & (sigma < math.radians(90.0))
        if not own.any():
            assert math.isnan(c.current[k]) and math.isnan(c.speed_low[k])
            continue
        assert c.current[k] == pytest.approx(np.sqrt((values[:2, own] ** 2).sum(axis=0).mean() / 2.0), rel=1e-6)
        assert c.speed_high[k] == pytest.approx(2.0 * angle[2, known].max(), rel=1e-6)
        assert c.speed_low[k] == pytest.approx(2.0 * angle[2, known].min(), rel=1e-6)
    assert math.isnan(whole.columns(int(t[-1]) + 10**9, 8, 1, 1.0).current[-1]), "silence is a gap"


def test_a_clock_that_is_set_back_begins_a_new_course(tracked: list[Tracked]) -> None:
    ring = CourseRing()
    for part in tracked:
        ring.add(part)
    back = replace(tracked[-1], run=replace(tracked[-1].run, t_ns=tracked[-1].run.t_ns - 3600 * 10**9))
    ring.add(back)
    assert np.isfinite(ring.columns(int(back.run.t_ns[-1]), 100, 1, 1.0).current).sum() <= 2
    assert math.isfinite(ring.present().i_rms)


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
        self.view = LiveView(self.runner, self.controls, self.watch, self.clock)
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
    monkeypatch.setattr(stage.view.monitor, "_no_bus", lambda: "no bus since 14:00:00: can0 is down")
    assert stage.view.status().run.bus.no_bus == "no bus since 14:00:00: can0 is down"
