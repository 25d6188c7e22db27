"""BLF: our reader and writer against python-can's, objects made by hand, and files that are cut off or damaged."""

from __future__ import annotations

import gzip
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.io.blf import BLFWriter
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ipmsm_can.bus.pythoncan import block_from_messages
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CANFD_BRS, CANFD_ESI, CANFD_FDF, FrameBlock
from ipmsm_can.logs import LogError, read_log, write_log
from tests.test_logs import random_block

START = 1_700_000_000.123
START_NS = 1_700_000_000_123_000_000


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    kind = draw(st.sampled_from(["classical", "fd", "remote", "error"]))
    extended = draw(st.booleans())
    common: dict[str, Any] = {
        "timestamp": START + draw(st.integers(0, 10**7)) * 1e-6,
        "arbitration_id": draw(st.integers(0, (1 << 29) - 1 if extended else (1 << 11) - 1)),
        "is_extended_id": extended, "channel": draw(st.integers(0, 3)), "is_rx": draw(st.booleans())}
    if kind == "remote":
        return can.Message(is_remote_frame=True, dlc=draw(st.integers(0, 8)), **common)
    if kind == "fd":
        length = draw(st.sampled_from([0, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64]))
        return can.Message(is_fd=True, bitrate_switch=draw(st.booleans()),
                           error_state_indicator=draw(st.booleans()),
                           data=draw(st.binary(min_size=length, max_size=length)), **common)
    return can.Message(is_error_frame=kind == "error", data=draw(st.binary(max_size=8)), **common)


def write_by_python_can(path: Path, sent: list[can.Message], container: int, level: int) -> None:
    with BLFWriter(path, max_container_size=container, compression_level=level) as writer:
        for message in sent:
            writer.on_message_received(message)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(st.lists(messages(), max_size=30), st.integers(128, 400), st.sampled_from([-1, 0, 1]), st.integers(1, 9))
def test_reads_as_python_can_does(tmp_path: Path, sent: list[can.Message], container: int, level: int,
                                  block_frames: int) -> None:
    """Small containers: many objects begin in one and end in another.  128 bytes and more, for into smaller ones
    python-can's writer does not put everything."""
    path = tmp_path / "a.blf"
    write_by_python_can(path, sent, container, level)
    theirs = list(can.LogReader(path))
    assert len(theirs) == len(sent)
    reader = read_log(path, block_frames=block_frames)
    parts = list(reader)
    assert all(len(p) == block_frames for p in parts[:-1])
    assert reader.problem == "" and reader.passed_over == 0 and reader.done == 1.0
    found, oracle = FrameBlock.concat(parts), block_from_messages(theirs)
    assert np.array_equal(found.raw, oracle.raw)
    assert np.all(np.abs(found.t_ns - oracle.t_ns) <= 240)  # theirs went through a float
    for channel in range(4):
        of_channel = block_from_messages([m for m in theirs if m.channel == channel])
        assert np.array_equal(FrameBlock.concat(read_log(path, channel=f"can{channel}")).raw, of_channel.raw)


def test_python_can_reads_what_we_write(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    block = random_block(5000, 11)
    block.t_ns[:] += np.arange(5000)  # single ns
    write_log(path, [block.take(slice(0, 1)), FrameBlock.zeros(0), block.take(slice(1, None))], "can2")
    reader = can.LogReader(path)
    theirs = list(reader)
    assert {m.channel for m in theirs} == {2}
    assert (reader.file_size, reader.object_count) == (path.stat().st_size, 5000)  # type: ignore[attr-defined]
    oracle = block_from_messages(theirs)
    assert np.array_equal(oracle.raw, block.raw)
    assert np.abs(oracle.t_ns - block.t_ns).max() <= 240
    found = FrameBlock.concat(read_log(path))
    assert np.array_equal(found.raw, block.raw) and np.array_equal(found.t_ns, block.t_ns)


def test_times_that_are_no_unix_times(tmp_path: Path) -> None:
    block = random_block(20, 1)
    block.t_ns[:] = np.arange(20) * 1_000_001
    write_log(tmp_path / "a.blf", [block])
    assert np.array_equal(FrameBlock.concat(read_log(tmp_path / "a.blf")).t_ns, block.t_ns)


def test_a_flushed_recording_can_be_read_before_its_end(tmp_path: Path) -> None:
    from ipmsm_can.logs import LogWriter

    block = random_block(100, 2)
    with LogWriter(tmp_path / "a.blf") as writer:
        writer.write(block.take(slice(0, 60)))
        writer.flush()
        reader = read_log(tmp_path / "a.blf")
        assert np.array_equal(FrameBlock.concat(reader).raw, block.raw[:60]) and reader.problem == ""
        writer.write(block.take(slice(60, None)))
    assert np.array_equal(FrameBlock.concat(read_log(tmp_path / "a.blf")).raw, block.raw)


# ---- objects made by hand -----------------------------------------------------------------------------

def an_object(kind: int, body: bytes, ticks: int = 0, flags: int = 2, version: int = 1) -> bytes:
    head = struct.pack("<LHHQ", flags, 0, 0, ticks) if version == 1 else struct.pack("<LBxHQ8x", flags, 0, 0, ticks)
    size = 16 + len(head) + len(body)
    return struct.pack("<4sHHLL", b"LOBJ", 16 + len(head), version, size, kind) + head + body


def a_file(stream: bytes, sizes: list[int] | None = None, method: int = 2, promised: int = 0) -> bytes:
    """The stream of objects in containers of the given sizes, the last with the rest."""
    head = struct.pack("<4sL8BQQLL8H8H", b"LOGG", 144, *[0] * 8, promised, 0, 0, 0,
                       2023, 11, 2, 14, 22, 13, 20, 123, *[0] * 8)
    out = head.ljust(144, b"\0")
    for size in [*(sizes or []), len(stream)]:
        piece, stream = stream[:size], stream[size:]
        packed = piece if method == 0 else zlib.compress(piece)
        total = 32 + len(packed)
        out += struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, total, 10, method, len(piece)) + packed
        out += bytes(total % 4)
    return out


def read_bytes(path: Path, content: bytes, **options: int) -> FrameBlock:
    path.write_bytes(content)
    return FrameBlock.concat(read_log(path, **options))  # type: ignore[arg-type]


def message(channel: int, can_id: int, data: bytes, flags: int = 0) -> bytes:
    return struct.pack("<HBBL8s", channel, flags, len(data), can_id, data)


def fd_64(data: bytes, valid: int, flags: int = 0x3000, ext: int = 0, more: bytes = b"") -> bytes:
    return struct.pack("<4B7LHBBL", 1, 15, valid, 0, 0x123 | CAN_EFF_FLAG, 0, flags, 0, 0, 0, 0, 0, 0, ext,
                       0) + data + more


def test_both_headers_and_both_units_of_time(tmp_path: Path) -> None:
    stream = (an_object(86, message(1, 0x100, b"\1\2") + bytes(8), 5, flags=1)
              + an_object(1, message(1, 0x101, b"\3"), 123_456_789, flags=2, version=2)
              + an_object(1, message(2, 0x102, b"\4"), 7, flags=0)
              + an_object(1, message(1, 0x103, b"\5"), 8, version=3)  # an unknown header is no frame
              + an_object(1, message(1, 0x104, b"", 0x80), (1 << 64) - 1, flags=1))
    block = read_bytes(tmp_path / "a.blf", a_file(stream))
    assert block.can_id.tolist() == [0x100, 0x101, 0x102, 0x104 | CAN_RTR_FLAG]
    assert block.t_ns.tolist() == [START_NS + 50_000, START_NS + 123_456_789, START_NS + 7, (1 << 63) - 1]
    assert block.length.tolist() == [2, 1, 1, 0]
    assert block.data[0, :3].tolist() == [1, 2, 0]


def test_a_start_that_is_no_time_counts_as_zero(tmp_path: Path) -> None:
    content = bytearray(a_file(an_object(1, message(1, 1, b""), 5)))
    for year, month, start in ((9999, 12, 0), (2262, 5, 0), (0, 0, 0), (2023, 13, 0), (1969, 1, 0),
                               (2262, 3, 9_220_947_200_123_000_000)):
        content[40:44] = struct.pack("<HH", year, month)
        assert read_bytes(tmp_path / "a.blf", bytes(content)).t_ns.tolist() == [start + 5]


def test_the_last_time_that_fits(tmp_path: Path) -> None:
    room = (1 << 63) - 1 - START_NS
    stream = b"".join(an_object(1, message(1, 1, b""), t, flags) for t, flags in (
        (room, 2), (room + 1, 2), (room // 10_000, 1), (room // 10_000 + 1, 1), (1 << 63, 2)))
    last = (1 << 63) - 1
    assert read_bytes(tmp_path / "a.blf", a_file(stream)).t_ns.tolist() == [
        last, last, START_NS + room // 10_000 * 10_000, last, last]


def test_fd_64_has_what_the_file_has(tmp_path: Path) -> None:
    """Payload cut short by the object or by data behind it is filled with zeros, as CANoe does."""
    payload = bytes(range(1, 65))
    stream = (an_object(101, fd_64(payload, 64)) + an_object(101, fd_64(payload[:12], 16, 0x7000))
              + an_object(101, fd_64(payload[:8], 16, ext=32 + 40 + 8, more=b"\xff" * 8), version=1)
              + an_object(101, fd_64(payload[:8], 8, 0)) + an_object(101, fd_64(b"", 0, 0x10))
              + an_object(101, fd_64(payload[:12], 12, 0)) + an_object(101, fd_64(payload[:8], 200)))
    path = tmp_path / "a.blf"
    block = read_bytes(path, a_file(stream))
    assert np.array_equal(block.raw, block_from_messages(can.LogReader(path)).raw)
    both = CANFD_FDF | CANFD_BRS
    assert block.flags.tolist() == [
        both, both | CANFD_ESI, both, 0, 0, 0, both]
    assert block.length.tolist() == [64, 16, 16, 8, 8, 8, 64]
    assert block.data[2, :17].tolist() == [*range(1, 9), *[0] * 9]


def test_errors_overloads_and_what_is_no_frame(tmp_path: Path) -> None:
    ext = struct.pack("<HHLBBBxLLH2x8s", 1, 0, 0, 0, 0, 3, 0, 0x44, 0, b"abcdefgh")
    stream = (an_object(73, ext) + an_object(2, struct.pack("<HHL", 1, 0, 0)) + an_object(96, b"a marker")
              + b"\0\0\0" + an_object(3, struct.pack("<HHL", 1, 0, 0)) + an_object(104, bytes([1]) + bytes(100))
              + an_object(1, b"short") + an_object(1, message(1, 0x7, b"\1")))
    path = tmp_path / "a.blf"
    path.write_bytes(a_file(stream))
    reader = read_log(path)
    block = FrameBlock.concat(reader)
    assert [hex(i) for i in block.can_id] == [hex(CAN_ERR_FLAG | i) for i in (0x44, 0x80, 0x8, 0x80)] + ["0x7"]
    assert block.data[0, :4].tobytes() == b"abc\0" and block.data[2, 2] == 0x20
    assert reader.passed_over == 2 and reader.problem == ""


def test_objects_outside_of_containers(tmp_path: Path) -> None:
    marker = an_object(96, b"abc")
    bare = an_object(1, message(1, 0x10, b"\1")) + marker + bytes(len(marker) % 4)
    content = a_file(an_object(1, message(1, 0x11, b"\2")), method=0)
    block = read_bytes(tmp_path / "a.blf", content[:144] + bare + content[144:])
    assert block.can_id.tolist() == [0x10, 0x11]


def test_containers_smaller_than_an_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each container comes to the kernel by itself: an object may come in many pieces, a piece may end anywhere."""
    monkeypatch.setattr("ipmsm_can.logs.blf.CHUNK_BYTES", 1)
    rng = np.random.default_rng(4)
    block = random_block(300, 12)
    write_log(tmp_path / "whole.blf", [block])
    content = (tmp_path / "whole.blf").read_bytes()
    stream = zlib.decompress(content[144 + 32:])
    assert len(stream) < 1 << 17  # one container
    for most in (2, 10, 60, 500):
        sizes = rng.integers(1, most, len(stream)).tolist()
        sizes = sizes[:int(np.searchsorted(np.cumsum(sizes), len(stream)))]
        found = read_bytes(tmp_path / "a.blf", a_file(stream, sizes), block_frames=77)
        assert np.array_equal(found.raw, block.raw), most


# ---- damage -------------------------------------------------------------------------------------------

def small_file() -> tuple[bytes, FrameBlock]:
    stream = b"".join(an_object(1, message(1 + i % 2, 0x100 + i, bytes([i] * (i % 9))), i) for i in range(12))
    content = a_file(stream, [100, 130, 7])
    block = FrameBlock.zeros(12)
    block.can_id[:] = 0x100 + np.arange(12)
    return a_file(stream, [100, 130, 7], promised=len(content)), block


@pytest.mark.parametrize("packed", [False, True])
def test_cut_off_at_every_byte(tmp_path: Path, packed: bool) -> None:
    """What was whole is given; then, or instead, one sentence."""
    content, block = small_file()
    if packed:
        content = gzip.compress(content, mtime=0)
    path = tmp_path / ("a.blf.gz" if packed else "a.blf")
    most = 0
    for cut in range(len(content)):
        path.write_bytes(content[:cut])
        reader = read_log(path, block_frames=5)
        found: list[FrameBlock] = []
        try:
            found.extend(reader)
        except LogError as error:
            told = str(error)
            assert not found
        else:
            told = reader.problem
        assert str(path) in told and "\n" not in told and told.count(str(path)) == 1
        assert "cut off" in told or (cut == 0 and "LOGG" in told)
        ids = FrameBlock.concat(found).can_id
        assert np.array_equal(ids, block.can_id[:len(ids)])
        assert len(ids) >= most  # a longer file never gives less
        most = len(ids)
    path.write_bytes(content)
    reader = read_log(path)
    assert np.array_equal(FrameBlock.concat(reader).can_id, block.can_id) and reader.problem == ""
    assert most >= 11


def test_no_damage_raises_anything_but_the_one_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    content, _ = small_file()
    stored = a_file(b"".join(an_object(kind, rng.bytes(100), 3, version=1 + kind % 2) for kind in (
        1, 2, 3, 73, 86, 100, 101, 104)), [50], method=0)
    path = tmp_path / "a.blf"
    for k in range(3000):
        damaged = np.frombuffer((content, stored)[k % 2], np.uint8).copy()
        where = rng.integers(0, len(damaged), rng.integers(1, 6))
        damaged[where] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, int(rng.integers(256))], len(where))
        path.write_bytes(damaged.tobytes())
        reader = read_log(path, block_frames=int(rng.integers(1, 20)))
        try:
            block = FrameBlock.concat(reader)
        except LogError as error:
            assert str(path) in str(error)
            continue
        assert (block.length <= np.where(block.flags & CANFD_FDF, 64, 8)).all()


def test_a_damaged_container_ends_reading_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    block = random_block(20_000, 3)
    write_log(path, [block])
    content = bytearray(path.read_bytes())
    middle = content.index(b"LOBJ", len(content) // 2) + 40
    content[middle:middle + 20] = b"\xff" * 20
    path.write_bytes(content)
    reader = read_log(path)
    found = FrameBlock.concat(reader)
    assert 0 < len(found) < 20_000 and np.array_equal(found.raw, block.raw[:len(found)])
    assert "is damaged: a container cannot be unpacked" in reader.problem and "left out" in reader.problem


def test_the_order_of_objects_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    good = an_object(1, message(1, 0x10, b"\1"))
    for bad in (b"rubbish instead", struct.pack("<4sHHLL", b"LOBJ", 16, 1, 8, 1) * 3,
                struct.pack("<4sHHLL", b"LOBJ", 16, 1, 1 << 31, 1)):
        path.write_bytes(a_file(good + bad + good))
        reader = read_log(path)
        assert FrameBlock.concat(reader).can_id.tolist() == [0x10]
        assert "behind 1 frames" in reader.problem and "damaged" in reader.problem


def test_a_channel_without_a_number(tmp_path: Path) -> None:
    (tmp_path / "a.blf").write_bytes(small_file()[0])
    with pytest.raises(LogError, match=r"have numbers, and 'left' has none; allowed is 0 or can0"):
        list(read_log(tmp_path / "a.blf", channel="left"))


FUZZ = """
import numpy as np
from ipmsm_can.logs import blf_kernel as k
from tests.test_blf import an_object
rng = np.random.default_rng(7)
kinds = (1, 2, 3, 73, 86, 96, 100, 101, 104)
seen = 0
for turn in range(20000):
    parts = [an_object(int(rng.choice(kinds)), rng.bytes(int(rng.integers(0, 110))), 3, 1 + int(rng.integers(2)),
                       1 + int(rng.integers(2))) for _ in range(3)]
    data = np.frombuffer(b"".join(parts), np.uint8).copy()
    for at in rng.integers(0, len(data), rng.integers(0, 4)):
        data[at] = rng.choice([0, 1, 31, 32, 41, 255])
    data = data[:rng.integers(0, len(data) + 1)]
    rows = int(rng.integers(1, 5))
    raw, t_ns, counts = np.zeros((rows, 72), np.uint8), np.zeros(rows, np.int64), np.zeros(k.COUNTS, np.int64)
    at, n = k.walk(data, 0, 1, k.ALL_CHANNELS, raw, t_ns, 0, counts)
    assert 0 <= at <= len(data) and n <= rows
    seen += n
print(seen)
"""


def test_no_kernel_reads_or_writes_beyond_its_arrays(tmp_path: Path) -> None:
    """The same kernel compiled with every index checked: an access out of bounds is an IndexError here."""
    run = subprocess.run([sys.executable, "-c", FUZZ], capture_output=True, text=True, check=False, env={
        **os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)})
    assert run.returncode == 0, run.stderr[-2000:]
    assert int(run.stdout) > 10_000
