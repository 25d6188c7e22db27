"""Drive and companion together in virtual time: what the estimate is worth, and who stops injecting when.

Errors are against the simulated rotor itself, in electrical degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.bus.cosim import BusFaults, Channel, CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M1, M2
from ipmsm_can.wire.protocol import (
    CompanionState,
    InjectionReason,
    InjectionState,
    MessageKind,
    Protocol,
    Waveform,
)

PROTOCOL = Protocol()
M1_PAPER: dict[str, Any] = {"motor": {"preset": "m1"}, "injection": {"enabled": False},
                            "observer": {"alpha": 20, "gamma": 10, "initial_flux": [0.5, 2]}}
PULSES = profile.torque_pulses()


def m2(alpha: float = 5.0, gamma: float = 50.0) -> dict[str, Any]:
    return {"motor": {"preset": "m2"}, "observer": {"alpha": alpha, "gamma": gamma, "initial_flux": [0.5, 2]}}


KIND: list[type[DriveNode]] = [DriveNode]


@pytest.fixture(autouse=True, scope="module")
def kind(node_class: type[DriveNode]) -> None:
    """Every test here runs with the package's own drive and with the one on the C library."""
    KIND[0] = node_class


@dataclass
class Bench:
    """A co-simulation and what is asked of it."""

    cosim: CoSimulation
    drive: DriveNode
    companion: Companion
    rate: float

    def run(self, seconds: float) -> None:
        self.cosim.run(seconds)

    @property
    def node(self) -> Any:
        return self.companion.nodes[self.drive.node]

    def count(self, name: str) -> int:
        return int(self.node.receiver.sequencer.count(name))

    def compare(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """(time of the sample [s], error [deg electrical], valid), one entry per row put out."""
        tracked = self.cosim.recording.tracked[self.drive.node]
        truth = np.concatenate([s.theta_e for s in self.cosim.recording.truth[self.drive.node]])
        counter = np.concatenate([t.run.counter for t in tracked])
        theta = np.concatenate([t.estimate.angle[0] for t in tracked])
        flags = np.concatenate([t.estimate.flags for t in tracked])
        error = np.degrees((theta - truth[counter] + np.pi) % (2.0 * np.pi) - np.pi)
        return counter / self.rate, error, (flags & confidence.VALID) != 0

    def truth(self, name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(s, name) for s in self.cosim.recording.truth[self.drive.node]])


def bench(config: dict[str, Any], track: Profile, motor: Any = M2, rate: float = 5000.0, fd: bool = False,
          faults: BusFaults | None = None, **parameters: Any) -> Bench:
    simulation = DriveSimulation(motor, DriveParameters(sample_rate=rate, **parameters), track)
    drive = KIND[0](PROTOCOL, 0, simulation, DriveNodeSettings(fd=fd))
    companion = Companion([config_from(config)], PROTOCOL, transmit=True)
    return Bench(CoSimulation([drive], companion, faults), drive, companion, rate)


def rms(error: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(error**2)))


# ---- the acceptance table -----------------------------------------------------------------------------

def test_m1_ramp_of_the_paper() -> None:
    b = bench(M1_PAPER, profile.paper_ramp(), M1, current_noise=0.0)
    b.run(2.5)
    t, error, valid = b.compare()
    assert t.size == 12_500 and not b.count("lost")
    assert np.abs(error[t >= 0.35]).max() < 2.0
    assert rms(error[t > t[-1] - 0.5]) < 0.05
    assert valid[t > 1.0].all()
    # the observer starts at (0.5, 2) Wb, wrong by most of a right angle: it did have something to do
    assert np.abs(error[t < 0.05]).max() > 45.0


@pytest.mark.parametrize(("alpha", "gamma", "fd"), [(5, 50, False), (10, 50, False), (10, 200, False),
                                                    (5, 200, False), (5, 50, True), (10, 200, True)])
def test_m2_torque_pulses(alpha: float, gamma: float, fd: bool) -> None:
    rate = 10_000.0 if fd else 5000.0
    b = bench(m2(alpha, gamma), PULSES, rate=rate, fd=fd)
    b.run(2.5)
    t, error, valid = b.compare()
    locked = t[np.flatnonzero(np.abs(error) > 2.0)[-1]]
    assert locked < 0.45
    # Too much gain is slow: at gamma 200 the pole at -w^2/(gamma |Phi|^2) draws the end of the lock out.
    assert rms(error[t > locked]) < (0.2 if gamma == 50 else 0.4)
    assert np.abs(error[t > 0.5]).max() < 1.0
    assert rms(error[t > 1.5]) < 0.05
    assert valid[t > 0.5].all()
    assert not b.count("lost") and not b.count("gaps")
    # In CAN FD the first DriveTiming has no block to speak of yet; with the second, 20 ms on, sample 0 is too old.
    assert b.node.view.estimates == (2499 if fd else 2500)


@pytest.mark.parametrize("fd", [False, True])
def test_five_percent_loss(fd: bool) -> None:
    b = bench(m2(), PULSES, rate=10_000.0 if fd else 5000.0, fd=fd, faults=BusFaults(loss=0.05, seed=3))
    b.run(2.5)
    t, error, _ = b.compare()
    assert 0.04 < b.count("lost") / t.size < 0.06
    assert rms(error[t > 0.45]) < 0.3
    assert np.abs(error[t > 0.45]).max() < 2.0
    if not fd:
        assert b.count("filled") == b.count("lost") and b.count("gaps") == 0


def test_everything_at_once_on_the_bus() -> None:
    """Loss, duplication, reordering, bursts, delay and jitter: counted, and the angle survives."""
    faults = BusFaults(loss=0.01, duplication=0.02, reordering=0.02, burst=0.0005, delay_ns=500_000,
                       jitter_ns=300_000, seed=1)
    b = bench(m2(), PULSES, faults=faults)
    b.run(2.5)
    t, error, valid = b.compare()
    assert b.count("duplicates") > 150 and b.count("reordered") > 100
    assert b.count("gaps") > 0 and b.count("filled") > 50
    assert b.count("restarts") == 0
    assert rms(error[t > 0.45]) < 1.0
    # within a few hundred milliseconds after a burst it may be off; it must not claim to be exact then
    assert np.abs(error[valid]).max() < 10.0
    assert valid[t > 1.0].mean() > 0.8


def test_counters_stay_true_through_loss() -> None:
    """Each received sample carries the truth's own current at that counter: off by one would show."""
    b = bench(m2(), PULSES, faults=BusFaults(loss=0.05, burst=0.001, reordering=0.01, seed=5))
    b.run(1.0)
    sent = np.array([b.truth("i_alpha"), b.truth("i_beta"), b.truth("v_alpha"), b.truth("v_beta")])
    tracked = b.cosim.recording.tracked[0]
    counter = np.concatenate([t.run.counter for t in tracked])
    values = np.concatenate([t.run.values for t in tracked], axis=1)
    filled = np.concatenate([t.run.filled for t in tracked]).astype(bool)
    half_step = np.array([[0.0026], [0.0026], [0.0126], [0.0126]])
    assert (np.abs(values - sent[:, counter])[:, ~filled] < half_step).all()
    assert (np.diff(counter) > 0).all()
    # the filled ones lie on straight lines: at 1000 rpm within a degree or so of the truth
    assert np.abs(values - sent[:, counter])[:2, filled].max() < 0.5


# ---- standstill and lock ------------------------------------------------------------------------------

def test_at_standstill_no_angle_is_claimed() -> None:
    b = bench({"motor": {"preset": "m2"}}, Profile(((0.0, 0.0), (1.0, 0.0), (1.2, 20 * RPM)), duration=4.0))
    b.run(1.0)
    assert not b.compare()[2].any()
    assert b.node.view.state in (CompanionState.STARTING, CompanionState.TRACKING)
    b.run(3.0)
    t, error, valid = b.compare()
    assert valid[t > 3.5].all()
    assert 1.0 < t[np.argmax(valid)] < 3.5
    assert np.abs(error[valid]).max() < 10.0


# ---- injection ----------------------------------------------------------------------------------------

def injection(**keys: Any) -> dict[str, Any]:
    # By speed, which is given; without it the angle's own sigma decides (test_by_sigma).
    by_speed = {"waveform": "rotating", "speed_on": 40.0, "speed_off": 60.0}
    return {"motor": {"preset": "m2"}, "injection": {**by_speed, **keys}}


def test_injection_from_low_speed_to_high() -> None:
    track = Profile(((0.0, 20 * RPM), (2.5, 20 * RPM), (3.5, 500 * RPM)), duration=4.5)
    b = bench(injection(current_limit=5.0, amplitude=6.0, frequency=400.0, ramp=60.0), track)
    scheduler = b.node.scheduler
    told: list[tuple[InjectionState, InjectionReason]] = []
    for _ in range(450):
        b.run(0.01)
        said = (scheduler.state, scheduler.reason)
        if not told or told[-1] != said:
            told.append(said)
    assert told == [
        (InjectionState.RAMP_UP, InjectionReason.LOW_SPEED), (InjectionState.ON, InjectionReason.LOW_SPEED),
        (InjectionState.RAMP_DOWN, InjectionReason.SPEED_HIGH_ENOUGH),
        (InjectionState.OFF, InjectionReason.SPEED_HIGH_ENOUGH)]
    amplitude = b.truth("injection_amplitude")
    # 60 V/s up to 6 V, in the wire's steps of 0.05 V
    at = {v: np.argmax(amplitude >= v) / 5000.0 for v in (1.0, 5.9)}
    assert at[5.9] - at[1.0] == pytest.approx(4.9 / 60.0, abs=0.025)
    assert amplitude.max() == pytest.approx(6.0, abs=0.026)
    assert amplitude[-2000:].max() == 0.0
    assert b.drive.rejected == 0


def test_injection_is_seen_in_the_status_frames() -> None:
    b = bench(injection(current_limit=5.0), constant(20 * RPM, duration=2.0))
    b.cosim._keep_frames = True
    b.run(1.0)
    frames = FrameBlock.concat(b.cosim.recording.frames)
    codec = PROTOCOL.codecs[MessageKind.COMPANION_STATUS]
    rows = np.flatnonzero(frames.can_id == codec.frame_id)
    values = codec.decode_rows(frames.words, rows)
    assert values[codec.index["injection_state"], -1] == InjectionState.ON
    assert values[codec.index["injection_reason"], -1] == InjectionReason.LOW_SPEED
    position = PROTOCOL.codecs[MessageKind.POSITION_ESTIMATE]
    rows = np.flatnonzero(frames.can_id == position.frame_id)
    injecting = position.decode_rows(frames.words, rows)[position.index["injecting"]]
    assert injecting[0] == 0 and injecting[-1] == 1


def test_current_limit_cuts_the_amplitude_back() -> None:
    limited = injection(current_limit=0.15, amplitude=6.0, frequency=400.0)
    b = bench(limited, constant(20 * RPM, duration=4.0), current_noise=0.0)
    b.run(0.5)
    assert b.node.scheduler.state is InjectionState.LIMITED
    assert b.node.scheduler.reason is InjectionReason.CURRENT_LIMIT
    b.run(3.5)
    assert 0.5 < b.truth("injection_amplitude")[-1] < 6.0
    # the last tenth of a second, 40 periods of 400 Hz, transformed by hand: both sequences are the major axis
    i = (b.truth("i_alpha") + 1j * b.truth("i_beta"))[-500:]
    turn = np.exp(-2j * np.pi * 400.0 * np.arange(500) / 5000.0)
    major = abs(np.mean(i * turn)) + abs(np.mean(i / turn))
    assert b.node.view.hf_current == pytest.approx(major, rel=0.05)
    assert 0.85 * 0.15 < major < 1.02 * 0.15


def test_a_drive_that_falls_silent_gets_no_more_commands() -> None:
    b = bench(injection(current_limit=5.0), constant(20 * RPM, duration=2.0))
    b.run(1.0)
    assert b.node.scheduler.amplitude > 5.0
    now, commands = 1_000_000_000, []
    for _ in range(300):
        now += 1_000_000
        answers = b.companion.respond([], now)
        label = PROTOCOL.classify(answers.raw)
        rows = np.flatnonzero(label == MessageKind.INJECTION_COMMAND * 16)
        codec = PROTOCOL.codecs[MessageKind.INJECTION_COMMAND]
        commands += [(now, int(w)) for w in codec.decode_rows(answers.words, rows)[codec.index["waveform"]]]
    assert b.node.scheduler.state is InjectionState.OFF
    assert b.node.scheduler.reason is InjectionReason.NO_SAMPLES
    waveforms = [w for _, w in commands]
    first_off = waveforms.index(0)
    assert set(waveforms[:first_off]) == {Waveform.ROTATING}
    assert waveforms[first_off:] == [0, 0, 0]
    # stale after 50 ms, told at the next period of 20 ms
    assert commands[first_off][0] - 1_000_000_000 <= 75_000_000
    assert commands[-1][0] - 1_000_000_000 <= 140_000_000


def test_a_companion_that_dies_leaves_no_injection_behind() -> None:
    ttl = 0.06
    b = bench(injection(current_limit=5.0, time_to_live=ttl, period=0.02), constant(20 * RPM, duration=3.0))
    b.run(1.0)
    assert b.truth("injection_amplitude")[-1] > 5.0
    dead = b.drive.step(2000).samples.injection_amplitude
    off = int(np.argmax(dead == 0.0))
    assert 0 < off <= ttl * 5000
    assert off > (ttl - 0.025) * 5000
    assert not dead[off:].any()


def test_lost_commands_do_not_stop_injection() -> None:
    b = bench(injection(current_limit=5.0), constant(20 * RPM, duration=3.0), faults=BusFaults(loss=0.1, seed=2))
    b.run(2.0)
    # time to live is 5 periods: 10 % loss practically never loses five in a row
    amplitude = b.truth("injection_amplitude")
    assert (amplitude[4000:] > 0.0).all()
    assert b.drive.rejected == 0


def test_the_drives_own_limit_stands_above_every_command() -> None:
    b = bench(injection(amplitude=50.0, current_limit=50.0, ramp=1000.0), constant(20 * RPM, duration=2.0),
              injection_limit=4.0)
    b.run(1.0)
    assert b.node.scheduler.amplitude == 50.0
    assert b.truth("injection_amplitude").max() == 4.0
    seen = np.hypot(b.truth("v_inj_alpha"), b.truth("v_inj_beta")).max()
    assert 3.5 < seen <= 4.0


def test_no_injection_when_configuration_forbids_it() -> None:
    b = bench(injection(enabled=False), constant(20 * RPM, duration=1.0))
    b.run(0.5)
    assert b.node.scheduler.state is InjectionState.DISABLED
    assert b.node.scheduler.reason is InjectionReason.DISABLED_BY_CONFIGURATION
    assert not b.truth("injection_amplitude").any()


# ---- the virtual bus itself ---------------------------------------------------------------------------

def test_the_same_seed_gives_the_same_bits() -> None:
    faults = BusFaults(loss=0.03, duplication=0.03, reordering=0.03, jitter_ns=200_000, seed=9)
    pair = [bench(m2(), PULSES, faults=faults) for _ in range(2)]
    for b in pair:
        b.run(0.5)
    for a, c in zip(pair[0].compare(), pair[1].compare(), strict=True):
        assert np.array_equal(a, c)
    other = bench(m2(), PULSES, faults=BusFaults(loss=0.03, seed=10))
    other.run(0.5)
    assert other.count("received") != pair[0].count("received")


def test_two_drives_on_one_bus() -> None:
    drives = [KIND[0](PROTOCOL, n, DriveSimulation(M2, DriveParameters(sample_rate=5000.0), PULSES, seed=n),
                      DriveNodeSettings()) for n in (2, 9)]
    configs = [config_from({**m2(), "wire": {"node": n}}) for n in (2, 9)]
    companion = Companion(configs, PROTOCOL, True)
    CoSimulation(drives, companion).run(1.0)
    for node in (2, 9):
        assert companion.nodes[node].view.estimates == 1000
        assert companion.nodes[node].view.flags & confidence.VALID
        assert companion.nodes[node].receiver.sequencer.count("lost") == 0


def numbered(n: int, spacing_ns: int = 1000) -> FrameBlock:
    block = FrameBlock.zeros(n)
    block.can_id[:] = np.arange(n)
    block.t_ns[:] = spacing_ns * np.arange(n)
    return block


def test_a_channel_without_faults_changes_nothing() -> None:
    channel = Channel(BusFaults(), 0)
    channel.send(numbered(100))
    first = channel.receive(49_000)
    assert first.can_id.tolist() == list(range(50))
    assert channel.receive(10**9).can_id.tolist() == list(range(50, 100))


def test_channel_faults_do_what_they_say() -> None:
    n = 20_000
    ids = {}
    for name, faults in (("loss", BusFaults(loss=0.1)), ("duplication", BusFaults(duplication=0.1)),
                         ("reordering", BusFaults(reordering=0.1, reorder_ns=5500)),
                         ("burst", BusFaults(burst=0.001, burst_length=20)),
                         ("jitter", BusFaults(jitter_ns=10_000)), ("delay", BusFaults(delay_ns=7000))):
        channel = Channel(faults, 0)
        for begin in range(0, n, 77):
            channel.send(numbered(n).take(slice(begin, begin + 77)))
        out = channel.receive(1 << 60)
        assert (np.diff(out.t_ns) >= 0).all()
        ids[name] = (out.can_id.astype(int), out.t_ns)
    assert ids["loss"][0].size / n == pytest.approx(0.9, abs=0.01)
    assert ids["duplication"][0].size / n == pytest.approx(1.1, abs=0.01)
    assert np.unique(ids["duplication"][0]).size == n
    assert sorted(ids["reordering"][0].tolist()) == list(range(n))
    assert (np.diff(ids["reordering"][0]) < 0).sum() / n == pytest.approx(0.1, abs=0.02)
    lengths = np.diff(ids["burst"][0]) - 1
    assert (lengths[lengths > 0] % 20 == 0).all() and lengths.any()
    assert ids["jitter"][0].tolist() == list(range(n))
    late = ids["jitter"][1] - 1000 * np.arange(n)
    assert late.min() >= 0 and late.max() <= 10_000
    assert (ids["delay"][1] - 1000 * np.arange(n) == 7000).all()


def test_channel_faults_do_not_depend_on_blocks() -> None:
    faults = BusFaults(loss=0.1, duplication=0.1, reordering=0.1, burst=0.01, jitter_ns=3000, seed=4)
    outs = []
    for size in (1, 10, 1000):
        channel = Channel(faults, 0)
        for begin in range(0, 1000, size):
            channel.send(numbered(1000).take(slice(begin, begin + size)))
        outs.append(channel.receive(1 << 60))
    for out in outs[1:]:
        assert np.array_equal(out.t_ns, outs[0].t_ns)
        assert np.array_equal(np.sort(out.can_id), np.sort(outs[0].can_id))


@pytest.mark.parametrize("keys", [{"loss": 1.5}, {"duplication": -0.1}, {"delay_ns": -1}, {"burst_length": -2}])
def test_impossible_faults_are_refused(keys: dict[str, Any]) -> None:
    name, value = next(iter(keys.items()))
    with pytest.raises(ValueError, match=f"{name} is {value}; allowed is"):
        BusFaults(**keys)
