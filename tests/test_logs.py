"""Logs: our candump parser against python-can's, round trips, and damaged files."""

from __future__ import annotations

import gzip
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ipmsm_can.bus.pythoncan import block_from_messages
from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FrameBlock,
)
from ipmsm_can.logs import LogError, LogWriter, read_log, write_log

LINES = """\
(1436509052.249713) vcan0 044#2A366C2BBA
(1436509052.449847) vcan0 0F6#7ADFE07BD2
(1436509052.650004) vcan1 12345678#
(1436509052.650005) can0 123#R
(1436509052.650006) can0 123#R4
(1436509052.650007) vcan0 7FF##1{fd} R
(1436509052.650008) vcan0 1FFFFFFF##3AABB T
(1436509052.650009) vcan0 00A#11.22.33
(1700000000.123456789) vcan0 00B#01\r
(1700000000.5) vcan0 00C#1122334455667788_9

(1700000001.000000) can0 20000004#0020000000006080
""".replace("{fd}", "5A" * 64)


def read_all(path: Path, **options: object) -> FrameBlock:
    return FrameBlock.concat(list(read_log(path, **options)))  # type: ignore[arg-type]


def random_block(n: int, seed: int, errors: bool = True) -> FrameBlock:
    """Clean rows of every kind of frame."""
    rng = np.random.default_rng(seed)
    block = FrameBlock.zeros(n)
    block.t_ns[:] = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 3000, n)) * 1000
    for row in range(n):
        kind = rng.integers(5 if errors else 4)
        extended = bool(rng.integers(2))
        can_id = int(rng.integers(1 << 29)) | CAN_EFF_FLAG if extended else int(rng.integers(1 << 11))
        length = int(rng.integers(9))
        if kind == 1:
            can_id |= CAN_RTR_FLAG
        elif kind == 2:
            length = int(rng.choice([0, 7, 8, 12, 16, 20, 24, 32, 48, 64]))
            block.raw[row, 5] = CANFD_FDF | int(rng.choice([0, CANFD_BRS, CANFD_ESI, CANFD_BRS | CANFD_ESI]))
        elif kind == 4:
            can_id, length = CAN_ERR_FLAG | int(rng.integers(1, 0x400)), 8
        block.can_id[row] = can_id
        block.raw[row, 4] = length
        if kind != 1:
            block.raw[row, 8:8 + length] = rng.integers(0, 256, length)
    return block


def test_lines_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(LINES)
    block = read_all(path)
    assert [hex(i) for i in block.can_id] == [hex(i) for i in (
        0x044, 0x0F6, 0x12345678 | CAN_EFF_FLAG, 0x123 | CAN_RTR_FLAG, 0x123 | CAN_RTR_FLAG, 0x7FF,
        0x1FFFFFFF | CAN_EFF_FLAG, 0x00A, 0x00B, 0x00C, CAN_ERR_FLAG | 4)]
    assert block.length.tolist() == [5, 5, 0, 0, 4, 64, 2, 3, 1, 8, 8]
    assert block.flags.tolist() == [0, 0, 0, 0, 0, 5, 7, 0, 0, 0, 0]
    assert block.data[0, :6].tobytes().hex() == "2a366c2bba00"
    assert block.data[5].tobytes() == b"\x5a" * 64
    assert block.data[10, :9].tobytes().hex() == "002000000000608000"
    assert block.t_ns[[0, 8, 9]].tolist() == [1436509052249713000, 1700000000123456789, 1700000000500000000]


def test_lines_for_people_are_read_too(tmp_path: Path) -> None:
    """What `candump -ta` prints, with the variants of -a and of error frames; times that are not absolute are not
    guessed at."""
    path = tmp_path / "a.log"
    path.write_text(
        " (1700000000.123456)  can0  1DA   [8]  0B 54 00 00 27 10 00 FF\n"
        " (1700000001.500000)  can1  18FF50E5   [3]  01 02 03\n"
        " (1700000002.000000)  can0  123   [0] \n"
        " (1700000003.000000)  can0  123   [4]  remote request\n"
        " (1700000004.000000)  can0  7FF  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B\n"
        " (1700000005.000000)  can0  321   [2]  41 42                     'AB'\n"
        " (1700000006.000000)  can0  20000040   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"
        " (000.000123)  can0  1DA   [2]  0B 54\n"
        " (1700000007.000000)  can0  1DA   [9]  00 00 00 00 00 00 00 00 00\n"
        " (1700000007.000000)  can0  1DA   [2]  0B 5\n"
        " (1700000007.000000)  can0  1DA   [2  0B 55\n"
        "  can0  1DA   [2]  0B 55\n")
    reader = read_log(path)
    block = FrameBlock.concat(reader)
    assert reader.bad_lines == 5
    assert [hex(i) for i in block.can_id] == [hex(i) for i in (
        0x1DA, 0x18FF50E5 | CAN_EFF_FLAG, 0x123, 0x123 | CAN_RTR_FLAG, 0x7FF, 0x321, 0x40 | CAN_ERR_FLAG)]
    assert block.length.tolist() == [8, 3, 0, 4, 12, 2, 8]
    assert (block.flags & CANFD_FDF).tolist() == [0, 0, 0, 0, CANFD_FDF, 0, 0]
    assert block.data[0, :9].tobytes().hex() == "0b5400002710 00ff00".replace(" ", "")
    assert block.data[4, :13].tobytes().hex() == "000102030405060708090a0b00"
    assert block.data[5, :3].tobytes() == b"AB\0"
    assert block.t_ns[:2].tolist() == [1700000000123456000, 1700000001500000000]
    assert len(read_all(path, channel="can1")) == 1


SAVVYCAN = """Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
194411100,00000109,false,1,8,00,01,00,FF,FF,FF,0F,0A
194416200,00000101,false,0,1,84
194421700,18FF50E5,true,0,7,00,00,00,00,00,00,C8
"""
SAVVYCAN_2 = """Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
194411100,00000109,false,Rx,1,8,00,01,00,FF,FF,FF,0F,0A,
194416200,00000101,false,Tx,0,1,84,
194421700,18FF50E5,true,Rx,0,7,00,00,00,00,00,00,C8,
"""


@pytest.mark.parametrize("text", [SAVVYCAN, SAVVYCAN_2])
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_savvycan_writes_another_csv(tmp_path: Path, text: str, ends: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.replace("\n", ends).encode())
    block = read_all(path)
    assert block.can_id.tolist() == [0x109, 0x101, 0x18FF50E5 | CAN_EFF_FLAG]
    assert block.length.tolist() == [8, 1, 7]
    assert block.data[0, :8].tobytes().hex() == "000100ffffff0f0a" and block.data[2, 6] == 0xC8
    assert np.abs(block.t_ns - [194411100000, 194416200000, 194421700000]).max() < 100
    assert read_all(path, channel="1").can_id.tolist() == [0x109]
    path.write_text(text + text.splitlines()[1].replace(",0A", "") + "\n")
    reader = read_log(path)
    assert len(FrameBlock.concat(reader)) == 3
    assert "a.csv cannot be read as .csv: line 5 is no frame: '194411100,00000109" in reader.problem
    path.write_text("time;id;data\n1;2;3\n")
    with pytest.raises(LogError, match="its first line is 'time;id;data'; allowed are the columns of python-can"):
        list(read_log(path))


def test_channel_picks_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(LINES)
    assert read_all(path, channel="vcan1").can_id.tolist() == [0x12345678 | CAN_EFF_FLAG]
    assert len(read_all(path, channel="can0")) == 3
    assert len(read_all(path, channel="vcan")) == 0
    asc = tmp_path / "a.asc"
    with can.Logger(asc) as logger:
        for channel in (1, 2, 2):
            logger.on_message_received(can.Message(timestamp=1.0, arbitration_id=channel, channel=channel,
                                                   is_extended_id=False))
    names = {str(m.channel) for m in can.LogReader(asc)}
    assert sorted(len(read_all(asc, channel=name)) for name in names) == [1, 2]


@pytest.mark.parametrize("suffix", [".log", ".log.gz"])
def test_candump_agrees_with_python_can(tmp_path: Path, suffix: str) -> None:
    ours, theirs = tmp_path / f"run-1.2{suffix}", tmp_path / "theirs.log"
    block = random_block(3000, 7, errors=False)
    write_log(ours, [block], "vcan0")
    if suffix.endswith(".gz"):
        theirs.write_bytes(gzip.decompress(ours.read_bytes()))
    else:
        theirs = ours
    oracle = block_from_messages(can.LogReader(theirs))
    found = read_all(ours)
    assert np.array_equal(found.raw, oracle.raw)
    assert np.abs(found.t_ns - oracle.t_ns).max() <= 240  # theirs went through a float
    assert np.array_equal(found.raw, block.raw)
    assert np.array_equal(found.t_ns, block.t_ns)


def test_python_can_wrote_it_and_we_read_it(tmp_path: Path) -> None:
    path = tmp_path / "theirs.log"
    block = random_block(1000, 9, errors=False)
    block.raw[(block.can_id & CAN_RTR_FLAG) != 0, 4] = 0  # python-can does not write a remote frame's length
    from ipmsm_can.bus.pythoncan import messages_from_block
    with can.Logger(path) as logger:
        for message in messages_from_block(block, "can3"):
            logger.on_message_received(message)
    found = read_all(path, channel="can3")
    assert np.array_equal(found.raw, block.raw)
    assert np.abs(found.t_ns - block.t_ns).max() <= 1000


def test_error_frames_survive_candump_text(tmp_path: Path) -> None:
    block = random_block(500, 3)
    assert ((block.can_id & CAN_ERR_FLAG) != 0).any()
    write_log(tmp_path / "e.log", [block])
    assert np.array_equal(read_all(tmp_path / "e.log").raw, block.raw)


def test_blocks_have_the_size_asked_for(tmp_path: Path) -> None:
    block = random_block(1003, 4)
    write_log(tmp_path / "e.log", [block.take(slice(0, 10)), block.take(slice(10, None))])
    parts = list(read_log(tmp_path / "e.log", block_frames=100))
    assert [len(p) for p in parts] == [100] * 10 + [3]
    assert np.array_equal(FrameBlock.concat(parts).raw, block.raw)


def test_pieces_of_the_file_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that fall across two reads of the file come out whole."""
    block = random_block(400, 5)
    write_log(tmp_path / "e.log", [block])
    for size in (97, 1000, 4096):
        monkeypatch.setattr("ipmsm_can.logs.candump.CHUNK_BYTES", size)
        reader = read_log(tmp_path / "e.log")
        assert np.array_equal(FrameBlock.concat(reader).raw, block.raw)
        assert reader.bad_lines == 0


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".trc", ".asc.gz", ".csv.gz"])
def test_other_formats_come_through_python_can(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(2)
    block = FrameBlock.zeros(200)
    block.can_id[:] = rng.integers(0, 0x800, 200)
    block.raw[:, 4] = 8
    block.raw[:, 8:16] = rng.integers(0, 256, (200, 8))
    block.t_ns[:] = 1_700_000_000_000_000_000 + np.arange(200) * 1_000_000
    write_log(tmp_path / f"x{suffix}", [block], "1")
    parts = list(read_log(tmp_path / f"x{suffix}", block_frames=64))
    found = FrameBlock.concat(parts)
    assert [len(p) for p in parts] == [64, 64, 64, 8]
    assert np.array_equal(found.raw, block.raw)
    assert np.abs(np.diff(found.t_ns) - 1_000_000).max() <= 2000


def test_packed_log_with_dots_in_its_name(tmp_path: Path) -> None:
    write_log(tmp_path / "x.asc.gz", [random_block(5, 1, errors=False)])
    (tmp_path / "x.asc.gz").rename(tmp_path / "run.2024.v1.asc.gz")
    assert len(read_all(tmp_path / "run.2024.v1.asc.gz")) == 5


def test_cut_off_gz_gives_what_is_there(tmp_path: Path) -> None:
    block = random_block(20_000, 8)
    write_log(tmp_path / "x.log.gz", [block])
    packed = (tmp_path / "x.log.gz").read_bytes()
    (tmp_path / "cut.log.gz").write_bytes(packed[:len(packed) * 3 // 4])
    reader = read_log(tmp_path / "cut.log.gz")
    found = FrameBlock.concat(reader)
    assert 13_000 < len(found) < 16_500
    assert np.array_equal(found.raw[:-1], block.raw[:len(found) - 1])
    assert "cut off" in reader.problem
    assert len(read_all(tmp_path / "x.log.gz")) == 20_000


def test_lines_not_understood_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    bad = ["(17.1) can0 123#1", "(17.1) can0 123#GG", "17.1 can0 123#00", "(17.1) can0 123", "(17.1) can0",
           "(1.2) can0 123456789#00", "(1.2) can0 123#112233445566778899", "(1.) can0 123#00", "(", "(1.2)",
           "(1.2) can0 123##", "(1.2) can0 123##1" + "00" * 65, "(1.2) can0 #00", "(1.2) can0 123#00x"]
    path.write_text("\n".join([*bad, "(1.2) can0 123#00"]) + "\n")
    reader = read_log(path)
    assert len(FrameBlock.concat(reader)) == 1
    assert reader.bad_lines == len(bad)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=40), st.text("(.)#R_[r] 0123456789ABCDEFx\n", max_size=40)
                          .map(str.encode)), max_size=20))
def test_rubbish_never_raises_anything_else(tmp_path: Path, lines: list[bytes]) -> None:
    path = tmp_path / "fuzz.log"
    path.write_bytes(b"\n".join([b"(1.5) can0 123#AA", *lines]))
    found = read_all(path)
    assert len(found) >= 1
    assert (found.length <= np.where(found.flags & CANFD_FDF, 64, 8)).all()


def test_sentences(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nothing\.log does not exist"):
        read_log(tmp_path / "nothing.log")
    with pytest.raises(LogError, match="is a folder"):
        read_log(tmp_path)
    (tmp_path / "a.xyz").write_text("x")
    with pytest.raises(LogError, match=r"suffix '.xyz'; allowed are .asc"):
        read_log(tmp_path / "a.xyz")
    (tmp_path / "a.log").write_text("hello\nworld\n")
    with pytest.raises(LogError, match=r"none of its 2 lines.*`candump -l can0` writes such lines"):
        list(read_log(tmp_path / "a.log"))
    for suffix in (".blf", ".mf4", ".db"):
        path = tmp_path / f"broken{suffix}"
        path.write_bytes(b"\x00\x01nonsense" * 50)
        with pytest.raises(LogError, match=f"broken{suffix} cannot be read as {suffix}"):
            list(read_log(path))
    (tmp_path / "a.log.gz").write_bytes(b"not packed at all")
    with pytest.raises(LogError, match="cut off or damaged"):
        list(read_log(tmp_path / "a.log.gz"))
    with pytest.raises(LogError, match="cannot be written"):
        LogWriter(tmp_path / "no" / "folder.log")
    with pytest.raises(LogError, match="cannot be written"):
        LogWriter(tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="block_frames is 0"):
        read_log(tmp_path / "a.log", block_frames=0)


def test_an_empty_log_has_no_blocks(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("")
    assert list(read_log(tmp_path / "a.log")) == []


def test_a_blf_that_ends_too_early_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    write_log(path, [random_block(20_000, 5)])
    whole = path.read_bytes()
    reader = read_log(path)
    count = sum(len(b) for b in reader)
    assert reader.problem == ""
    path.write_bytes(whole[:len(whole) * 2 // 3])
    reader = read_log(path)
    assert 0 < sum(len(b) for b in reader) < count
    assert "is cut off" in reader.problem and str(len(whole)) in reader.problem


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc", ".asc.gz"])
@pytest.mark.parametrize("missing", [2, 5, 9, 15])
def test_a_text_that_ends_within_a_line_says_so(tmp_path: Path, suffix: str, missing: int) -> None:
    """The half line is no frame: its identifier and half its bytes would read like one."""
    block = FrameBlock.zeros(50)
    block.can_id[:] = 0x100
    block.raw[:, 4] = 8
    block.raw[:, 8:16] = 0xA5
    block.t_ns[:] = 1_700_000_000_000_000_000 + np.arange(50) * 1_000_000
    path = tmp_path / f"a{suffix}"
    write_log(path, [block], "1")
    packed = suffix.endswith(".gz")
    text = (gzip.decompress(path.read_bytes()) if packed else path.read_bytes())
    assert read_log(path).problem == "" and len(read_all(path)) == 50
    text = text.split(b"End TriggerBlock")[0][:-missing]
    path.write_bytes(gzip.compress(text) if packed else text)
    reader = read_log(path)
    found = FrameBlock.concat(reader)
    assert np.array_equal(found.raw, block.raw[:49])
    assert reader.problem == f"{path} is cut off: its last line has no end and is left out"


def test_an_asc_that_ends_between_two_lines_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    write_log(path, [random_block(20, 3, errors=False)], "1")
    text = path.read_text()
    assert "Begin Triggerblock" in text and text.endswith("End TriggerBlock\n")
    for whole in (text, text.rstrip("\n"), text.replace("Begin Trigger", "//").replace("End TriggerBlock\n", "")):
        path.write_text(whole)
        reader = read_log(path)
        assert sum(len(b) for b in reader) == 20 and reader.problem == ""
    path.write_text(text.replace("End TriggerBlock\n", ""))
    reader = read_log(path)
    assert sum(len(b) for b in reader) == 20
    assert reader.problem == f"{path} is cut off: it has no line 'End TriggerBlock'"
