"""Drive and companion as two processes on a real SocketCAN interface; candump and cansend as third parties."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cantools
import cantools.autosar
import numpy as np
import pytest

from ipmsm_can.wire.dbc import default_dbc_path

PROGRAM = [sys.executable, "-m", "ipmsm_can"]
BUS = ["-i", "socketcan", "-c", "vcan0"]
ENVIRONMENT = {**os.environ, "PYTHONUNBUFFERED": "1"}
needs_can_utils = pytest.mark.skipif(not (shutil.which("candump") and shutil.which("cansend"))
                                     and os.environ.get("CI") != "true", reason="can-utils are not installed")
pytestmark = needs_can_utils

Log = list[tuple[float, int, bytes]]
LAST_ID = 0x7FE
"""A frame that ends a recording; nobody else uses it."""


@contextmanager
def dumping(path: Path) -> Iterator[None]:
    """candump into a file; its receive buffer is large enough for everything here."""
    with path.open("wb") as out:
        process = subprocess.Popen(["candump", "-L", "-r", str(1 << 25), "vcan0"], stdout=out)
        time.sleep(0.3)
        try:
            yield
        finally:
            # On a slow machine it lags behind; when it has written the last frame it has written them all.
            subprocess.run(["cansend", "vcan0", f"{LAST_ID:03X}#"], check=True)
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline and f" {LAST_ID:03X}#" not in path.read_text()[-200:]:
                time.sleep(0.1)
            process.terminate()
            process.wait(10)


def read(path: Path) -> Log:
    """What candump wrote: (time, identifier, payload); parsed here, not by the package."""
    pattern = re.compile(r"\((\d+\.\d+)\) vcan0 ([0-9A-F]+)#(?:#[0-9A-F])?([0-9A-F]*)")
    found = (pattern.match(line) for line in path.read_text().splitlines())
    frames = [(float(m[1]), int(m[2], 16), bytes.fromhex(m[3])) for m in found if m]
    assert frames[-1][1] == LAST_ID, "candump did not get to the end"
    return frames[:-1]


@contextmanager
def companion(config: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`ipmsm-can run` that is ready to listen."""
    process = subprocess.Popen([*PROGRAM, "run", str(config), *BUS, *options], stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True, env=ENVIRONMENT)
    try:
        assert process.stdout is not None
        for line in process.stdout:  # it speaks once the bus is open
            if "| drive " in line:
                break
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(10)


def drive(*options: str) -> str:
    """`ipmsm-can drive` to its end; what it printed."""
    done = subprocess.run([*PROGRAM, "drive", *BUS, *options], capture_output=True, text=True, timeout=120,
                          env=ENVIRONMENT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ended(process: subprocess.Popen[str]) -> str:
    """Ask the companion to end; what it printed from here on."""
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0, out
    return out


def number(pattern: str, text: str) -> int:
    """The number in the first match."""
    match = re.search(pattern, text)
    assert match, f"{pattern!r} not in {text!r}"
    return int(match[1])


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "drive.toml"
    path.write_text('[motor]\npreset = "m2"\n')
    return path


@pytest.fixture
def steady(tmp_path: Path) -> Path:
    """A profile that is at 300 rpm at once: lock within a fraction of a second."""
    path = tmp_path / "steady.toml"
    path.write_text("duration = 4.0\nspeed_rpm = [[0, 300], [2, 300], [3, 600]]\n"
                    "load_torque = [[0, 0], [2.5, 0], [2.5, 3]]\n")
    return path


def decoded(log: Log, name: str, node: int = 0) -> list[tuple[float, dict[str, Any]]]:
    """Messages of a node as cantools decodes them."""
    database: Any = cantools.database.load_file(str(default_dbc_path()))
    message = database.get_message_by_name(name)
    return [(t, message.decode(data, decode_choices=False)) for t, can_id, data in log
            if can_id == message.frame_id + node]


def errors_at_matching_samples(log: Log) -> np.ndarray:
    """Angle error [deg] of every valid PositionEstimate whose sample also has a DriveReference."""
    last_seen: dict[int, tuple[float, float]] = {}
    errors = []
    references = iter(decoded(log, "DriveReference"))
    upcoming = next(references, None)
    for t, m in decoded(log, "PositionEstimate"):
        while upcoming is not None and upcoming[0] <= t:
            last_seen[int(upcoming[1]["sample_counter"]) & 0x3FF] = (upcoming[0], float(upcoming[1]["theta_e"]))
            upcoming = next(references, None)
        seen = last_seen.get(int(m["sample_counter"]))
        if seen is not None and t - seen[0] < 0.05 and m["valid"]:
            errors.append((np.degrees(float(m["theta_e"]) - seen[1]) + 180.0) % 360.0 - 180.0)
    return np.array(errors)


@pytest.fixture(params=[(), ("--firmware",)], ids=["python", "c"])
def wire(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Options of the drive: whether the package or the C library makes and checks its frames."""
    if request.param and not shutil.which("cc"):
        pytest.skip("no C compiler")
    options: tuple[str, ...] = request.param
    return options


@pytest.mark.parametrize(("options", "rate", "sample_id"), [((), 5000, 0x100), (("--fd",), 10_000, 0x120)])
def test_two_processes_and_a_witness(config: Path, steady: Path, tmp_path: Path, wire: tuple[str, ...],
                                     options: Sequence[str], rate: int, sample_id: int) -> None:
    """No frame lost, estimates at 1 kHz, each with the right CRC, the right sample and the right angle."""
    dump = tmp_path / "dump.log"
    with dumping(dump), companion(config, "--transmit", *options) as process:
        driven = drive(str(config), "--profile", str(steady), "--duration", "4", *options, *wire)
        said = ended(process)
    log = read(dump)
    per_frame = 7 if options else 1
    samples = sum(can_id == sample_id for _, can_id, _ in log) * per_frame
    # A drive on a machine that is too slow gives up time, never frames.
    assert number(r"(\d+) frames sent", driven) == sum(can_id < 0x200 for _, can_id, _ in log)
    assert 1.5 * rate < samples <= 4.1 * rate
    assert number(r"(\d+) samples", said) == samples
    assert number(r"kernel drops (\d+)", said) == 0
    assert number(r"lost (\d+)", said) == 0
    assert number(r"bad frames (\d+)", said) == 0
    estimates = [(t, data) for t, can_id, data in log if can_id == 0x200]
    # An estimate older than 20 ms is not sent, so a machine that stood still for that long sends fewer; the
    # exact rate is tested in virtual time.
    assert 0.8 <= len(estimates) / (samples / (rate / 1000)) <= 1.001
    identifiers = _data_ids("PositionEstimate")
    for k, (_, data) in enumerate(estimates):
        assert data[1] & 0x0F == k % 16
        assert data[0] == cantools.autosar.compute_profile2_crc(data, identifiers[k % 16])
    counters = [int(m["sample_counter"]) for _, m in decoded(log, "PositionEstimate")]
    assert np.mean(np.diff(counters) % 1024 == rate // 1000) > 0.8
    errors = errors_at_matching_samples(log)
    assert errors.size > 100  # of some hundreds, fewer where the machine gave up time
    assert np.abs(errors).max() < 15.0
    assert np.sqrt(np.mean(errors[errors.size // 2:] ** 2)) < 0.5


def _data_ids(name: str) -> list[int]:
    database: Any = cantools.database.load_file(str(default_dbc_path()))
    attribute = database.get_message_by_name(name).dbc.attributes["E2EDataIDList"].value
    return list(bytes.fromhex(re.sub(r"[^0-9A-Fa-f]", "", str(attribute))))


def test_silent_without_transmit(config: Path, steady: Path, tmp_path: Path) -> None:
    dump = tmp_path / "dump.log"
    with dumping(dump), companion(config) as process:
        drive(str(config), "--profile", str(steady), "--duration", "1")
        said = ended(process)
    log = read(dump)
    assert "SILENT" in said
    assert number(r"(\d+) samples", said) > 1000
    assert not [can_id for _, can_id, _ in log if can_id >= 0x200]


def test_garbage_from_cansend_is_dropped_counted_and_shown(config: Path, steady: Path, tmp_path: Path) -> None:
    dump = tmp_path / "dump.log"
    with dumping(dump), companion(config, "--transmit") as process:
        for frame in ("100#11", "100#", "140#0011223344556677", "7FF#DEADBEEF", "100#R", "1FFFFFFF#00",
                      "120#1122334455667788", "160#FFFFFFFFFFFFFF"):
            subprocess.run(["cansend", "vcan0", frame], check=True)
        drive(str(config), "--profile", str(steady), "--duration", "2")
        said = ended(process)
    statuses = decoded(read(dump), "CompanionStatus")
    assert number(r"(\d+) samples", said) > 2000
    assert number(r"unknown ids (\d+)", said) == 2
    assert number(r"wrong length (\d+)", said) == 4
    assert number(r"remote (\d+)", said) == 1
    assert statuses[-1][1]["bad_frames"] >= 4


def test_a_drive_stops_injecting_when_the_companion_dies(config: Path, tmp_path: Path,
                                                         wire: tuple[str, ...]) -> None:
    """The companion is killed, not asked: no "off" is ever sent, the time to live ends it."""
    dump = tmp_path / "dump.log"
    standing = tmp_path / "standing.toml"
    standing.write_text("duration = 3.0\nspeed_rpm = [[0, 0]]\n")
    with dumping(dump), companion(config, "--transmit") as process:
        driving = subprocess.Popen([*PROGRAM, "drive", str(config), *BUS, "--profile", str(standing), *wire],
                                   stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=ENVIRONMENT)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not _commands(dump):
            time.sleep(0.05)
        time.sleep(0.7)
        process.kill()
        driving.communicate(timeout=60)
    log = read(dump)
    last_command = max(t for t, can_id, _ in log if can_id == 0x220)
    status = decoded(log, "DriveStatus")
    assert any(m["active_waveform"] == 1 for t, m in status if t < last_command)
    # 0.1 s to live, and DriveStatus speaks every 0.1 s.
    after = [m["active_waveform"] for t, m in status if t > last_command + 0.3]
    assert after
    assert not any(after)


def _commands(path: Path) -> bool:
    return " 220#" in path.read_text()


def test_a_missing_interface_is_one_sentence(config: Path) -> None:
    done = subprocess.run([*PROGRAM, "run", str(config), "-i", "socketcan", "-c", "can17"], capture_output=True,
                          text=True, check=False, timeout=60, env=ENVIRONMENT)
    assert done.returncode == 2
    assert "can17" in done.stderr
    assert "Traceback" not in done.stderr
