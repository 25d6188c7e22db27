"""The simulated drive through the C library against the one through the package: the same bytes, the same rules."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import CoSimulation
from ipmsm_can.cli import main
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive import firmware_library
from ipmsm_can.drive.angle_source import AngleState
from ipmsm_can.drive.firmware import (
    ANGLE_DOUBTFUL,
    ANGLE_INVALID,
    ANGLE_MISSING,
    ANGLE_USABLE,
    FirmwareError,
    FirmwareNode,
    FirmwareStep,
)
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings, Step
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import Database, default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol

PROTOCOL = Protocol()
TRACK = Profile(((0.0, 0.0), (0.2, 300.0 * RPM), (0.6, -300.0 * RPM)), ((0.0, 0.0), (0.3, 3.0)))
SAMPLES = (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK, MessageKind.DRIVE_REFERENCE)


def simulated(rate: float, **parameters: Any) -> DriveSimulation:
    return DriveSimulation(M2, DriveParameters(sample_rate=rate, **parameters), TRACK, theta_0=1.0)


def both(rate: float = 5000.0, fd: bool = False, node: int = 3) -> tuple[DriveNode, FirmwareNode]:
    settings = DriveNodeSettings(fd=fd, encoder_counts=6144)
    return (DriveNode(PROTOCOL, node, simulated(rate), settings),
            FirmwareNode(PROTOCOL, node, simulated(rate), settings))


def command(counter: int, node: int = 3, **values: float) -> FrameBlock:
    signals = {"waveform": 1.0, "amplitude": 5.0, "frequency": 400.0, "axis_angle": 0.3, "time_to_live": 60.0}
    raw = PROTOCOL.encode(MessageKind.INJECTION_COMMAND, node, {**signals, **values}, counter)
    return FrameBlock(raw, np.zeros(1, np.int64))


def together(parts: list[Step]) -> FrameBlock:
    return FrameBlock.concat([part.frames for part in parts])


def codes_apart(kind: MessageKind, ours: FrameBlock, theirs: FrameBlock) -> NDArray[np.float64]:
    """How many steps of its signal each physical value of such frames differs by."""
    codec = PROTOCOL.codecs[kind]
    rows = np.flatnonzero(ours.can_id == PROTOCOL.base_ids[kind] + 3)
    scale = np.array([layout.scale for layout in codec.layouts])[:, None]
    keep = [k for k, name in enumerate(codec.signals) if name != "e2e_crc"]
    one, other = (PROTOCOL.decode(kind, 3, block.raw, rows)[0] for block in (ours, theirs))
    return np.asarray(np.abs((one - other) / scale)[keep])


@pytest.mark.parametrize(("rate", "fd"), [(5000.0, False), (10_000.0, True)])
def test_the_same_frames(rate: float, fd: bool) -> None:
    """Same identifiers, order, times, counters and states in every frame; measured values to the single code that
    single precision rounds the other way at a halfway point, and that seldom."""
    ours, theirs = both(rate, fd)
    parts: tuple[list[Step], list[Step]] = ([], [])
    for n in (1, 3, 0, 700, 17, 2000, 1279):
        for drive, steps in zip((ours, theirs), parts, strict=True):
            steps.append(drive.step(n))
    one, other = map(together, parts)
    assert len(one) == len(other) > 4000 / 7
    assert np.array_equal(one.raw[:, :8], other.raw[:, :8])
    assert np.array_equal(one.t_ns, other.t_ns)
    measured = np.zeros(len(one), np.bool_)
    for kind in SAMPLES:
        found = codes_apart(kind, one, other)
        assert found.max(initial=0.0) <= 1.001
        assert (found > 0.5).mean() < 0.002 if found.size else True
        measured |= one.can_id == PROTOCOL.base_ids[kind] + 3
    assert np.array_equal(one.raw[~measured], other.raw[~measured])
    assert 20 < (~measured).sum() < 100
    if fd:  # a block goes out under a checksum of its own
        rows = np.flatnonzero(other.can_id == 0x123)
        assert PROTOCOL.decode(MessageKind.DRIVE_SAMPLE_BLOCK, 3, other.raw, rows)[1].all()


class OnTheCodes(DriveSimulation):
    """A drive whose sensors measure in the steps of the wire, so that nothing lies halfway between two codes."""

    def run(self, n: int, probe: NDArray[np.float64] | None = None,
            told: NDArray[np.float64] | None = None) -> DriveSamples:
        samples = super().run(n, probe, told)
        steps = {"i_alpha": 0.005, "i_beta": 0.005, "v_alpha": 0.025, "v_beta": 0.025, "omega_e": 0.25}
        return replace(samples, theta_e=np.round(samples.theta_e, 3),
                       **{name: step * np.round(getattr(samples, name) / step) for name, step in steps.items()})


@pytest.mark.parametrize(("rate", "fd"), [(5000.0, False), (10_000.0, True)])
def test_the_same_bytes_where_no_rounding_is_in_doubt(rate: float, fd: bool) -> None:
    frames = []
    for kind in (DriveNode, FirmwareNode):
        drive = kind(PROTOCOL, 3, OnTheCodes(M2, DriveParameters(sample_rate=rate), TRACK, 1.0),
                     DriveNodeSettings(fd=fd))
        parts: list[Step] = []
        for counter in range(20):
            drive.receive(command(counter // 2 * 2, frequency=0.0))  # none can be executed, every other repeats
            parts.append(drive.step(300))
        frames.append(together(parts))
        assert drive.rejected == 20
    assert np.array_equal(frames[0].raw, frames[1].raw)
    assert np.array_equal(frames[0].t_ns, frames[1].t_ns)


def test_a_block_in_parts_gives_the_same_bits() -> None:
    _, whole = both()
    _, parts = both()
    sent: list[tuple[int, FrameBlock]] = [(0, command(0)), (150, command(1, amplitude=9.0)), (420, command(2))]
    at = 0
    found: list[Step] = []
    for n in (150, 1, 7, 262, 80, 300):
        for when, block in sent:
            if when == at:
                parts.receive(block)
        found.append(parts.step(n))
        at += n
    expected: list[Step] = []
    for n, (_, block) in zip((150, 270, 380), sent, strict=True):
        whole.receive(block)
        expected.append(whole.step(n))
    one, other = together(expected), together(found)
    assert np.array_equal(one.raw, other.raw) and np.array_equal(one.t_ns, other.t_ns)
    assert np.concatenate([p.samples.injection_amplitude for p in found]).max() == 9.0


def test_probing_voltage_is_the_packages() -> None:
    """What the library decided is what the machine got, and what the package would have decided."""
    drives = both()
    orders: list[dict[str, float]] = [{}, {"waveform": 2.0}, {"waveform": 3.0, "frequency": 250.0},
                                      {"waveform": 0.0}]
    for drive in drives:
        for counter, values in enumerate(orders):
            drive.receive(command(counter, 3, **values))
            drive.step(100)
        drive.receive(command(4, amplitude=20.0))
    one, other = (drive.step(600).samples for drive in drives)
    assert np.abs(one.v_inj_alpha - other.v_inj_alpha).max() < 2e-5
    assert np.abs(one.v_inj_beta - other.v_inj_beta).max() < 2e-5
    assert np.array_equal(one.injection_waveform, other.injection_waveform)
    assert np.abs(one.injection_amplitude - other.injection_amplitude).max() < 2e-5
    assert one.injection_amplitude.max() == 20.0
    assert np.flatnonzero(other.injection_amplitude).max() == 299


def test_the_librarys_own_limit_holds() -> None:
    settings = DriveNodeSettings()
    drive = FirmwareNode(PROTOCOL, 3, simulated(5000.0, injection_limit=100.0), settings)
    drive.receive(command(0, amplitude=80.0, time_to_live=400.0))
    samples = drive.step(1000).samples
    assert samples.injection_amplitude.max() == 30.0
    assert 25.0 < np.hypot(samples.v_inj_alpha, samples.v_inj_beta).max() <= 30.001


def test_more_frames_than_a_period_takes_wait_for_the_next() -> None:
    _, drive = both()
    bad = command(0)
    bad.raw[:, 8] ^= 1
    drive.receive(FrameBlock.concat([bad] * 40))
    drive.step(1)
    assert drive.rejected == 16
    drive.step(1)
    assert drive.rejected == 32
    drive.step(5)
    assert drive.rejected == 40 == drive.counts().commands.wrong_crc


def test_the_angle_is_used_while_the_companion_answers_and_refused_after() -> None:
    config = config_from({"motor": {"preset": "m2"}})
    track = Profile(((0.0, 0.0), (0.4, 0.0), (0.6, 300.0 * RPM)), duration=2.0)
    drive = FirmwareNode(PROTOCOL, 0, DriveSimulation(M2, DriveParameters(sample_rate=5000.0), track),
                         DriveNodeSettings())
    steps: list[FirmwareStep] = []
    run = drive.step

    def kept(n: int, t0_ns: int = 0) -> FirmwareStep:
        steps.append(run(n, t0_ns))
        return steps[-1]

    drive.step = kept  # type: ignore[method-assign]
    CoSimulation([drive], Companion([config], PROTOCOL, transmit=True)).run(2.0)
    for _ in range(20):
        drive.step(5)
    verdict = np.concatenate([s.verdict for s in steps])
    theta = np.concatenate([s.theta_e for s in steps])
    truth = np.concatenate([s.samples.theta_e for s in steps])
    usable = verdict == ANGLE_USABLE
    assert (verdict[:1024] == ANGLE_MISSING).all()
    assert (verdict == ANGLE_INVALID).any()
    assert usable[7500:10_000].all()
    assert np.array_equal(np.isnan(theta), ~(usable | (verdict == ANGLE_DOUBTFUL)))
    error = np.degrees(np.angle(np.exp(1j * (theta - truth))))[7500:10_000]
    assert np.abs(error).max() < 0.5
    # 50 samples are 10 ms; the last answer was to a sample at most a millisecond before the end.
    assert not usable[10_051:].any()
    assert (verdict[10_051:] == ANGLE_MISSING).all()
    assert usable[10_040]
    counts = drive.counts()
    assert counts.estimates.ok > 1900 and counts.estimates[1:] == (0, 0, 0, 0)


def estimate(counter: int, sample: int, theta: float, omega: float, valid: bool = True) -> FrameBlock:
    kind = MessageKind.POSITION_ESTIMATE
    raw = PROTOCOL.encode(kind, 3, {
        "theta_e": PROTOCOL.angle(kind, "theta_e", theta), "omega_e": omega, "sample_counter": sample & 1023,
        "sigma_theta": 4.0, "valid": float(valid), "locked": 1.0, "polarity_known": 1.0, "injecting": 0.0}, counter)
    return FrameBlock(raw, np.zeros(1, np.int64))


@pytest.mark.parametrize("drive", [
    {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.3},
    {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.3, "valid_until": 310},
    {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.3, "valid_until": 290},
    {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.3, "angle_sigma_limit": 3.0},
    {"angle_source": "companion", "brake": True},
    {"angle_source": "companion", "estimate_time_to_live": 0.005, "open_loop_current": 2.0},
], ids=["swap", "doubted later", "doubted before", "too uncertain", "wait", "silence"])
def test_the_control_runs_on_what_the_library_says(drive: dict[str, Any]) -> None:
    """The same estimates to both drives, the last 8 ms apart, from `valid_until` on not valid: the same states at
    the same samples, the same status frames, and the same angle but for single precision."""
    drive = dict(drive)
    valid_until = drive.pop("valid_until", 400)
    found = []
    for kind in (DriveNode, FirmwareNode):
        node = kind(PROTOCOL, 3, simulated(5000.0, **drive), DriveNodeSettings())
        steps = []
        for k in range(400):
            if k % 4 and k < 390:
                now = node.simulation.next_sample
                node.receive(estimate(k - k // 4, max(0, now - 4), 0.2 + 0.01 * now, 50.0, k < valid_until))
            elif k == 395:
                node.receive(estimate(k, 0, 0.0, 0.0))  # far too old
            steps.append(node.step(5))
        found.append(steps)
    ours, theirs = ([{name: np.concatenate([getattr(s.samples, name) for s in steps])
                      for name in ("angle_state", "control_theta", "omega_e", "i_q")} for steps in found])
    assert np.array_equal(ours["angle_state"], theirs["angle_state"])
    assert len(set(ours["angle_state"])) > 1
    used = ours["angle_state"] == AngleState.COMPANION
    apart = np.angle(np.exp(1j * (ours["control_theta"] - theirs["control_theta"])))
    assert np.abs(apart[used]).max(initial=0.0) < 1e-5
    assert used.any() == ("angle_sigma_limit" not in drive and valid_until != 290)
    assert np.abs(ours["omega_e"] - theirs["omega_e"]).max() < 0.5
    frames = [together(steps) for steps in found]
    kinds = [block.take(np.isin(block.can_id, [PROTOCOL.base_ids[k] + 3 for k in (
        MessageKind.DRIVE_STATUS, MessageKind.DRIVE_TIMING)])) for block in frames]
    assert np.array_equal(kinds[0].raw, kinds[1].raw) and np.array_equal(kinds[0].t_ns, kinds[1].t_ns)
    reference = [np.count_nonzero(block.can_id == PROTOCOL.base_ids[MessageKind.DRIVE_REFERENCE] + 3)
                 for block in frames]
    assert reference[0] == reference[1] == (150 if "encoder_fails_at" in drive else 200)


def test_another_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.dbc"
    path.write_bytes(default_dbc_path().read_bytes())
    with pytest.raises(FirmwareError, match=r"other\.dbc"):
        FirmwareNode(Protocol(Database.load(path)), 0, simulated(5000.0), DriveNodeSettings())


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Nothing loaded, an empty cache, and no compiler chosen."""
    firmware_library.load.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    return monkeypatch


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["drive", "-i", "virtual", "-c", "x", "--firmware", "--duration", "0.1"]) == 2
    said = capsys.readouterr().err
    assert said.endswith("\n")
    return said.splitlines()[-1]


def test_without_a_compiler_one_sentence_says_so(fresh: pytest.MonkeyPatch, tmp_path: Path,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    fresh.setenv("PATH", str(tmp_path))
    assert "none of cc, gcc, clang is installed" in sentence(capsys)
    fresh.setenv("CC", "no-such-cc")
    assert "CC is 'no-such-cc'" in sentence(capsys)


def test_a_compiler_that_fails_is_quoted(fresh: pytest.MonkeyPatch, tmp_path: Path,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    compiler = tmp_path / "broken-cc"
    compiler.write_text("#!/bin/sh\necho 'drive.c: fatal error: out of paper' >&2\nexit 1\n")
    compiler.chmod(0o755)
    fresh.setenv("CC", str(compiler))
    assert "out of paper" in sentence(capsys)
    assert not list((tmp_path / "ipmsm_can").iterdir())


def test_without_cffi_one_sentence_says_so(fresh: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fresh.setitem(sys.modules, "cffi", None)
    assert "ipmsm_can[firmware]" in sentence(capsys)


def test_compiled_once_and_again_when_a_source_changes(fresh: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "firmware"
    shutil.copytree(firmware_library.sources_folder(), folder, ignore=shutil.ignore_patterns("build"))
    first = firmware_library.compiled(folder)
    before = first.stat().st_mtime_ns
    assert firmware_library.compiled(folder) == first and first.stat().st_mtime_ns == before
    with (folder / "include" / "ipmsm_can" / "probing.h").open("a") as header:
        header.write("/* another */\n")
    assert firmware_library.compiled(folder) != first
    assert len(list((tmp_path / "ipmsm_can").glob("firmware-*.so"))) == 2
    assert not [path for path in (tmp_path / "ipmsm_can").iterdir() if not path.name.startswith("firmware-")]
