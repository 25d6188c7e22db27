"""The companion and the simulated drive as a person starts them, on python-can's virtual bus.

Everything here runs in real time on whatever machine there is: asserted is what happens, never how fast.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest

from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.port import BusError, open_port
from ipmsm_can.bus.warmup import warm_up_companion, warm_up_drives
from ipmsm_can.cli import bus, main
from ipmsm_can.cli.drive import build_drives, read_profile
from ipmsm_can.cli.monitor import RunMonitor
from ipmsm_can.companion import Companion
from ipmsm_can.config import parse_config
from ipmsm_can.config.build import build_protocol
from ipmsm_can.drive.profile import demo
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.dbc import default_dbc_path

M2 = '[motor]\npreset = "m2"\n'
DRIVE_IDS = {0x100, 0x140, 0x160, 0x180}


@contextmanager
def listening(channel: str, fd: bool = False) -> Iterator[list[can.Message]]:
    """All messages on a virtual bus, as a third party hears them."""
    heard: list[can.Message] = []
    protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
    with can.Bus(interface="virtual", channel=channel, protocol=protocol) as third:
        notifier = can.Notifier(third, [heard.append], timeout=0.1)
        try:
            yield heard
        finally:
            notifier.stop()


@contextmanager
def driving(channel: str, *options: str) -> Iterator[None]:
    """`ipmsm-can drive` in a thread: on the air before the body begins, told to end when it is over."""
    codes: list[int] = []
    stops: list[bus.Stop] = []
    thread = threading.Thread(target=lambda: codes.append(main(
        ["drive", *options, "--duration", "600", "-i", "virtual", "-c", channel, "--quiet"])))
    ordinary = bus.stop_on_signals

    @contextmanager
    def noted(duration: float | None = None) -> Iterator[bus.Stop]:
        with ordinary(duration) as stop:
            if threading.current_thread() is thread:
                stops.append(stop)
            yield stop

    with (pytest.MonkeyPatch.context() as patch,
          can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as first):
        patch.setattr(bus, "stop_on_signals", noted)
        thread.start()
        try:
            assert first.recv(timeout=240) is not None, "the drive never sent anything"
            yield
        finally:
            for stop in stops:
                stop.now()
            thread.join()
    assert codes == [0]


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile first, so that no test has to wait for it with a drive on the air."""
    configs = (parse_config(M2),)
    protocol = build_protocol(configs)
    warm_up_companion(configs, protocol)
    for fd in (False, True):
        warm_up_drives(build_drives(configs, protocol, demo(), fd=fd), protocol)


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "drive.toml"
    path.write_text(M2)
    return str(path)


@pytest.fixture
def steady(tmp_path: Path) -> str:
    path = tmp_path / "steady.toml"
    path.write_text("speed_rpm = [[0, 600]]\nduration = 60.0\n")
    return str(path)


DATABASE: Any = cantools.database.load_file(default_dbc_path())


def values(messages: list[can.Message], name: str) -> list[dict[str, float]]:
    """What cantools reads in the messages of one kind of drive 0."""
    message = DATABASE.get_message_by_name(name)
    return [message.decode(bytes(m.data), decode_choices=False) for m in messages
            if m.arbitration_id == message.frame_id]


def angle_errors(heard: list[can.Message]) -> list[float]:
    """Angle of each valid PositionEstimate minus that of the encoder at the same sample [rad electrical]."""
    reference, position = (DATABASE.get_message_by_name(n) for n in ("DriveReference", "PositionEstimate"))
    truth = {v["sample_counter"]: v["theta_e"] for v in values(heard, "DriveReference")}
    errors, latest = [], 0
    for m in heard:
        if m.arbitration_id == reference.frame_id:
            latest = reference.decode(bytes(m.data))["sample_counter"]
        elif m.arbitration_id == position.frame_id:
            v = position.decode(bytes(m.data), decode_choices=False)
            # ten bits of the counter, and it is never far from the encoder's
            sample = latest + (v["sample_counter"] - latest + 512) % 1024 - 512
            if v["valid"] and sample in truth:
                errors.append(float((v["theta_e"] - truth[sample] + np.pi) % (2 * np.pi) - np.pi))
    return errors


def test_run_is_silent_by_default(config: str, steady: str, capsys: pytest.CaptureFixture[str]) -> None:
    with listening("silent") as heard, driving("silent", "--profile", steady):
        assert main(["run", config, "-i", "virtual", "-c", "silent", "--duration", "1.5", "--quiet"]) == 0
    assert {m.arbitration_id for m in heard} == DRIVE_IDS
    out = capsys.readouterr().out
    assert out.startswith("SILENT (listening only) for 1.")
    assert "0 sent" in out
    assert "turnaround" not in out
    assert "drive 0 (m2): " in out


def test_run_answers_with_transmit_and_follows_the_rotor(config: str, steady: str,
                                                          capsys: pytest.CaptureFixture[str]) -> None:
    with listening("answers") as heard, driving("answers", "--profile", steady, "--theta0", "70"):
        code = main(["run", config, "-i", "virtual", "-c", "answers", "--transmit", "--duration", "2", "--quiet"])
    assert code == 0
    # at this speed there may be no reason to inject
    assert {m.arbitration_id for m in heard} - {0x220} == DRIVE_IDS | {0x200, 0x240, 0x260}
    assert capsys.readouterr().out.count("TRANSMITTING for 2.") == 1
    errors = angle_errors(heard)
    assert len(errors) > 50
    assert np.median(np.abs(errors)) < np.radians(2.0)


def test_no_samples_are_a_fault(config: str, tmp_path: Path, steady: str,
                                capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.toml"
    other.write_text(M2 + "[wire]\nnode = 5\n")
    with driving("one of two", "--profile", steady):
        code = main(["run", config, str(other), "-i", "virtual", "-c", "one of two", "--duration", "1", "--quiet"])
    out, err = capsys.readouterr()
    assert code == 1
    assert err.count("\n") == 1
    assert err.startswith("ipmsm-can run: drive 5 sent no samples that could be used (identifier 0x105 or 0x125); ")
    assert "drive 5 (m2): no samples came" in out and "drive 0 (m2): no samples" not in out


def test_samples_without_a_rate_are_a_fault(tmp_path: Path, steady: str,
                                            capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "mute.toml"
    config.write_text(M2)
    mute = tmp_path / "drive.toml"
    mute.write_text(M2 + "[simulation]\ntiming_rate = 0\n")
    with driving("mute", str(mute), "--profile", steady):
        assert main(["run", str(config), "-i", "virtual", "-c", "mute", "--duration", "1", "--quiet"]) == 1
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and "drive 0 sent samples but no DriveTiming" in err and "wire.sample_rate" in err
    assert "drive 0 (m2): no sample could be used: waiting for DriveTiming" in out


def test_an_observer_that_never_locked_is_told(config: str, tmp_path: Path, steady: str,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    """At standstill, listening, nothing can lock: that is no fault of the bus, but it is to be said."""
    profile = tmp_path / "still.toml"
    profile.write_text("speed_rpm = [[0, 0]]\nduration = 60.0\n")
    for name, words in ((str(profile), True), (steady, False)):
        with driving("lazy", "--profile", name):
            assert main(["run", config, "-i", "virtual", "-c", "lazy", "--duration", "1.5", "--quiet"]) == 0
        told = capsys.readouterr().out
        assert ("the observer never locked" in told) == words, told
        assert "never valid" not in told


def test_the_drive_obeys_the_companion(config: str, tmp_path: Path) -> None:
    profile = tmp_path / "still.toml"
    profile.write_text("speed_rpm = [[0, 0]]\nduration = 60.0\n")
    with listening("obeys") as heard, driving("obeys", "--profile", str(profile)):
        code = main(["run", config, "-i", "virtual", "-c", "obeys", "--transmit", "--duration", "1.5", "--quiet"])
        time.sleep(0.5)  # time to live 0.1 s, and DriveStatus comes every 0.1 s
    assert code == 0
    commands = values(heard, "InjectionCommand")
    assert commands and {v["waveform"] for v in commands} <= {1, 3}  # rotating, and polarity pulses at standstill
    assert 1 in {v["waveform"] for v in commands}
    assert max(v["amplitude"] for v in commands) > 1.0
    told = [v["active_waveform"] for v in values(heard, "DriveStatus")]
    assert 1 in told
    assert told[-1] == 0, "nobody commands any more: the time to live ends it"
    assert all(v["valid"] == 0 for v in values(heard, "PositionEstimate"))


def test_two_drives_in_can_fd(tmp_path: Path, steady: str) -> None:
    files = []
    for node in (0, 5):
        path = tmp_path / f"n{node}.toml"
        path.write_text(f"{M2}[wire]\nnode = {node}\n[simulation]\nsample_rate = 2000\ncurrent_bandwidth = 100\n")
        files.append(str(path))
    with listening("two", fd=True) as heard, driving("two", *files, "--profile", steady, "--fd"):
        assert main(["run", *files, "-i", "virtual", "-c", "two", "--fd", "--transmit", "--duration", "1.5",
                     "--quiet"]) == 0
    assert {m.arbitration_id for m in heard} >= {0x120, 0x125, 0x200, 0x205, 0x260, 0x265}
    assert not {m.arbitration_id for m in heard} & {0x100, 0x105}
    blocks = [m for m in heard if m.arbitration_id == 0x125]
    assert all(m.is_fd and m.dlc == 64 for m in blocks)


def test_a_drive_says_how_fast_it_samples(steady: str) -> None:
    with listening("says") as heard:
        code = main(["drive", "--profile", steady, "-i", "virtual", "-c", "says", "--duration", "0.5", "--quiet"])
    assert code == 0
    timing = values(heard, "DriveTiming")
    assert timing and {v["sample_rate"] for v in timing} == {5000}
    samples = [m for m in heard if m.arbitration_id == 0x100]
    assert [m.data[7] >> 4 for m in samples[:40]] == [k % 16 for k in range(40)]


class LeavingPort:
    """A port whose adapter is pulled out at the third look."""

    description, fd, drops, unsent = "pulled (test)", False, 0, 0

    def __init__(self) -> None:
        self.looks = 0
        self.closed = False

    def receive(self, timeout_s: float, *_: object) -> FrameBlock:
        self.looks += 1
        if self.looks == 3:
            raise BusError("can0 is gone: No such device")
        return FrameBlock.zeros(0)

    def send(self, block: FrameBlock) -> int:
        return len(block)

    def __enter__(self) -> LeavingPort:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


@pytest.mark.parametrize("command", ["run", "drive"])
def test_a_bus_that_goes_away_is_a_fault(command: str, config: str, monkeypatch: pytest.MonkeyPatch,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    port = LeavingPort()
    monkeypatch.setattr(bus, "open_bus", lambda *_: port)
    code = main([command, config, "-i", "virtual", "-c", "pulled", "--quiet",
                 *(["--no-reconnect"] if command == "run" else [])])
    out, err = capsys.readouterr()
    assert code == 1
    assert port.closed
    assert err.startswith(f"ipmsm-can {command}: the bus went away after 0.")
    assert err.endswith("s: can0 is gone: No such device\n")
    assert err.count("\n") == 1
    assert out != "", "the summary comes all the same"


def started(*argv: str, terminal: int | None = None) -> subprocess.Popen[str]:
    """ipmsm-can as a process of its own, in a group of its own."""
    out = subprocess.PIPE if terminal is None else terminal
    return subprocess.Popen([sys.executable, "-m", "ipmsm_can", *argv], stdout=out, stderr=subprocess.PIPE,
                            stdin=subprocess.DEVNULL, text=True, start_new_session=True,
                            env={**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"})


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["run", "drive"])
def test_signals_end_it_with_a_summary(command: str, number: signal.Signals, config: str) -> None:
    process = started(command, config, "-i", "virtual", "-c", "signals")
    assert process.stdout is not None and process.stderr is not None
    first = process.stdout.readline()
    assert first.startswith("0:00:01 ")
    os.kill(process.pid, number)
    rest, err = process.communicate(timeout=60)
    err = err.removeprefix("compiling kernels (first time only) ...\n")
    if command == "run":
        assert process.returncode == 1
        assert "no samples came" in rest
        assert err.count("\n") == 1 and "drive 0 sent no samples that could be used" in err
    else:
        assert (process.returncode, err) == (0, "")
        assert "frames sent in" in rest


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals of POSIX")
def test_on_a_terminal_the_status_is_a_picture_that_leaves_nothing_behind(config: str) -> None:
    import pty

    master, slave = pty.openpty()
    process = started("run", config, "-i", "virtual", "-c", "picture", "--duration", "2", terminal=slave)
    os.close(slave)
    shown = bytearray()
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:  # Linux: the other side is closed
            break
        if not part:
            break
        shown += part
    os.close(master)
    assert process.wait(timeout=60) == 1  # no samples came
    enter, leave = shown.index(b"\x1b[?1049h"), shown.rindex(b"\x1b[?1049l")
    picture = bytes(shown[enter:leave])
    assert b"SILENT (listening only)" in picture
    assert b"waiting for samples" in picture
    assert b"no samples came" in shown[leave:]


def test_the_first_frames_do_not_wait_for_a_compiler() -> None:
    """After the warm-up, a live companion compiles nothing more: neither single frames nor blocks nor CAN FD."""
    code = """
import sys, numpy as np
from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.port import open_port
from ipmsm_can.bus.warmup import warm_up_companion, warm_up_drives
from ipmsm_can.cli.drive import build_drives
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.config.build import build_protocol
from ipmsm_can.drive.profile import demo

def compiled():
    return {f"{m}.{n}": len(f.signatures) for m, module in list(sys.modules.items()) if m.startswith("ipmsm_can")
            for n, f in vars(module).items() if hasattr(f, "signatures")}

configs = (config_from({"motor": {"preset": "m2"}}),)
protocol = build_protocol(configs)
with open_port({"interface": "virtual", "channel": "warm", "fd": True}) as port, \
        open_port({"interface": "virtual", "channel": "warm", "fd": True}) as other:
    warm_up_companion(configs, protocol)
    warm_up_drives(build_drives(configs, protocol, demo()), protocol)
    warm_up_drives(build_drives(configs, protocol, demo(), fd=True), protocol)
    before = compiled()
    assert sum(before.values()) > 20, before
    for fd in (False, True):
        runner = LiveRunner(port, Companion(configs, protocol, True), 1e6, 5e6)
        drive, = build_drives(configs, protocol, demo(), fd=fd)
        for n in [1, 2, 3, 50] * 10 + [500] * 5:
            other.send(drive.step(n).frames)
            runner.round()
            drive.receive(other.receive(0.0))
        faults = BusFaults(loss=0.02, duplication=0.02, reordering=0.02, burst=0.001)
        drives, companion = build_drives(configs, protocol, demo(), fd=fd), Companion(configs, protocol, True)
        CoSimulation(drives, companion, faults).run(1.0)
    after = compiled()
print({name: (before.get(name, 0), n) for name, n in after.items() if n != before.get(name, 0)})
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    assert told.stdout.strip() == "{}"


def test_a_second_look_at_the_clock_ends_a_run() -> None:
    stop = bus.Stop(0.05)
    assert not stop()
    time.sleep(0.06)
    assert stop()
    by_hand = bus.Stop()
    assert not by_hand()
    by_hand.now("SIGTERM")
    assert by_hand() and by_hand.name == "SIGTERM"


def test_opening_asks_for_can_fd_where_a_drive_needs_it() -> None:
    args = argparse.Namespace(interface="virtual", channel="asks")
    with bus.open_bus(args) as port:
        assert not port.fd
    with bus.open_bus(args, fd=True) as port:
        assert port.fd
    with open_port({"interface": "virtual", "channel": "asks"}) as port:
        assert not port.fd


def test_a_drive_that_fell_silent_has_no_valid_angle_on_the_screen(steady: str) -> None:
    configs = (parse_config(M2),)
    protocol = build_protocol(configs)
    drive, = build_drives(configs, protocol, read_profile(steady))
    with bus.open_bus(argparse.Namespace(interface="virtual", channel="stale")) as port:
        runner = LiveRunner(port, Companion(configs, protocol, transmit=True), 1e6, 5e6)
        monitor = RunMonitor(runner)
        runner.companion.process(drive.step(10_000).frames, 2_000_000_000)
        runner.companion.process(FrameBlock.zeros(0), 2_010_000_000)
        before, = monitor.status().nodes
        runner.companion.process(FrameBlock.zeros(0), 2_500_000_000)
        after, = monitor.status().nodes
    assert (before.live, before.valid, before.trust) == (True, True, "VALID")
    assert before.rpm == pytest.approx(600.0, abs=1.0)
    assert before.received == 10_000
    assert (after.live, after.valid, after.locked, after.polarity_known) == (False, False, False, False)
    assert (after.trust, after.state) == ("no estimate", "no samples any more")


def test_drives_start_where_they_are_told_and_each_has_noise_of_its_own(steady: str) -> None:
    configs = tuple(parse_config(f"{M2}[wire]\nnode = {k}\n") for k in range(2))
    protocol = build_protocol(configs)
    runs = [[d.step(20).samples for d in build_drives(configs, protocol, read_profile(steady), 1.25, seed)]
            for seed in (0, 7, 7)]
    assert [drive.theta_e[0] for run in runs for drive in run] == pytest.approx([1.25] * 6)
    assert not np.array_equal(runs[0][0].i_alpha, runs[0][1].i_alpha)
    assert not np.array_equal(runs[0][0].i_alpha, runs[1][0].i_alpha)
    assert np.array_equal(runs[1][1].i_alpha, runs[2][1].i_alpha)
