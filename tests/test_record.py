"""Recordings: what comes in is what is in the files, whatever happens to the disk, the bus and the program."""

from __future__ import annotations

import os
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from ipmsm_can.bus.link import Link
from ipmsm_can.bus.port import BusError
from ipmsm_can.cli import bus, main
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CANFD_BRS, CANFD_FDF, FrameBlock
from ipmsm_can.logs import Mark, gaps, read_log
from ipmsm_can.logs.source import LogError
from ipmsm_can.logs.writer import LogWriter
from ipmsm_can.record.background import Background
from ipmsm_can.record.recorder import Recorder
from ipmsm_can.record.rotation import Names, Rotation
from ipmsm_can.record.tap import Tap
from tests.test_blf import a_file, an_object

NOW = 1_700_000_000_123_456_000
NOTHING = FrameBlock.zeros(0)
SUFFIXES = [".blf", ".log", ".log.gz", ".asc", ".csv", ".trc", ".db", ".mf4"]


def frames(n: int, first: int = 0, t_ns: int = NOW) -> FrameBlock:
    """Numbered classical frames, a millisecond apart."""
    block = FrameBlock.zeros(n)
    block.can_id[:] = 0x123
    block.length[:] = 8
    block.words[:, 1] = np.arange(first, first + n, dtype=np.uint64)
    block.t_ns[:] = t_ns + 1_000_000 * np.arange(first, first + n)
    return block


def mixed() -> FrameBlock:
    """One frame of every kind."""
    block = frames(6)
    block.can_id[1] = 0x1ABCDEF | CAN_EFF_FLAG
    block.can_id[2] = CAN_ERR_FLAG | 0x80
    block.can_id[3] = 0x77 | CAN_RTR_FLAG
    block.data[3] = 0
    block.length[4], block.flags[4] = 64, CANFD_FDF | CANFD_BRS
    block.data[4] = np.arange(64)
    return block


def numbers(path: Path) -> list[int]:
    block = FrameBlock.concat(read_log(path))
    found: list[int] = block.words[block.can_id == 0x123, 1].tolist()
    return found


@pytest.mark.parametrize("suffix", [".blf", ".log", ".log.gz", ".mf4"])
def test_every_kind_of_frame_comes_back_and_marks_stand_between(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    block = mixed()
    recorder = Recorder(path, "can0")
    recorder.take(block.take(slice(0, 3)), (), NOTHING)
    recorder.mark(Mark(int(block.t_ns[2]), "somebody\nkicked it"))
    recorder.take(block.take(slice(3, 6)), (), NOTHING)
    recorder.close()
    reader = read_log(path)
    back = FrameBlock.concat(reader)
    assert np.array_equal(back.raw, block.raw)
    assert np.abs(back.t_ns - block.t_ns).max() < 1000
    assert [m.text for m in reader.marks] == ["somebody kicked it"]
    assert abs(reader.marks[0].t_ns - int(block.t_ns[2])) < 1000
    assert (reader.problem, reader.bad_lines, reader.passed_over) == ("", 0, 0)
    assert recorder.status().whole and recorder.status().frames == 6
    if suffix == ".blf":  # python-can reads it and passes over the marker
        assert len(list(can.LogReader(path))) == 6


def test_a_marker_of_python_can_is_read_and_ours_is_one_for_it(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs.blf"
    writer = can.BLFWriter(theirs)
    writer.on_message_received(can.Message(timestamp=1_700_000_000.0, arbitration_id=1, data=b"\1"))
    writer.log_event("door slammed", 1_700_000_000.5)
    writer.stop()
    reader = read_log(theirs)
    assert sum(len(b) for b in reader) == 1
    assert [m.text for m in reader.marks] == ["door slammed - python-can - Added by python-can"]
    assert abs(reader.marks[0].t_ns - 1_700_000_000_500_000_000) < 1000


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_gap_is_marked_in_or_beside_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    with LogWriter(path, "can0") as writer:
        writer.write(frames(3))
        for mark in (Mark(NOW + 10**9, "gap begins: can0 is down"), Mark(NOW + 3 * 10**9, "gap ends: 2.000 s ...")):
            writer.mark(mark)
        writer.write(frames(3, 4000))
    reader = read_log(path)
    assert sum(len(b) for b in reader) == 6
    (gap,) = gaps(reader.marks)
    assert gap.reason == "can0 is down" and gap.seconds == pytest.approx(2.0, abs=1e-5)
    assert abs(gap.began_ns - NOW - 10**9) < 1000


def test_a_marker_in_units_of_ten_microseconds(tmp_path: Path) -> None:
    """As Vector's tools may write it."""
    path = tmp_path / "run.blf"
    body = struct.pack("<LLL3xBLLL12x", 0, 0, 0, 0, 2, 4, 3) + b"grpnamewhy"
    path.write_bytes(a_file(an_object(96, body, ticks=150_000, flags=1)
                            + an_object(1, struct.pack("<HBBL8s", 1, 0, 1, 0x10, b"\1"), ticks=1_500_000_000)))
    reader = read_log(path)
    (block,) = list(reader)
    assert [(m.text, m.t_ns) for m in reader.marks] == [("gr - pnam - ewh", int(block.t_ns[0]))]


def test_frames_sent_stand_behind_what_they_answer_and_are_told_apart(tmp_path: Path) -> None:
    received, sent = frames(4), frames(2, 100)
    sent.t_ns[:] = received.t_ns[[0, 2]]
    for suffix in (".blf", ".log", ".asc"):
        path = tmp_path / f"run{suffix}"
        recorder = Recorder(path, "can0")
        recorder.take(received, (), sent)
        recorder.close()
        assert numbers(path) == [0, 100, 1, 2, 101, 3]
        if suffix != ".blf":  # python-can's reader of BLF does tell, from the flags
            assert [m.is_rx for m in can.LogReader(path)] == [True, False, True, True, False, True]
    assert [m.is_rx for m in can.LogReader(tmp_path / "run.blf")] == [True, False, True, True, False, True]
    assert not sent.raw[:, 6].any(), "the frames themselves are not touched"


def test_rotation_by_size_numbers_on_and_loses_nothing(tmp_path: Path) -> None:
    (tmp_path / "run_006.blf").write_bytes(b"somebody else's")
    recorder = Recorder(tmp_path / "run.blf", "can0", Rotation(size=20_000.0), flush_s=0.01)
    for k in range(40):
        recorder.take(frames(500, 500 * k), (), NOTHING)
        time.sleep(0.005)
    recorder.close()
    files = sorted(tmp_path.glob("run_*.blf"))[1:]
    assert files[0].name == "run_007.blf" and len(files) > 3
    assert recorder.status().files == len(files)
    assert [n for path in files for n in numbers(path)] == list(range(20_000))
    assert recorder.status().size == sum(p.stat().st_size for p in files)
    assert (tmp_path / "run_006.blf").read_bytes() == b"somebody else's"


def test_rotation_of_a_format_that_is_put_together_at_the_end(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mf4", "can0", Rotation(size=2_000_000.0), flush_s=0.01)
    for k in range(6):
        recorder.take(frames(10_000, 10_000 * k), (), NOTHING)
        deadline = time.monotonic() + 60
        while recorder.status().waiting and time.monotonic() < deadline:
            time.sleep(0.01)
    recorder.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 1 and [n for path in files for n in numbers(path)] == list(range(60_000))


def test_rotation_by_the_time_of_the_frames(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.log.gz", "can0", Rotation(seconds=2.0), flush_s=0.01)
    for k in range(7):
        recorder.take(frames(1000, 1000 * k), (), NOTHING)
        deadline = time.monotonic() + 20
        while recorder.status().waiting and time.monotonic() < deadline:
            time.sleep(0.01)
    recorder.close()
    # a block lasts 0.999 s, so three of them are the first to be longer than 2 s
    assert {p.name: len(numbers(p)) for p in tmp_path.iterdir()} == {
        "run_001.log.gz": 3000, "run_002.log.gz": 3000, "run_003.log.gz": 1000}


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.blf").write_bytes(b"evidence")
    with pytest.raises(LogError, match=r"run\.blf exists, and recordings are never overwritten"):
        Recorder(tmp_path / "run.blf")
    with pytest.raises(LogError, match=r"the folder .* does not exist"):
        Names(tmp_path / "no" / "run.blf", Rotation())
    assert (tmp_path / "run.blf").read_bytes() == b"evidence"


def test_a_slow_disk_holds_nobody_up_and_what_is_missing_is_marked(tmp_path: Path,
                                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.blf"
    released, writing = threading.Event(), threading.Event()
    ordinary = LogWriter.write

    def slow(self: LogWriter, block: FrameBlock) -> None:
        writing.set()
        assert released.wait(60)
        ordinary(self, block)

    monkeypatch.setattr(LogWriter, "write", slow)
    recorder = Recorder(path, "can0", room=1000, flush_s=0.01)
    recorder.take(frames(400), (), NOTHING)
    assert writing.wait(60)
    recorder.take(frames(500, 400), (), NOTHING)
    recorder.take(frames(300, 900), (), NOTHING)   # no room: 900 wait
    recorder.take(frames(100, 1200), (), NOTHING)  # fits
    assert recorder.status().refused == 300 and not recorder.status().whole
    released.set()
    deadline = time.monotonic() + 60
    while recorder.status().waiting and time.monotonic() < deadline:
        time.sleep(0.01)
    recorder.take(frames(10, 1300), (), NOTHING)
    recorder.close()
    assert numbers(path) == [*range(900), *range(1200, 1310)]
    reader = read_log(path)
    assert sum(len(b) for b in reader) == 1010
    assert [m.text for m in reader.marks] == ["300 frames before this are missing: writing was slower than the bus"]
    assert "300 frames are not in it: writing was slower than the bus" in recorder.status().summary


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc"])
def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path, suffix: str) -> None:
    """A limit on the size of files stands for the end of the disk; ENOSPC itself is in tests/vcan."""
    path = tmp_path / f"run{suffix}"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    try:
        recorder = Recorder(path, "can0", flush_s=0.01)
        rng = np.random.default_rng(1)
        for k in range(60):
            block = frames(1000, 1000 * k)
            block.words[:, 1] = rng.integers(0, 1 << 63, 1000)  # does not let itself be packed
            recorder.take(block, (), NOTHING)
            time.sleep(0.005)
            if recorder.status().problem:
                break
        deadline = time.monotonic() + 60
        while not recorder.status().problem and time.monotonic() < deadline:
            time.sleep(0.01)
        recorder.take(frames(7), (), NOTHING)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    status = recorder.status()
    assert "File too large" in status.problem and not status.whole and status.lost >= 7
    assert status.words.startswith("NOT RECORDING")
    reader = read_log(path)
    assert sum(len(b) for b in reader) >= status.frames > 0


def test_no_space_left_is_said_in_plain_words(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    recorder = Recorder(path, "can0", flush_s=0.01)
    recorder._writer.close()
    recorder._writer._writer._stream = open("/dev/full", "wb")  # type: ignore[attr-defined]  # noqa: PTH123, SIM115
    recorder.take(frames(5), (), NOTHING)
    recorder.close()
    assert recorder.status().problem == f"no space left on the disk of {path}"
    assert recorder.status().lost == 5


KILLED = """
import sys, time
from pathlib import Path
from ipmsm_can.frames import FrameBlock
from ipmsm_can.record.recorder import Recorder
from tests.test_record import frames
recorder = Recorder(sys.argv[1], "can0")
k = 0
while True:
    recorder.take(frames(10, 10 * k), (), FrameBlock.zeros(0))
    k += 1
    print(recorder.status().frames, flush=True)
    time.sleep(0.01)
"""


@pytest.mark.parametrize("suffix", [".blf", ".log.gz"])
def test_a_killed_program_leaves_all_that_was_written(tmp_path: Path, suffix: str) -> None:
    """Twice a second what has come is written; whatever the program had counted as written is in the file."""
    path = tmp_path / f"run{suffix}"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True,
                               cwd=Path(__file__).parents[1])
    assert process.stdout is not None
    written = {0}
    for line in process.stdout:
        written.add(int(line))
        if len(written) > 3:
            break
    os.kill(process.pid, signal.SIGKILL)
    written |= {int(line) for line in process.stdout if line.endswith("\n")}
    process.wait()
    found = numbers(path)
    assert found == list(range(len(found)))
    assert len(found) >= max(written) > 0


class _Broken:
    """A port that fails when told to, and works again when told to."""

    def __init__(self) -> None:
        self.drops = self.unsent = 0
        self.fd = False
        self.description = "broken"
        self.up = True
        self.blocks: list[FrameBlock] = []

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        if self.blocks:
            return self.blocks.pop(0)
        if not self.up:
            raise BusError(100, "can0 is down; bring it up")
        return NOTHING

    def send(self, block: FrameBlock) -> int:
        return len(block)

    def check(self) -> None:
        if not self.up:
            raise BusError(100, "can0 is down; bring it up")

    def close(self) -> None:
        """Nothing to close."""


def a_link(clock: Callable[[], int]) -> tuple[_Broken, Link]:
    port = _Broken()
    return port, Link(port, lambda: port, sleep=lambda _s: None, now_ns=clock)  # type: ignore[arg-type, return-value]


def test_gaps_and_drops_are_marked_where_they_are(tmp_path: Path) -> None:
    """Also one that was over before anybody looked."""
    path = tmp_path / "run.log"
    time_ns = [NOW]
    port, link = a_link(lambda: time_ns[0])
    recorder = Recorder(path, "can0")
    tap = Tap(link, [recorder])

    def shown(block: FrameBlock) -> None:
        tap.observe(block, (), NOTHING, 0)

    shown(frames(2))
    for k, looked in enumerate((True, False)):
        port.up = False
        time_ns[0] = NOW + (k + 1) * 10**10
        link.lose(BusError(100, "can0 is down; bring it up"))
        if looked:
            shown(frames(1, 10 * k + 2))  # what had arrived
            shown(NOTHING)
        port.up = True
        time_ns[0] += 2 * 10**9
        assert link.retry()
        shown(frames(2, 10 * k + 100))
    port.drops = 37
    shown(frames(1, 900))
    tap.close()
    begins, ends = "gap begins: can0 is down; bring it up", "gap ends: 2.000 s without a bus"
    assert [line.split(") ")[1] if line.startswith("#") else int(line.split("#")[1][:2], 16)
            for line in path.read_text().splitlines()] == [
        0, 1, 2, begins, ends, 100, 101, begins, ends, 110, 111, 900 % 256,
        "37 frames dropped by the kernel shortly before this"]
    reader = read_log(path)
    assert sum(len(b) for b in reader) == 8
    assert [g.seconds for g in gaps(reader.marks)] == pytest.approx([2.0, 2.0])
    assert "37 frames dropped" in reader.marks[-1].text


def test_what_waits_is_written_before_the_end_and_an_error_is_kept() -> None:
    done: list[int] = []
    background: Background[int] = Background("test", done.extend, 10, 100.0)
    assert all(background.put(k, 1) for k in range(10)) and background.close(60)
    assert done == list(range(10)) and not background.put(11, 1) and background.lost == 1

    def fails(items: list[int]) -> None:
        raise OSError(f"no: {len(items)}")

    failing: Background[int] = Background("test", fails, 10, 0.001)
    failing.put(1, 3)
    assert failing.close(60) and isinstance(failing.error, OSError) and failing.lost == 3 and failing.waiting == 0


# ---- the commands -------------------------------------------------------------------------------------

def test_record_writes_what_is_on_the_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.blf"
    stops: list[bus.Stop] = []
    ordinary = bus.stop_on_signals
    codes: list[int] = []
    with can.Bus(interface="virtual", channel="rec") as sender, pytest.MonkeyPatch.context() as patch:
        class Entered:
            def __init__(self, duration: float | None = None) -> None:
                self.context = ordinary(duration)

            def __enter__(self) -> bus.Stop:
                stops.append(self.context.__enter__())
                return stops[-1]

            def __exit__(self, *words: object) -> None:
                self.context.__exit__(None, None, None)

        patch.setattr(bus, "stop_on_signals", Entered)
        thread = threading.Thread(target=lambda: codes.append(main(
            ["record", str(path), "-i", "virtual", "-c", "rec", "--quiet"])))
        thread.start()
        deadline = time.monotonic() + 240
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        for k in range(200):
            sender.send(can.Message(arbitration_id=0x123, data=k.to_bytes(8, "little"), is_extended_id=False))
        time.sleep(0.5)
        stops[0].now()
        thread.join(60)
    assert codes == [0]
    assert numbers(path) == list(range(200))
    assert f"recorded 200 frames in {path}" in capsys.readouterr().out


@pytest.mark.parametrize(("options", "told"), [
    (["--rotate-size", "lots"], "--rotate-size is 'lots'; allowed is a number with a unit of B, kB, MB"),
    (["--rotate-size", "1kB"], "allowed is 10 kB or more"),
    (["--rotate-time", "10"], "--rotate-time is '10'; allowed is a number with a unit of s, min, h, d"),
    (["--measure", "x.mf4"], "--measure needs to know"),
])
def test_wrong_options_in_one_sentence(options: list[str], told: str, tmp_path: Path,
                                       capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["record", str(tmp_path / "a.blf"), "-i", "virtual", "-c", "none", "--duration", "0.1", "--quiet",
                 *options])
    assert code == 2 and told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_unknown_suffix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", str(tmp_path / "a.xyz"), "-i", "virtual", "-c", "none"]) == 2
    assert "has the suffix '.xyz'; allowed are .asc, .blf" in capsys.readouterr().err
