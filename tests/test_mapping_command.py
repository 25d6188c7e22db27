"""`ipmsm-can map` and `replay --map`: what they say, and their exit codes."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.rows import RowBlock
from ipmsm_can.cli import main
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import write_log
from ipmsm_can.mapping import MappedBlock, load_map, make_plan, shipped_maps
from ipmsm_can.mapping.check import text
from ipmsm_can.mapping.convert import CURRENT_APART, VOLTAGE_APART
from ipmsm_can.mapping.load import map_folder
from ipmsm_can.mapping.survey import Survey
from ipmsm_can.mapping.track import MappedTracking
from ipmsm_can.wire.protocol import Protocol
from ipmsm_can.wire.sequence_kernel import RESTARTED
from tests.mapping_traffic import dbc_text, run
from tests.replaying import column, config, drive_frames, toml
from tests.test_mapping_drives import cascadia

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("log") / "car.log"
    write_log(path, [cascadia(seconds=3.0)])
    return str(path)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("log") / "own.blf"
    write_log(path, [drive_frames(Protocol(), 1.0, reference_rate=500.0)])
    return str(path)


def _line(text: str, start: str) -> str:
    return next(line for line in text.splitlines() if line.strip().startswith(start))


def test_check_tells_rates_distances_and_what_can_be_done(car: str, capsys: Capture) -> None:
    assert main(["map", "--check", car, "cascadia_pm"]) == 0
    shown = capsys.readouterr().out
    line = _line(shown, "current.a")
    assert "PM_A6_Currents.i_a" in line and "0x0A6" in line and "100/s" in line and " A" in line
    assert "0.2 ms from the current, 0.2 at most" in _line(shown, "angle.signal")
    assert "12 to 12 Hz electrical" in _line(shown, "speed.signal")
    assert re.search(r"fast observer +no +the voltage is a momentary value", shown)
    assert re.search(r"steady-state checks +yes", shown)
    assert re.search(r"bus statistics +yes", shown)
    assert "320 to 320 V" in _line(shown, "dc_voltage.signal")
    assert "missing" not in shown.split("what it allows")[0].replace("values missing", "")


def test_check_of_our_own_wire_allows_the_fast_observer(own: str, capsys: Capture) -> None:
    assert main(["map", "--check", own, "ipmsm_can"]) == 0
    shown = capsys.readouterr().out
    found = re.search(r"fast observer +yes +5000 samples a second, (\d+) in an electrical turn", shown)
    assert found and 95 <= int(found[1]) <= 105  # 1000 rpm, three pole pairs
    assert re.search(r"encoder checks +yes", shown) and re.search(r"voltage timing +yes", shown)


def test_what_the_log_does_not_hold_is_exit_1(tmp_path: Path, capsys: Capture) -> None:
    block = cascadia()
    write_log(tmp_path / "a.log", [block.take((block.can_id & 0x7FF) != 0xA7)])
    assert main(["map", "--check", str(tmp_path / "a.log"), "cascadia_pm"]) == 1
    shown = capsys.readouterr().out
    assert "message PM_A7_Voltages (0x0A7) never came; it carries voltage.d, voltage.q, dc_voltage.signal" in shown
    assert re.search(r"steady-state checks +no", shown)


def test_a_bus_that_has_one_identifier_of_the_map_by_chance(tmp_path: Path, capsys: Capture) -> None:
    lines = [f"(1629633295.{k:03}000)\tcan0\t0B0#0103640000000000\n" for k in range(99)]
    (tmp_path / "a.log").write_text("".join(lines))
    assert main(["map", "--check", str(tmp_path / "a.log"), "cascadia_pm"]) == 1
    shown = capsys.readouterr().out
    assert re.search(r"steady-state checks +no +none of the samples have current, voltage", shown)
    assert "NEVER CAME" in _line(shown, "current.a")


def test_too_few_samples_in_a_turn(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "x.dbc").write_text((map_folder() / "cascadia_pm.dbc").read_text())
    map_text = shipped_maps()["cascadia_pm"].read_text().replace("mean = false", "mean = true")
    (tmp_path / "x.toml").write_text(map_text.replace("cascadia_pm.dbc", "x.dbc"))
    write_log(tmp_path / "a.log", [cascadia(hertz=25.0)])
    assert main(["map", "--check", str(tmp_path / "a.log"), str(tmp_path / "x.toml")]) == 0
    assert "100 samples a second are 4.0 in an electrical turn at 25 Hz; it needs 12" in capsys.readouterr().out


def test_a_wrong_direction_shows(tmp_path: Path, car: str, capsys: Capture) -> None:
    (tmp_path / "cascadia_pm.dbc").write_text((map_folder() / "cascadia_pm.dbc").read_text())
    map_text = shipped_maps()["cascadia_pm"].read_text()
    for change, told in ((("direction = 1", "direction = -1"), "the angle runs against the speed"),
                         (('of = "electrical"', 'of = "shaft"'), "the angle turns 4.00 times as fast"),
                         (('measure = "peak"                # assumed', 'measure = "rms" # assumed'), "")):
        (tmp_path / "x.toml").write_text(map_text.replace(*change))
        assert main(["map", "--check", car, str(tmp_path / "x.toml"), "--pole-pairs", "4"]) == 0
        shown = capsys.readouterr().out
        assert told in shown
        assert ("the angle" in shown.split("what it allows")[0]) == bool(told)


@pytest.mark.parametrize(("change", "told"), [
    (("PM_A6_Currents.i_a", "PM_A6_Currents.ia"), "has no signal 'ia'; did you mean i_a?"),
    (("PM_A6_Currents.i_a", "PM_A6_Current.i_a"), "has no message 'PM_A6_Current'; did you mean PM_A6_Currents?"),
    (('"cascadia_pm.dbc"', '"bad.dbc"'), "bad.dbc is no usable DBC"),
    (('"cascadia_pm.dbc"', '"none.dbc"'), 'map.dbc is "none.dbc"; allowed is the path of a file that exists'),
    (("[map]", "[map"), "not valid TOML"),
    (("node", "nodes"), ""),
])
def test_bad_files_are_one_sentence_and_exit_2(tmp_path: Path, car: str, capsys: Capture, change: tuple[str, str],
                                               told: str) -> None:
    (tmp_path / "cascadia_pm.dbc").write_text((map_folder() / "cascadia_pm.dbc").read_text())
    (tmp_path / "bad.dbc").write_text((map_folder() / "cascadia_pm.dbc").read_text().replace("16|16@", "60|16@"))
    (tmp_path / "x.toml").write_text(shipped_maps()["cascadia_pm"].read_text().replace(*change))
    code = main(["map", "--check", car, str(tmp_path / "x.toml")])
    error = capsys.readouterr().err
    assert code == (2 if told else 0)
    assert told in error and error.count("\n") == (1 if told else 0)


def test_the_log_of_another_bus_and_no_log(tmp_path: Path, own: str, capsys: Capture) -> None:
    assert main(["map", "--check", own, "cascadia_pm"]) == 2
    error = capsys.readouterr().err
    assert "holds no frame of the map (identifiers 0x0A5, 0x0A6, 0x0A7, 0x0B0); seen were 0x100, 0x140" in error
    assert error.count("\n") == 1
    assert main(["replay", own, "--drive", toml(tmp_path), "--map", "cascadia_pm"]) == 2
    assert "holds no frame of the map" in capsys.readouterr().err
    assert main(["map", "--check", str(tmp_path / "none.log"), "cascadia_pm"]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert main(["map", "--check", own, "odrive"]) == 2
    assert "pole pairs of the motor are not known" in capsys.readouterr().err


def test_frames_full_of_noise_never_raise(tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(8)
    block = FrameBlock(rng.integers(0, 256, (5000, 72), dtype=np.uint8), rng.integers(0, 10**10, 5000))
    block.can_id[:] = rng.integers(0, 8, 5000).astype(np.uint32) * 0x20000000 + rng.integers(0, 0x200, 5000)
    block.length[:] = rng.integers(0, 9, 5000)
    block.flags[:] = 0
    for name in shipped_maps():
        survey = Survey(make_plan(load_map(name), pole_pairs=4))
        survey.run([block.take(slice(0, 1700)), block.take(slice(1700, None))])
        assert "what it allows" in text(survey, "noise", name)


def test_a_log_cut_off_is_checked_as_far_as_it_goes_and_exit_2(tmp_path: Path, capsys: Capture) -> None:
    write_log(tmp_path / "long.blf", [drive_frames(Protocol(), 4.0)])
    whole = (tmp_path / "long.blf").read_bytes()
    (tmp_path / "cut.blf").write_bytes(whole[:len(whole) * 2 // 3])
    assert main(["map", "--check", str(tmp_path / "cut.blf"), "ipmsm_can"]) == 2
    shown = capsys.readouterr()
    assert "what it allows" in shown.out and "what was readable is checked" in shown.err
    assert shown.err.count("\n") == 1


def test_list_and_show(capsys: Capture) -> None:
    assert main(["map", "list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == list(shipped_maps())
    assert main(["map", "show", "vesc"]) == 0
    assert '[map]\ntitle = "VESC, status frames"' in capsys.readouterr().out
    assert main(["map", "show", "vesk"]) == 2
    assert "did you mean vesc?" in capsys.readouterr().err
    assert main(["map"]) == 2


def test_replay_through_the_map_of_our_own_wire_finds_what_the_native_way_finds(
        tmp_path: Path, own: str, capsys: Capture) -> None:
    ours, theirs = tmp_path / "a.csv", tmp_path / "b.csv"
    drive = toml(tmp_path)
    assert main(["replay", own, "--drive", drive, "--out", str(ours)]) == 0
    assert main(["replay", own, "--drive", drive, "--map", "ipmsm_can", "--out", str(theirs)]) == 0
    shown = capsys.readouterr().out
    assert "fast observer: 5000 samples a second" in shown and "0 lost, 0 of them filled" in shown
    a, b = (np.loadtxt(p, delimiter=",", skiprows=1) for p in (ours, theirs))
    keep = [k for k in range(11) if k not in (0, 7)]  # numbers from 0, and nobody says when the drive injects
    assert a.shape == b.shape == (5000, 11)
    assert np.array_equal(a[:, keep], b[:, keep])


def test_replay_fills_short_gaps_and_leaves_out_the_unusable(tmp_path: Path, capsys: Capture) -> None:
    block = drive_frames(Protocol(), 1.0, reference_rate=500.0)
    lost = (np.random.default_rng(2).random(len(block)) < 0.03) & (block.can_id == 0x100)
    write_log(tmp_path / "a.blf", [block.take(~lost)])
    assert main(["replay", str(tmp_path / "a.blf"), "--drive", toml(tmp_path), "--map", "ipmsm_can", "--out",
                 str(tmp_path / "a.csv")]) == 0
    shown = capsys.readouterr().out
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    assert f"{lost.sum()} lost, {lost.sum()} of them filled" in shown
    assert table.shape[0] == 5000 and table[:, 1].sum() == lost.sum()
    assert np.allclose(np.diff(table[:, 2]), 2e-4, atol=1e-9)
    assert main(["replay", str(tmp_path / "a.blf"), "--drive", toml(tmp_path), "--out",
                 str(tmp_path / "b.csv")]) == 0
    native = np.loadtxt(tmp_path / "b.csv", delimiter=",", skiprows=1)
    keep = [k for k in range(11) if k not in (0, 7)]
    assert np.allclose(table[:, keep], native[:, keep], rtol=1e-6, atol=1e-6)


def test_tracking_is_the_same_whatever_the_blocks_and_leaves_out_what_is_apart() -> None:
    inverter = load_map("ipmsm_can")
    block = drive_frames(Protocol(), 0.2)
    block = block.take(np.random.default_rng(2).random(len(block)) > 0.02)
    whole = run(block, inverter)
    whole.quality[200:205] |= VOLTAGE_APART
    whole.quality[300:330] |= CURRENT_APART
    whole.i_beta[400] = np.nan
    whole.gap[600] = RESTARTED
    rows: list[list[RowBlock]] = []
    for edges in ([0, len(whole)], [0, 1, 2, 199, 203, 310, 400, 401, 600, len(whole)]):
        rows.append([])
        tracking = MappedTracking(config(), inverter, 5000.0, rows[-1].append)
        for a, b in pairwise(edges):
            names = MappedBlock.__dataclass_fields__
            tracking.feed(MappedBlock(**{n: np.ascontiguousarray(getattr(whole, n)[..., a:b]) for n in names}))
        assert tracking.unusable == 36
    for name in RowBlock.__dataclass_fields__:
        assert np.array_equal(column(rows[0], name), column(rows[1], name)), name
    # 30 samples and what was lost among them are more than max_gap: a hole, not a straight line
    step = np.diff(column(rows[0], "sample"))
    assert step.max() >= 31 and np.count_nonzero(step > 1) == 1
    assert column(rows[0], "filled").sum() >= 6


def test_replay_of_a_slow_drive_gives_steady_state_quantities(tmp_path: Path, car: str, capsys: Capture) -> None:
    out, drive = tmp_path / "a.csv", tmp_path / "drive.toml"
    drive.write_text('[motor]\npreset = "m2"\npole_pairs = 4\nrated_torque = 30\n')
    assert main(["replay", car, "--drive", str(drive), "--map", "cascadia_pm", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "no fast observer: the voltage is a momentary value" in shown
    found = re.search(r"psi_m +([\d.]+) Wb, scatter ([\d.e-]+); drive.toml has 0.59", shown)
    assert found and abs(float(found[1]) - 0.59) < 2e-3 and float(found[2]) < 5e-3
    rest = re.search(r"v_d +([+-][\d.]+) V from what R, L_q and the speed explain", shown)
    assert rest and abs(float(rest[1])) < 0.15
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table.size == 300 and np.isfinite(table["psi_m"]).sum() > 250
    assert main(["replay", car, "--drive", str(drive), "--map", "cascadia_pm", "--out",
                 str(tmp_path / "a.parquet")]) == 2
    assert "written as .csv only" in capsys.readouterr().err


def test_replay_says_what_does_not_go_together(tmp_path: Path, car: str, capsys: Capture) -> None:
    drive = toml(tmp_path)
    for arguments, told in ((["--map", "cascadia_pm", "--drive", toml(tmp_path, 1)], "--map takes one --drive"),
                            (["--node", "3"], "--node goes with --map"),
                            (["--map", "vesc"], "holds no frame of the map")):
        assert main(["replay", car, "--drive", drive, *arguments]) == 2
        assert told in capsys.readouterr().err


def test_current_without_a_voltage_is_told(tmp_path: Path, capsys: Capture) -> None:
    dbc = dbc_text({1: ("M", ['x : 0|16@1- (0.1,0) [0|0] "A"', 'y : 16|16@1- (0.1,0) [0|0] "A"'])})
    (tmp_path / "x.dbc").write_text(dbc)
    block = FrameBlock.zeros(50)
    block.can_id[:], block.length[:], block.t_ns[:] = 1, 8, np.arange(50) * 1_000_000
    write_log(tmp_path / "a.log", [block])
    (tmp_path / "x.toml").write_text('[map]\ntitle = "x"\ndbc = "x.dbc"\n[current]\nform = "alpha_beta"\n'
                                     'measure = "peak"\nalpha = "M.x"\nbeta = "M.y"\n')
    assert main(["map", "--check", str(tmp_path / "a.log"), str(tmp_path / "x.toml")]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"fast observer +no +the map has not the voltage of the motor", shown)
    assert "current.alpha (M.x) never changes: it is 0 A in all 50 reports" in shown
