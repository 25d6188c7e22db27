"""The measurement file: asammdf reads in it what cantools decodes from the frames, and what was estimated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest

from ipmsm_can.bus.replay import Replay
from ipmsm_can.cli import main
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import Mark, write_log
from ipmsm_can.logs.source import LogError
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.record import measure
from ipmsm_can.record.measure import SAMPLE_CHANNELS, MeasureFile, MeasureRecorder
from ipmsm_can.wire.codec import SignalLayout
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import Protocol

asammdf: Any = pytest.importorskip("asammdf")
PROTOCOL = Protocol()
DATABASE: Any = cantools.database.load_file(default_dbc_path())
START = 1_700_000_000_250_000_000
MESSAGES = ("DriveTiming", "DriveStatus", "DriveReference", "PositionEstimate", "ActiveFluxEstimate",
            "CompanionStatus")


@pytest.fixture(scope="module")
def config() -> DriveConfig:
    return config_from({"motor": {"preset": "m2"}})


@pytest.fixture(scope="module")
def frames() -> FrameBlock:
    """A second of a drive at 2 kHz, with two samples missing, and every kind of answer in between."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=2000.0, current_bandwidth=100.0),
                                 constant(600.0 * RPM, 1.0, 1.0))
    drive = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings(reference_rate=200.0)).step(2000).frames
    companion = Companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL, transmit=True)
    parts = []
    for k in range(0, len(drive), 10):
        block = drive.take(slice(k, k + 10))
        parts += [block, companion.process(block, int(block.t_ns[-1]))]
    both = FrameBlock.concat(parts)
    both.t_ns[:] += START
    samples = np.flatnonzero(both.can_id == 0x100)
    kept = np.ones(len(both), bool)
    kept[samples[[700, 701]]] = False
    return both.take(kept)


def tracked(config: DriveConfig, frames: FrameBlock, path: Path, piece: int) -> list[Tracked]:
    companion = Companion([config], PROTOCOL, transmit=False)
    file = MeasureFile(path, [0], PROTOCOL)
    parts: list[Tracked] = []
    for k in range(0, len(frames), piece):
        block = frames.take(slice(k, k + piece))
        new = companion.feed(block)
        file.feed(block, new)
        parts += new
    file.mark(Mark(int(frames.t_ns[0]) + 500_000_000, "here it\nrattled"))
    file.close()
    return parts


def decoded(frames: FrameBlock, name: str) -> tuple[np.ndarray[Any, Any], list[dict[str, Any]]]:
    """Times [ns] and signals of a message, by cantools."""
    message = DATABASE.get_message_by_name(name)
    rows = np.flatnonzero(frames.can_id == message.frame_id)
    return frames.t_ns[rows], [
        message.decode(frames.data[r, :message.length].tobytes(), decode_choices=False) for r in rows]


def test_every_message_as_cantools_decodes_it(config: DriveConfig, frames: FrameBlock, tmp_path: Path,
                                              monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "BATCH", 150)  # so that groups are extended, too
    path = tmp_path / "run.mf4"
    tracked(config, frames, path, 77)
    with asammdf.MDF(path) as file:
        groups = {g.channel_group.acq_name: k for k, g in enumerate(file.groups)}
        assert set(groups) >= {"Samples", *MESSAGES}
        assert file.header.start_time.timestamp() == pytest.approx(int(frames.t_ns[0]) * 1e-9, abs=1e-6)
        assert "0.500000 s: here it rattled" in file.header.comment
        for name in MESSAGES:
            t_ns, expected = decoded(frames, name)
            assert len(expected) > 5
            for signal in DATABASE.get_message_by_name(name).signals:
                channel = file.get(signal.name, group=groups[name])
                assert channel.unit == (signal.unit or "")
                assert np.abs(channel.timestamps - 1e-9 * (t_ns - frames.t_ns[0])).max() < 1e-9
                wanted = [row[signal.name] for row in expected]
                if signal.choices and signal.scale == 1.0:
                    words = [str(signal.choices.get(v, "")) for v in wanted]
                    assert [v.decode() for v in channel.samples.tolist()] == words
                else:
                    assert channel.samples.tolist() == pytest.approx(wanted, rel=1e-14, abs=0)


def test_samples_and_estimates_on_the_time_of_the_counter(config: DriveConfig, frames: FrameBlock,
                                                          tmp_path: Path) -> None:
    path = tmp_path / "run.mf4"
    parts = tracked(config, frames, path, 501)
    with asammdf.MDF(path) as file:
        def channel(name: str) -> Any:
            return file.get(name, group=0)

        t = channel("i_alpha").timestamps
        counter = channel("sample_counter").samples
        assert np.array_equal(counter, np.arange(counter[0], counter[0] + len(counter)))
        assert np.abs(np.diff(t) - 1.0 / 2000.0).max() < 1e-9
        filled = channel("filled").samples != 0
        assert np.flatnonzero(filled).tolist() == [700, 701]
        _, samples = decoded(frames, "DriveSample")
        for name in ("i_alpha", "i_beta", "v_alpha", "v_beta"):
            expected = np.array([float(row[name]) for row in samples])
            found = channel(name).samples[~filled]
            assert found.dtype == np.float32 and np.abs(found - expected).max() <= 1e-7 * np.abs(expected).max()
            assert channel(name).unit == name[0].upper().replace("I", "A")
        flags = np.concatenate([p.estimate.flags for p in parts])
        for name, expected in (
                ("theta_e", np.concatenate([p.estimate.angle[speed.THETA_HAT] for p in parts])),
                ("omega_e", np.concatenate([p.estimate.angle[speed.OMEGA] for p in parts])),
                ("sigma_theta", np.concatenate([p.estimate.sigma for p in parts])),
                ("valid", flags & confidence.VALID != 0), ("locked", flags & confidence.LOCKED != 0)):
            assert np.array_equal(channel(name).samples, expected.astype(channel(name).samples.dtype)), name
        assert channel("valid").samples[-1] == 1 and channel("valid").samples[0] == 0
        assert {c.name for c in file.groups[0].channels} == {"time", *SAMPLE_CHANNELS}
        assert np.abs(channel("arrival_delay").samples).max() < 2e-3


def test_the_commands_make_the_same_file(config: DriveConfig, frames: FrameBlock, tmp_path: Path,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    log, toml, out = tmp_path / "run.blf", tmp_path / "drive.toml", tmp_path / "out.mf4"
    write_log(log, [frames])
    toml.write_text('[motor]\npreset = "m2"\n')
    out.write_bytes(b"old")
    assert main(["replay", str(log), "--drive", str(toml), "--out", str(out)]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    reference = tmp_path / "reference.mf4"
    tracked(config, frames, reference, 10_000)
    with asammdf.MDF(out) as a, asammdf.MDF(reference) as b:
        for name in SAMPLE_CHANNELS:
            assert np.array_equal(a.get(name, group=0).samples, b.get(name, group=0).samples), name


def test_live_in_a_thread_and_never_over_a_file(config: DriveConfig, frames: FrameBlock, tmp_path: Path) -> None:
    path = tmp_path / "run.mf4"
    recorder = MeasureRecorder(path, [0], PROTOCOL, flush_s=0.01)
    replay = Replay([config], PROTOCOL, tap=lambda block, parts: recorder.take(block, parts, FrameBlock.zeros(0)))
    for k in range(0, len(frames), 100):
        replay.feed(frames.take(slice(k, k + 100)))
    recorder.close()
    status = recorder.status()
    assert status.whole and status.frames == len(frames) and status.size == path.stat().st_size
    with asammdf.MDF(path) as file:
        assert file.groups[0].channel_group.cycles_nr == 2000
    assert [p.name for p in tmp_path.iterdir()] == ["run.mf4"], "no temporary file is left"
    with pytest.raises(LogError, match="exists, and recordings are never overwritten"):
        MeasureRecorder(path, [0], PROTOCOL)


def test_offsets_and_words_of_a_signal() -> None:
    temperature = SignalLayout("t", 0, 8, scale=0.5, offset=-40.0, unit="degC", choices={255: "broken"})
    kind, conversion = measure._stored(temperature)
    assert kind == np.uint8 and conversion == {"a": 0.5, "b": -40.0}
    assert measure._about(temperature) == "(87.5: broken)"
    assert measure._stored(SignalLayout("n", 0, 12, kind="signed")) == (np.dtype(np.int16), None)


def test_where_it_cannot_be_made(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"has the suffix '\.csv'; allowed for a measurement is \.mf4"):
        MeasureFile(tmp_path / "a.csv", [0], PROTOCOL)
    with pytest.raises(LogError, match=r"the folder .*no does not exist"):
        MeasureFile(tmp_path / "no" / "a.mf4", [0], PROTOCOL)


def test_two_drives_are_told_apart_and_nothing_at_all_is_a_file_too(tmp_path: Path, frames: FrameBlock) -> None:
    path = tmp_path / "run.mf4"
    both = [config_from({"motor": {"preset": "m2"}, "wire": {"node": n}}) for n in (0, 1)]
    other = FrameBlock(frames.raw.copy(), frames.t_ns)
    other.can_id[:] += 1
    companion = Companion(both, PROTOCOL, transmit=False)
    file = MeasureFile(path, [0, 1], PROTOCOL)
    for block in (frames, other):
        file.feed(block, companion.feed(block))
    file.close()
    with asammdf.MDF(path) as read:
        names = {g.channel_group.acq_name for g in read.groups}
        assert {"Drive 0 samples", "Drive 1 samples", "DriveStatus 0", "DriveStatus 1"} <= names
    empty = MeasureFile(tmp_path / "empty.mf4", [0], PROTOCOL)
    empty.close()
    with asammdf.MDF(tmp_path / "empty.mf4") as read:
        assert not read.groups
