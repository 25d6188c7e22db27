"""The shipped maps on made-up traffic of their protocols, encoded by cantools, and on frames made by hand."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.frames import CAN_EFF_FLAG, FrameBlock
from ipmsm_can.mapping import MappedBlock, load_map, mapped
from ipmsm_can.mapping.convert import ANGLE_APART, CURRENT_APART, VOLTAGE_APART, spoils_dq
from ipmsm_can.mapping.load import map_folder
from ipmsm_can.wire.protocol import Protocol
from ipmsm_can.wire.receive import SampleReceiver
from tests.mapping_traffic import T0, Truth, frames, run, same
from tests.replaying import drive_frames

TRUTH = Truth()
PAIRS = 4


def _dbc(name: str) -> Path:
    return map_folder() / f"{name}.dbc"


def _seconds(found: MappedBlock) -> np.ndarray:
    return 1e-9 * (found.t_ns - T0)


def _by_hand(can_id: int, data: bytes) -> FrameBlock:
    block = FrameBlock(np.zeros((1, 72), np.uint8), np.array([T0], np.int64))
    block.can_id[0], block.length[0] = can_id, len(data)
    block.data[0, :len(data)] = list(data)
    return block


def _degrees_off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.degrees(np.abs(np.angle(np.exp(1j * (found - expected)))).max()))


def cascadia(hertz: float = 12.0, seconds: float = 1.0, lag: float = 2e-4) -> FrameBlock:
    """Frames every 10 ms, one `lag` after the other, each sampled when it is sent."""
    truth, t = Truth(hertz), np.arange(int(seconds * 100)) * 1e-2
    a, b, c = truth.phases(truth.i(t + lag))
    v = truth.v_dq(t + 2 * lag)
    fast = np.arange(int(seconds * 330)) * 3e-3
    i = truth.i_dq(fast)
    return frames(_dbc("cascadia_pm"), {
        "PM_A5_Position": (t, {"electrical_angle": np.degrees(truth.theta(t)) % 360.0, "speed": 60 * hertz / PAIRS,
                               "electrical_frequency": truth.omega(t) / (2 * math.pi), "delta_resolver": 0.0}),
        "PM_A6_Currents": (t + lag, {"i_a": a, "i_b": b, "i_c": c, "i_dc": 3.0}),
        "PM_A7_Voltages": (t + 2 * lag, {"v_dc": 320.0, "v_out": np.abs(v), "v_ab_or_v_d": v.real,
                                         "v_bc_or_v_q": v.imag}),
        "PM_A8_Flux": (t + 3 * lag, {"i_d": truth.i_dq(t + 3 * lag).real, "i_q": truth.i_dq(t + 3 * lag).imag}),
        "PM_B0_Fast": (fast, {"torque_feedback": 1.5 * PAIRS * 0.59 * i.imag, "v_dc": 320.0})})


def test_cascadia() -> None:
    found = run(cascadia(), load_map("cascadia_pm"))
    t = _seconds(found)
    assert len(found) == 100 and np.allclose(np.diff(t), 1e-2)
    inner = slice(1, -1)
    assert np.abs(found.i_alpha + 1j * found.i_beta - TRUTH.i(t)).max() < 0.1  # steps of 0.1 A in three phases
    assert np.abs(found.v_d + 1j * found.v_q - TRUTH.v_dq(t))[inner].max() < 0.1
    assert np.abs(found.v_alpha + 1j * found.v_beta - TRUTH.v(t))[inner].max() < 0.1 + 45 * math.radians(0.1)
    assert np.abs(found.i_d + 1j * found.i_q - TRUTH.i_dq(t))[inner].max() < 0.1 + 7 * math.radians(0.1)
    assert _degrees_off(found.theta_e[inner], TRUTH.theta(t)[inner]) < 0.1
    assert np.abs(found.omega_e - TRUTH.omega(t)).max() < 0.05 * 2 * math.pi
    assert np.abs(found.torque[inner] - 1.5 * PAIRS * 0.59 * TRUTH.i_dq(t).imag[inner]).max() < 0.1
    assert np.allclose(found.v_dc, 320.0) and not found.quality[inner].any()


def test_cascadia_turning_fast_is_said_to_be_too_far_apart() -> None:
    found = run(cascadia(hertz=150.0), load_map("cascadia_pm"))
    assert (found.quality[1:-1] & ANGLE_APART != 0).all()  # 0.2 ms are 10.8 deg
    assert not (found.quality & (CURRENT_APART | VOLTAGE_APART)).any()  # dq voltages do not turn
    # Between two reports it turned one and a half times; the speed says so.
    assert _degrees_off(found.theta_e[1:-1], Truth(150.0).theta(_seconds(found))[1:-1]) < 1.0


def test_cascadia_in_d_and_q_does_not_mind_the_angle() -> None:
    truth = Truth(150.0)
    found = run(cascadia(hertz=150.0), load_map("cascadia_pm_dq"))
    t = _seconds(found)
    assert np.abs(found.i_d + 1j * found.i_q - truth.i_dq(t)).max() < 0.075
    assert np.abs(found.v_d + 1j * found.v_q - truth.v_dq(t))[1:].max() < 0.08
    assert (found.quality & ANGLE_APART != 0).all()
    assert not (found.quality & spoils_dq(load_map("cascadia_pm_dq"))).any()
    assert spoils_dq(load_map("cascadia_pm")) & ANGLE_APART


def test_cascadia_by_hand() -> None:
    # -25.0, 100.3, -75.3 A: 0xFF06, 0x03EB, 0xFD0F, low byte first
    found = run(_by_hand(0xA6, bytes([0x06, 0xFF, 0xEB, 0x03, 0x0F, 0xFD, 0, 0])), load_map("cascadia_pm"))
    assert found.i_alpha[0] == pytest.approx(-25.0)
    assert found.i_beta[0] == pytest.approx((100.3 + 75.3) / math.sqrt(3.0))
    moved = run(_by_hand(0xC6, bytes([0x06, 0xFF, 0xEB, 0x03, 0x0F, 0xFD, 0, 0])), load_map("cascadia_pm"),
                node=0x20)
    assert moved.i_alpha[0] == found.i_alpha[0]


def test_vesc() -> None:
    t, slow = np.arange(50) * 2e-2, np.arange(5) * 0.2
    shift = 57
    block = frames(_dbc("vesc"), {
        "VESC_Status": (t, {"erpm": 60 * 12.0 + 100 * t, "current": -TRUTH.i_dq(t).imag, "duty": 0.12}),
        "VESC_Status_4": (slow + 1e-3, {"temperature_motor": 61.5, "input_current": 1.0, "pid_position": 90.0}),
        "VESC_Status_5": (slow + 2e-3, {"v_in": 48.0 + slow, "tachometer": 3.0})}, shift)
    found = run(block, load_map("vesc"), node=57)
    t = _seconds(found)
    assert len(found) == 50 and not list(mapped([block], load_map("vesc"), node=58))
    assert np.abs(found.i_q + TRUTH.i_dq(t).imag).max() <= 0.051 and not found.i_d.any()
    assert np.abs(found.omega_e - (720 + 100 * t) * 2 * math.pi / 60).max() <= 0.51 * 2 * math.pi / 60
    assert np.abs(found.v_dc - 48.0 - np.clip(t - 2e-3, 0, 0.8)).max() < 0.051
    assert np.allclose(found.temperature, 61.5)
    assert np.isnan(found.i_alpha).all() and np.isnan(found.v_alpha).all()  # no angle, no voltage


def test_vesc_by_hand() -> None:
    # big-endian: -1234 erpm, 45.6 A, duty 0.789
    data = struct.pack(">ihh", -1234, 456, 789)
    assert data == bytes([0xFF, 0xFF, 0xFB, 0x2E, 0x01, 0xC8, 0x03, 0x15])
    found = run(_by_hand(0x00000905 | CAN_EFF_FLAG, data), load_map("vesc"), node=5)
    assert found.i_q[0] == pytest.approx(45.6)
    assert found.omega_e[0] == pytest.approx(-1234 * 2 * math.pi / 60)
    assert not list(mapped([_by_hand(0x105, data)], load_map("vesc"), node=5))  # 11 bits are another frame


def test_odrive() -> None:
    t = np.arange(100) * 1e-2
    turns = TRUTH.theta(t) / (2 * math.pi * PAIRS)
    late = t + 4e-4
    block = frames(_dbc("odrive"), {
        "ODrive_Encoder_Estimates": (t, {"position": turns, "velocity": 12.0 / PAIRS}),
        "ODrive_Iq": (late, {"iq_setpoint": 6.0, "iq_measured": TRUTH.i_dq(late).imag}),
        "ODrive_Bus_Voltage_Current": (t[::10], {"v_bus": 24.0, "i_bus": 0.5})}, shift=3 << 5)
    found = run(block, load_map("odrive"), node=3, pole_pairs=PAIRS)
    t = _seconds(found)
    inner = slice(0, -1)
    assert np.abs(found.i_q - TRUTH.i_dq(t).imag).max() < 1e-6
    assert _degrees_off(found.theta_e[inner], TRUTH.theta(t)[inner]) < 1e-3
    assert np.allclose(found.omega_e, TRUTH.omega(t), rtol=1e-6) and np.allclose(found.v_dc, 24.0)
    q_only = 1j * TRUTH.i_dq(t).imag * np.exp(1j * TRUTH.theta(t))
    assert np.abs(found.i_alpha + 1j * found.i_beta - q_only)[inner].max() < 1e-4


def test_odrive_by_hand() -> None:
    # 1.5 A asked, -2.75 A measured: 0x3FC00000, 0xC0300000
    data = bytes([0, 0, 0xC0, 0x3F, 0, 0, 0x30, 0xC0])
    found = run(_by_hand((9 << 5) | 0x14, data), load_map("odrive"), node=9, pole_pairs=PAIRS)
    assert found.i_q[0] == -2.75


def test_moteus() -> None:
    t = np.arange(500) * 1e-3
    turns = (TRUTH.theta(t) / (2 * math.pi * PAIRS)) % 1.0
    i = TRUTH.i_dq(t)
    sent = {"layout": 0x000624, "mode": 10.0, "position": 0.5, "velocity": 12.0 / PAIRS, "torque": 1.25,
            "i_q": i.imag, "i_d": i.real, "v_bus": 24.0, "encoder_0": turns}
    block = frames(_dbc("moteus"), {"Moteus_Reply": (t, sent)}, shift=7 << 8)
    found = run(block, load_map("moteus"), node=7, pole_pairs=PAIRS)
    t = _seconds(found)
    assert np.abs(found.i_d + 1j * found.i_q - i).max() < 0.075
    assert _degrees_off(found.theta_e, TRUTH.theta(t)) < 0.5 * 1e-4 * 360 * PAIRS + 1e-3
    assert np.abs(found.omega_e - TRUTH.omega(t)).max() < 2 * math.pi * PAIRS * 0.00025
    assert np.allclose(found.torque, 1.25) and np.allclose(found.v_dc, 24.0) and not found.quality.any()


@pytest.mark.parametrize("flag", [0, CAN_EFF_FLAG])
def test_moteus_by_hand_with_either_length_of_identifier(flag: int) -> None:
    data = (bytes([0x24, 0x06, 0x00]) + struct.pack("<hhhhhh", 10, 1234, -400, 56, -37, 12)
            + bytes([0x25, 0x0D]) + struct.pack("<h", 243)
            + bytes([0x25, 0x50]) + struct.pack("<h", 2500) + b"\x50")
    assert len(data) == 24
    found = run(_by_hand(0x100 | flag, data), load_map("moteus"), pole_pairs=1)
    assert (found.i_d[0], found.i_q[0]) == pytest.approx((1.2, -3.7))
    assert found.v_dc[0] == pytest.approx(24.3) and found.torque[0] == pytest.approx(0.56)
    assert found.theta_e[0] == pytest.approx(math.pi / 2) and found.omega_e[0] == pytest.approx(-0.2 * math.pi)
    other = bytes([0x24, 0x05]) + data[2:]  # the answer to another query
    assert not list(mapped([_by_hand(0x100 | flag, other)], load_map("moteus"), pole_pairs=1))


def test_openinverter() -> None:
    t = np.arange(100) * 1e-2
    a, b, _ = TRUTH.phases(TRUTH.i(t))
    i = TRUTH.i_dq(t)
    block = frames(_dbc("openinverter"), {
        "OI_Phase": (t, {"il1": a, "il2": b, "angle": np.degrees(TRUTH.theta(t)) % 360.0, "udc": 350.0}),
        "OI_Vector": (t + 3e-4, {"id": i.real, "iq": i.imag, "speed": 180.0, "fstat": 12.0})})
    found = run(block, load_map("openinverter"))
    t = _seconds(found)
    assert np.abs(found.i_alpha + 1j * found.i_beta - TRUTH.i(t)).max() < 0.12
    assert np.abs(found.i_d + 1j * found.i_q - TRUTH.i_dq(t)).max() < 0.13
    assert _degrees_off(found.theta_e, TRUTH.theta(t)) < 0.006
    assert np.allclose(found.omega_e, TRUTH.omega(t)) and np.allclose(found.v_dc, 350.0)


def test_openinverter_by_hand() -> None:
    # il1 12.3 A, il2 -4.5 A, 90.00 deg, 351.2 V
    found = run(_by_hand(0x101, struct.pack("<hhHH", 123, -45, 9000, 3512)), load_map("openinverter"))
    assert found.i_alpha[0] == pytest.approx(12.3)
    assert found.i_beta[0] == pytest.approx((12.3 - 2 * 4.5) / math.sqrt(3.0))
    assert found.i_d[0] == pytest.approx(found.i_beta[0]) and found.v_dc[0] == pytest.approx(351.2)


def test_our_own_wire_as_a_map_gives_the_samples_of_the_native_way() -> None:
    protocol = Protocol()
    block = drive_frames(protocol, 0.6, node=2)
    ids = block.can_id
    samples, timings = (np.flatnonzero(ids == base + 2) for base in (0x100, 0x140))
    runs = SampleReceiver(protocol, 2, 0, 5000.0).push(block, samples, timings, np.zeros(0, np.intp))
    native = np.concatenate([r.values for r in runs], axis=1)
    counter = np.concatenate([r.counter for r in runs])
    found = run(block, load_map("ipmsm_can"), node=2)
    assert native.shape == (4, 3000)
    for row, name in enumerate(("i_alpha", "i_beta", "v_alpha", "v_beta")):
        assert np.array_equal(native[row], getattr(found, name)), name
    assert np.array_equal(np.diff(counter), np.diff(found.sample))
    same(found, run(block, load_map("ipmsm_can"), [7, 500, 501, 2000], node=2))


def test_losses_on_our_own_wire_are_counted_as_natively() -> None:
    protocol = Protocol()
    block = drive_frames(protocol, 0.6)
    lost = np.random.default_rng(4).random(len(block)) < 0.05
    lost &= block.can_id == 0x100
    lost[2000:2060] |= block.can_id[2000:2060] == 0x100
    block = block.take(~lost)
    ids = block.can_id
    samples, timings = (np.flatnonzero(ids == base) for base in (0x100, 0x140))
    receiver = SampleReceiver(protocol, 0, 0, None)
    counter = np.concatenate([r.counter for r in receiver.push(block, samples, timings, np.zeros(0, np.intp))])
    found = run(block, load_map("ipmsm_can"))
    assert np.array_equal(np.diff(counter), np.diff(found.sample)) and found.gap.max() > 40
