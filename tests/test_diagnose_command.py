"""`ipmsm-can diagnose`: the same findings from every format, one sentence for bad files, a page without network."""

from __future__ import annotations

import json
import re
import threading
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.drive_runner import DriveRunner
from ipmsm_can.bus.port import open_port
from ipmsm_can.cli import main
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.writer import write_log
from ipmsm_can.mapping.load import map_folder
from ipmsm_can.wire.protocol import Protocol
from tests import mapping_traffic
from tests.test_mapping_drives import cascadia
from tests.test_mapping_live import run_live
from tools.faults import FAULTS, Drive, config, frames, healthy, ordinary_profile

PROTOCOL = Protocol()
DBC = Path(__file__).parents[1] / "dbc" / "ipmsm_can.dbc"


def drive(what: str | None, seconds: float = 2.5) -> Drive:
    import numpy as np

    d = healthy(3, 100)
    d = replace(d, profile=ordinary_profile(np.random.default_rng(4), 0.5 * d.plate.rated_torque, seconds))
    return d if what is None else next(breaks for words, _, breaks in FAULTS if words == what)(d)


def toml(folder: Path, d: Drive, more: str = "") -> str:
    motor = config(d).motor.model_dump(exclude_none=True)
    path = folder / "drive.toml"
    path.write_text("[motor]\n" + "".join(f"{key} = {value}\n" for key, value in motor.items()) + more)
    return str(path)


@pytest.fixture(scope="module")
def late() -> FrameBlock:
    return frames(drive("voltage 0.8 samples late"), PROTOCOL)


def test_the_same_findings_from_every_format(tmp_path: Path, late: FrameBlock) -> None:
    given = toml(tmp_path, drive(None))
    found = {}
    for suffix in ("log", "asc", "blf", "mf4"):
        if suffix == "mf4":
            pytest.importorskip("asammdf")
        path = tmp_path / f"run.{suffix}"
        write_log(path, [late])
        assert main(["diagnose", str(path), "--drive", given, "--json", str(tmp_path / "out.json")]) == 1
        found[suffix] = json.loads((tmp_path / "out.json").read_text())
        found[suffix].pop("source")
    assert found["log"]["findings"][0]["code"] == "voltage.delay"
    for suffix, report in found.items():
        assert report == found["log"], suffix


def test_a_page_and_its_json(tmp_path: Path, late: FrameBlock, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "run.blf", [late])
    page = tmp_path / "diagnosis.html"
    given = toml(tmp_path, drive(None))
    assert main(["diagnose", str(tmp_path / "run.blf"), "--drive", given, "--out", str(page)]) == 1
    text = page.read_text()
    assert not re.search(r'(?:src|href)=|url\(|https?://|@import', text), "the page must load nothing"
    assert "voltage.delay" in text and "<script>" in text
    data = json.loads((tmp_path / "diagnosis.json").read_text())
    assert data["worst"] == "warning"
    for finding in data["findings"]:
        assert finding["code"] in text
    assert str(page) in capsys.readouterr().out
    # Every picture is well-formed and its data lie within its frame.
    pictures = re.findall(r"<svg viewBox=.*?</svg>", text)
    assert len(pictures) >= 4
    for picture in pictures:
        root = ET.fromstring(picture)
        x, y, width, height = map(float, root.attrib["viewBox"].split())
        for path in root.iter("path"):
            if "data-series" not in path.attrib:
                continue
            points = [tuple(map(float, p.replace("h0", "").split()))
                      for p in re.split("[ML]", path.attrib["d"]) if p]
            assert points
            slack = 1e-3 * max(width, height, 1.0)
            assert all(x - slack <= px <= x + width + slack and y - slack <= py <= y + height + slack
                       for px, py in points)


def test_a_sound_drive_ends_with_0_and_says_what_was_looked_at(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "run.log", [frames(drive(None), PROTOCOL)])
    assert main(["diagnose", str(tmp_path / "run.log"), "--drive", toml(tmp_path, drive(None))]) == 0
    said = capsys.readouterr().out
    assert "Nothing found." in said
    assert "looked at, and fine:" in said and "signs and order of phases" in said


def test_json_on_the_terminal_is_nothing_but_json(tmp_path: Path, late: FrameBlock,
                                                  capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "run.log", [late])
    assert main(["diagnose", str(tmp_path / "run.log"), "--drive", toml(tmp_path, drive(None)), "--json", "-"]) == 1
    assert json.loads(capsys.readouterr().out)["findings"][0]["code"] == "voltage.delay"


def test_through_a_map_the_findings_are_the_same(tmp_path: Path, late: FrameBlock) -> None:
    write_log(tmp_path / "run.log", [late])
    codes = {}
    for how, more in {"wire": [], "map": ["--map", "ipmsm_can"]}.items():
        out = tmp_path / f"{how}.json"
        assert main(["diagnose", str(tmp_path / "run.log"), "--drive", toml(tmp_path, drive(None)), "--json",
                     str(out), *more]) == 1
        codes[how] = [f["code"] for f in json.loads(out.read_text())["findings"]]
    assert codes["map"][0] == codes["wire"][0] == "voltage.delay"


def refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """The one sentence that a refused command says."""
    assert main(["diagnose", *args]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    said = [line for line in said if not line.startswith(("compiling", "note:"))]
    assert len(said) == 1, said
    assert said[0].startswith("ipmsm-can diagnose: ") and "Traceback" not in said[0]
    return said[0]


def test_bad_files_give_one_sentence_and_2(tmp_path: Path, late: FrameBlock,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    log, given = tmp_path / "run.blf", toml(tmp_path, drive(None))
    write_log(log, [late])
    whole = log.read_bytes()
    cut = tmp_path / "cut.blf"
    cut.write_bytes(whole[:200])
    assert "is cut off" in refused(capsys, str(cut), "--drive", given)
    cut.write_bytes(whole[:len(whole) // 2])
    assert "what was readable is in the report" in refused(capsys, str(cut), "--drive", given)
    assert "does not exist" in refused(capsys, str(tmp_path / "none.blf"), "--drive", given)
    assert "has the suffix" in refused(capsys, given, "--drive", given)
    assert "node 3" in refused(capsys, str(log), "--drive", toml(tmp_path, drive(None), "[wire]\nnode = 3\n"))
    bad = tmp_path / "bad.dbc"
    bad.write_text("BO_ 256 DriveSample: 8 X\n SG_ i_alpha : nonsense\n")
    assert "bad.dbc" in refused(capsys, str(log), "--drive",
                                toml(tmp_path, drive(None), '[wire]\ndbc = "bad.dbc"\n'))
    bad.write_text(DBC.read_text().replace("SG_ i_alpha ", "SG_ i_alfa "))
    assert "lacks the signals i_alpha" in refused(capsys, str(log), "--drive",
                                                  toml(tmp_path, drive(None), '[wire]\ndbc = "bad.dbc"\n'))


def test_bad_maps_and_options_give_one_sentence_and_2(tmp_path: Path, late: FrameBlock,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    log, given = tmp_path / "run.blf", toml(tmp_path, drive(None))
    write_log(log, [late])
    assert "holds no frame of the map" in refused(capsys, str(log), "--drive", given, "--map", "cascadia_pm")
    assert "shipped are" in refused(capsys, str(log), "--drive", given, "--map", "no_such_map")
    shipped = Path(__file__).parents[1] / "dbc" / "maps" / "ipmsm_can.toml"
    broken = tmp_path / "broken.toml"
    text = shipped.read_text().replace("i_alpha", "i_alfa")
    broken.write_text(re.sub(r'dbc = ".*"', f'dbc = "{DBC}"', text))
    assert "i_alfa" in refused(capsys, str(log), "--drive", given, "--map", str(broken))
    assert "ends in .html" in refused(capsys, str(log), "--drive", given, "--out", str(tmp_path / "x.txt"))
    assert "input files" in refused(capsys, str(log), "--drive", given, "--json", given)
    assert "neither a LOG was named nor a bus" in refused(capsys, "--drive", given)
    assert "both the log" in refused(capsys, str(log), "--drive", given, "-i", "virtual", "-c", "0")
    live = ("--drive", given, "-i", "virtual", "-c", "0")
    assert "--node goes with --map" in refused(capsys, *live, "--node", "3")
    assert "shipped are" in refused(capsys, *live, "--map", "no_such_map")


def test_a_silent_bus_gives_one_sentence_and_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "--drive", toml(tmp_path, drive(None)), "-i", "virtual", "-c", "diagnose_silent",
                   "--duration", "0.2")
    assert "no sample of drive 0 came" in said


def test_live_it_listens_to_the_bus_and_sends_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    d = drive("current reversed", 30.0)
    channel = "diagnose_live"
    options = {"interface": "virtual", "channel": channel, "fd": True}
    with open_port(options) as bus, open_port(options) as witness:
        simulation = DriveSimulation(d.true, d.parameters, d.profile, d.theta_0, d.seed)
        simulation.run(int(0.4 * d.parameters.sample_rate))  # beyond its first standstill
        runner = DriveRunner(bus, [DriveNode(PROTOCOL, 0, simulation, replace(d.settings, fd=True), d.faults)])
        done = threading.Event()
        thread = threading.Thread(target=runner.run, args=(done.is_set,))
        thread.start()
        try:
            code = main(["diagnose", "--drive", toml(tmp_path, d), "-i", "virtual", "-c", channel, "--fd",
                         "--duration", "2.5"])
        finally:
            done.set()
            thread.join()
        assert code == 1
        assert "ERROR: the current is reversed" in capsys.readouterr().out
        heard = 0
        while len(block := witness.receive(0.1)):
            heard += len(block)
        assert heard == runner.sent, "somebody else sent"


def test_live_through_a_map_it_finds_what_it_finds_in_a_log_and_sends_nothing(
        tmp_path: Path, late: FrameBlock, capsys: pytest.CaptureFixture[str]) -> None:
    given, log = Path(toml(tmp_path, drive(None))), tmp_path / "run.log"
    write_log(log, [late])
    assert main(["diagnose", str(log), "--drive", str(given), "--map", "ipmsm_can"]) == 1
    recorded = capsys.readouterr().out.splitlines()
    code, said, heard = run_live(given, "ipmsm_can", late, capsys, command="diagnose")
    assert code == 1 and not heard
    begin = next(k for k, line in enumerate(recorded) if line.startswith("length"))
    source, *report = said.splitlines()
    assert source == "ipmsm_can (virtual through python-can) with the map ipmsm_can"
    figure = re.compile(r"[\d.]+")  # python-can's time stamps are floats: the last digit of a figure may differ
    assert [figure.sub("#", line) for line in report] == [figure.sub("#", line) for line in recorded[begin:]]
    assert report[0] == recorded[begin]
    assert "WARNING: the voltage is late" in report


def test_live_through_a_map_it_says_why_nothing_can_be_said(tmp_path: Path, late: FrameBlock,
                                                            capsys: pytest.CaptureFixture[str]) -> None:
    given = Path(toml(tmp_path, drive(None)))
    silent = cascadia(seconds=0.5)
    silent = silent.take(silent.can_id != 0xA7)  # the message of the voltages
    for block, why in ((late.take(slice(0, 20)), "holds no frame of the map (identifiers 0x0A5"),
                       (silent, "nothing can be made of the signals: the voltage is a momentary value"),
                       (silent, "none of the samples have current, voltage and speed"),
                       (late.take(slice(0, 0)), "no frame came on cascadia_pm")):
        code, said, _ = run_live(given, "cascadia_pm", block, capsys, command="diagnose")
        assert code == 2 and why in said and "Traceback" not in said, said


def test_a_map_without_a_voltage_allows_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t = np.arange(100) * 2e-2
    block = mapping_traffic.frames(map_folder() / "vesc.dbc", {
        "VESC_Status": (t, {"erpm": 3000.0, "current": 5.0 + t, "duty": 0.2})})
    write_log(tmp_path / "run.log", [block])
    said = refused(capsys, str(tmp_path / "run.log"), "--drive", toml(tmp_path, drive(None)), "--map", "vesc")
    assert "neither those of the fast observer (the map has not the voltage of the motor) nor of the " in said
