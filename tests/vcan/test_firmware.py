"""The C library on a real SocketCAN interface: drive_stub and `ipmsm-can run`, and a forger as the third.

What the drive prints is held against what somebody else on the bus heard.  A longer run of the first test:
`IPMSM_CAN_SECONDS=60 tools/vcan/run .venv/bin/python -m pytest tests/vcan/test_firmware.py`.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tests.vcan.test_end_to_end import companion, decoded, dumping, ended, number, read

FOLDER = Path(__file__).resolve().parents[2] / "firmware_stub"
PROTOCOL = Protocol()
SECONDS = float(os.environ.get("IPMSM_CAN_SECONDS", "5"))
CLAMP = 30.0
TIME_TO_LIVE_MS = 100
CI = os.environ.get("CI") == "true"
pytestmark = [
    pytest.mark.skipif(not (shutil.which("candump") or CI), reason="can-utils are not installed"),
    pytest.mark.skipif(not ((shutil.which("cc") and shutil.which("make")) or CI), reason="no C compiler and make"),
    pytest.mark.timeout(600)]

Event = dict[str, Any]


@pytest.fixture(scope="module")
def program() -> str:
    subprocess.run(["make", "-s", "-C", str(FOLDER), "drive-stub"], check=True)
    return str(FOLDER / "build" / "drive_stub")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "drive.toml"
    # Probing by speed: by its own sigma the angle would need none at the speeds below.
    path.write_text('[motor]\npreset = "m2"\n[injection]\nwaveform = "rotating"\nspeed_on = 40\nspeed_off = 60\n')
    return path


class Stub:
    """A running drive_stub."""

    def __init__(self, program: str, out: Path, *options: str) -> None:
        with out.open("w") as file:
            self.process = subprocess.Popen([program, "vcan0", *options], stdout=file, stderr=subprocess.STDOUT)
        self._out = out
        self._read = 0
        self._log: list[Event] = []

    @property
    def log(self) -> list[Event]:
        """What it printed so far; only what is new is read, as there is one processor for everything."""
        with self._out.open("rb") as file:
            file.seek(self._read)
            new = file.read()
        whole = new[:new.rfind(b"\n") + 1]
        self._read += len(whole)
        self._log += map(json.loads, whole.splitlines())
        return self._log

    def wait_for(self, begin: int = 0, **wanted: Any) -> int:
        """Wait for an event with these values from the given one on; its place in the log."""
        deadline = time.monotonic() + 120
        place = begin
        while time.monotonic() < deadline:
            log = self.log
            while place < len(log):
                if all(log[place].get(key) == value for key, value in wanted.items()):
                    return place
                place += 1
            assert self.process.poll() is None, self._out.read_text()
            time.sleep(0.05)
        raise AssertionError(f"no {wanted}: {self.log[-20:]}")

    def end(self) -> Event:
        """Ask it to end; its last line."""
        self.process.send_signal(signal.SIGTERM)
        return self.wait_to_end()

    def wait_to_end(self) -> Event:
        assert self.process.wait(SECONDS + 60) == 0, self._out.read_text()
        assert self.log[-1]["event"] == "end"
        return self.log[-1]


@contextmanager
def stub(program: str, folder: Path, *options: str) -> Iterator[Stub]:
    running = Stub(program, folder / "stub.json", *options)
    try:
        running.wait_for(event="start")
        yield running
    finally:
        if running.process.poll() is None:
            running.process.kill()
            running.process.wait(10)


def voltages(path: Path) -> NDArray[np.float64]:
    """(alpha, beta) [V] of every DriveSample on the bus."""
    samples = decoded(read(path), "DriveSample")
    return np.array([[m["v_alpha"], m["v_beta"]] for _, m in samples], np.float64).T


@pytest.mark.parametrize(("options", "rate", "frame", "per_frame"),
                         [((), 5000, 0x100, 1), (("--fd",), 10_000, 0x120, 7)])
def test_nothing_is_lost(program: str, config: Path, tmp_path: Path, options: tuple[str, ...], rate: int,
                         frame: int, per_frame: int) -> None:
    dump = tmp_path / "dump.log"
    with dumping(dump), companion(config, "--transmit", *options) as process:
        with stub(program, tmp_path, *options, "--rpm", "300", "--duration", str(SECONDS)) as drive:
            last = drive.wait_to_end()
        time.sleep(0.3)
        said = ended(process)
    log = read(dump)
    frames = [data for _, can_id, data in log if can_id == frame]
    assert last["dropped"] == last["errors"] == 0
    assert last["sent"] == sum(can_id < 0x200 for _, can_id, _ in log)
    assert last["sample"] == round(SECONDS * rate)  # a stub that stood still is late, but loses none
    assert len(frames) == last["sample"] // per_frame
    assert number(r"kernel drops (\d+)", said) == 0
    assert number(r" lost (\d+)", said) == 0
    assert number(r"bad frames (\d+)", said) == 0
    assert number(r"duplicates (\d+)", said) == 0
    # A companion counts from the sample it can first place: in classical frames a DriveTiming may settle that.
    assert len(frames) * per_frame - 100 <= number(r"(\d+) samples", said) <= len(frames) * per_frame
    # What comes within the last tick or after it finds nobody any more.
    places = [place for place, (_, can_id, _) in enumerate(log) if can_id == frame]
    in_time = sum(can_id == 0x200 for _, can_id, _ in log[:places[-20 // per_frame - 1]])
    taken = last["estimates"]
    assert in_time <= taken["ok"] <= sum(can_id == 0x200 for _, can_id, _ in log)
    assert taken["repeated"] == taken["wrong_sequence"] == taken["wrong_crc"] == taken["lost"] == 0
    commands = [data for _, can_id, data in log if can_id == 0x220]
    assert last["commands"]["ok"] == len(commands)
    assert last["commands"]["rejected"] == 0
    assert last["usable"] > 0  # how long depends on how evenly the processes get their turns
    errors = [event["error_deg"] for event in drive.log if event["event"] == "counts"]
    assert 0.0 < max(errors[1:]) < 1.0


def test_a_killed_companion_and_the_next_one(program: str, config: Path, tmp_path: Path) -> None:
    """Killed while the drive probes: probing ends by the time to live and the angle is refused; a new companion
    finds the rotor again and probes again."""
    dump = tmp_path / "dump.log"
    # The companion first: where it has to compile its kernels, nobody else should need the processor.
    with (dumping(dump), companion(config, "--transmit") as process,
          stub(program, tmp_path, "--rpm", "100") as drive):
        drive.wait_for(event="probing", waveform=1)
        drive.wait_for(event="angle", verdict="usable")
        time.sleep(0.5)
        before = len(drive.log)
        process.kill()
        off = drive.wait_for(before, event="probing", waveform=0)
        # Not an event but the state: on a slow machine the last estimate may have been too old already.
        drive.wait_for(off, event="counts")
        silent = next(e for e in reversed(drive.log) if e["event"] == "counts")
        assert silent["probing"] == 0
        refused = [e["verdict"] for e in drive.log if e["event"] == "angle"][-1]
        assert refused == "missing"
        restart = len(drive.log)
        with companion(config, "--transmit"):
            on = drive.wait_for(restart, event="probing", waveform=1)
            usable = drive.wait_for(restart, event="angle", verdict="usable")
            drive.wait_for(max(on, usable), event="counts")
        drive.wait_for(usable, event="angle", verdict="missing")
        last = drive.end()
    # By the library's own count, whatever the machine did meanwhile: 100 ms are 500 samples.
    ending = drive.log[off]
    assert 0 < ending["samples_since_command"] <= TIME_TO_LIVE_MS * 5
    # ... and as the bus saw it: samples after the last command until the probing is gone from the voltage.
    log = read(dump)
    kinds = [can_id for _, can_id, _ in log if can_id in (0x100, 0x220)]
    commands = np.flatnonzero(np.array(kinds) == 0x220)
    gap = int(np.argmax(np.diff(commands)))
    first_death = int(commands[gap])
    samples_before = first_death - gap  # DriveSamples before the last command
    v = voltages(dump)
    ripple = np.hypot(*(v - turned(v)))
    after = np.flatnonzero(ripple[samples_before:samples_before + 1500] > 2.0)
    # Two periods from decision to report, and the tick in which the command was read.
    assert 0 < after.max() <= TIME_TO_LIVE_MS * 5 + 2 + 10
    assert ripple[samples_before - 500:samples_before].max() > 3.0
    error = [e["error_deg"] for e in drive.log[usable:] if e["event"] == "counts"]
    assert 0.0 < max(error) < 5.0
    # The new companion's counter begins anew: at most one command and one estimate are taken for old ones.
    assert last["commands"]["rejected"] <= 1
    assert last["commands"]["wrong_crc"] == last["commands"]["not_executable"] == 0


def turned(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The slow part of a voltage: what a straight line through five periods of 400 Hz at 5 kHz leaves."""
    width = 25  # two periods of the probing signal
    kernel = np.ones(width) / width
    return np.array([np.convolve(axis, kernel, "same") for axis in v])


def forged(counter: int, **values: float) -> FrameBlock:
    signals = {"waveform": 1.0, "amplitude": 5.0, "frequency": 400.0, "axis_angle": 0.0, "time_to_live": 100.0}
    raw = PROTOCOL.encode(MessageKind.INJECTION_COMMAND, 0, {**signals, **values}, counter)
    return FrameBlock(raw, np.zeros(1, np.int64))


def test_forged_commands(program: str, tmp_path: Path) -> None:
    """Wrong CRC, a frozen counter, and an amplitude beyond the clamp: the first two do nothing, the third gets no
    further than the clamp, and all are counted.  Seen from the drive and from the voltage on the bus."""
    dump = tmp_path / "dump.log"
    with (dumping(dump), stub(program, tmp_path, "--rpm", "0", "--noise", "0") as drive,
          SocketCanPort("vcan0") as port):
        drive.wait_for(event="counts")
        for _ in range(3):  # nothing is known of the counter yet; each has another one
            for k in range(8):
                bad = forged(k, amplitude=200.0)
                bad.raw[:, 8 + k] ^= 0x10
                port.send(bad)
                time.sleep(0.002)
        other = PROTOCOL.encode(MessageKind.INJECTION_COMMAND, 1, {"waveform": 1.0, "amplitude": 5.0}, 0)
        other.view(np.uint32)[:, 0] -= np.uint32(1)  # another node's command under this node's identifier
        port.send(FrameBlock(other, np.zeros(1, np.int64)))
        quiet = drive.wait_for(len(drive.log), event="counts")
        assert drive.log[quiet]["commands"]["wrong_crc"] == 25
        assert drive.log[quiet]["commands"]["rejected"] == 25
        assert drive.log[quiet]["probe_peak"] == 0.0
        assert not [e for e in drive.log if e["event"] == "probing"]

        port.send(forged(5))  # a good one, and then the same counter for longer than it lives
        drive.wait_for(event="probing", waveform=1)
        for _ in range(100):
            port.send(forged(5, amplitude=25.0))
            time.sleep(0.005)
        off = drive.wait_for(quiet, event="probing", waveform=0)
        frozen = drive.wait_for(len(drive.log), event="counts")
        # Counted in samples and by the clock: where the stub got no turn for a while, the clock ends it.
        assert drive.log[off]["samples_since_command"] <= TIME_TO_LIVE_MS * 5
        assert (drive.log[off]["samples_since_command"] == TIME_TO_LIVE_MS * 5
                or drive.log[off]["us_since_command"] > TIME_TO_LIVE_MS * 1000)
        assert drive.log[frozen]["commands"]["repeated"] == 100
        assert drive.log[frozen]["commands"]["ok"] == 1
        assert 4.5 < drive.log[frozen]["probe_peak"] <= 5.0

        for counter, signal_ in ((6, {"waveform": 7.0}), (7, {"frequency": 0.0}), (8, {"frequency": 3000.0})):
            port.send(forged(counter, **signal_))
        refused = drive.wait_for(len(drive.log), event="counts")
        assert drive.log[refused]["commands"]["not_executable"] == 3
        assert drive.log[refused]["probing"] == 0

        port.send(forged(9, amplitude=200.0, time_to_live=400.0))
        drive.wait_for(refused, event="probing", waveform=1)
        drive.wait_for(refused, event="probing", waveform=0)
        last = drive.end()
    assert last["commands"]["beyond_limit"] == 1
    assert last["commands"]["rejected"] == 25 + 100 + 3
    assert 0.9 * CLAMP < last["probe_peak"] <= CLAMP + 0.001
    # Standing still without noise, the voltage on the bus is the probing signal and what the control answers.
    size = np.hypot(*voltages(dump))
    assert 20.0 < size.max() < 1.5 * CLAMP
    statuses = decoded(read(dump), "DriveStatus")
    assert statuses[-1][1]["rejected_commands"] == 128
    assert max(m["faults"] for _, m in statuses) == 1 << 5
