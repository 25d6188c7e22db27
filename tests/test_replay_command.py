"""`ipmsm-can replay`: every format of log, and logs with something wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.rows import COLUMNS
from ipmsm_can.cli import main
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import read_log, write_log
from ipmsm_can.wire.protocol import Protocol
from tests.replaying import column, config, drive_frames, rows_of, toml


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return Protocol()


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".asc", ".blf"])
def test_every_log_format_gives_the_same_rows(tmp_path: Path, protocol: Protocol, suffix: str,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    frames = drive_frames(protocol, 0.4)
    log, out = tmp_path / f"a{suffix}", tmp_path / "a.csv"
    write_log(log, [frames])
    assert main(["replay", str(log), "--drive", toml(tmp_path), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "2000 samples over 0.400 s at 5000 Hz" in shown and "deg rms" in shown
    assert f"wrote {out}" in shown
    table = np.loadtxt(out, delimiter=",", skiprows=1)
    rows = rows_of(frames, [config()], protocol)[0]
    assert table.shape == (2000, 11)
    for k, name in enumerate(COLUMNS):
        if name != "injecting":  # other formats round arrival times
            assert np.allclose(table[:, k], column(rows, name), rtol=1e-9, atol=1e-9), name


def test_several_drives(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = drive_frames(protocol, 0.2, 0), drive_frames(protocol, 0.2, 5)
    both = FrameBlock.concat([a, b])
    both = both.take(np.argsort(both.t_ns, kind="stable"))
    write_log(tmp_path / "a.log", [both])
    arguments = ["replay", str(tmp_path / "a.log"), "--drive", toml(tmp_path, 0), "--drive", toml(tmp_path, 5),
                 "--out", str(tmp_path / "x.csv")]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "node 0: 1000 samples" in shown and "node 5: 1000 samples" in shown
    one, five = ((tmp_path / f"x.node{n}.csv").read_bytes() for n in (0, 5))
    assert one.count(b"\n") == five.count(b"\n") == 1001 and one != five
    alone = tmp_path / "alone.csv"
    assert main(["replay", str(tmp_path / "a.log"), "--drive", toml(tmp_path, 5), "--out", str(alone)]) == 0
    assert alone.read_bytes() == five


def test_a_log_cut_off_is_replayed_as_far_as_it_goes(tmp_path: Path, protocol: Protocol,
                                                     capsys: pytest.CaptureFixture[str]) -> None:
    frames = drive_frames(protocol, 2.0)
    for name in ("a.blf", "a.log.gz", "a.asc"):
        log, out = tmp_path / name, tmp_path / "a.csv"
        write_log(log, [frames.take(slice(k, k + 1000)) for k in range(0, len(frames), 1000)])
        log.write_bytes(log.read_bytes()[:int(0.7 * log.stat().st_size)])
        assert read_log(log) is not None
        assert main(["replay", str(log), "--drive", toml(tmp_path), "--out", str(out)]) == 2
        errors = capsys.readouterr().err
        assert len(errors.splitlines()) == 1 and str(log) in errors
        lines = out.read_bytes().splitlines()
        assert 2000 < len(lines) < 10001
        assert len(lines[-1].split(b",")) == 11


def test_a_half_line_at_the_end(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.2)])
    log.write_bytes(log.read_bytes()[:-30])
    assert main(["replay", str(log), "--drive", toml(tmp_path)]) == 2
    assert "1 of its lines cannot be read" in capsys.readouterr().err


def test_the_wrong_log(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.1, node=3)])
    assert main(["replay", str(log), "--drive", toml(tmp_path), "--out", str(tmp_path / "a.csv")]) == 2
    errors = capsys.readouterr().err
    assert "no sample frame of node 0 (identifiers 0x100 and 0x120)" in errors
    assert "seen were 0x103, 0x143, 0x163, 0x183" in errors
    assert not (tmp_path / "a.csv").exists()


def test_a_channel_that_is_not_in_the_log(tmp_path: Path, protocol: Protocol,
                                          capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.1, node=3)], channel="can0")
    assert main(["replay", str(log), "--drive", toml(tmp_path), "--channel", "can9"]) == 2
    assert "holds no frame of channel 'can9'" in capsys.readouterr().err
    assert main(["replay", str(log), "--drive", toml(tmp_path), "--channel", "can0"]) == 2
    assert "no sample frame of node 0 on channel 'can0' (identifiers" in capsys.readouterr().err


def test_no_drive_timing(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.1, timing_rate=0.0)])
    assert main(["replay", str(log), "--drive", toml(tmp_path)]) == 2
    assert "set wire.sample_rate" in capsys.readouterr().err
    assert main(["replay", str(log), "--drive", toml(tmp_path, wire='sample_rate = "5 kHz"\n')]) == 0


@pytest.mark.parametrize(("arguments", "words"), [
    (["missing.log", "--drive", "{toml}"], "missing.log does not exist"),
    (["{toml}", "--drive", "{toml}"], "suffix '.toml'"),
    (["{log}", "--drive", "missing.toml"], "there is no such file"),
    (["{log}", "--drive", "{toml}", "--drive", "{toml}"], "wire.node is 0"),
    (["{log}", "--drive", "{toml}", "--out", "{log}"], "allowed are .csv and .parquet"),
    (["{log}", "--drive", "{toml}", "--out", "nowhere/x.csv"], "the folder nowhere does not exist"),
])
def test_bad_input(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str], arguments: list[str],
                   words: str) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.01)])
    filled = [a.format(toml=toml(tmp_path), log=log) for a in arguments]
    assert main(["replay", *filled]) == 2
    errors = capsys.readouterr().err
    assert words in errors and len(errors.splitlines()) == 1


def test_the_log_is_never_overwritten(tmp_path: Path, protocol: Protocol,
                                      capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.csv"  # python-can's CSV log and our rows share a suffix
    write_log(log, [drive_frames(protocol, 0.01)])
    before = log.read_bytes()
    assert main(["replay", str(log), "--drive", toml(tmp_path), "--out", str(log)]) == 2
    assert "one of the input files" in capsys.readouterr().err
    assert log.read_bytes() == before


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_ctrl_c_loses_nothing_written(tmp_path: Path, protocol: Protocol, monkeypatch: pytest.MonkeyPatch,
                                      name: str) -> None:
    from ipmsm_can import logs

    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    frames = drive_frames(protocol, 0.4)

    class Interrupted:
        problem, bad_lines, passed_over = "", 0, 0

        def __init__(self, *_: object, **__: object) -> None:
            self._blocks = iter([frames.take(slice(0, 1000)), frames.take(slice(1000, 1500))])

        def __iter__(self) -> Interrupted:
            return self

        def __next__(self) -> FrameBlock:
            block = next(self._blocks, None)
            if block is None:
                raise KeyboardInterrupt
            return block

    monkeypatch.setattr(logs, "read_log", Interrupted)
    out = tmp_path / name
    assert main(["replay", "any.log", "--drive", toml(tmp_path), "--out", str(out)]) == 130
    expected = column(rows_of(frames.take(slice(0, 1500)), [config()], protocol)[0], "theta_rad")
    if name.endswith("csv"):
        assert np.allclose(np.loadtxt(out, delimiter=",", skiprows=1)[:, 3], expected, atol=1e-9)
    else:
        import pyarrow.parquet

        assert np.array_equal(pyarrow.parquet.read_table(out)["theta_rad"].to_numpy(), expected)
