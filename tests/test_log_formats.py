"""The same drive in every format: the same frames, and the same estimates of them.  MF4 and packed logs."""

from __future__ import annotations

import builtins
import gc
import gzip
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from ipmsm_can.bus.pythoncan import block_from_messages, messages_from_block
from ipmsm_can.cli import main
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CANFD_FDF, FrameBlock
from ipmsm_can.logs import LogError, read_log, write_log
from ipmsm_can.wire.protocol import Protocol
from tests.mf4_files import write_mf4
from tests.replaying import drive_frames, toml
from tests.test_logs import random_block

FORMATS = (".log", ".blf", ".asc", ".mf4")


def write(path: Path, block: FrameBlock) -> None:
    """In the format of the suffix, .gz allowed."""
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    if plain.suffix == ".mf4":
        write_mf4(plain, block)
    else:
        write_log(plain, [block])
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(plain.read_bytes(), 1))
        plain.unlink()


@pytest.fixture(scope="module")
def drive() -> FrameBlock:
    """100,000 frames, at times that every format can hold: whole us, the first on a whole ms."""
    frames = drive_frames(Protocol(), 18.1)
    return FrameBlock(frames.raw, frames.t_ns // 1000 * 1000).take(slice(0, 100_000))


def test_identical_from_every_format(tmp_path: Path, drive: FrameBlock,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    assert len(drive) == 100_000
    results = {}
    for suffix in FORMATS:
        path, out = tmp_path / f"run{suffix}", tmp_path / f"run{suffix}.csv"
        write(path, drive)
        reader = read_log(path)
        found = FrameBlock.concat(reader)
        assert np.array_equal(found.raw, drive.raw), suffix
        # python-can's readers go through a float of seconds since 1970; MF4 holds one since its start
        most = {".log": 0, ".blf": 0, ".asc": 500, ".mf4": 5}[suffix]
        assert np.abs(found.t_ns - drive.t_ns).max() <= most, suffix
        assert reader.problem == "" and reader.bad_lines == 0 and reader.passed_over == 0 and reader.done == 1.0
        assert main(["replay", str(path), "--drive", toml(tmp_path), "--out", str(out)]) == 0
        shown = capsys.readouterr().out.split("replayed ")[0]
        results[suffix] = (out.read_bytes(), shown)
    assert len(results[".log"][0].splitlines()) > 80_000
    for suffix in FORMATS[1:]:
        assert results[suffix] == results[".log"], suffix


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".mf4", ".csv", ".trc", ".db"])
def test_packed_is_the_same(tmp_path: Path, drive: FrameBlock, suffix: str) -> None:
    few = drive.take(slice(0, 3000))
    write(tmp_path / f"a.b{suffix}", few)
    plain = FrameBlock.concat(read_log(tmp_path / f"a.b{suffix}"))
    (tmp_path / f"a.b{suffix}").unlink()  # a database would be added to
    write(tmp_path / f"a.b{suffix}.gz", few)
    reader = read_log(tmp_path / f"a.b{suffix}.gz", block_frames=700)
    packed = FrameBlock.concat(reader)
    assert np.array_equal(packed.raw, few.raw) and np.array_equal(packed.t_ns, plain.t_ns)
    assert reader.problem == "" and reader.done == 1.0
    whole = (tmp_path / f"a.b{suffix}.gz").read_bytes()
    (tmp_path / f"cut{suffix}.gz").write_bytes(whole[:len(whole) * 2 // 3])
    reader = read_log(tmp_path / f"cut{suffix}.gz")
    try:
        count = sum(len(b) for b in reader)
    except LogError as error:
        assert suffix in (".mf4", ".db") and "cut off" in str(error)  # their tables of contents stand at the end
    else:
        assert 0 < count < 3000 and str(tmp_path) in reader.problem


def test_progress_grows_to_one(tmp_path: Path, drive: FrameBlock) -> None:
    for suffix in FORMATS:
        write(tmp_path / f"a{suffix}", drive)
        reader = read_log(tmp_path / f"a{suffix}", block_frames=5000)
        done = [reader.done for _ in reader]
        assert len(done) == 20
        assert done == sorted(done) and 0.0 < done[0] < 0.7 <= done[-2] <= 1.0, suffix
        assert reader.done == 1.0


def test_bounded_blocks_whatever_the_log(tmp_path: Path, drive: FrameBlock) -> None:
    for suffix in FORMATS:
        write(tmp_path / f"a{suffix}", drive.take(slice(0, 2050)))
        parts = list(read_log(tmp_path / f"a{suffix}", block_frames=500))
        assert [len(p) for p in parts] == [500, 500, 500, 500, 50], suffix
        assert np.array_equal(FrameBlock.concat(parts).raw, drive.raw[:2050])


# ---- MF4 ----------------------------------------------------------------------------------------------

def test_mf4_every_kind_of_frame(tmp_path: Path) -> None:
    """Data, error and remote frames are in three groups, and come out in the order of time."""
    path, block = tmp_path / "a.mf4", random_block(3000, 21)
    write_mf4(path, block)
    found = FrameBlock.concat(read_log(path, block_frames=999))
    assert np.array_equal(found.raw, block.raw) and np.abs(found.t_ns - block.t_ns).max() <= 5
    oracle = block_from_messages(can.LogReader(path))
    assert np.array_equal(found.raw, oracle.raw) and np.abs(found.t_ns - oracle.t_ns).max() <= 250


def test_mf4_written_by_python_can(tmp_path: Path) -> None:
    path, block = tmp_path / "a.mf4", random_block(300, 22)
    with can.Logger(path) as logger:
        for number, message in enumerate(messages_from_block(block)):
            message.channel = number % 2
            logger.on_message_received(message)
    found = FrameBlock.concat(read_log(path))
    oracle = list(can.LogReader(path))
    assert np.array_equal(found.raw, block_from_messages(oracle).raw) and np.array_equal(found.raw, block.raw)
    assert np.abs(found.t_ns - block.t_ns).max() <= 1000
    for channel in (0, 1):
        part = FrameBlock.concat(read_log(path, channel=str(channel)))
        assert np.array_equal(part.raw, block.raw[channel::2])


def test_mf4_with_the_least_a_recorder_writes(tmp_path: Path) -> None:
    """No DataLength and no EDL: the DLC tells the length, at most 8.  Bit 31 of the identifier tells extended."""
    block = random_block(500, 23, errors=False)
    plain = block.take((block.flags & CANFD_FDF == 0) & (block.can_id & 0x40000000 == 0))
    assert (plain.can_id & CAN_EFF_FLAG != 0).any()
    ids = plain.can_id.copy()
    write_mf4(tmp_path / "a.mf4", plain, dlc_only=True)
    found = FrameBlock.concat(read_log(tmp_path / "a.mf4"))
    assert np.array_equal(found.can_id & 0x1FFFFFFF, ids & 0x1FFFFFFF)
    assert np.array_equal(found.length, plain.length) and np.array_equal(found.data, plain.data)


def test_mf4_channels(tmp_path: Path) -> None:
    block = random_block(200, 24)
    channels = np.arange(200) % 3 + 1
    write_mf4(tmp_path / "a.mf4", block, channels)
    assert np.array_equal(FrameBlock.concat(read_log(tmp_path / "a.mf4", channel="can2")).raw, block.raw[1::3])


def test_mf4_merges_many_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records are fetched in portions that end at other times in each group."""
    block = random_block(1000, 25)
    assert (block.can_id & CAN_ERR_FLAG != 0).any()
    write_mf4(tmp_path / "a.mf4", block)
    for portion in (1, 7, 100):
        monkeypatch.setattr("ipmsm_can.logs.mf4._RECORDS", portion)
        assert np.array_equal(FrameBlock.concat(read_log(tmp_path / "a.mf4", block_frames=64)).raw, block.raw)


def test_mf4_that_holds_no_bus(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append(Signal(name="speed", samples=np.arange(5.0), timestamps=np.arange(5.0)))
        file.save(tmp_path / "a.mf4")
    with pytest.raises(LogError, match="holds no CAN bus logging"):
        list(read_log(tmp_path / "a.mf4"))


def test_mf4_without_asammdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                             capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mf4").write_bytes(b"MDF     4.10")
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "asammdf":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    assert main(["replay", str(tmp_path / "a.mf4"), "--drive", toml(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "needs the package asammdf" in told and "pip install 'ipmsm_can[mf4]'" in told
    assert len(told.splitlines()) == 1


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_mf4_cut_off_says_so(tmp_path: Path, drive: FrameBlock) -> None:
    write_mf4(tmp_path / "a.mf4", drive.take(slice(0, 5000)))
    whole = (tmp_path / "a.mf4").read_bytes()
    for cut in (10, 64, 200, 1000, len(whole) // 3, len(whole) // 2, len(whole) - 500, len(whole) - 1):
        path = tmp_path / "cut.mf4"
        path.write_bytes(whole[:cut])
        reader = read_log(path)
        try:
            found = FrameBlock.concat(reader)
        except LogError as error:
            assert f"{path} is cut off or damaged" in str(error)
            gc.collect()
        else:
            assert np.array_equal(found.raw, drive.raw[:len(found)])
            assert reader.problem or len(found) == 5000
