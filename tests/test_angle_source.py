"""The angle the control runs on: which estimates it takes, when it swaps, when it stops, and what it says."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipmsm_can.config import config_from
from ipmsm_can.config.build import drive_parameters
from ipmsm_can.drive.angle_source import AngleState, AngleVerdict, extrapolate
from ipmsm_can.drive.estimates import EstimateReceiver
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings, Step
from ipmsm_can.drive.profile import RPM, Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.e2e import E2EStatus
from ipmsm_can.wire.protocol import DriveMode, MessageKind, Protocol

PROTOCOL = Protocol()
DATABASE: Any = cantools.database.load_file(default_dbc_path())
VECTORS = json.loads((Path(__file__).parent / "firmware" / "vectors.json").read_text())
RATE = 5000.0
WARM_UP = 1024
GOOD = {"sigma_theta": 1.0, "valid": 1.0, "locked": 1.0, "polarity_known": 1.0, "injecting": 0.0}
ENCODER, COMPANION, HOLD, OPEN_LOOP, STOPPED = AngleState


def estimate(counter: int, sample: int, theta: float, omega: float, **values: float) -> NDArray[np.uint8]:
    kind = MessageKind.POSITION_ESTIMATE
    return PROTOCOL.encode(kind, 0, {
        "theta_e": PROTOCOL.angle(kind, "theta_e", theta), "omega_e": omega, "sample_counter": sample & 1023,
        **GOOD, **values}, counter)


def block(*raw: NDArray[np.uint8]) -> FrameBlock:
    frames = np.concatenate(raw)
    return FrameBlock(frames, np.zeros(frames.shape[0], np.int64))


class Rig:
    """A drive whose companion is the test: it knows the rotor, and tells of it `late` samples later."""

    def __init__(self, speed_rpm: float = 600.0, theta_0: float = 1.0, track: Profile | None = None,
                 **parameters: Any) -> None:
        simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, **parameters),
                                     track or constant(speed_rpm * RPM), theta_0)
        self.drive = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings())
        self.steps: list[Step] = []
        self.counter = 0

    def silence(self, n: int) -> None:
        self.steps.append(self.drive.step(n))

    def hear(self, sample: int, **values: float) -> None:
        """A good estimate of the rotor at that sample, but for the values given."""
        theta, omega = (float(self.all(name)[sample]) for name in ("theta_e", "omega_e"))
        given = {"theta": theta, "omega": omega, **values}
        self.drive.receive(block(estimate(self.counter, sample, **given)))
        self.counter += 1

    def run(self, n: int, every: int = 5, late: int = 4, **values: float) -> None:
        """n samples with an estimate before every fifth of them."""
        for _ in range(n // every):
            self.hear(self.drive.simulation.next_sample - late, **values)
            self.silence(every)

    def all(self, name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(s.samples, name) for s in self.steps])

    @property
    def state(self) -> AngleState:
        return AngleState(int(self.steps[-1].samples.angle_state[-1]))

    @property
    def changes(self) -> list[tuple[int, AngleState]]:
        states = self.all("angle_state")
        return [(int(k), AngleState(int(states[k]))) for k in np.flatnonzero(np.diff(states, prepend=-1.0))]

    def status(self) -> list[dict[str, Any]]:
        message = DATABASE.get_message_by_name("DriveStatus")
        frames = FrameBlock.concat([s.frames for s in self.steps])
        rows = np.flatnonzero(frames.can_id == message.frame_id)
        return [{"sample": round(frames.t_ns[r] * RATE / 1e9),
                 **message.decode(frames.data[r, :8].tobytes(), decode_choices=False)} for r in rows]

    @property
    def angle_error(self) -> NDArray[np.float64]:
        error: NDArray[np.float64] = np.angle(np.exp(1j * (self.all("control_theta") - self.all("theta_e"))))
        return error


BOTH: dict[str, Any] = {"angle_source": "encoder_then_companion", "encoder_fails_at": 0.3}
FAILS = 1500


# ---- what is taken ------------------------------------------------------------------------------------

def test_the_receiver_agrees_with_the_vectors_of_the_c_library() -> None:
    receivers = {node: EstimateReceiver(PROTOCOL, node, 1023, 90.0) for node in (0, 6)}
    for row in VECTORS["estimates"]:
        raw = FrameBlock.zeros(1)
        raw.can_id[:] = PROTOCOL.base_ids[MessageKind.POSITION_ESTIMATE] + row["node"]
        raw.length[:] = 8
        raw.data[0, :8] = list(bytes.fromhex(row["frame"]))
        receiver = receivers[row["node"]]
        before = dict(receiver.counts)
        latest = row["latest"] + (2**32 if row["latest"] < 2**31 else 0)
        got = receiver.take(raw.raw, np.array([0]), latest)
        status = E2EStatus(row["status"])
        assert receiver.counts == {**before, status: before[status] + 1}
        assert (got is not None) == (status <= E2EStatus.OK_SOME_LOST)
        if got is not None:
            assert got.sample % 2**32 == row["named"]
            assert got.theta_e == pytest.approx(row["theta_e"]) and got.omega_e == row["omega_e"]
            certain = row["sigma_theta"] <= 90.0
            if not (row["locked"] and row["polarity_known"]):
                expected = AngleVerdict.INVALID
            elif row["valid"]:
                expected = AngleVerdict.USABLE if certain else AngleVerdict.UNCERTAIN
            else:
                expected = AngleVerdict.DOUBTFUL if certain else AngleVerdict.INVALID
            assert got.verdict == expected


def test_extrapolation_agrees_with_the_vectors_of_the_c_library() -> None:
    for row in VECTORS["extrapolations"]:
        found = extrapolate(row["theta"], row["omega"], row["elapsed"])
        assert 0.0 <= found < math.tau
        # the inputs are printed in single precision
        assert abs(math.remainder(found - row["expected"], math.tau)) < 3e-5


@pytest.mark.parametrize(("age", "taken"), [(0, True), (50, True), (51, False), (1000, False)])
def test_an_estimate_older_than_its_time_to_live_is_not_taken(age: int, taken: bool) -> None:
    receiver = EstimateReceiver(PROTOCOL, 0, 50, 10.0)
    got = receiver.take(estimate(0, 5000 - age, 1.0, 2.0), np.array([0]), 5000)
    assert (got is not None) == taken and receiver.late == (not taken)
    if got is not None:
        assert got.sample == 5000 - age


def test_none_is_taken_while_the_last_run_may_still_echo() -> None:
    rig = Rig(angle_source="companion", speed_rpm=0.0)
    rig.silence(WARM_UP - 1)
    rig.hear(WARM_UP - 5)
    rig.silence(1)
    assert rig.drive.estimates.late == 1 and rig.state is HOLD
    rig.hear(WARM_UP - 5)
    rig.silence(1)
    assert rig.state is COMPANION


# ---- what runs ----------------------------------------------------------------------------------------

def test_with_an_encoder_estimates_change_nothing() -> None:
    plain, other = Rig(), Rig(angle_source="encoder_then_companion")
    for rig in (plain, other):
        rig.silence(WARM_UP)
        rig.run(500, omega=-3000.0, theta=2.0)
    for name in DriveSamples.__dataclass_fields__:
        assert np.array_equal(plain.all(name), other.all(name)), name
    assert set(other.all("angle_state")) == {ENCODER}


def test_a_failed_encoder_is_replaced_within_the_period_and_speed_is_kept() -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(2000, late=11)
    assert rig.changes == [(0, ENCODER), (FAILS, COMPANION)]
    # 14 bits of angle and 0.25 rad/s of speed on the wire, and 11 to 15 samples of extrapolation
    assert np.degrees(np.abs(rig.angle_error[FAILS:]).max()) < 0.1
    assert np.abs(rig.all("omega_e") / M2.pole_pairs - rig.all("speed_reference")).max() < 0.5 * RPM


def test_the_control_angle_is_the_estimate_carried_on_to_the_sample() -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(FAILS - WARM_UP + 4)
    rig.drive.receive(block(estimate(rig.counter, rig.drive.simulation.next_sample - 7, 0.3, -200.0)))
    first = rig.drive.simulation.next_sample
    rig.silence(30)
    expected = 0.3 - 200.0 * (np.arange(30) + 7) / RATE
    wrong = np.angle(np.exp(1j * (rig.all("control_theta")[first:] - expected)))
    assert np.abs(wrong).max() < 2e-4


def test_the_speed_controlled_is_the_estimated_one() -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(FAILS - WARM_UP + 4)
    for _ in range(300):
        late = rig.drive.simulation.next_sample - 2
        rig.hear(late, omega=1.05 * float(rig.all("omega_e")[late]))
        rig.silence(5)
    assert rig.state is COMPANION
    assert rig.all("omega_e")[-1] / M2.pole_pairs == pytest.approx(600.0 * RPM / 1.05, rel=2e-3)


@pytest.mark.parametrize("wrong", [{"locked": 0.0}, {"polarity_known": 0.0}, {"valid": 0.0, "locked": 0.0},
                                   {"valid": 0.0, "polarity_known": 0.0}, {"valid": 0.0, "sigma_theta": 10.5},
                                   {"sigma_theta": 10.5}, {"sigma_theta": 127.5}])
def test_an_angle_that_may_not_be_used_stops_the_drive_at_once_and_for_good(wrong: dict[str, Any]) -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(1000)
    at = rig.drive.simulation.next_sample
    rig.run(5, **wrong)
    rig.run(300)
    assert rig.changes == [(0, ENCODER), (FAILS, COMPANION), (at, STOPPED)]
    assert np.isnan(rig.all("control_theta")[at:]).all()
    assert np.abs(rig.all("torque")[at + 1:]).max() < 1e-9
    assert not rig.all("v_alpha")[at + 1:].any() and not rig.all("v_beta")[at + 1:].any()


def test_an_angle_that_is_valid_no_more_is_kept_within_the_limit_and_begins_nothing() -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(1000)
    rig.run(500, valid=0.0, sigma_theta=10.0)
    assert rig.changes == [(0, ENCODER), (FAILS, COMPANION)]
    assert np.degrees(np.abs(rig.angle_error[FAILS:]).max()) < 0.1
    other = Rig(**BOTH)
    other.silence(WARM_UP)
    other.run(1000, valid=0.0)
    assert other.changes == [(0, ENCODER), (FAILS, STOPPED)]


def test_silence_stops_the_drive_when_the_time_to_live_is_over() -> None:
    rig = Rig(estimate_time_to_live=0.01, **BOTH)
    rig.silence(WARM_UP)
    rig.run(1000, late=4)
    last = rig.drive.simulation.next_sample - 5 - 4
    rig.silence(200)
    assert rig.changes[-1] == (last + 51, STOPPED)


def test_a_repeated_or_damaged_estimate_keeps_nothing_alive() -> None:
    rig = Rig(estimate_time_to_live=0.01, **BOTH)
    rig.silence(WARM_UP)
    rig.run(1000, late=4)
    now = rig.drive.simulation.next_sample
    for k in range(40):
        theta, omega = float(rig.all("theta_e")[-1]), float(rig.all("omega_e")[-1])
        damaged = estimate(rig.counter + k, rig.drive.simulation.next_sample - 1, theta, omega)
        damaged[0, 12] ^= 1
        frozen = estimate(rig.counter - 1, rig.drive.simulation.next_sample - 1, theta, omega)
        rig.drive.receive(block(damaged, frozen))
        rig.silence(5)
    assert rig.changes[-1] == (now - 9 + 51, STOPPED)


@pytest.mark.parametrize("source", ["encoder", "encoder_then_companion"])
def test_without_a_replacement_a_failed_encoder_stops_the_drive(source: str) -> None:
    rig = Rig(angle_source=source, encoder_fails_at=0.3)
    rig.silence(2000)
    assert rig.changes == [(0, ENCODER), (FAILS, STOPPED)]


def test_a_stopped_rotor_coasts_as_mechanics_say() -> None:
    rig = Rig(angle_source="encoder", encoder_fails_at=0.3, friction=2e-3,
              track=Profile(((0.0, 600.0 * RPM),), ((0.0, 0.0), (0.3, 0.0), (0.3, 0.5))))
    rig.silence(3000)
    omega_m = rig.all("omega_e")[FAILS:] / M2.pole_pairs
    t = np.arange(omega_m.size) / RATE
    settled = -0.5 / 2e-3
    expected = settled + (omega_m[0] - settled) * np.exp(-2e-3 / M2.J * t)
    assert np.abs(omega_m - expected).max() < 1e-6
    turned = np.unwrap(rig.all("theta_e")[FAILS:])
    assert turned[-1] - turned[0] == pytest.approx(M2.pole_pairs * np.trapezoid(expected, t), abs=1e-4)


def test_a_waiting_drive_holds_no_current_and_takes_the_first_good_angle() -> None:
    rig = Rig(angle_source="companion", track=Profile(((0.0, 0.0), (0.3, 0.0), (0.5, 300.0 * RPM)), duration=1.0),
              current_noise=0.0)
    rig.silence(WARM_UP)
    rig.run(500, valid=0.0)
    assert rig.changes == [(0, HOLD)]
    assert np.hypot(rig.all("i_d"), rig.all("i_q")).max() < 1e-6
    begin = rig.drive.simulation.next_sample
    rig.run(3500)
    assert rig.changes == [(0, HOLD), (begin, COMPANION)]
    assert rig.all("omega_e")[-1] / M2.pole_pairs == pytest.approx(300.0 * RPM, rel=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_open_loop_start_takes_the_rotor_along(sign: float) -> None:
    track = Profile(((0.0, 0.0), (0.1, 0.0), (0.1, sign * 500.0 * RPM)), duration=3.0)
    rig = Rig(angle_source="companion", track=track, theta_0=2.0, open_loop_current=2.0, open_loop_speed=40.0,
              open_loop_ramp=0.5, friction=0.01)
    rig.silence(9999)
    assert rig.changes == [(0, HOLD), (500, OPEN_LOOP)]
    theta = np.unwrap(rig.all("control_theta")[500:])
    speed = np.diff(theta) * RATE
    assert np.abs(speed).max() == pytest.approx(40.0, rel=1e-6) and sign * speed[-1] > 0.0
    assert np.flatnonzero(np.abs(speed) > 39.99)[0] == pytest.approx(2500, abs=2)
    rotor = rig.all("omega_e")[-2000:]
    assert rotor.mean() == pytest.approx(sign * 40.0, rel=0.05)
    size = np.hypot(rig.all("i_d"), rig.all("i_q"))[-2000:]
    assert size.mean() == pytest.approx(2.0, rel=0.05)


@given(st.lists(st.integers(1, 400), min_size=1, max_size=12))
def test_any_partition_gives_the_same_bits(sizes: list[int]) -> None:
    """The same estimates at the same samples, whatever the blocks between them."""
    def run(cuts: set[int]) -> tuple[Rig, FrameBlock]:
        rig = Rig(**BOTH)
        for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), 2400], strict=True):
            if begin % 100 == 0 and begin > WARM_UP:
                theta = 1.0 + 600.0 * RPM * M2.pole_pairs * (begin - 3) / RATE
                rig.drive.receive(block(estimate(begin // 100, begin - 3, theta, 600.0 * RPM * M2.pole_pairs)))
            rig.silence(end - begin)
        return rig, FrameBlock.concat([s.frames for s in rig.steps])

    at = set(range(100, 2400, 100))
    whole, frames = run(at)
    parts, others = run(at | {min(int(k), 2399) for k in np.cumsum(sizes)})
    assert whole.changes[1] == (FAILS, COMPANION) and whole.changes[-1][1] is STOPPED
    assert np.array_equal(frames.raw, others.raw) and np.array_equal(frames.t_ns, others.t_ns)
    for name in ("theta_e", "omega_e", "i_q", "v_alpha", "angle_state"):
        assert np.array_equal(whole.all(name), parts.all(name)), name


# ---- what is said -------------------------------------------------------------------------------------

def test_status_tells_of_the_swap_and_of_the_stop_at_once() -> None:
    rig = Rig(**BOTH)
    rig.silence(WARM_UP)
    rig.run(1000)
    at = rig.drive.simulation.next_sample + 42
    rig.silence(600)
    said = {s["sample"]: (s["mode"], s["faults"], s["encoder_available"]) for s in rig.status()}
    assert said[1000] == (DriveMode.RUNNING, 0, 1)
    assert said[FAILS] == said[2000] == (DriveMode.RUNNING, 0x10, 0)
    assert said[at] == said[2500] == (DriveMode.SAFE_STOP, 0x50, 0)
    assert sorted(said) == sorted({0, 500, 1000, FAILS, 2000, at, 2500})
    frames = FrameBlock.concat([s.frames for s in rig.steps])
    reference = frames.t_ns[frames.can_id == 0x180]
    assert reference.max() < FAILS / RATE * 1e9


def test_status_says_that_the_angle_is_waited_for() -> None:
    rig = Rig(angle_source="companion", speed_rpm=0.0)
    rig.silence(WARM_UP)
    rig.run(500)
    said = {s["sample"]: (s["mode"], s["faults"]) for s in rig.status()}
    assert said[0] == said[1000] == (DriveMode.RUNNING, 0x40)
    assert said[WARM_UP] == said[1500] == (DriveMode.RUNNING, 0)


# ---- settings -----------------------------------------------------------------------------------------

@pytest.mark.parametrize(("name", "value", "words"), [
    ("angle_source", "resolver", "encoder, companion, encoder_then_companion"),
    ("encoder_fails_at", -1.0, "0 or more, in s"),
    ("estimate_time_to_live", 1e-4, "0.0002 to 0.2046 s"),
    ("estimate_time_to_live", 0.2048, "0.0002 to 0.2046 s"),
    ("angle_sigma_limit", 0.0, "above 0 and at most 90"),
    ("open_loop_current", -1.0, "0 or more, in A"),
    ("open_loop_speed", 0.0, "above 0, in rad/s electrical"),
    ("open_loop_ramp", 0.0, "above 0, in s"),
])
def test_a_wrong_setting_is_named(name: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} is .*{words}"):
        DriveParameters(sample_rate=RATE, **{name: value})


def test_the_settings_come_from_the_configuration() -> None:
    config = config_from({"motor": {"preset": "m2"}, "simulation": {
        "angle_source": "companion", "encoder_fails_at": "2 s", "estimate_time_to_live": "20 ms",
        "angle_sigma_limit": "8 deg", "open_loop_current": "2 A", "open_loop_speed": "100 rpm",
        "open_loop_ramp": "500 ms"}})
    p = drive_parameters(config)
    assert (p.angle_source, p.encoder_fails_at, p.estimate_max_age) == ("companion", 2.0, 100)
    assert (p.angle_sigma_limit, p.open_loop_current, p.open_loop_ramp) == (8.0, 2.0, 0.5)
    assert p.open_loop_speed == pytest.approx(100.0 * RPM * M2.pole_pairs)
    with pytest.raises(ValueError, match=r"^simulation\.estimate_time_to_live is"):
        drive_parameters(config_from({"motor": {"preset": "m2"}, "simulation": {"estimate_time_to_live": "1 s"}}))
