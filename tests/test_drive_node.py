"""The simulated drive on the wire: frames against cantools, and which commands it obeys."""

from __future__ import annotations

import math
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.drive import profile
from ipmsm_can.drive.node import COMMAND_REJECTED, DriveNode, DriveNodeSettings, Step
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CAN_EFF_FLAG, FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol

PROTOCOL = Protocol()
DATABASE: Any = cantools.database.load_file(default_dbc_path())
RATE = 5000.0


KIND: list[type[DriveNode]] = [DriveNode]


@pytest.fixture(autouse=True, scope="module")
def kind(node_class: type[DriveNode]) -> None:
    """Every test here runs with the package's own frames and with those of the C library."""
    KIND[0] = node_class


def drive(node: int = 0, fd: bool = False, rate: float = RATE, limit: float = 30.0, **rates: Any) -> DriveNode:
    parameters = DriveParameters(sample_rate=rate, injection_limit=limit)
    simulation = DriveSimulation(M2, parameters, profile.torque_pulses())
    return KIND[0](PROTOCOL, node, simulation, DriveNodeSettings(fd=fd, **rates))


def read(step: Step, name: str, node: int = 0) -> list[dict[str, Any]]:
    message = DATABASE.get_message_by_name(name)
    frames = step.frames
    rows = np.flatnonzero(frames.can_id == message.frame_id + node)
    assert (frames.length[rows] == message.length).all()
    return [message.decode(frames.data[r, :message.length].tobytes(), decode_choices=False) for r in rows]


def command(counter: int, node: int = 0, **values: float) -> NDArray[np.uint8]:
    signals = {"waveform": 1.0, "amplitude": 5.0, "frequency": 400.0, "axis_angle": 0.0, "time_to_live": 100.0}
    return PROTOCOL.encode(MessageKind.INJECTION_COMMAND, node, {**signals, **values}, counter)


def hear(d: DriveNode, *raw: NDArray[np.uint8]) -> None:
    frames = np.concatenate(raw)
    d.receive(FrameBlock(frames, np.zeros(frames.shape[0], np.int64)))


def obeyed(d: DriveNode, n: int = 100) -> bool:
    return bool(d.step(n).samples.injection_amplitude.any())


# ---- frames out ---------------------------------------------------------------------------------------

@pytest.mark.parametrize("node", [0, 11])
def test_samples_as_cantools_reads_them(node: int) -> None:
    step = drive(node).step(1000)
    s, frames = step.samples, read(step, "DriveSample", node)
    assert [f["sample_counter"] for f in frames] == [k % 16 for k in range(1000)]
    for name, unit in (("i_alpha", 0.005), ("i_beta", 0.005), ("v_alpha", 0.025), ("v_beta", 0.025)):
        # 0.5 of a code; the C library's single precision may see a halfway point 0.001 of a code away
        assert np.abs(np.array([f[name] for f in frames]) - getattr(s, name)).max() <= 0.501 * unit


def test_blocks_as_cantools_reads_them() -> None:
    d = drive(fd=True, rate=10_000.0)
    parts = [d.step(n) for n in (3, 4, 1, 500, 0, 13)]
    blocks = [b for step in parts for b in read(step, "DriveSampleBlock")]
    assert [b["first_sample"] for b in blocks] == list(range(0, 518, 7))
    assert [b["sample_count"] for b in blocks] == [7] * 74
    assert [b["e2e_counter"] for b in blocks] == [k % 256 for k in range(74)]
    for name in ("i_alpha", "i_beta", "v_alpha", "v_beta"):
        sent = np.array([b[f"{name}_{j}"] for b in blocks for j in range(7)])
        truth = np.concatenate([getattr(step.samples, name) for step in parts])[:518]
        assert np.abs(sent - truth).max() <= 0.0126
    times = np.concatenate([step.frames.t_ns[step.frames.can_id == 0x120] for step in parts])
    assert (times == (np.arange(74) * 7 + 6) * 100_000).all()  # a block goes out with its last sample


def test_blocks_are_protected_as_autosar_asks() -> None:
    import cantools.autosar.end_to_end as e2e

    step = drive(3, fd=True).step(70)
    rows = np.flatnonzero(step.frames.can_id == 0x123)
    data_id = DATABASE.get_message_by_name("DriveSampleBlock").dbc.attributes["E2EDataID"].value + 3
    assert rows.size == 10
    for row in rows:
        assert e2e.check_profile5_crc(step.frames.data[row].tobytes(), data_id)


def test_the_other_messages_and_their_rates() -> None:
    d = drive(timing_rate=50.0, status_rate=10.0, reference_rate=500.0)
    step = d.step(5000)
    timing = read(step, "DriveTiming")
    assert [t["sample_counter"] for t in timing] == list(range(0, 5000, 100))
    assert {t["sample_rate"] for t in timing} == {RATE}
    status = read(step, "DriveStatus")
    assert len(status) == 10
    told = {(s["mode"], s["encoder_available"], s["protocol_version"], s["v_dc"]) for s in status}
    assert told == {(2, 1, 1, 540)}
    reference = read(step, "DriveReference")
    assert [r["sample_counter"] for r in reference] == list(range(0, 5000, 10))
    for r in reference:
        k = r["sample_counter"]
        assert abs(math.remainder(r["theta_e"] - step.samples.theta_e[k], math.tau)) <= 4.8e-5
        assert abs(r["omega_e"] - step.samples.omega_e[k]) <= 0.126


def test_timing_of_blocks_names_the_sample_that_was_sent() -> None:
    """The block that holds sample k is sent with the last of its seven samples."""
    step = drive(fd=True, rate=10_000.0, timing_rate=1000.0).step(100)
    last_sent = -1
    named = []
    for can_id, data in zip(step.frames.can_id, step.frames.data, strict=True):
        if can_id == 0x120:
            last_sent += 7
        elif can_id == 0x140:
            named.append(int(data[:4].view("<u4")[0]))
            assert named[-1] == last_sent
    assert named == [6, 20, 27, 34, 48, 55, 69, 76, 90]  # none before the first block


def test_encoder_of_finite_resolution_rounds_to_its_own_steps() -> None:
    step = drive(reference_rate=500.0, encoder_counts=6144).step(5000)
    grid = math.tau * M2.pole_pairs / 6144
    told = np.array([r["theta_e"] for r in read(step, "DriveReference")])
    off = np.angle(np.exp(1j * (told - step.samples.theta_e[::10])))
    assert np.abs(np.angle(np.exp(1j * (told - grid * np.round(told / grid))))).max() <= 1e-4
    assert 0.45 * grid < np.abs(off).max() <= 0.5 * grid + 1e-4


def test_rates_of_zero_are_silence() -> None:
    step = drive(timing_rate=0.0, status_rate=0.0, reference_rate=0.0).step(2000)
    assert set(step.frames.can_id.tolist()) == {0x100}


def test_frames_are_in_order_of_time_and_follow_their_sample() -> None:
    step = drive().step(1000, t0_ns=123)
    t = step.frames.t_ns
    assert (np.diff(t) >= 0).all() and t[0] == 123
    labels = PROTOCOL.classify(step.frames.raw)
    at = np.flatnonzero(labels == MessageKind.DRIVE_TIMING * 16)
    assert (labels[at - 1] == 0).all() and (t[at - 1] == t[at]).all()


@given(st.lists(st.integers(0, 120), min_size=1, max_size=8), st.booleans())
def test_any_partition_gives_the_same_frames(sizes: list[int], fd: bool) -> None:
    one, other = drive(fd=fd), drive(fd=fd)
    whole = one.step(sum(sizes)).frames
    parts = FrameBlock.concat([other.step(n).frames for n in sizes])
    assert np.array_equal(whole.raw, parts.raw) and np.array_equal(whole.t_ns, parts.t_ns)


# ---- commands in --------------------------------------------------------------------------------------

def test_a_good_command_is_obeyed_and_shown() -> None:
    d = drive()
    hear(d, command(0, time_to_live=200.0))
    step = d.step(501)
    assert step.samples.injection_amplitude.max() == pytest.approx(5.0)
    assert d.rejected == 0
    hear(d, command(1, time_to_live=200.0))
    assert read(d.step(500), "DriveStatus")[-1]["active_waveform"] == 1


def test_time_to_live_in_samples() -> None:
    d = drive()
    hear(d, command(0, time_to_live=60.0))
    amplitude = d.step(1000).samples.injection_amplitude
    assert np.flatnonzero(amplitude).max() == 299


def test_wrong_checksum_is_not_obeyed_but_counted_and_shown() -> None:
    d = drive()
    d.step(1)
    for byte in range(8):
        raw = command(byte)
        raw[0, 8 + byte] ^= 0x20
        hear(d, raw)
    assert not obeyed(d, 498)
    assert d.rejected == 8
    said = read(d.step(2), "DriveStatus")[-1]
    assert said["rejected_commands"] == 8 and said["faults"] == COMMAND_REJECTED
    later = read(d.step(500), "DriveStatus")[-1]
    assert later["rejected_commands"] == 8 and later["faults"] == 0


def test_a_frozen_counter_is_obeyed_once() -> None:
    """A sender that hangs and repeats its last frame: the time to live runs out all the same."""
    d = drive()
    frozen = command(5, time_to_live=60.0)
    amplitude = []
    for _ in range(50):
        hear(d, frozen)
        amplitude.append(d.step(100).samples.injection_amplitude)
    on = np.flatnonzero(np.concatenate(amplitude))
    assert on.max() == 299
    assert d.rejected == 49


def test_a_command_for_another_node_is_not_mine() -> None:
    d = drive(2)
    hear(d, command(0, 3))
    assert not obeyed(d) and d.rejected == 0
    stolen = command(0, 3)
    stolen.view(np.uint32)[:, 0] -= np.uint32(1)  # node 3's frame under node 2's identifier
    hear(d, stolen)
    assert not obeyed(d) and d.rejected == 1


@pytest.mark.parametrize(("signal", "value"), [("waveform", 4.0), ("waveform", 7.0), ("frequency", 0.0),
                                               ("frequency", 2501.0)])
def test_what_cannot_be_executed_is_refused_and_the_old_command_stays(signal: str, value: float) -> None:
    d = drive()
    hear(d, command(0, time_to_live=100.0))
    d.step(100)
    hear(d, PROTOCOL.encode(MessageKind.INJECTION_COMMAND, 0, {
        "waveform": 1.0, "amplitude": 5.0, "frequency": 400.0, "axis_angle": 0.0, "time_to_live": 100.0,
        signal: value}, 1))
    amplitude = d.step(1000).samples.injection_amplitude
    assert d.rejected == 1
    assert amplitude[:300].min() == pytest.approx(5.0)
    assert np.flatnonzero(amplitude).max() == 399  # the first command's 100 ms


def test_amplitude_is_clamped_to_the_drives_own_limit() -> None:
    d = drive(limit=3.0)
    hear(d, command(0, amplitude=200.0))
    samples = d.step(400).samples
    assert samples.injection_amplitude.max() == 3.0
    assert np.hypot(samples.v_inj_alpha, samples.v_inj_beta).max() <= 3.0


def test_lost_commands_do_not_matter_but_a_jump_back_by_one_does() -> None:
    d = drive()
    for counter in (0, 3, 10, 1 + 16):
        hear(d, command(counter, time_to_live=40.0))
        assert obeyed(d, 300)
    assert d.rejected == 0
    hear(d, command(0 + 16))  # 15 ahead, or one behind: a replayed older frame
    d.step(1)
    assert d.rejected == 1


def test_frames_that_are_no_commands_are_ignored() -> None:
    d = drive()
    extended = command(0)
    extended.view(np.uint32)[:, 0] |= np.uint32(CAN_EFF_FLAG)
    short = command(1)
    short[0, 4] = 7
    hear(d, extended, short, PROTOCOL.encode(MessageKind.COMPANION_STATUS, 0, {"state": 1.0}))
    assert not obeyed(d) and d.rejected == 0
    d.receive(FrameBlock.zeros(0))


@pytest.mark.parametrize("age", range(1, 9))
def test_a_command_that_was_held_up_is_not_obeyed(age: int) -> None:
    """An old "on" that comes after the "off" which was sent later."""
    d = drive()
    hear(d, command(20, waveform=0.0, amplitude=0.0))
    hear(d, command(20 - age, time_to_live=40.0))
    assert not obeyed(d, 300)
    assert d.rejected == 1
