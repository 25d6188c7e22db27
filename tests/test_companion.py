"""The companion in virtual time: what it answers, what it drops, and what it says about it.

Answers are read back with cantools, which knows nothing of our codec.
"""

from __future__ import annotations

import math
from typing import Any

import cantools
import cantools.autosar.end_to_end as e2e
import numpy as np
import pytest

from ipmsm_can.companion import Companion
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.node import STALE_AFTER_NS, Tracked
from ipmsm_can.wire.dbc import Database, default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol

PROTOCOL = Protocol()
DATABASE: Any = cantools.database.load_file(default_dbc_path())
MS = 1_000_000
RATE = 5000.0
BASE = {name: DATABASE.get_message_by_name(name).frame_id for name in (
    "PositionEstimate", "InjectionCommand", "ActiveFluxEstimate", "CompanionStatus", "DriveSample",
    "DriveSampleBlock", "DriveTiming", "DriveStatus")}


def config(node: int = 0, **sections: dict[str, object]) -> DriveConfig:
    table: dict[str, Any] = {"motor": {"preset": "m2"}, "observer": {"alpha": 5, "gamma": 50}, **sections}
    return config_from({**table, "wire": {"node": node, **table.get("wire", {})}})


def drive(node: int = 0, track: profile.Profile | None = None, fd: bool = False, rate: float = RATE,
          **rates: Any) -> DriveNode:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=rate), track or profile.torque_pulses(),
                                 theta_0=0.5 * node, seed=node)
    return DriveNode(PROTOCOL, node, simulation, DriveNodeSettings(fd=fd, **rates))


def by_name(answers: FrameBlock, name: str, node: int = 0) -> list[dict[str, Any]]:
    """The frames of one message as cantools reads them."""
    message = DATABASE.get_message_by_name(name)
    rows = np.flatnonzero(answers.can_id == BASE[name] + node)
    return [message.decode(answers.data[r, :answers.length[r]].tobytes(), decode_choices=False) for r in rows]


def play(companion: Companion, frames: FrameBlock, until_ns: int, begin_ns: int = 0,
         step_ns: int = MS) -> tuple[list[Tracked], FrameBlock]:
    """Feed frames as their time comes, one look every step_ns; returns everything tracked and answered."""
    tracked, answers = [], []
    for now in range(begin_ns + step_ns, until_ns + 1, step_ns):
        begin, end = np.searchsorted(frames.t_ns, [now - step_ns, now], side="right")
        if now == begin_ns + step_ns:
            begin = np.searchsorted(frames.t_ns, begin_ns, side="left")
        part = companion.feed(frames.take(slice(int(begin), int(end))))
        tracked += part
        answers.append(companion.respond(part, now))
    return tracked, FrameBlock.concat(answers)


def joined(tracked: list[Tracked], node: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(counter, theta_hat, flags) of a node."""
    mine = [t for t in tracked if t.node == node]
    return (np.concatenate([t.run.counter for t in mine]), np.concatenate([t.estimate.angle[0] for t in mine]),
            np.concatenate([t.estimate.flags for t in mine]))


def status(companion: Companion, now_ns: int, node: int = 0) -> dict[str, Any]:
    """The next CompanionStatus: as the clock has come far enough, or later."""
    answers = companion.respond([], now_ns)
    found = by_name(answers, "CompanionStatus", node)
    assert found, "no CompanionStatus is due"
    return found[-1]


# ---- answers ------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def second() -> tuple[list[Tracked], FrameBlock]:
    """One second of one drive, answered."""
    companion = Companion([config()], PROTOCOL, transmit=True)
    return play(companion, drive().step(5000).frames, 1000 * MS)


def test_one_estimate_a_millisecond(second: tuple[list[Tracked], FrameBlock]) -> None:
    _, answers = second
    estimates = by_name(answers, "PositionEstimate")
    counters = [e["sample_counter"] for e in estimates]
    assert counters == [k % 1024 for k in range(0, 5000, 5)]
    assert [e["e2e_counter"] for e in estimates] == [k % 16 for k in range(1000)]
    times = answers.t_ns[answers.can_id == BASE["PositionEstimate"]]
    assert (np.diff(times) == MS).sum() >= 996


def test_estimates_say_what_was_estimated(second: tuple[list[Tracked], FrameBlock]) -> None:
    tracked, answers = second
    counter, theta, flags = joined(tracked)
    omega = np.concatenate([t.estimate.angle[2] for t in tracked])
    sigma = np.concatenate([t.estimate.sigma for t in tracked])
    assert counter.tolist() == list(range(5000))
    message = DATABASE.get_message_by_name("PositionEstimate")
    rows = np.flatnonzero(answers.can_id == BASE["PositionEstimate"])
    seen = set()
    for k, row in zip(range(0, 5000, 5), rows, strict=True):
        e = message.decode(answers.data[row, :8].tobytes(), decode_choices=False)
        assert abs(math.remainder(e["theta_e"] - theta[k], math.tau)) < 0.5001 * 3.835e-4
        assert abs(e["omega_e"] - omega[k]) < 0.126
        assert abs(e["sigma_theta"] - min(math.degrees(sigma[k]), 127.5)) < 0.251
        assert (e["locked"], e["polarity_known"], e["valid"], e["injecting"]) == (
            flags[k] & 1, flags[k] >> 1 & 1, flags[k] >> 2 & 1, 0)
        seen.add(int(flags[k]))
    assert {0, confidence.LOCKED, 7} <= seen


def test_protection_is_what_autosar_asks_for(second: tuple[list[Tracked], FrameBlock]) -> None:
    _, answers = second
    ids = {name: bytes.fromhex(DATABASE.get_message_by_name(name).dbc.attributes["E2EDataIDList"].value)
           for name in ("PositionEstimate", "InjectionCommand")}
    checked = {}
    for name, listed in ids.items():
        rows = np.flatnonzero(answers.can_id == BASE[name])
        for row in rows:
            payload = bytearray(answers.data[row, :8].tobytes())
            data_id = listed[payload[1] & 15]
            assert e2e.check_profile2_crc(bytes(payload), data_id)
            payload[5] ^= 4
            assert not e2e.check_profile2_crc(bytes(payload), data_id)
        checked[name] = rows.size
    assert checked["PositionEstimate"] == 1000


def test_flux_answers(second: tuple[list[Tracked], FrameBlock]) -> None:
    tracked, answers = second
    flux = by_name(answers, "ActiveFluxEstimate")
    assert len(flux) == 50
    x = np.concatenate([t.estimate.flux[2:4] for t in tracked], axis=1)[:, ::100]
    excitation = np.concatenate([t.estimate.excitation for t in tracked])[::100]
    for k, f in enumerate(flux):
        assert f["x_alpha"] == pytest.approx(x[0, k], abs=5.1e-5)
        assert f["x_beta"] == pytest.approx(x[1, k], abs=5.1e-5)
        if excitation[k] > 1e-30:
            assert f["excitation_level"] == pytest.approx(10 * math.log10(excitation[k]), abs=0.0051)
    assert math.hypot(flux[-1]["x_alpha"], flux[-1]["x_beta"]) == pytest.approx(M2.psi_m, rel=0.02)


def test_other_rates_of_answers() -> None:
    frames = drive().step(2500).frames
    rates: dict[str, object] = {"rate": 250.0, "flux_rate": 10.0, "status_rate": 20.0}
    companion = Companion([config(estimate=rates)], PROTOCOL, True)
    _, answers = play(companion, frames, 500 * MS)
    assert [e["sample_counter"] for e in by_name(answers, "PositionEstimate")] == [k % 1024
                                                                                   for k in range(0, 2500, 20)]
    assert len(by_name(answers, "ActiveFluxEstimate")) == 5
    assert len(by_name(answers, "CompanionStatus")) == 10


def test_fd_blocks_are_answered_at_the_same_rate() -> None:
    companion = Companion([config(wire={"max_gap": 8})], PROTOCOL, True)
    frames = drive(fd=True, rate=10_000.0).step(10_000).frames
    tracked, answers = play(companion, frames, 1000 * MS)
    counter, _, _ = joined(tracked)
    assert counter.tolist() == list(range(counter.size)) and counter.size > 9990
    counters = [e["sample_counter"] for e in by_name(answers, "PositionEstimate")]
    assert counters == [k % 1024 for k in range(0, counter.size, 10)]


def test_without_transmit_nothing_leaves() -> None:
    companion = Companion([config()], PROTOCOL, transmit=False)
    tracked, answers = play(companion, drive().step(2500).frames, 500 * MS)
    assert len(answers) == 0
    assert joined(tracked)[2][-1] == 7
    assert companion.nodes[0].scheduler.reason.name == "TRANSMIT_NOT_ENABLED"


def test_an_old_backlog_is_not_answered() -> None:
    """A reader that was away for a second answers the last 20 ms of what it missed."""
    companion = Companion([config()], PROTOCOL, True)
    frames = drive().step(5000).frames
    answers = companion.process(frames, 1000 * MS)
    assert [e["sample_counter"] for e in by_name(answers, "PositionEstimate")] == [k % 1024
                                                                                   for k in range(4900, 5000, 5)]


# ---- several drives -----------------------------------------------------------------------------------

def test_several_drives_do_not_touch_each_other() -> None:
    nodes = (0, 7, 15)
    frames = {n: drive(n, fd=n == 7).step(2500).frames for n in nodes}
    together = FrameBlock.concat(list(frames.values()))
    together = together.take(np.argsort(together.t_ns, kind="stable"))
    tracked, answers = play(Companion([config(n) for n in nodes], PROTOCOL, True), together, 500 * MS)
    for n in nodes:
        alone, own = play(Companion([config(n)], PROTOCOL, True), frames[n], 500 * MS)
        for a, b in zip(joined(alone, n), joined(tracked, n), strict=True):
            assert np.array_equal(a, b)
        mine = answers.take((answers.can_id & 0x1F) % 16 == n)
        assert np.array_equal(mine.raw, own.raw)
    assert len(answers) > 1500


def test_a_node_nobody_asked_for_is_left_alone() -> None:
    companion = Companion([config(0)], PROTOCOL, True)
    tracked, answers = play(companion, drive(3).step(1000).frames, 200 * MS)
    assert tracked == []
    assert set(answers.can_id.tolist()) == {BASE["CompanionStatus"]}


def test_two_drives_with_one_number_are_refused() -> None:
    with pytest.raises(ValueError, match="node 2 is given twice"):
        Companion([config(2), config(2)], PROTOCOL, True)


# ---- bad input ----------------------------------------------------------------------------------------

def with_rows(block: FrameBlock, change: Any, every: int = 10) -> tuple[FrameBlock, int]:
    """The block with every tenth DriveSample or DriveSampleBlock changed; and how many those are."""
    rows = np.flatnonzero(np.isin(block.can_id, [BASE["DriveSample"], BASE["DriveSampleBlock"]]))[1::every]
    changed = FrameBlock(block.raw.copy(), block.t_ns)
    change(changed, rows)
    return changed, rows.size


def set_id(flag: int) -> Any:
    def change(block: FrameBlock, rows: np.ndarray) -> None:
        block.can_id[rows] |= np.uint32(flag)
    return change


@pytest.mark.parametrize(("change", "count"), [
    (set_id(CAN_EFF_FLAG), "unknown"), (set_id(CAN_RTR_FLAG), "remote"), (set_id(CAN_ERR_FLAG), "errors")])
def test_frames_that_only_look_like_samples(change: Any, count: str) -> None:
    frames, n = with_rows(drive().step(1000).frames, change)
    companion = Companion([config()], PROTOCOL, True)
    tracked, _ = play(companion, frames, 200 * MS)
    assert getattr(companion.counts, count) == n == 100
    assert companion.counts.frames == len(frames)
    assert companion.nodes[0].receiver.sequencer.count("lost") == n
    assert sum(int(t.run.filled.sum()) for t in tracked) == n
    assert status(companion, 300 * MS)["lost_samples"] == n


def test_wrong_length_is_counted_and_shown() -> None:
    def cut(block: FrameBlock, rows: np.ndarray) -> None:
        block.raw[rows, 4] = np.arange(rows.size) % 8
    frames, n = with_rows(drive().step(1000).frames, cut)
    companion = Companion([config(), config(4)], PROTOCOL, True)
    play(companion, frames, 200 * MS)
    assert companion.counts.wrong_length == companion.nodes[0].wrong_length == n
    assert companion.nodes[4].wrong_length == 0
    assert status(companion, 300 * MS)["bad_frames"] == n
    assert status(companion, 400 * MS, 4)["bad_frames"] == 0


def test_bad_checksum_of_a_block_is_counted_and_shown() -> None:
    def flip(block: FrameBlock, rows: np.ndarray) -> None:
        block.raw[rows, 40] ^= 0x10
    frames, n = with_rows(drive(fd=True, rate=10_000.0).step(7000).frames, flip, 50)
    companion = Companion([config(wire={"max_gap": 8})], PROTOCOL, True)
    tracked, _ = play(companion, frames, 700 * MS)
    assert companion.nodes[0].bad_frames == n == 20
    assert status(companion, 800 * MS)["bad_frames"] == n
    assert sum(int(t.run.filled.sum()) for t in tracked) == 7 * n


def test_impossible_block_content_is_dropped_although_intact() -> None:
    companion = Companion([config(wire={"sample_rate": 5000.0})], PROTOCOL, True)
    for count in (0, 8, 255):
        raw = PROTOCOL.encode(MessageKind.DRIVE_SAMPLE_BLOCK, 0, {"first_sample": 7.0, "sample_count": 1.0}, count)
        raw[:, 15] = count
        protection = PROTOCOL.protection(MessageKind.DRIVE_SAMPLE_BLOCK, 0)
        assert protection is not None
        protection.protect(raw, np.array([count]))
        assert companion.feed(FrameBlock(raw, np.zeros(1, np.int64))) == []
    assert companion.nodes[0].bad_frames == 3


def test_impossible_sample_rates_are_dropped() -> None:
    companion = Companion([config()], PROTOCOL, True)
    for rate in (0.0, 99.999, 100_000.001, 4e6):
        raw = PROTOCOL.encode(MessageKind.DRIVE_TIMING, 0, {"sample_counter": 0.0, "sample_rate": rate})
        companion.feed(FrameBlock(raw, np.zeros(1, np.int64)))
    assert companion.nodes[0].bad_frames == 4
    assert status(companion, 0)["bad_frames"] == 4


def float_protocol() -> Protocol:
    """Somebody's DBC whose voltages are floats: 64-byte classical message is not possible, so v_beta only."""
    text = default_dbc_path().read_text(encoding="utf-8")
    text = text.replace(" SG_ i_alpha : 0|15@1-", " SG_ i_alpha : 0|8@1-").replace(
        " SG_ i_beta : 15|15@1-", " SG_ i_beta : 8|8@1-").replace(
        " SG_ v_alpha : 30|15@1-", " SG_ v_alpha : 16|12@1-").replace(
        ' SG_ v_beta : 45|15@1- (0.025,0) [-409.6|409.575] "V"', ' SG_ v_beta : 28|32@1- (1,0) [0|0] "V"')
    lines = text.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("BA_ "))
    lines.append("SIG_VALTYPE_ 256 v_beta : 1;")
    assert first
    return Protocol(Database.loads("\n".join(lines) + "\n"))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_sample_that_is_no_number_is_dropped(value: float) -> None:
    protocol = float_protocol()
    companion = Companion([config(wire={"sample_rate": 5000.0})], protocol, True)
    n = 100
    v_beta = np.full(n, 3.0)
    v_beta[40] = value
    raw = protocol.encode(MessageKind.DRIVE_SAMPLE, 0, {
        "i_alpha": np.zeros(n), "i_beta": np.zeros(n), "v_alpha": np.zeros(n), "v_beta": v_beta,
        "sample_counter": np.arange(n) & 15})
    tracked = companion.feed(FrameBlock(raw, np.arange(n) * 200_000))
    assert companion.nodes[0].bad_frames == 1
    (part,) = tracked
    assert part.run.counter.size == n and np.flatnonzero(part.run.filled).tolist() == [40]
    assert np.isfinite(part.estimate.flux).all()


# ---- states -------------------------------------------------------------------------------------------

def test_states_from_silence_to_lock_and_back() -> None:
    companion = Companion([config(estimate={"status_rate": 1000.0})], PROTOCOL, True)
    frames = drive(timing_rate=25.0).step(2500).frames
    late = frames.take(slice(20, None))  # without the DriveTiming that goes with sample 0
    seen: list[int] = []
    _, answers = play(companion, late, 700 * MS)
    for s in by_name(answers, "CompanionStatus"):
        if not seen or seen[-1] != s["state"]:
            seen.append(s["state"])
    names = DATABASE.get_message_by_name("CompanionStatus").get_signal_by_name("state").choices
    told = [str(names[k]) for k in seen]
    assert told[:2] == ["waiting_for_samples", "waiting_for_timing"]
    assert told[-2:] == ["locked", "stale"]
    assert set(told[2:-2]) <= {"starting", "tracking", "locked"}


def test_silence_makes_stale_after_its_time_and_not_before() -> None:
    companion = Companion([config(estimate={"status_rate": 1000.0})], PROTOCOL, True)
    play(companion, drive().step(1500).frames, 300 * MS)
    last = int(1499 / RATE * 1e9)
    assert status(companion, last + STALE_AFTER_NS)["state"] != 5
    assert status(companion, last + STALE_AFTER_NS + MS)["state"] == 5
    assert STALE_AFTER_NS == 50 * MS


def test_status_says_which_observer_and_protocol() -> None:
    companion = Companion([config()], PROTOCOL, True)
    companion.bus_load, companion.turnaround = 0.42, 0.0015
    said = status(companion, 0)
    assert (said["observer"], said["version"], said["bus_load"], said["turnaround"]) == (0, 1, 42, 1500)
    companion.turnaround = 1.0
    assert status(companion, 100 * MS)["turnaround"] == 5115


def test_injecting_is_what_the_drive_said() -> None:
    companion = Companion([config()], PROTOCOL, True)
    source = drive()
    source.simulation.command_injection(1, 6.0, 400.0, 0.0, 1500)
    frames = source.step(2500).frames
    _, answers = play(companion, frames, 500 * MS)
    flags = [e["injecting"] for e in by_name(answers, "PositionEstimate")]
    # DriveStatus every 500 samples, 0 included; the waveform ran for the first 1500
    changes = (np.flatnonzero(np.diff(flags)) + 1).tolist()
    assert flags[0] == 0 and flags[-1] == 0
    assert changes == [1, 301] or changes == [101, 301] or changes == [1, 300]


def test_frames_until_due_never_sleeps_over_an_answer() -> None:
    companion = Companion([config()], PROTOCOL, True)
    assert companion.frames_until_due(0) == 1
    frames = drive().step(1000).frames
    frames = frames.take(frames.can_id == BASE["DriveSample"])
    companion.feed(FrameBlock(PROTOCOL.encode(MessageKind.DRIVE_TIMING, 0, {
        "sample_counter": 0.0, "sample_rate": RATE}), np.zeros(1, np.int64)))
    for k in range(500):
        now = int(frames.t_ns[k])
        tracked = companion.feed(frames.take(slice(k, k + 1)))
        companion.respond(tracked, now)
        node = companion.nodes[0]
        other = min(node.next_status - now, node.quiet_ns(now)) * 1e-9 * RATE
        frames_left = companion.frames_until_due(now)
        assert 1 <= frames_left <= min(5 - k % 5, other + 1)
        if other > 5:
            assert frames_left == 5 - k % 5
    assert companion.frames_until_due(now + STALE_AFTER_NS + 1) == 1
