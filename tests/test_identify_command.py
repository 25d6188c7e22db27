"""`ipmsm-can identify` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ipmsm_can.cli import main
from ipmsm_can.config import load_config
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.logs import write_log
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import Protocol
from tools.identification import drawn, running

TOML = """\
# my drive
[motor]
preset = "m2"   # from the plate
R = "1.1 ohm"   # measured cold

[wire]
dbc = "mine.dbc"
# keep me
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("identify")
    d = drawn("m2", 5)
    simulation = DriveSimulation(d.motor, d.parameters, running("m2"), d.theta_0, d.seed)
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings())
    write_log(folder / "run.blf", [node.step(int(2.5 * d.parameters.sample_rate), 10**18).frames])
    (folder / "drive.toml").write_text(TOML)
    (folder / "mine.dbc").write_bytes(default_dbc_path().read_bytes())
    (folder / "elsewhere").mkdir()
    return folder


def test_a_drive_toml_is_written_that_loads(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "elsewhere" / "found.toml"
    log, drive = folder / "run.blf", folder / "drive.toml"
    assert main(["identify", str(log), "--drive", str(drive), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "L_q" in shown and f"wrote {out}" in shown
    assert max(map(len, shown.splitlines()[:-1])) < 120
    text = out.read_text()
    for kept in ("# my drive", "# keep me", 'preset = "m2"   # from the plate', "measured cold"):
        assert kept in text
    motor, true = load_config(out).build_motor(), drawn("m2", 5).motor
    for name, share in (("R", 0.05), ("L_d", 0.05), ("L_q", 0.03), ("psi_m", 0.01)):
        assert getattr(motor, name) == pytest.approx(getattr(true, name), rel=share), name
    assert motor.pole_pairs == true.pole_pairs
    assert load_config(out).wire.dbc is not None
    assert (folder / "drive.toml").read_text() == TOML


def test_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(folder / "run.blf"), "--drive", str(folder / "drive.toml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["method"] == "encoder" and found["parameters"]["psi_m"]["told"]
    assert found["parameters"]["psi_m"]["low"] < drawn("m2", 5).motor.psi_m * 1.0001


@pytest.mark.parametrize(("arguments", "sentence"), [
    (["run.blf", "--out", "drive.toml"], "is one of the input files"),
    (["run.blf", "--out", "found.csv"], "allowed is a .toml file"),
    (["run.blf", "--out", "nowhere/found.toml"], "does not exist"),
    (["missing.blf"], "does not exist"),
    (["run.blf", "--node", "3"], "--node goes with --map"),
])
def test_bad_input(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
                   arguments: list[str], sentence: str) -> None:
    monkeypatch.chdir(folder)
    assert main(["identify", *arguments, "--drive", "drive.toml"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("ipmsm-can identify: ") and sentence in said and said.count("\n") == 1


def test_a_log_that_is_cut_off_is_used_as_far_as_it_goes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (folder / "run.blf").read_bytes()
    cut = folder / "cut.blf"
    cut.write_bytes(whole[:int(0.8 * len(whole))])
    assert main(["identify", str(cut), "--drive", str(folder / "drive.toml")]) == 2
    shown = capsys.readouterr()
    assert "what was readable is used" in shown.err and "psi_m" in shown.out


def test_a_log_of_another_bus(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "other.toml").write_text('[motor]\npreset = "m2"\n[wire]\nnode = 4\n')
    assert main(["identify", str(folder / "run.blf"), "--drive", str(folder / "other.toml")]) == 2
    assert "holds no sample frame of node 4" in capsys.readouterr().err
