"""Whoever listens sends nothing, whatever arrives and however often the bus goes away; and it always says so."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.port import BusError
from ipmsm_can.cli import bus, main
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CAN_ERR_FLAG, FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol

PROTOCOL = Protocol()


def everything() -> FrameBlock:
    """A drive that stands and would like to be probed, its answers' own identifiers, error frames, and rubbish."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(0.0 * RPM, 0.0, 4.0))
    drive = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings()).step(10_000).frames
    rng = np.random.default_rng(0)
    odd = FrameBlock(rng.integers(0, 256, (2000, 72)).astype(np.uint8), np.zeros(2000, np.int64))
    odd.can_id[:700] = rng.integers(0, 0x800, 700)
    odd.can_id[700:900] = CAN_ERR_FLAG | rng.integers(0, 0x400, 200).astype(np.uint32)
    odd.length[:] = np.minimum(odd.length, 64)
    places = np.sort(rng.integers(0, len(drive), len(odd)))
    odd.t_ns[:] = drive.t_ns[places]
    mixed = FrameBlock.concat([drive, odd]).take(np.argsort(np.concatenate([drive.t_ns, odd.t_ns]), kind="stable"))
    mixed.t_ns[:] += time.time_ns()
    return mixed


class Ear:
    """A port that only has ears: sending is a fault.  It fails after each block of frames where `failing`."""

    description, fd, drops, unsent = "ear (test)", True, 0, 0
    opened = 0
    at = 0

    def __init__(self, frames: FrameBlock, failing: bool) -> None:
        self.frames, self.failing = frames, failing
        self._heard = False
        Ear.opened += 1

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        if self._heard and self.failing:
            raise BusError("can0 is gone: No such device")
        block = self.frames.take(slice(Ear.at, Ear.at + 600))
        Ear.at += len(block)
        self._heard = True
        return block

    def send(self, block: FrameBlock) -> int:
        raise AssertionError(f"a listener sent {len(block)} frames")

    def close(self) -> None:
        """Nothing to close."""

    def __enter__(self) -> Ear:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "drive.toml"
    path.write_text('[motor]\npreset = "m2"\n')
    return str(path)


@pytest.mark.parametrize("failing", [False, True], ids=["steady bus", "bus that fails 20 times"])
@pytest.mark.parametrize("command", ["run", "bus"])
def test_a_listener_never_sends(command: str, failing: bool, config: str, monkeypatch: pytest.MonkeyPatch,
                                capsys: pytest.CaptureFixture[str]) -> None:
    frames = everything()
    Ear.at = Ear.opened = 0
    monkeypatch.setattr(bus, "open_bus", lambda *_: Ear(frames, failing))
    monkeypatch.setattr("ipmsm_can.bus.link.PAUSE_S", 0.0)
    monkeypatch.setattr("ipmsm_can.bus.link.Link.pause", lambda _: 0.25)
    asked = [0]

    class Until(bus.Stop):
        def __call__(self) -> bool:
            asked[0] += 1
            return Ear.at >= len(frames) and asked[0] > 50

    monkeypatch.setattr(bus, "Stop", Until)
    words = [config] if command == "run" else []
    code = main([command, *words, "-i", "virtual", "-c", "ear", "--quiet"])
    out, _ = capsys.readouterr()
    assert Ear.at == len(frames)
    if failing:
        assert Ear.opened >= 20
        assert "went away " in out
    if command == "run":
        assert out.startswith("SILENT (listening only) for ")
        assert "0 sent" in out and f"{len(frames)} frames received" in out
        assert code in (0, 1)  # 1: there was no bus at the end
    else:
        assert "error frames" in out
        assert code == (1 if failing else code)


@pytest.mark.parametrize("command", ["run", "bus"])
def test_no_reconnect_ends_with_what_was_heard(command: str, config: str, monkeypatch: pytest.MonkeyPatch,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    Ear.at = Ear.opened = 0
    frames = everything()
    monkeypatch.setattr(bus, "open_bus", lambda *_: Ear(frames, True))
    words = [config, "--quiet"] if command == "run" else ["--json"]
    code = main([command, *words, "-i", "virtual", "-c", "ear", "--no-reconnect"])
    out, err = capsys.readouterr()
    assert (code, Ear.opened) == (1, 1)
    assert "the bus went away" in err and err.rstrip().endswith("can0 is gone: No such device")
    if command == "bus":
        data = json.loads(out)
        assert data["frames"] + data["errors"]["frames"] == 600
    else:
        assert "600 frames received" in out


@pytest.mark.parametrize("command", ["run", "bus"])
def test_no_bus_at_the_end_is_a_fault(command: str, config: str, monkeypatch: pytest.MonkeyPatch,
                                      capsys: pytest.CaptureFixture[str]) -> None:
    Ear.at = Ear.opened = 0
    frames = everything()

    def open_bus(*_: object) -> Ear:
        if Ear.opened:
            raise BusError("there is no CAN interface 'can0' (No such device)")
        return Ear(frames, True)

    monkeypatch.setattr(bus, "open_bus", open_bus)
    words = [config] if command == "run" else []
    assert main([command, *words, "-i", "virtual", "-c", "ear", "--quiet", "--duration", "0.8"]) == 1
    out, err = capsys.readouterr()
    assert "there is no bus since " in (out + err).lower() and "there is no CAN interface 'can0'" in out + err


@pytest.mark.parametrize(("words", "voice"), [
    (["run", "CONFIG"], "SILENT (listening only)"),
    (["run", "CONFIG", "--transmit"], "TRANSMITTING"),
    (["bus"], "SILENT (listening only)"),
    (["drive"], "TRANSMITTING"),
])
def test_every_status_line_says_which_it_is(words: list[str], voice: str, config: str,
                                            monkeypatch: pytest.MonkeyPatch,
                                            capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("ipmsm_can.cli.screen.LINE_S", 0.3)
    main([config if w == "CONFIG" else w for w in words] + ["-i", "virtual", "-c", "voice", "--duration", "1"])
    lines = [one for one in capsys.readouterr().out.splitlines() if one.startswith("0:00:0")]
    assert lines
    assert all(one.split(" ", 1)[1].startswith(voice) for one in lines), lines
