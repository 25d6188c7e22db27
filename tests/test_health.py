"""Health of a bus: every figure against a plain Python count of the same frames, every finding provoked."""

from __future__ import annotations

import dataclasses
import json
import math
import tracemalloc
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipmsm_can.bus.bits import frame_seconds
from ipmsm_can.bus.health import BusHealth
from ipmsm_can.bus.health_kernel import IDS_MAX
from ipmsm_can.bus.health_report import HealthReport
from ipmsm_can.bus.health_words import TABLE_HEAD, table_row, text
from ipmsm_can.cli import main, plain
from ipmsm_can.cli.render import render
from ipmsm_can.cli.status import HealthStatus
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CANFD_BRS, CANFD_FDF, FrameBlock
from ipmsm_can.logs import write_log
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol

PROTOCOL = Protocol()
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND + 123_456_789


def cyclic(can_id: int, period: float, seconds: float, length: int = 8, jitter: float = 0.0, seed: int = 0,
           at: float = 0.0) -> FrameBlock:
    n = int(seconds / period)
    block = FrameBlock.zeros(n)
    block.can_id[:] = can_id
    block.length[:] = length
    rng = np.random.default_rng(seed + can_id)
    block.raw[:, 8:8 + length] = rng.integers(0, 256, (n, length))
    late = np.abs(rng.normal(0.0, jitter, n)) if jitter else np.zeros(n)
    block.t_ns[:] = START + ((at + np.arange(n) * period + late) * 1e9).astype(np.int64)
    return block


def merged(*blocks: FrameBlock) -> FrameBlock:
    block = FrameBlock.concat(blocks)
    return block.take(np.argsort(block.t_ns, kind="stable"))


def without(block: FrameBlock, begin: float, end: float, can_id: int | None = None) -> FrameBlock:
    """Without the frames of a stretch of time [s from START], of one identifier or all."""
    t = 1e-9 * (block.t_ns - START)
    gone = (t >= begin) & (t < end)
    return block.take(~(gone & ((block.can_id == can_id) if can_id is not None else True)))


def errors(*frames: str, at: float = 0.5) -> FrameBlock:
    """Error frames from "id#data" in hexadecimal."""
    block = FrameBlock.zeros(len(frames))
    for k, one in enumerate(frames):
        can_id, data = one.split("#")
        block.can_id[k] = int(can_id, 16) | CAN_ERR_FLAG
        block.length[k] = len(data) // 2
        block.raw[k, 8:8 + len(data) // 2] = np.frombuffer(bytes.fromhex(data), np.uint8)
        block.t_ns[k] = START + round(at * 1e9) + k
    return block


def report(block: FrameBlock, bitrate: float = 500e3, data_bitrate: float = 2e6, **options: Any) -> HealthReport:
    health = BusHealth(bitrate, data_bitrate, **options)
    health.update(block)
    return health.report("test")


def sentences(r: HealthReport, severity: str | None = None) -> str:
    return "\n".join(f.sentence for f in r.findings if severity in (None, f.severity))


def mixture(seed: int, n: int = 4000) -> FrameBlock:
    """Any traffic: both kinds of identifier, remote and FD frames, lengths, error frames, time in jumps."""
    rng = np.random.default_rng(seed)
    block = FrameBlock.zeros(n)
    pool = np.concatenate([rng.integers(0, 0x800, 12), rng.integers(0, 1 << 29, 12) | CAN_EFF_FLAG])
    block.can_id[:] = rng.choice(pool, n)
    fd = rng.random(n) < 0.3
    block.length[:] = np.where(fd, rng.choice([0, 5, 8, 12, 24, 64], n), rng.integers(0, 9, n))
    block.raw[fd, 5] = CANFD_FDF | CANFD_BRS
    block.can_id[(rng.random(n) < 0.05) & ~fd] |= np.uint32(CAN_RTR_FLAG)
    block.can_id[rng.random(n) < 0.02] |= np.uint32(CAN_ERR_FLAG)
    for k in range(n):
        block.raw[k, 8:8 + block.length[k]] = rng.integers(0, 256, block.length[k])
    block.t_ns[:] = START + np.cumsum(rng.integers(0, 3_000_000, n) * rng.choice([0, 1, 1, 30], n))
    return block


def by_hand(block: FrameBlock) -> dict[int, dict[str, Any]]:
    """The same figures, one frame at a time in plain Python."""
    seen: dict[int, list[int]] = defaultdict(list)
    for k, can_id in enumerate(block.can_id.tolist()):
        if not can_id & CAN_ERR_FLAG:
            seen[can_id & ~CAN_RTR_FLAG].append(k)
    out = {}
    for key, rows in seen.items():
        t = block.t_ns[rows].tolist()
        gaps = [b - a for a, b in pairwise(t)]
        lengths = block.length[rows].tolist()
        windows: dict[int, int] = defaultdict(int)
        for stamp in t:
            windows[stamp // SECOND] += 1
        inner = [windows[w] for w in range(min(windows) + 1, max(windows))]
        out[key] = {
            "count": len(rows), "jitter": 1e-9 * float(np.std(gaps)) if gaps else math.nan,
            "rate": 1e9 * len(gaps) / sum(gaps) if sum(gaps) else math.nan, "max_gap": 1e-9 * max(gaps, default=0),
            "changes": sum(a != b for a, b in pairwise(lengths)),
            "lengths": (min(lengths), max(lengths)),
            "least": min(inner, default=-1), "most": max(inner, default=-1),
            "remote": sum(bool(block.can_id[k] & CAN_RTR_FLAG) for k in rows)}
    return out


@pytest.mark.parametrize("seed", range(3))
def test_every_figure_against_a_plain_count(seed: int) -> None:
    block = mixture(seed)
    r = report(block)
    expected = by_hand(block)
    assert len(r.ids) == len(expected)
    for i in r.ids:
        e = expected[i.can_id | (CAN_EFF_FLAG if i.extended else 0)]
        assert (i.count, i.length_changes, (i.min_length, i.max_length), i.remote) == (
            e["count"], e["changes"], e["lengths"], e["remote"])
        assert (i.least, i.most) == (e["least"], e["most"])
        for name in ("jitter", "rate", "max_gap"):
            assert getattr(i, name) == pytest.approx(e[name], rel=1e-9, nan_ok=True), name
    busy = frame_seconds(block, 500e3, 2e6)
    assert r.mean_load == pytest.approx(busy.sum() / (1e-9 * (block.t_ns[-1] - block.t_ns[0])))
    whole = np.bincount((block.t_ns // SECOND - block.t_ns[0] // SECOND).astype(int), weights=busy)
    assert r.peak_load == pytest.approx(whole.max())
    gaps = np.diff(block.t_ns)
    assert r.silence == pytest.approx(1e-9 * gaps.max())
    assert r.silence_at == pytest.approx(1e-9 * (block.t_ns[int(np.argmax(gaps))] - block.t_ns[0]))
    assert r.frames + r.errors.frames == len(block)
    assert sum(i.share for i in r.ids) == pytest.approx(1.0)


def test_any_cut_gives_the_same_report() -> None:
    block = mixture(9)
    rng = np.random.default_rng(0)
    health = BusHealth(500e3, 2e6)
    for rows in np.split(np.arange(len(block)), np.sort(rng.integers(0, len(block), 60))):
        health.update(block.take(rows))
    assert json.dumps(health.report("test").to_dict()) == json.dumps(report(block).to_dict())


def test_a_quiet_bus_has_no_findings() -> None:
    block = merged(cyclic(0x120, 0.01, 12.0, jitter=2e-4), cyclic(0x350, 0.1, 12.0), cyclic(0x5, 0.002, 12.0))
    r = report(block)
    assert r.findings == ()
    assert "Nothing remarkable." in text(r)
    slow, = (i for i in r.ids if i.can_id == 0x350)
    assert slow.period == pytest.approx(0.1, rel=1e-6)
    assert (slow.steady, slow.least, slow.most) == (True, 10, 10)


def test_load_is_told_from_70_percent_on_and_where_the_bit_rate_must_be_wrong() -> None:
    per_frame = float(frame_seconds(cyclic(0x100, 0.01, 10.0), 500e3).mean())
    for load, severity, words in ((0.66, "", ""), (0.75, "warning", "The bus load reaches 7"),
                                  (0.95, "error", "The bus load reaches 9"),
                                  (1.5, "warning", "more than a bus of 500 kbit/s can carry")):
        r = report(cyclic(0x100, per_frame / load, 3.0))
        assert r.mean_load == pytest.approx(load, rel=0.01)
        assert [(f.severity, words in f.sentence) for f in r.findings] == ([(severity, True)] if words else [])
    guessed = report(cyclic(0x100, per_frame / 0.8, 3.0), assumed_rates=True)
    assert "if the bit rate is 500 kbit/s" in sentences(guessed)


def test_load_of_fd_frames_counts_both_rates() -> None:
    block = cyclic(0x120, 0.001, 2.0)
    block.raw[:, 4] = 64
    block.raw[:, 5] = CANFD_FDF | CANFD_BRS
    slow, fast = report(block, 1e6, 1e6), report(block, 1e6, 5e6)
    assert slow.mean_load == pytest.approx(frame_seconds(block, 1e6, 1e6).sum() / 1.999, rel=1e-3)
    assert fast.mean_load < 0.35 * slow.mean_load


def test_a_pause_of_one_sender_and_the_silence_of_all() -> None:
    block = merged(cyclic(0x120, 0.01, 10.0, jitter=3e-4), cyclic(0x300, 0.05, 10.0))
    told = sentences(report(without(block, 4.0, 4.8, 0x120)))
    assert told.startswith("Sent by the clock, but with pauses: 0x120 every 10 ms, once not for 81")
    assert "at 3.99" in told and "0x300" not in told
    told = sentences(report(without(block, 4.0, 6.5)))
    assert told.startswith("The whole bus was silent for 2.5") and "pauses" not in told


def test_a_pause_of_its_own_is_told_beside_the_silence_of_all() -> None:
    block = merged(cyclic(0x120, 0.01, 12.0, jitter=3e-4), cyclic(0x300, 0.05, 12.0))
    told = sentences(report(without(without(block, 3.0, 4.5), 6.0, 9.0, 0x120)))
    assert "The whole bus was silent for 1.5" in told
    assert "with pauses: 0x120 every 10 ms, once not for 3.0" in told and "0x300" not in told
    told = sentences(report(without(without(block, 3.0, 4.5), 2.0, 6.0, 0x120)))
    assert "The whole bus was silent for 1.5" in told
    assert "with pauses: 0x120 every 10 ms, once not for 4.0" in told and "0x300" not in told


def test_a_few_frames_in_a_row_are_no_load() -> None:
    assert report(cyclic(0x100, 2.5e-4, 0.002)).findings == ()


def test_sporadic_frames_pause_without_being_told() -> None:
    block = cyclic(0x120, 0.01, 60.0)
    gaps = np.random.default_rng(2).exponential(0.05, len(block))
    block.t_ns[:] = START + np.cumsum((1e9 * gaps).astype(np.int64))
    r = report(block)
    assert not r.ids[0].steady
    assert r.findings == ()


def test_a_rate_that_wanders() -> None:
    block = FrameBlock.concat([cyclic(0x200, 0.01, 5.0), cyclic(0x200, 0.014, 5.0, at=5.0)])
    assert sentences(report(block)) == "The rate is not steady: 0x200 71 to 100 in a second."


def test_payload_lengths_and_names() -> None:
    block = merged(cyclic(0x123, 0.01, 2.0), cyclic(0x124, 0.1, 2.0, length=4), cyclic(0x123, 0.5, 2.0, length=3))
    r = report(block, name=lambda can_id, *_: "Speed" if can_id == 0x123 else "", database="car.dbc")
    told = sentences(r, "notice")
    assert "The length of the payload changes: 0x123 Speed 3 to 8 bytes." in told
    assert "Not in car.dbc: 0x124." in told
    assert [i.label for i in r.unknown] == ["0x124"]
    foreign = report(block, name=lambda *_: "", database="car.dbc")
    assert "None of the 2 identifiers is in car.dbc." in sentences(foreign)


def test_error_frames_are_decoded_and_told() -> None:
    good = cyclic(0x100, 0.01, 2.0)
    block = merged(good, errors("204#0008000000006000", "88#0000040A00000000", "88#0000040800000000",
                                "88#0000810800000000"))
    e = report(block).errors
    assert e.violations == {"bit stuffing error": 2, "single bit error": 1, "while transmitting": 1}
    assert list(e.places.items()) == [("CRC sequence", 2), ("data", 1)]
    assert (e.tx_errors, e.rx_errors, e.bus_offs) == (96, 0, 0)
    told = sentences(report(block))
    assert told.startswith("4 error frames: 1 x controller problem, 3 x protocol violation, 3 x bus error")
    assert "2 x bit stuffing error" in told and "most often in CRC sequence (2), data (1)" in told
    off = report(merged(good, errors("40#0000000000000000")))
    assert off.findings[0].severity == "error" and "went bus-off once and is so still" in off.findings[0].sentence
    back = report(merged(good, errors("40#0000000000000000", "100#0000000000000000")))
    assert "bus-off once: nothing" in back.findings[0].sentence
    passive = report(merged(good, errors("204#0030000000008085")))
    assert "was error passive (counters tx 128 rx 133)" in passive.findings[0].sentence
    over = report(merged(good, errors("4#0001000000000000")))
    assert "own buffer overflowed once" in sentences(over, "error")
    assert report(block).frames == len(good)


def test_error_frames_of_other_origin_are_only_counted() -> None:
    """In a BLF recording of Vector's tools the identifier is the frame's: 0x40 is not bus-off there."""
    r = report(merged(cyclic(0x100, 0.01, 2.0), errors("40#0000000000000000")), error_classes=False)
    assert (r.errors.frames, r.errors.bus_offs, r.errors.state) == (1, 0, "")
    assert [f.severity for f in r.findings] == ["warning"]
    assert "1 error frame; what they mean is not told" in sentences(r)


def drive_traffic(seconds: float, ppm: float = 0.0, node: int = 0) -> FrameBlock:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(600.0 * RPM, 1.0, seconds))
    block = DriveNode(PROTOCOL, node, simulation, DriveNodeSettings()).step(int(5000 * seconds)).frames
    rng = np.random.default_rng(node)
    t = (block.t_ns / (1.0 + 1e-6 * ppm)).astype(np.int64) + rng.exponential(1e5, len(block)).astype(np.int64)
    block.t_ns[:] = START + np.maximum.accumulate(t)
    return block


def test_samples_lost_are_placed() -> None:
    block = drive_traffic(4.0)
    rng = np.random.default_rng(1)
    keep = (block.can_id != 0x100) | (rng.random(len(block)) > 0.002)
    keep[:1000] = True
    lost = int((~keep).sum())
    for drops, severity, words in (
            (-1, "warning", "in the drive, on the bus or in the computer that listened, which did not tell"),
            (0, "warning", "not in this computer's kernel or in this program, so in the drive"),
            (10, "warning", f"at most 10 in this computer's kernel, at least {lost - 10} before it"),
            (lost, "warning", "possibly all in this computer's kernel")):
        health = BusHealth(1e6, 5e6, protocol=PROTOCOL)
        health.update(block.take(keep))
        health.note_port(drops)
        r = health.report()
        assert [d.lost for d in r.drives] == [lost]
        assert f"{lost} samples of drive 0 never came (" in sentences(r, severity)
        assert words in sentences(r, severity)
        assert ("The kernel of this computer dropped" in sentences(r, "error")) == (drops > 0)


def test_the_clock_of_each_drive() -> None:
    """Two drives on one bus, one of them with a clock far off."""
    block = merged(drive_traffic(6.0, 420.0), drive_traffic(6.0, -15.0, node=3))
    r = report(block, 1e6, protocol=PROTOCOL)
    fast, good = r.drives
    assert (fast.node, good.node) == (0, 3)
    assert fast.drift_ppm == pytest.approx(420.0, abs=2.0)
    assert good.drift_ppm == pytest.approx(-15.0, abs=2.0)
    told = sentences(r, "notice")
    assert "The clock of drive 0 runs 420 ppm faster" in told and "drive 3" not in told


def test_samples_without_timing_are_told() -> None:
    block = drive_traffic(1.0)
    r = report(block.take(block.can_id != 0x140), 1e6, protocol=PROTOCOL)
    assert "Drive 0 sends samples but no DriveTiming: losses cannot be counted." in sentences(r)
    assert any("Where other devices send these identifiers: --dbc FILE" in f.advice for f in r.findings)


def test_outages_no_bus_and_nothing_at_all() -> None:
    health = BusHealth(1e6, 1e6)
    assert sentences(health.report()) == "Not one frame came."
    health.note_outages(2, 7.5, "no bus since 10:00:00: can0 is down")
    r = health.report()
    assert sentences(r, "error").splitlines() == ["There is no bus since 10:00:00: can0 is down.",
                                                  "The bus went away 2 times, for 7.5 s in all."]
    status = HealthStatus("ipmsm-can bus", 3.0, r)
    assert plain.line(status) == "0:00:03 SILENT (listening only) no bus since 10:00:00: can0 is down"


def test_silence_counts_up_to_now() -> None:
    health = BusHealth(1e6, 1e6)
    block = cyclic(0x100, 0.01, 1.0)
    health.update(block)
    now = int(block.t_ns[-1]) + 9 * SECOND
    r = health.report(now_ns=now)
    assert r.silence == pytest.approx(9.0) and r.load == 0.0
    assert r.duration == pytest.approx(9.99)
    assert "The whole bus was silent for 9 s, at 0.990 s." in sentences(r)


def test_time_that_runs_backwards_is_told_and_harmless() -> None:
    block = FrameBlock.concat([cyclic(0x100, 0.01, 3.0), cyclic(0x100, 0.01, 3.0, at=-100.0)])
    r = report(block)
    assert r.back == 1 and "Time stamps run backwards once." in sentences(r)
    assert r.duration == pytest.approx(5.98)
    assert r.ids[0].rate == pytest.approx(100.0)


def test_memory_stays_the_same_whatever_comes() -> None:
    """Every frame another identifier, garbage in all bytes: nothing raises, and nothing grows."""
    rng = np.random.default_rng(0)
    health = BusHealth(1e6, 5e6, protocol=PROTOCOL)

    def rubbish() -> FrameBlock:
        return FrameBlock(rng.integers(0, 256, (20_000, 72)).astype(np.uint8),
                          rng.integers(0, 1 << 60, 20_000).astype(np.int64))

    health.update(rubbish())
    r = health.report()
    assert len(r.ids) == IDS_MAX and r.uncounted == r.frames - sum(i.count for i in r.ids) > 0
    assert "more identifiers than are told apart" in sentences(r)
    tracemalloc.start()
    try:
        health.update(rubbish())
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(5):
            health.update(rubbish())
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 100_000
    json.loads(json.dumps(health.report().to_dict(), allow_nan=False))
    assert text(health.report())


def test_wrong_rates_are_named() -> None:
    with pytest.raises(ValueError, match=r"bitrate is 0"):
        BusHealth(0, 1e6)


# ---- the command --------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("health") / "run.log"
    block = merged(drive_traffic(3.0), errors("204#0008000000006000"), cyclic(0x7A0, 0.1, 3.0))
    write_log(path, [block])
    write_log(path.with_suffix(".blf"), [block])
    return path


def told(argv: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = main(argv)
    out, err = capsys.readouterr()
    return code, out, err.removeprefix("compiling kernels (first time only) ...\n")


def test_a_recording_is_told_in_words_and_in_json(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = told(["bus", str(recording), "-b", "1000000"], capsys)
    assert (code, err) == (0, "")
    assert out.startswith(f"{recording}: ")
    assert "0x100 DriveSample 0" in out and "Not in ipmsm_can.dbc: 0x7A0." in out
    assert "1 error frame: 1 x controller problem" in out
    assert max(map(len, out[out.index(TABLE_HEAD):].splitlines())) <= 80
    code, out, err = told(["bus", str(recording), "--json"], capsys)
    data = json.loads(out)
    assert (code, err) == (0, "")
    assert data["assumed_rates"] and data["errors"]["tx_errors"] == 96
    assert {i["label"] for i in data["ids"]} >= {"0x100 DriveSample 0", "0x7A0"}
    assert data["drives"][0]["lost"] == 0
    # a BLF file may come from anywhere: the same error frame is only counted
    blf = json.loads(told(["bus", str(recording.with_suffix(".blf")), "--json"], capsys)[1])
    assert (blf["errors"]["frames"], blf["errors"]["decoded"], blf["errors"]["tx_errors"]) == (1, False, -1)
    for name in ("label", "count", "min_length", "length_changes", "steady"):
        assert [i[name] for i in blf["ids"]] == [i[name] for i in data["ids"]]
    assert blf["drives"][0]["received"] == data["drives"][0]["received"]


def test_a_foreign_database(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dbc = tmp_path / "car.dbc"
    dbc.write_text('VERSION ""\nBU_: A\nBO_ 1952 Beacon: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] "" A\n')
    data = json.loads(told(["bus", str(recording), "--dbc", str(dbc), "--json"], capsys)[1])
    names = {i["can_id"]: i["name"] for i in data["ids"]}
    assert names[0x7A0] == "Beacon" and names[0x100] == ""
    assert data["drives"] == [], "what 0x100 means is not known on such a bus"


@pytest.mark.parametrize(("argv", "words"), [
    (["bus", "nowhere.log"], "the log nowhere.log does not exist"),
    (["bus"], "neither a LOG was named nor a bus: no CAN interface was given"),
    (["bus", "a.log", "-i", "virtual", "-c", "x"], "both the log a.log and a bus (virtual) are named"),
])
def test_bad_input_is_one_sentence(argv: list[str], words: str, capsys: pytest.CaptureFixture[str],
                                   monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("CAN_INTERFACE", "CAN_CHANNEL"):
        monkeypatch.delenv(name, raising=False)
    code, out, err = told(argv, capsys)
    assert (code, out) == (2, "")
    assert words in err and err.count("\n") == 1


def test_a_recording_cut_off_is_told(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = tmp_path / "cut.blf"
    content = recording.with_suffix(".blf").read_bytes()
    cut.write_bytes(content[:len(content) * 2 // 3])
    code, out, err = told(["bus", str(cut)], capsys)
    assert code == 2 and "DriveSample" in out
    assert "cut.blf" in err and err.endswith("; what was readable is in the report\n")


def test_the_picture_fits_the_window(recording: Path) -> None:
    from ipmsm_can.logs import read_log

    health = BusHealth(1e6, 5e6, protocol=PROTOCOL, assumed_rates=True)
    for block in read_log(recording):
        health.update(block)
    r = health.report("can0 (SocketCAN, kernel time stamps)")
    for height in (12, 24, 50):
        lines = render(HealthStatus("ipmsm-can bus", 12.0, r), 80, height).plain.splitlines()
        assert len(lines) <= height and max(map(len, lines)) <= 80
        assert "SILENT (listening only)" in lines[0]
    assert any("0x100" in one for one in lines)
    assert plain.line(HealthStatus("ipmsm-can bus", 12.0, r)).startswith("0:00:12 SILENT (listening only) load ")
    assert len(table_row(dataclasses.replace(r.ids[0], name="A" * 40, count=10**8))) <= 80


def test_a_name_of_ours_needs_a_payload_of_ours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another inverter answers on 0x181 with four bytes, and the tabs are as its recorder wrote them."""
    (tmp_path / "a.log").write_text("(1629633295.166562)\tcan0\t181#8A000004\n"
                                    "(1629633295.168364)\tcan0\t182#F600000511223344\n")
    assert main(["bus", str(tmp_path / "a.log"), "-b", "500000"]) == 0
    shown = capsys.readouterr().out
    assert "0x182 DriveReference 2" in shown and "0x181 DriveReference" not in shown
    assert "Not in ipmsm_can.dbc: 0x181." in shown
