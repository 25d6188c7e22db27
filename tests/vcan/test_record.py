"""Recording on a real SocketCAN interface: a full bus, a bus that goes away again and again, a full disk.

IPMSM_CAN_SECONDS=60 makes the full bus last so long, and the bus go away 20 times instead of 6.
"""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.bits import frame_bits
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.frames import CANFD_BRS, CANFD_FDF, FrameBlock
from ipmsm_can.logs import gaps, read_log
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol
from tests.vcan.test_reconnect import OUTAGES, Sender, ip, traffic, vcan7  # noqa: F401

PROGRAM = [sys.executable, "-m", "ipmsm_can"]
FILLER = 0x5FF
SECONDS = float(os.environ.get("IPMSM_CAN_SECONDS", "4"))


def filler(n: int, fd: bool, first: int) -> FrameBlock:
    """Numbered frames of nobody's."""
    block = FrameBlock.zeros(n)
    block.can_id[:] = FILLER
    block.length[:] = 64 if fd else 8
    block.flags[:] = CANFD_FDF | CANFD_BRS if fd else 0
    block.words[:, 1] = np.arange(first, first + n, dtype=np.uint64)
    if fd:
        block.data[:, 8:] = np.arange(56)
    return block


def full_bus(seconds: float, fd: bool, load: float) -> FrameBlock:
    """A drive's traffic (5 kHz classical or 10 kHz FD), filled up with numbered frames to this load, one behind the
    other as on the wire; times from 0."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=10_000.0 if fd else 5000.0),
                                 constant(600.0 * RPM, 1.0, seconds))
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings(fd=fd, reference_rate=200.0))
    drive = node.step(int(simulation.parameters.sample_rate * seconds)).frames

    def lasts(block: FrameBlock) -> np.ndarray:
        nominal, data = frame_bits(block)
        return nominal / 1e6 + data / 5e6

    room = load * seconds - lasts(drive).sum()
    fill = filler(int(room / lasts(filler(1000, fd, 0)).mean()), fd, 0)
    fill.t_ns[:] = np.linspace(0, 1e9 * seconds, len(fill)).astype(np.int64)
    both = FrameBlock.concat([drive, fill])
    both = both.take(np.argsort(both.t_ns, kind="stable"))
    assert abs(lasts(both).sum() / seconds - load) < 0.02
    return both


def play(frames: FrameBlock, channel: str = "vcan0") -> float:
    """Send at their times; returns how long it took [s]."""
    begin = time.monotonic()
    at = 0
    with SocketCanPort(channel, filters=[]) as port:
        while at < len(frames):
            end = int(np.searchsorted(frames.t_ns, 1e9 * (time.monotonic() - begin)))
            while at < end:
                sent = port.send(frames.take(slice(at, min(end, at + 200))))
                at += sent
            time.sleep(0.002)
    return time.monotonic() - begin


@contextmanager
def on_a_terminal(*words: str) -> Iterator[tuple[subprocess.Popen[bytes], bytearray]]:
    """A command with its live screen on; what it draws gathers in the bytes."""
    master, slave = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"}
    process = subprocess.Popen([*PROGRAM, *words], stdin=subprocess.DEVNULL, stdout=slave, stderr=slave,
                               env=environment)
    os.close(slave)
    drawn = bytearray()
    done = threading.Event()

    def read() -> None:
        while not done.is_set() or select.select([master], [], [], 0)[0]:
            if not select.select([master], [], [], 0.2)[0]:
                continue
            try:
                drawn.extend(os.read(master, 65536))
            except OSError:
                return

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield process, drawn
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(20)
        done.set()
        reader.join(20)
        os.close(master)


def until(drawn: bytearray, word: bytes, seconds: float = 300.0) -> None:
    deadline = time.monotonic() + seconds
    while word not in drawn:
        assert time.monotonic() < deadline, bytes(drawn[-2000:]).decode(errors="replace")
        time.sleep(0.05)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "drive.toml"
    path.write_text('[motor]\npreset = "m2"\n')
    return path


def caught_up(log: Path) -> None:
    """Wait until no more of our frames come into a recording: on one slow processor the program may lag behind by
    what waits in the kernel."""
    count, since = -1, time.monotonic()
    while time.monotonic() < since + 3.0:
        found = sum(int(np.count_nonzero(b.can_id == FILLER)) for b in read_log(log))
        if found != count:
            count, since = found, time.monotonic()
        time.sleep(0.5)


def told(pattern: str, text: str) -> int:
    match = re.search(pattern, text)
    assert match, text[-3000:]
    return int(match[1])


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


@pytest.mark.parametrize(("fd", "load", "suffix", "answer"), [
    (False, 1.0, ".blf", False), (False, 1.0, ".log", True), (True, 0.6, ".blf", True)])
def test_no_frame_is_lost_that_the_kernel_delivered(config: Path, tmp_path: Path, fd: bool, load: float,
                                                    suffix: str, answer: bool) -> None:
    """Classical at 1 Mbit/s saturated, FD at 60 %; the companion's screen is on, it records, and answers or not."""
    frames = full_bus(SECONDS, fd, load)
    log = tmp_path / f"run{suffix}"
    with on_a_terminal("run", str(config), "-i", "socketcan", "-c", "vcan0", "--record", str(log),
                       *(["--transmit"] if answer else []),
                       *(["--measure", str(tmp_path / "run.mf4")] if fd else [])) as (process, drawn):
        until(drawn, b"REC ")
        used = cpu_s(process.pid)
        took = play(frames)
        used = cpu_s(process.pid) - used
        caught_up(log)
        process.send_signal(signal.SIGINT)
        process.wait(60)
    text = drawn.decode(errors="replace")
    drops = told(r"kernel drops (\d+)", text[text.rindex(" frames received, "):])
    received = told(r"(\d+) frames received", text)
    answers = told(r"frames received, (\d+) sent", text)
    recorded = told(r"recorded (\d+) frames in", text)
    back = FrameBlock.concat(read_log(log))
    print(f"\n{len(frames)} frames in {took:.2f} s ({len(frames) / took:.0f}/s), {drops} dropped by the kernel, "
          f"{received} received, {answers} sent, {recorded} recorded, {used / took:.0%} of the processor")
    assert received == len(frames) - drops
    assert recorded == len(back) == received + answers
    numbers = back.words[back.can_id == FILLER, 1].tolist()
    assert numbers == sorted(set(numbers))
    expected = np.concatenate([frames.words[frames.can_id != FILLER], frames.words[frames.can_id == FILLER]])
    if not drops:
        ours = (back.can_id & 0x600) == 0x200
        found = back.words[~ours]
        found = np.concatenate([found[back.can_id[~ours] != FILLER], found[back.can_id[~ours] == FILLER]])
        assert np.array_equal(found, expected), "every frame, in order, to the last bit"
    assert process.returncode == 0
    if fd:
        from asammdf import MDF

        with MDF(tmp_path / "run.mf4") as file:
            filled = file.get("filled", group=0).samples
            assert len(filled) >= 0.99 * 10_000 * SECONDS and (drops or not filled.any())


def test_what_the_kernel_drops_is_counted_shown_and_marked(tmp_path: Path) -> None:
    """A receive buffer for a few frames, and a program that is stopped for a second."""
    log = tmp_path / "run.log"
    frames = full_bus(1.0, False, 0.9)
    with on_a_terminal("record", str(log), "-i", "socketcan", "-c", "vcan0", "--bus-kwargs",
                       "receive_buffer=40000") as (process, drawn):
        until(drawn, b"REC ")
        play(frames)
        process.send_signal(signal.SIGSTOP)
        play(frames)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        play(frames)
        caught_up(log)
        process.send_signal(signal.SIGINT)
        process.wait(60)
    text = drawn.decode(errors="replace")
    drops = told(r"(\d+) frames dropped by the kernel: they are in no file", text)
    reader = read_log(log)
    recorded = sum(len(b) for b in reader)
    print(f"\n{3 * len(frames)} frames sent, {drops} dropped by the kernel, {recorded} recorded")
    assert recorded == 3 * len(frames) - drops and drops > 1000
    assert sum(int(m.text.split()[0]) for m in reader.marks if "dropped by the kernel" in m.text) == drops
    assert process.returncode == 1


def test_outages_during_a_recording(vcan7: str, tmp_path: Path) -> None:  # noqa: F811
    """Down and up, or away and made anew: complete but for the gaps, and every gap is marked."""
    log = tmp_path / "run.blf"
    sender = Sender(traffic(6.0 * OUTAGES))
    process = subprocess.Popen([*PROGRAM, "record", str(log), "-i", "socketcan", "-c", vcan7],
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                               env={**os.environ, "PYTHONUNBUFFERED": "1"})
    assert process.stdout is not None
    lines: list[str] = []

    def read() -> None:
        assert process.stdout is not None
        lines.extend(process.stdout)

    try:
        while not lines or " REC " not in lines[-1]:  # kernels may have to be compiled first
            lines.append(process.stdout.readline())
            assert lines[-1], "".join(lines)
        thread = threading.Thread(target=read)
        thread.start()
        sender.thread.start()
        for k in range(OUTAGES):
            time.sleep(1.0)
            if k % 2:
                ip("link", "del", vcan7)
                time.sleep(0.4)
                ip("link", "add", "dev", vcan7, "type", "vcan")
            else:
                ip("link", "set", vcan7, "down")
                time.sleep(0.4)
            ip("link", "set", vcan7, "up")
        time.sleep(2.0)
        sender.stop = True
        sender.thread.join(20)
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        process.wait(60)
        thread.join(20)
    finally:
        sender.stop = True
        if process.poll() is None:
            process.kill()
    said = "".join(lines)
    assert process.returncode == 0, said
    reader = read_log(log)
    received = FrameBlock.concat(reader)
    found = gaps(reader.marks)
    print(f"\n{len(received)} frames recorded, {len(found)} gaps of {[round(g.seconds, 2) for g in found]} s")
    assert len(found) == OUTAGES and all(g.ended_ns is not None and g.seconds > 0.2 for g in found), said
    assert all("vcan7" in g.reason for g in found)
    assert f"the bus went away {OUTAGES} times" in said
    numbers = received.words[received.can_id == 0x180, 1].tolist()
    assert numbers == sorted(set(numbers)), "nothing twice, and in order"
    known = set(numbers)
    missing = [t for n, t in sender.sent.items() if n not in known]
    away = [(g.began_ns - 100_000_000, (g.ended_ns or 0) + 50_000_000) for g in found]
    outside = [t for t in missing if not any(a <= t <= b for a, b in away)]
    assert outside == [] and len(numbers) > 0.5 * len(sender.sent) > 50 * OUTAGES
    # no frame of the recording lies within a gap: the marks are where the gaps are
    for g in found:
        inside = (received.t_ns > g.began_ns) & (received.t_ns < g.began_ns + 100_000_000)
        assert not inside.any()


def test_a_full_disk(config: Path, tmp_path: Path) -> None:
    """It is said in one sentence, the companion goes on, and what fitted can be read."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", str(disk)], check=False).returncode:
        pytest.skip("not allowed to mount")
    log = disk / "run.log"
    try:
        with on_a_terminal("run", str(config), "-i", "socketcan", "-c", "vcan0", "--record",
                           str(log)) as (process, drawn):
            until(drawn, b"REC ")
            frames = full_bus(3.0, False, 0.9)
            play(frames)
            until(drawn, b"NOT RECORDING", 30)
            process.send_signal(signal.SIGINT)
            process.wait(60)
        text = drawn.decode(errors="replace")
        assert f"no space left on the disk of {log}" in text and "Traceback" not in text
        assert told(r"(\d+) frames received", text) == len(frames)
        assert process.returncode == 1
        assert 1000 < sum(len(b) for b in read_log(log)) < len(frames)
    finally:
        subprocess.run(["umount", str(disk)], check=False)
