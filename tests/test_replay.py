"""Replay: rows against the companion, a second opinion on every number in them, and logs with something wrong."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.api import estimate
from ipmsm_can.bus.logs import read_log, write_log
from ipmsm_can.bus.replay import EncoderComparison, Replay, SampleClock, prepare
from ipmsm_can.bus.rows import COLUMNS, RowBlock, check_rows_path, open_rows
from ipmsm_can.cli import main
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import MessageKind, Protocol, Waveform
from ipmsm_can.wire.sequence import RESTARTED, SampleRun

T0 = 1_700_000_000_000_000_000
RATE = 5000.0
DRIVE = '[motor]\npreset = "m2"\n[observer]\nalpha = 5\ngamma = 50\n[wire]\nnode = {node}\n{wire}'


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return Protocol()


def drive_frames(protocol: Protocol, seconds: float, node: int = 0, fd: bool = False, noise: float = 0.02,
                 **rates: float) -> FrameBlock:
    """What a drive at 1000 rpm with load pulses sends, an injection in the middle included."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, current_noise=noise),
                                 profile.torque_pulses(), seed=node)
    drive = DriveNode(protocol, node, simulation, DriveNodeSettings(fd=fd, **rates))
    n = int(seconds * RATE)
    first = drive.step(n // 2, T0).frames
    simulation.command_injection(int(Waveform.ROTATING), 6.0, 400.0, 0.0, int(0.25 * RATE))
    return FrameBlock.concat([first, drive.step(n - n // 2, T0).frames])


def config(node: int = 0, **wire: object) -> DriveConfig:
    return config_from({"motor": {"preset": "m2"}, "observer": {"alpha": 5, "gamma": 50},
                        "wire": {"node": node, **wire}})


def toml(tmp_path: Path, node: int = 0, wire: str = "") -> str:
    path = tmp_path / f"drive{node}.toml"
    path.write_text(DRIVE.format(node=node, wire=wire))
    return str(path)


def rows_of(frames: FrameBlock, configs: list[DriveConfig], protocol: Protocol,
            edges: list[int] | None = None) -> dict[int, list[RowBlock]]:
    found: dict[int, list[RowBlock]] = {c.wire.node: [] for c in configs}
    cuts = [0, *(edges or []), len(frames)]
    pieces = [frames.take(slice(a, b)) for a, b in pairwise(cuts)]
    chosen, again = prepare(configs, protocol, pieces)
    replay = Replay(chosen, protocol, lambda node, rows: found[node].append(rows))
    for piece in again:
        replay.feed(piece)
    return found


def column(blocks: list[RowBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(b, name) for b in blocks])


# ---- rows ---------------------------------------------------------------------------------------------

def damaged(frames: FrameBlock, seed: int) -> FrameBlock:
    """Losses, a long gap, duplicates, late frames."""
    rng = np.random.default_rng(seed)
    keep = np.flatnonzero(rng.random(len(frames)) > 0.03)
    keep = keep[(keep < 3000) | (keep > 3200)]
    rows = np.sort(np.concatenate([keep, keep[::50]]))
    late = rng.integers(0, rows.size - 3, 20)
    rows[late], rows[late + 2] = rows[late + 2].copy(), rows[late].copy()
    out = frames.take(rows)
    out.t_ns.sort()
    return out


@pytest.mark.parametrize("fd", [False, True])
def test_blocks_of_any_size_give_the_same_bytes(protocol: Protocol, tmp_path: Path, fd: bool) -> None:
    frames = damaged(drive_frames(protocol, 1.0, fd=fd), 1)
    rng = np.random.default_rng(2)
    partitions: list[list[int]] = [[], sorted(rng.integers(0, len(frames), 40).tolist()),
                                   list(range(0, len(frames), 7)), list(range(1, 200))]
    texts = []
    for k, edges in enumerate(partitions):
        file = open_rows(tmp_path / f"{k}.csv")
        for rows in rows_of(frames, [config()], protocol, edges)[0]:
            file.write(rows)
        file.close()
        texts.append((tmp_path / f"{k}.csv").read_bytes())
    assert len(texts[0].splitlines()) > 4500
    assert all(text == texts[0] for text in texts[1:])


def test_every_frame_a_block_of_its_own(protocol: Protocol) -> None:
    frames = damaged(drive_frames(protocol, 0.5), 3).take(slice(0, 1500))
    for configs in ([config()], [config(sample_rate=RATE)]):
        whole = rows_of(frames, configs, protocol)[0]
        single = rows_of(frames, configs, protocol, list(range(1, len(frames))))[0]
        for name in COLUMNS:
            assert np.array_equal(column(whole, name), column(single, name)), name


def test_rows_say_what_the_estimator_says(protocol: Protocol) -> None:
    """Undamaged log: the same numbers as `estimate` gives for the samples as the wire rounds them."""
    frames = drive_frames(protocol, 0.6)
    blocks = rows_of(frames, [config()], protocol)[0]
    label = protocol.classify(frames.raw)
    values = protocol.codecs[MessageKind.DRIVE_SAMPLE].decode(frames.take(label == 0).words)
    result = estimate(values[:2].T, values[2:4].T, RATE, M2, alpha=5.0, gamma=50.0)
    assert np.array_equal(column(blocks, "sample"), np.arange(3000))
    assert not column(blocks, "filled").any()
    assert np.array_equal(column(blocks, "theta_rad"), result.theta)
    assert np.array_equal(column(blocks, "omega_rad_s"), result.omega)
    assert np.array_equal(column(blocks, "lambda_alpha"), result.flux[:, 0])
    assert np.array_equal(column(blocks, "lambda_beta"), result.flux[:, 1])
    assert np.array_equal(column(blocks, "excitation"), result.excitation)
    assert np.array_equal(column(blocks, "valid"), result.valid)
    assert np.array_equal(column(blocks, "locked"), result.locked)
    assert 0 < column(blocks, "valid").sum() < column(blocks, "locked").sum() <= 3000
    assert np.allclose(column(blocks, "time_s"), np.arange(3000) / RATE, rtol=0, atol=1e-12)


def test_filled_rows_are_where_frames_are_missing(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 0.4)
    label = protocol.classify(frames.raw)
    samples = np.flatnonzero(label == 0)
    gone = samples[[500, 501, 502, 900, 1500]]
    kept = frames.take(np.setdiff1d(np.arange(len(frames)), gone))
    blocks = rows_of(kept, [config()], protocol)[0]
    assert np.array_equal(column(blocks, "sample"), np.arange(2000))
    assert np.flatnonzero(column(blocks, "filled")).tolist() == [500, 501, 502, 900, 1500]


def test_injecting_follows_drive_status(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 1.0)
    label = protocol.classify(frames.raw)
    codec = protocol.codecs[MessageKind.DRIVE_STATUS]
    status = np.flatnonzero(label == MessageKind.DRIVE_STATUS * 16)
    said = codec.decode_rows(frames.words, status)[codec.index["active_waveform"]] != 0
    assert said.any() and not said.all()
    expected, now = [], False
    for row in range(len(frames)):
        # A DriveStatus follows the sample of the same instant on the wire.
        if label[row] == 0:
            expected.append(now)
        elif row in status:
            now = bool(said[np.flatnonzero(status == row)[0]])
    injecting = column(rows_of(frames, [config()], protocol, [700, 2900])[0], "injecting")
    assert injecting.astype(bool).tolist() == expected


def test_sample_rate_of_the_toml_yields_to_drive_timing(protocol: Protocol) -> None:
    """Samples before the first DriveTiming get their right 32-bit counters in hindsight."""
    frames = drive_frames(protocol, 0.4)
    late = frames.take(slice(300, None))
    samples = column(rows_of(late, [config(sample_rate=RATE)], protocol)[0], "sample")
    assert samples[0] > 200
    assert np.array_equal(np.diff(samples), np.ones(samples.size - 1))
    silent = late.take(protocol.classify(late.raw) != MessageKind.DRIVE_TIMING * 16)
    blocks = rows_of(silent, [config(sample_rate=RATE)], protocol)[0]
    assert column(blocks, "sample").size == samples.size
    assert np.array_equal(column(blocks, "theta_rad"),
                          column(rows_of(late, [config()], protocol)[0], "theta_rad"))


# ---- the clock ----------------------------------------------------------------------------------------

def run_of(counter: list[int], gap: list[int] | None = None, t_ms: list[float] | None = None,
           rate: float = 1000.0) -> SampleRun:
    n = len(counter)
    t = np.array(t_ms if t_ms is not None else [float(c) for c in counter]) * 1e6
    return SampleRun(rate, np.array(counter, np.int64), np.zeros((4, n)), np.zeros(n, np.uint8),
                     np.zeros(n, np.uint8), np.array(gap or [0] * n, np.int64), t.astype(np.int64))


def test_clock_counts_samples_not_arrivals() -> None:
    clock = SampleClock()
    run = run_of([70, 71, 72, 75, 76], [0, 0, 0, 2, 0], [0, 5, 5.1, 9, 90])
    assert np.allclose(clock.times(run), [0, 0.001, 0.002, 0.005, 0.006])
    assert np.allclose(clock.times(run_of([77, 78], None, [91, 92])), [0.007, 0.008])


def test_clock_goes_through_the_wrap_of_the_counter() -> None:
    clock = SampleClock()
    last = (1 << 32) - 1
    assert np.allclose(clock.times(run_of([last - 1, last, 0, 1])), [0, 0.001, 0.002, 0.003])
    assert np.allclose(clock.times(run_of([2, 3])), [0.004, 0.005])


def test_clock_bridges_restart_rate_change_and_setting_back_by_arrival() -> None:
    clock = SampleClock()
    clock.times(run_of([1000, 1001], t_ms=[0, 1]))
    assert np.allclose(clock.times(run_of([3, 4], [RESTARTED, 0], [51, 52])), [0.051, 0.052])
    assert np.allclose(clock.times(run_of([5, 6], t_ms=[53, 53.5], rate=2000.0)), [0.053, 0.0535])
    # put right backwards, and the two arrived in the same millisecond: still forwards
    back = clock.times(run_of([-10 + 6, -9 + 6], [1, 0], [53.5, 53.5], rate=2000.0))
    assert np.allclose(back, [0.054, 0.0545])


@given(st.lists(st.integers(1, 30), min_size=1, max_size=60), st.sets(st.integers(1, 59)))
def test_clock_does_not_depend_on_blocks(steps: list[int], cuts: set[int]) -> None:
    counter = np.cumsum(steps).astype(np.int64)
    gap = np.array(steps, np.int64) - 1
    nothing = np.zeros(counter.size, np.uint8)
    run = SampleRun(7000.0, counter, np.zeros((4, counter.size)), nothing, nothing, gap, counter * 142857)
    whole = SampleClock().times(run)
    clock, parts = SampleClock(), []
    edges = [0, *sorted(c for c in cuts if c < counter.size), counter.size]
    for a, b in pairwise(edges):
        parts.append(clock.times(SampleRun(7000.0, counter[a:b], run.values[:, a:b], run.filled[a:b],
                                           run.doubt[a:b], gap[a:b], run.t_ns[a:b])))
    assert np.array_equal(whole, np.concatenate(parts))
    assert (np.diff(whole) > 0).all()
    assert np.allclose(whole, (counter - counter[0]) / 7000.0)


# ---- encoder ------------------------------------------------------------------------------------------

def test_encoder_comparison_by_hand() -> None:
    c = EncoderComparison()
    c.estimate(np.array([10, 11, 12]), np.array([3.1, 0.1, 0.2]), np.array([True, True, False]))
    c.reference(np.array([10, 11, 12, 14]), np.array([-3.1, 0.1, 1.0, 0.5]))
    c.estimate(np.array([13, 14]), np.array([0.0, 0.8]), np.array([True, True]))
    errors = [2 * math.pi - 6.2, 0.0, 0.3]
    assert (c.references, c.compared) == (4, 3)
    assert c.rms == pytest.approx(math.sqrt(sum(e * e for e in errors) / 3))
    assert c.largest == pytest.approx(0.3)


def test_encoder_error_is_that_of_the_truth(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 1.0)
    found: list[RowBlock] = []
    replay = Replay([config()], protocol, lambda _, rows: found.append(rows))
    for begin in range(0, len(frames), 501):
        replay.feed(frames.take(slice(begin, begin + 501)))
    label = protocol.classify(frames.raw)
    codec = protocol.codecs[MessageKind.DRIVE_REFERENCE]
    truth = codec.decode(frames.take(label == MessageKind.DRIVE_REFERENCE * 16).words)
    at = truth[codec.index["sample_counter"]].astype(int)
    theta, valid = column(found, "theta_rad")[at], column(found, "valid")[at].astype(bool)
    error = np.angle(np.exp(1j * (theta - truth[codec.index["theta_e"]])))[valid]
    summary = replay.summaries[0]
    assert summary.encoder.compared == error.size > 400
    assert summary.encoder.rms == pytest.approx(np.sqrt(np.mean(error**2)))
    assert summary.encoder.largest == pytest.approx(np.abs(error).max())
    assert summary.rows == 5000 and summary.valid == column(found, "valid").sum()
    assert summary.first_valid == pytest.approx(np.argmax(column(found, "valid")) / RATE)


# ---- files --------------------------------------------------------------------------------------------

def some_rows(reals: list[float]) -> RowBlock:
    n = len(reals)
    x = np.array(reals)
    flag = (np.arange(n) % 2).astype(np.uint8)
    return RowBlock(np.arange(n) + (1 << 32) - n, flag, np.arange(n) / 7000.0, x, -x, 1 - flag, flag, flag, x, x, x)


@given(st.lists(st.floats() | st.floats(-10, 10) | st.integers(-10**6, 10**6).map(lambda k: k / 1000),
                min_size=1, max_size=20))
def test_numbers_are_written_as_python_writes_them(tmp_path_factory: pytest.TempPathFactory,
                                                   reals: list[float]) -> None:
    path = tmp_path_factory.mktemp("rows") / "a.csv"
    rows = some_rows(reals)
    file = open_rows(path)
    file.write(rows)
    file.close()
    with path.open(newline="") as stream:
        table = list(csv.reader(stream))
    assert tuple(table[0]) == COLUMNS
    for k, line in enumerate(table[1:]):
        assert line[0] == str(rows.sample[k])
        assert [line[1], line[5], line[6], line[7]] == [str(int(v[k])) for v in (
            rows.filled, rows.valid, rows.locked, rows.injecting)]
        assert abs(float(line[2]) - rows.time_s[k]) < 6e-10
        for text, value in zip(line[3:5], (reals[k], -reals[k]), strict=True):
            if abs(value) < 1e-280:
                assert abs(float(text)) <= 1e-280
            elif math.isinf(float(format(value, ".10g"))):
                assert float(text) in (value, math.copysign(math.inf, value))  # ten digits round it up to there
            elif math.isfinite(value):
                # the last digit may differ where the eleventh is a five
                assert float(text) == pytest.approx(value, rel=5.1e-10)
                assert len(text) <= len(format(value, ".10g")) + 1
            else:
                assert text == format(value, ".10g")
        assert line[8] == line[9] == line[10] == line[3]
    assert len(table) == len(reals) + 1


@pytest.mark.parametrize("value", [0.1, 1.0, 123456.0, 9999999999.0, 9.99999999996, 1e10, 1e-4, 9.99e-5, 0.00012345,
                                   3.14159265358979, 1e100, 2.5e-100, 1e22, 512.0, 1000.5])
def test_the_layout_of_a_number(tmp_path: Path, value: float) -> None:
    file = open_rows(tmp_path / "a.csv")
    file.write(some_rows([value]))
    file.close()
    assert (tmp_path / "a.csv").read_text().splitlines()[1].split(",")[3] == format(value, ".10g")


def test_parquet_keeps_every_bit(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rng = np.random.default_rng(0)
    rows = some_rows(rng.normal(size=1000).tolist())
    file = open_rows(tmp_path / "a.parquet")
    file.write(rows)
    file.write(rows)
    file.close()
    table = parquet.read_table(tmp_path / "a.parquet")
    assert tuple(table.column_names) == COLUMNS
    for name in COLUMNS:
        assert np.array_equal(table[name].to_numpy(), np.tile(getattr(rows, name), 2)), name


@pytest.mark.parametrize(("name", "words"), [("a.txt", "allowed are .csv and .parquet"), ("a", "suffix ''"),
                                             ("nowhere/a.csv", "does not exist")])
def test_paths_that_cannot_be(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_rows_path(tmp_path / name)


def test_without_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ValueError, match="needs the package pyarrow"):
        check_rows_path(tmp_path / "a.parquet")


def test_a_full_disk_is_an_error(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    link = tmp_path / "a.csv"
    link.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space"):
        file = open_rows(link)
        file.write(some_rows([1.0]))
        file.close()


# ---- the command --------------------------------------------------------------------------------------

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
        assert main(["replay", str(log), "--drive", toml(tmp_path), "--out", str(out)]) == 1
        errors = capsys.readouterr().err
        assert len(errors.splitlines()) == 1 and str(log) in errors
        lines = out.read_bytes().splitlines()
        assert 2000 < len(lines) < 10001
        assert len(lines[-1].split(b",")) == 11


def test_a_half_line_at_the_end(tmp_path: Path, protocol: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    write_log(log, [drive_frames(protocol, 0.2)])
    log.write_bytes(log.read_bytes()[:-30])
    assert main(["replay", str(log), "--drive", toml(tmp_path)]) == 1
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
    from ipmsm_can.bus import logs

    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    frames = drive_frames(protocol, 0.4)

    class Interrupted:
        problem, bad_lines = "", 0

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
