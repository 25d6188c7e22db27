"""The two sides of the demo: the drive, in a thread or in a process of its own, and both in virtual time."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self

import numpy as np

from ipmsm_can.bus.bits import BusLoad
from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.bus.drive_runner import DriveRunner
from ipmsm_can.bus.port import BusError, Port, open_port
from ipmsm_can.bus.warmup import warm_up_companion, warm_up_drives
from ipmsm_can.companion import Companion
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import demo
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import Node
from ipmsm_can.report.recorder import Record, Recorder
from ipmsm_can.report.summary import BusFigures
from ipmsm_can.wire.protocol import Protocol

_CLASSICAL_RATE, _FD_RATE = 5000.0, 10_000.0
_LOOK_S = 0.005
_SWITCH_S = 0.0005
_START_S, _END_S = 120.0, 3.0


@dataclass(frozen=True, slots=True)
class Setting:
    """What the demo runs: everything a second process needs to build the same drive.

    duration [s]; seed: of the sensor noise and of the rotor's first angle.
    """

    fd: bool
    seed: int
    duration: float

    def config(self) -> DriveConfig:
        """The companion's configuration: M2 with every default."""
        return config_from({"motor": {"preset": "m2"}}, source="demo")

    def protocol(self) -> Protocol:
        """The project's own messages."""
        return Protocol()

    @property
    def theta_0(self) -> float:
        """The rotor's first angle [rad electrical], -pi..pi."""
        return float(np.random.default_rng(self.seed).uniform(-math.pi, math.pi))

    def drive(self, protocol: Protocol) -> DriveNode:
        """A drive at the beginning of the profile."""
        config = self.config()
        parameters = DriveParameters(sample_rate=_FD_RATE if self.fd else _CLASSICAL_RATE)
        simulation = DriveSimulation(config.build_motor(), parameters, demo(), self.theta_0, self.seed)
        return DriveNode(protocol, config.wire.node, simulation, DriveNodeSettings(fd=self.fd))


@dataclass(frozen=True, slots=True)
class Outcome:
    """A run that is over.  theta_0 [rad electrical]; trouble: what went wrong outside the figures."""

    record: Record
    node: Node
    bus: BusFigures
    theta_0: float
    trouble: list[str] = field(default_factory=list)


@dataclass(slots=True)
class DriveResult:
    """How it went on the drive's side; error: a sentence, "" if all was well."""

    unsent: int = 0
    slips: int = 0
    rejected: int = 0
    error: str = ""


def warm_up(setting: Setting) -> None:
    """Compile or load all kernels that a run needs."""
    run_in_virtual_time(Setting(setting.fd, 0, 0.1))
    warm_up_companion([setting.config()], setting.protocol())


def run_in_virtual_time(setting: Setting, faults: BusFaults | None = None) -> Outcome:
    """Both sides on one virtual bus, as fast as the machine goes; the same bits every time."""
    config, protocol = setting.config(), setting.protocol()
    drive = setting.drive(protocol)
    companion = Companion([config], protocol, transmit=True)
    simulation = CoSimulation([drive], companion, faults, keep_frames=True)
    recorder = Recorder(companion, config.wire.node)
    load = BusLoad(config.wire.bitrate, config.wire.data_bitrate)
    nothing = FrameBlock.zeros(0)
    for look in range(round(setting.duration / _LOOK_S)):
        recording = simulation.run(_LOOK_S)
        now_ns = round((look + 1) * 1e9 * _LOOK_S)
        frames = FrameBlock.concat(recording.frames)
        load.update(frames)
        companion.bus_load = load.load(now_ns)
        recorder.observe(frames, recording.tracked[config.wire.node], nothing, now_ns)
        # What has been looked at goes, so that a long run needs no more memory than its record.
        recording.frames.clear()
        recording.tracked[config.wire.node].clear()
        recording.truth[config.wire.node].clear()
    figures = BusFigures("a simulated bus in virtual time", rejected_commands=drive.rejected)
    return Outcome(recorder.record(), companion.nodes[config.wire.node], figures, setting.theta_0)


class ThreadDrive:
    """The drive in a thread of this process, for buses that do not leave it.  Closes the port in the end."""

    def __init__(self, setting: Setting, port: Port) -> None:
        self._port = port
        self._runner = DriveRunner(port, [setting.drive(setting.protocol())])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="drive", daemon=True)
        self._result = DriveResult()
        # Two threads that take turns every millisecond must not wait 5 ms for the interpreter.
        self._switch_before = sys.getswitchinterval()

    def __enter__(self) -> Self:
        sys.setswitchinterval(_SWITCH_S)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._port.close()
        sys.setswitchinterval(self._switch_before)

    def go(self) -> None:
        """Start driving."""
        self._thread.start()

    @property
    def failed(self) -> bool:
        """The drive is gone."""
        return bool(self._result.error)

    def _work(self) -> None:
        try:
            self._runner.run(self._stop.is_set)
        except (BusError, ValueError) as error:
            self._result.error = f"the drive gave up: {error}"

    def finish(self) -> DriveResult:
        """How it went, after the with block."""
        runner = self._runner
        return DriveResult(self._port.unsent, runner.slips, runner.drives[0].rejected, self._result.error)


class ProcessDrive:
    """The drive in a process of its own, as it would be on a real bus.

    options: of the bus, as for `open_port`.  Entering waits until the drive is ready; a drive that cannot
    start raises BusError there.
    """

    def __init__(self, setting: Setting, options: Mapping[str, Any]) -> None:
        # A fresh interpreter: forking one that has threads and an open bus is asking for trouble.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        plain = {k: v for k, v in options.items() if isinstance(v, str | int | float | bool | list | dict)}
        self._process = context.Process(target=_drive_process, args=(theirs, setting, plain), name="drive",
                                        daemon=True)
        self._result = DriveResult(error="the drive did not answer")
        self._theirs = theirs

    def __enter__(self) -> Self:
        self._process.start()
        self._theirs.close()
        answer = self._hear(_START_S)
        if answer != "ready":
            self._process.join(_END_S)
            raise BusError(0, answer.error if isinstance(answer, DriveResult) else "the drive did not start")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        with contextlib.suppress(OSError):
            self._pipe.send("stop")
        answer = self._hear(_END_S)
        if isinstance(answer, DriveResult):
            self._result = answer
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()

    def go(self) -> None:
        """Start driving."""
        self._pipe.send("go")

    @property
    def failed(self) -> bool:
        """The drive is gone."""
        return not self._process.is_alive()

    def _hear(self, patience_s: float) -> object:
        try:
            return self._pipe.recv() if self._pipe.poll(patience_s) else None
        except (EOFError, OSError):
            return None

    def finish(self) -> DriveResult:
        """How it went, after the with block."""
        return self._result


def _drive_process(pipe: Connection, setting: Setting, options: Mapping[str, Any]) -> None:
    """Body of the drive's process: ready, go, drive until anything comes through the pipe, report."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the companion's side hears Ctrl-C and says stop
    result = DriveResult()
    try:
        protocol = setting.protocol()
        warm_up_drives([setting.drive(protocol)], protocol)
        with open_port(options) as port:
            runner = DriveRunner(port, [setting.drive(protocol)])
            port.receive(0.0)
            pipe.send("ready")
            pipe.recv()
            try:
                runner.run(pipe.poll)
            finally:
                result = DriveResult(port.unsent, runner.slips, runner.drives[0].rejected)
    except (BusError, ValueError) as error:
        result.error = f"the drive gave up: {error}"
    except EOFError:
        return  # the other side is gone
    with contextlib.suppress(OSError):
        pipe.send(result)
