"""The live view of another inverter: what the screen gets through a map, and that nothing is ever sent."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from ipmsm_can.bus import listen
from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.listen import Listener
from ipmsm_can.cli import main
from ipmsm_can.cli.mapped_monitor import MappedMonitor
from ipmsm_can.config import config_from
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.control import Controls
from ipmsm_can.live_view.judging import Batch, MappedSource, Plan
from ipmsm_can.live_view.mapped import MappedSight
from ipmsm_can.live_view.picture import picture
from ipmsm_can.live_view.status import MonitorStatus
from ipmsm_can.live_view.taking import FrameClock, LiveView
from ipmsm_can.live_view.watch import Watch
from ipmsm_can.logs import read_log
from ipmsm_can.logs.writer import write_log
from ipmsm_can.mapping import load_map, make_plan
from ipmsm_can.mapping import look as looking
from ipmsm_can.mapping.follow import Follower
from ipmsm_can.mapping.load import map_folder
from ipmsm_can.mapping.look import Look
from ipmsm_can.mapping.mapper import Mapper
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import Protocol
from tests import mapping_traffic
from tests.replaying import drive_frames
from tests.test_mapping_drives import PAIRS, cascadia
from tests.test_mapping_live import run_live

CONFIG = config_from({"motor": {"preset": "m2"}})
NOTHING = FrameBlock.zeros(0)


class Fed:
    """A port that gives frames in pieces, and takes none."""

    fd = True
    drops = unsent = 0
    description = "fed"

    def __init__(self, frames: FrameBlock, piece: int) -> None:
        self.sent = 0
        self._blocks = [frames.take(slice(k, k + piece)) for k in range(0, len(frames), piece)]

    @property
    def finished(self) -> bool:
        return not self._blocks

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        return self._blocks.pop(0) if self._blocks else NOTHING

    def send(self, block: FrameBlock) -> int:
        self.sent += len(block)
        return len(block)

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Stage:
    """A mapped drive and the live view, in a time of their own."""

    def __init__(self, name: str, frames: FrameBlock, piece: int = 500, look_s: float = 0.3,
                 node: int | None = None) -> None:
        self.passed = 0.0
        self.port = Fed(frames, piece)
        plan = make_plan(load_map(name), node=node, pole_pairs=CONFIG.build_motor().pole_pairs)
        self.sight = MappedSight(CONFIG, plan, look_s)
        self.clock = FrameClock(True, lambda: 0.0)
        self.controls = Controls(None, None, lambda: None, self.clock.now_ns, self.clock.words, threading.Event(),
                                 lambda: self.passed)
        self.view = LiveView(self.sight, self.controls, Watch(None, lambda: "now"), self.clock)
        self.listener = Listener(Link(self.port, lambda: self.port), BusHealth(1e6, 5e6), False,
                                 observer=self.view.observe, clock=lambda: self.passed)
        self.sight.watch(MappedMonitor(self.listener, self.sight.follower, "ipmsm-can monitor --map"))

    def go(self, rounds: int | None = None) -> MonitorStatus:
        """So many blocks, or all."""
        left = iter(range(1_000_000 if rounds is None else rounds))
        self.listener.run(lambda: self.port.finished or next(left, None) is None)
        return self.view.status()

    def press(self, keys: str) -> MonitorStatus:
        for key in keys:
            self.controls.press(key)
        return self.view.status()


@pytest.fixture(autouse=True)
def in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listen, "GATHER_S", 0.0)


@pytest.fixture(scope="module")
def fast() -> FrameBlock:
    """To be read only: parts of a block share its memory."""
    return drive_frames(Protocol(), 1.5, reference_rate=500.0)


def text(status: MonitorStatus, width: int = 80, height: int = 24) -> str:
    return "\n".join(str(line) for line in picture(status, width, height))


def claims_an_angle(shown: str) -> bool:
    return " VALID" in shown.replace("NOT VALID", "") or "\u00b0 \u00b1" in shown


# What the screen gets


def test_a_map_that_allows_the_fast_observer(fast: FrameBlock) -> None:
    stage = Stage("ipmsm_can", fast)
    status = stage.go()
    drive, node = status.drives[0], status.run.nodes[0]
    assert (node.state, node.live, node.valid, drive.reported) == ("locked", True, True, False)
    assert drive.rpm == pytest.approx(1000.0, rel=0.01) and 0.0 < drive.rpm_sigma < 5.0
    assert node.injection == "none: a mapped inverter is only listened to"
    shown = text(status)
    for words in ("ipmsm-can monitor --map", "SILENT (listening only)", "drive 0  m2  locked", "[x] valid",
                  "electrical         VALID", "rpm mechanical", "V rms to neutral", "lost 0", "bus load",
                  "1 sigma of the angle", "reported    angle ", "deg rms off the estimate"):
        assert words in shown, words
    assert len(shown.splitlines()) == 24 and max(map(len, shown.splitlines())) <= 80


def test_the_curves_are_those_of_the_mapped_samples_at_their_arrival(fast: FrameBlock) -> None:
    stage = Stage("ipmsm_can", fast)
    status = stage.go()
    stage.sight.follower.flush()
    block = Mapper(stage.sight.follower.plan, 5000.0).feed(fast)
    bins = stage.sight.courses[0]._bins
    for key in np.unique(block.t_ns // 10**8)[:-1]:  # what it looked at counts once
        own = block.t_ns // 10**8 == key
        kept = bins[bins["key"] == key]
        assert kept["n"].tolist() == [own.sum()]
        assert kept["i2"][0] == pytest.approx((block.i_alpha[own] ** 2 + block.i_beta[own] ** 2).sum(), rel=1e-9)
    assert np.isfinite(status.drives[0].course.sigma).any()


@pytest.mark.parametrize("name", ["ipmsm_can", "cascadia_pm"])
def test_the_course_is_the_same_whatever_the_blocks(name: str, fast: FrameBlock) -> None:
    frames = fast if name == "ipmsm_can" else cascadia(seconds=2.0)
    kept = []
    for piece in (37, 1000, len(frames)):
        stage = Stage(name, frames, piece)
        stage.go()
        kept.append(stage.sight.courses[0]._bins.tobytes())
    assert kept[0] == kept[1] == kept[2]


def test_a_map_that_allows_only_steady_state() -> None:
    stage = Stage("cascadia_pm", cascadia(seconds=4.0), look_s=2.0)
    status = stage.go()
    drive, node = status.drives[0], status.run.nodes[0]
    assert node.state == "steady-state quantities only"
    assert (node.live, node.known, drive.reported) == (False, False, True)
    assert drive.rpm == pytest.approx(60.0 * 12.0 / 3, rel=1e-3) and math.isnan(drive.rpm_sigma)
    t = 1e-9 * stage.sight.follower.last_ns - 1_700_000_000
    assert (drive.i_d, drive.i_q) == pytest.approx((-1.5 + 0.2 * t, 6.0 + 0.5 * t), abs=0.15)
    assert drive.i_rms == pytest.approx(math.hypot(drive.i_d, drive.i_q) / math.sqrt(2.0), rel=0.01)
    assert not np.isfinite(drive.course.sigma).any() and np.isfinite(drive.course.speed_low).any()
    for width, height in ((80, 24), (120, 40), (40, 10)):
        assert not claims_an_angle(text(status, width, height))
    shown = text(status)
    for words in ("angle       unknown", "+240.0 rpm mechanical            as the drive reports it", "A rms",
                  "of them steady enough to judge by", "psi_m       0.59 Wb", "phase current [A rms]"):
        assert words in shown, words
    assert "power" in text(status, 80, 40) and "1 sigma" not in shown


def test_while_it_looks_there_is_what_the_drive_reports() -> None:
    stage = Stage("cascadia_pm", cascadia(seconds=4.0), 100, look_s=2.0)
    status = stage.go(5)
    assert status.run.nodes[0].state == "looking at the signals"
    assert status.drives[0].reported and status.run.nodes[0].received > 30
    assert status.drives[0].rpm == pytest.approx(240.0, rel=1e-3) and not claims_an_angle(text(status))


def vesc(seconds: float) -> FrameBlock:
    """Speed and current, and no voltage at all."""
    t = np.arange(round(50 * seconds)) * 2e-2
    return mapping_traffic.frames(map_folder() / "vesc.dbc", {
        "VESC_Status": (t, {"erpm": 720.0, "current": 6.0, "duty": 0.1})}, 57)


def test_a_map_without_a_voltage_shows_what_is_reported(config: Path, tmp_path: Path,
                                                        capsys: pytest.CaptureFixture[str]) -> None:
    stage = Stage("vesc", vesc(3.0), 10, node=57)
    status = stage.go()
    assert status.run.nodes[0].state == "nothing can be made of the signals" and not status.run.nodes[0].live
    assert (status.drives[0].rpm, status.drives[0].i_q) == pytest.approx((240.0, 6.0), rel=1e-3)
    shown = text(status)
    assert "voltage     unknown" in shown and "as the drive reports it" in shown and not claims_an_angle(shown)
    log = tmp_path / "run.blf"
    write_log(log, [vesc(3.0)])
    assert monitor(config, "--log", str(log), "--map", "vesc", "--node", "57", "--speed", "20") == 0
    assert "nothing can be made of the signals: the map has not the voltage" in capsys.readouterr().out


def test_the_wrong_bus(fast: FrameBlock) -> None:
    stage = Stage("cascadia_pm", fast)
    status = stage.go()
    assert status.run.nodes[0].state == "no frame of the map has come yet" and status.run.nodes[0].received == 0
    assert status.run.bus.frames == len(fast) and not status.drives[0].reported
    shown = text(status)
    assert "speed       unknown" in shown and not claims_an_angle(shown)
    assert max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize("name", ["ipmsm_can", "cascadia_pm"])
def test_nothing_is_claimed_once_the_bus_is_silent(name: str, fast: FrameBlock) -> None:
    stage = Stage(name, fast if name == "ipmsm_can" else cascadia(seconds=2.0))
    stage.go()
    stage.passed = 2.0
    status = stage.view.status()
    assert status.run.nodes[0].state == "no samples any more" and not status.drives[0].reported
    assert not claims_an_angle(text(status)) and "speed       unknown" in text(status)


# Keys


def test_no_key_orders_anything(fast: FrameBlock) -> None:
    stage = Stage("ipmsm_can", fast)
    stage.go()
    for keys in ("i", "iy", "o", "a"):
        status = stage.press(keys)
        assert status.drives[0].order == "" and not status.injectable
        assert not any("ordered" in event.words for event in status.events)
        if "y" not in keys:
            assert "a mapped inverter is only listened to" in status.notice
    assert stage.port.sent == 0 and "injection  p" not in text(status)
    held = stage.press("p").drives[0]
    assert stage.view.status().drives[0] is held
    stage.press("p")
    assert stage.press("t\t").drives[0].course.column_s == pytest.approx(0.8)
    assert stage.press("m").events[-1].words == "mark 1 (not recorded)"


# Findings


def said(name: str, frames: FrameBlock) -> list[tuple[str, str]]:
    source = MappedSource(Plan((CONFIG,), (1_000_000, 5_000_000), True, name))
    for k in range(0, len(frames), 700):
        source.feed(Batch(frames.take(slice(k, k + 700))))
    return [(told.severity, told.sentence) for told in source.findings()]


def test_findings_say_why_there_is_no_angle_and_what_is_doubtful(fast: FrameBlock) -> None:
    found = said("cascadia_pm", cascadia(seconds=3.0))
    # the made-up motor has a pole pair more than the drive.toml says
    assert found[0] == ("warning", "The reported torque is 132 % of that of currents and fitted motor.")
    assert found[1][0] == "notice" and found[1][1].startswith("Steady-state quantities only: the voltage is a mom")
    assert any(sentence.startswith("Of the map: speed.signal") for _, sentence in found)
    strange = fast.take(np.arange(len(fast)))
    strange.t_ns[:] += np.arange(len(strange)) * 1_000_000
    (severity, sentence), = said("cascadia_pm", strange)
    assert severity == "warning" and sentence.startswith("The bus holds no frame of the map (identifiers 0x0A5")
    assert "seen were 0x100" in sentence


def test_findings_hold_the_diagnosis_through_the_map() -> None:
    """As many samples gone as makes a finding of our own wire's diagnosis, through the map."""
    frames = drive_frames(Protocol(), 4.5)
    samples = np.flatnonzero(frames.can_id == 0x100)
    gone = np.zeros(len(frames), bool)
    gone[samples[11_000::40]] = True
    found = said("ipmsm_can", frames.take(~gone))
    assert any("samples" in sentence and not sentence.startswith("Of the map") for _, sentence in found), found


# The follower's part


def test_samples_that_are_filled_stand_evenly_between_those_that_came(fast: FrameBlock) -> None:
    samples = np.flatnonzero(fast.can_id == 0x100)
    gone = np.zeros(len(fast), bool)
    gone[samples[[3000, 3001, 5000]]] = True
    parts: list[Tracked] = []
    plan = make_plan(load_map("ipmsm_can"), pole_pairs=CONFIG.build_motor().pole_pairs)
    follower = Follower(CONFIG, plan, 0.3, estimates=parts.append)
    kept = fast.take(~gone)
    for k in range(0, len(kept), 250):
        follower.feed(kept.take(slice(k, k + 250)))
    follower.flush()
    t = np.concatenate([p.run.t_ns for p in parts])
    filled = np.concatenate([p.run.filled for p in parts])
    assert t.size == samples.size and np.flatnonzero(filled).tolist() == [3000, 3001, 5000]
    assert np.array_equal(t[filled == 0], fast.t_ns[np.delete(samples, [3000, 3001, 5000])])
    assert np.abs(t[filled != 0] - fast.t_ns[samples[[3000, 3001, 5000]]]).max() < 1_000_000
    assert all(p.run.values.shape == (4, p.run.t_ns.size) == (4, p.estimate.sigma.size) for p in parts)


def test_a_clock_that_stands_or_runs_back_does_not_make_it_look_forever(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(load_map("cascadia_pm"), pole_pairs=PAIRS)
    frames = cascadia(seconds=3.0)
    monkeypatch.setattr(looking, "MOST_FRAMES", 100)
    standing = frames.take(np.arange(250))
    standing.t_ns[:] = standing.t_ns[0]
    look = Look(plan, None)
    assert [look.feed(standing.take(slice(k, k + 30))) is None for k in range(0, 120, 30)] == [True] * 3 + [False]
    monkeypatch.undo()
    look, back = Look(plan, None), frames.take(np.arange(len(frames)))
    back.t_ns[:] -= 3600 * 10**9
    assert look.feed(frames.take(slice(0, 50))) is None
    assert look.feed(back) is not None and look.allowed is not None


# The command


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("toml") / "drive.toml"
    path.write_text('[motor]\npreset = "m2"\n')
    return path


def monitor(config: Path, *options: str) -> int:
    return main(["monitor", str(config), "--no-findings", *options])


@pytest.mark.parametrize(("name", "told"), [
    ("cascadia_pm", ["300 samples, lost 0", "last: steady-state quantities only", "psi_m      0.59 Wb"]),
    ("ipmsm_can", ["7500 samples, lost 0", "last: locked, VALID", "fast observer: 5000 samples a second"])])
def test_a_log_is_played_to_its_end(name: str, told: Sequence[str], config: Path, fast: FrameBlock, tmp_path: Path,
                                    capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "run.blf"
    frames = fast if name == "ipmsm_can" else cascadia(seconds=3.0)
    write_log(log, [frames])
    code = monitor(config, "--log", str(log), "--map", name, "--speed", "20", "--duration", "120")
    said = capsys.readouterr()
    assert code == 0, said.err
    assert f"{len(frames)} frames received, 0 sent" in said.out
    assert all(words in said.out for words in told), said.out


def test_a_log_of_the_wrong_bus(config: Path, fast: FrameBlock, tmp_path: Path,
                                capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "run.blf"
    write_log(log, [fast])
    assert monitor(config, "--log", str(log), "--map", "cascadia_pm", "--speed", "50") == 2
    said = capsys.readouterr()
    assert "holds no frame of the map (identifiers 0x0A5" in said.err and "no samples came" in said.out


def test_live_it_records_and_sends_nothing(config: Path, tmp_path: Path,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    frames = cascadia(seconds=3.0)
    log = tmp_path / "run.blf"
    code, said, heard = run_live(config, "cascadia_pm", frames, capsys, "--record", str(log), command="monitor",
                                 quiet="--no-findings")
    assert code == 0 and not heard, said
    assert f"recorded {len(frames)} frames in {log}" in said and "SILENT (listening only)" in said
    assert sum(map(len, read_log(log))) == len(frames)


LIVE = ("-i", "virtual", "-c", "x")


@pytest.mark.parametrize(("options", "told"), [
    ([*LIVE, "--map", "cascadia_pm", "--transmit"], "--transmit does not go with --map"),
    ([*LIVE, "--map", "cascadia_pm", "--measure", "x.mf4"], "--measure does not go with --map"),
    (["--map", "cascadia_pm", "--demo"], "--demo does not go with --map"),
    ([*LIVE, "--map", "cascadia"], "did you mean cascadia_pm"),
    ([*LIVE, "--node", "3"], "--node goes with --map"),
    (["--map", "cascadia_pm", "--log", "none.blf", "--record", "x.blf"], "--record is given with --log"),
])
def test_what_does_not_go_with_a_map(options: list[str], told: str, config: Path,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    assert monitor(config, *options) == 2
    assert told in capsys.readouterr().err


def test_one_configuration_and_no_more(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", *LIVE, "--map", "cascadia_pm"]) == 2
    assert "--map takes one drive.toml, and there are 0" in capsys.readouterr().err
    assert main(["monitor", str(config), str(config), *LIVE, "--map", "cascadia_pm"]) == 2
    assert "--map takes one drive.toml, and there are 2" in capsys.readouterr().err


def test_silence_is_said(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert monitor(config, "-i", "virtual", "-c", "silent", "--map", "cascadia_pm", "--duration", "0.3") == 1
    assert "no sample of the map cascadia_pm could be used: no frame of the map has come yet" in (
        capsys.readouterr().err)
