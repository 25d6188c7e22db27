"""`ipmsm-can demo`, end to end: in virtual time, and on a bus inside the program."""

from __future__ import annotations

import gc
import math
import re
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.cosim import BusFaults
from ipmsm_can.cli import demo, main
from ipmsm_can.cli.demo_sides import Setting, run_in_virtual_time, warm_up
from ipmsm_can.config import config_from
from ipmsm_can.drive.profile import demo as demo_profile
from ipmsm_can.report.summary import compare, summarise
from ipmsm_can.wire.protocol import MessageKind


def test_fast_demo_locks_and_shows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "folder"
    assert main(["demo", "--fast", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= max(80, len(f"  plot: {out}/demo.html and {out}/demo.png"))
    said = " ".join(printed.split())
    assert "in virtual time" in said and "All well" in said
    lock = re.search(r"first valid angle \.+ ([\d.]+) s after the first sample, ([\d.]+) s after the rotor", said)
    error = re.search(r"error once valid \.+ ([\d.]+) deg rms, ([\d.]+) deg", said)
    assert lock and error
    # Before 1.5 s the rotor stands; a twentieth of a turn at 20 rpm is enough.
    assert 1.5 < float(lock[1]) < 2.0 and 0.05 < float(lock[2]) < 0.5
    assert 0.01 < float(error[1]) < 0.3 and float(error[2]) < 2.0
    assert "80000 at 5000 Hz in 16.0 s" in said
    assert "lost ........................ 0 samples (0 filled in, 0 gaps" in said
    page = (out / "demo.html").read_text()
    assert "prefers-color-scheme:dark" in page and "http" not in page and "src=" not in page
    assert f"{float(lock[2]):.2f} s" in page and "Locked, and no frame was lost" in page
    assert (out / "demo.png").stat().st_size > 50_000


def test_lost_frames_are_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setting = Setting(fd=False, seed=1, duration=5.0)
    outcome = run_in_virtual_time(setting, BusFaults(loss=0.01, seed=3))
    assert demo.finish(setting, outcome, tmp_path, "") == 1
    said = capsys.readouterr().out
    lost = re.search(r"Something was wrong: (\d+) samples were lost on the way", said)
    assert lost and 200 < int(lost[1]) < 300
    assert f"{lost[1]} samples were lost" in (tmp_path / "demo.html").read_text()


@pytest.fixture
def too_strict(monkeypatch: pytest.MonkeyPatch) -> None:
    """No angle is ever as good as these drives want it."""
    asked = {"motor": {"preset": "m2"}, "estimate": {"valid_sigma": 0.001}}
    monkeypatch.setattr(Setting, "config", lambda self: config_from(asked))


@pytest.mark.usefixtures("too_strict")
def test_never_locking_is_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--fast", "--duration", "3", "--out", str(tmp_path)]) == 1
    assert "the angle never became valid" in capsys.readouterr().out


@pytest.mark.parametrize("seed", range(6))
def test_from_wherever_the_rotor_starts(seed: int) -> None:
    """At standstill nothing is claimed; what is claimed later is right, the half turn included."""
    setting = Setting(fd=False, seed=seed, duration=4.6)
    outcome = run_in_virtual_time(setting)
    record = outcome.record
    s = summarise(record, outcome.node, outcome.bus)
    turning = demo_profile().speed[1][0]
    assert not record.flags[record.time < turning].any()
    assert np.degrees(record.sigma[record.time < turning]).min() > 170.0
    assert s.faults() == []
    assert s.worst_valid < 2.0
    # the encoder is what the drive made of the seed, not what the companion thinks
    first = compare(record).theta_encoder[0]
    assert math.remainder(first - setting.theta_0, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-3)


def test_probing_is_asked_for_and_obeyed_at_low_speed_only() -> None:
    record = run_in_virtual_time(Setting(fd=False, seed=1, duration=9.0)).record
    low, high = record.time < 1.5, (record.time > 7.0) & (record.time < 9.0)
    assert record.injecting[low].mean() > 0.9
    assert not record.injecting[high].any()
    # first the polarity pulses, in vain on a linear machine; then the probing signal alone
    assert 9.1 < record.command_amplitude[record.command_time < 0.5].max() <= 30.0
    assert record.command_amplitude[(record.command_time > 0.5) & (record.command_time < 1.5)].max() <= 9.1
    # never more than is needed, and never nothing
    assert record.command_amplitude[(record.command_time > 0.5) & (record.command_time < 1.5)].min() > 0.0
    assert not (record.command_time > 7.0).any()
    assert record.frames[MessageKind.INJECTION_COMMAND] == record.command_time.size


def test_fd_blocks() -> None:
    outcome = run_in_virtual_time(Setting(fd=True, seed=1, duration=4.6))
    s = summarise(outcome.record, outcome.node, outcome.bus)
    assert s.faults() == []
    assert s.sample_rate == 10_000.0
    assert s.frames[MessageKind.DRIVE_SAMPLE] == 0 and s.frames[MessageKind.DRIVE_SAMPLE_BLOCK] == 46_000 // 7
    assert 0.1 < s.load_mean < 0.6


def test_warming_up_keeps_the_collector_away_from_what_is_loaded() -> None:
    """A full collection over all loaded modules stops a live bus for 0.1 s."""
    gc.unfreeze()
    warm_up(Setting(fd=False, seed=0, duration=1.0))
    assert gc.get_freeze_count() > 10_000
    assert len(gc.get_objects()) < 10_000


def test_same_seed_same_run() -> None:
    a, b, c = (run_in_virtual_time(Setting(fd=False, seed=seed, duration=0.5)).record for seed in (1, 1, 2))
    assert np.array_equal(a.theta, b.theta) and np.array_equal(a.command_amplitude, b.command_amplitude)
    assert not np.array_equal(a.current, c.current)


@pytest.mark.usefixtures("too_strict")
def test_on_a_bus_inside_the_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It never locks; how the machine keeps up is not judged here, but both sides must have spoken."""
    code = main(["demo", "--duration", "3", "-i", "virtual", "-c", "demo-test", "--out", str(tmp_path)])
    said = capsys.readouterr().out
    assert code == 1 and "the angle never became valid" in said
    assert "virtual bus, inside this program; the drive in a thread" in said
    counts = dict(re.findall(r"    (\w+) \.+ +(\d+)  ", said))
    assert int(counts["DriveSample"]) >= 14_900
    assert int(counts["DriveReference"]) >= 1_400
    assert int(counts["PositionEstimate"]) > 1_000
    assert int(counts["InjectionCommand"]) > 50
    assert re.search(r"turnaround p50 / p99 / p99.9  \d+ µs / \d+ µs / \d+ µs", said)
    assert (tmp_path / "demo.html").exists()


@pytest.mark.parametrize(("arguments", "words"), [
    (["--duration", "1"], "--duration is 1 s; allowed is 3 to 300 s"),
    (["--duration", "nan"], "--duration is nan s"),
    (["--seed", "-1"], "--seed is -1; allowed is 0 or more"),
    (["-i", "virtual", "-c", "x", "--fd", "--out", "/dev/null/x"], "/dev/null/x"),
    (["-i", "socketcan", "-c", "no-such-can7"], "can"),
])
def test_bad_input_is_answered_by_one_sentence(arguments: list[str], words: str, tmp_path: Path,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    out = [] if "--out" in arguments else ["--out", str(tmp_path)]
    assert main(["demo", *arguments, *out]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and words in said.err
