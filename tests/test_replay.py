"""Replay: rows against the companion, and a second opinion on every number in them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.api import estimate
from ipmsm_can.bus.replay import EncoderComparison, Replay
from ipmsm_can.bus.rows import COLUMNS, RowBlock, open_rows
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tests.replaying import RATE, column, config, drive_frames, rows_of


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return Protocol()


def damaged(frames: FrameBlock, seed: int) -> FrameBlock:
    """Losses, a long gap, duplicates, late frames."""
    rng = np.random.default_rng(seed)
    keep = np.flatnonzero(rng.random(len(frames)) > 0.03)
    keep = keep[(keep < 3000) | (keep > 3200)]
    rows = np.sort(np.concatenate([keep, keep[::50]]))
    late = rng.integers(0, rows.size - 3, 20)
    rows[late], rows[late + 2] = rows[late + 2].copy(), rows[late].copy()
    out = frames.take(rows)
    out.t_ns.sort()
    return out


@pytest.mark.parametrize("fd", [False, True])
def test_blocks_of_any_size_give_the_same_bytes(protocol: Protocol, tmp_path: Path, fd: bool) -> None:
    frames = damaged(drive_frames(protocol, 1.0, fd=fd), 1)
    rng = np.random.default_rng(2)
    partitions: list[list[int]] = [[], sorted(rng.integers(0, len(frames), 40).tolist()),
                                   list(range(0, len(frames), 7)), list(range(1, 200))]
    texts = []
    for k, edges in enumerate(partitions):
        file = open_rows(tmp_path / f"{k}.csv")
        for rows in rows_of(frames, [config()], protocol, edges)[0]:
            file.write(rows)
        file.close()
        texts.append((tmp_path / f"{k}.csv").read_bytes())
    assert len(texts[0].splitlines()) > 4500
    assert all(text == texts[0] for text in texts[1:])


def test_every_frame_a_block_of_its_own(protocol: Protocol) -> None:
    frames = damaged(drive_frames(protocol, 0.5), 3).take(slice(0, 1500))
    for configs in ([config()], [config(sample_rate=RATE)]):
        whole = rows_of(frames, configs, protocol)[0]
        single = rows_of(frames, configs, protocol, list(range(1, len(frames))))[0]
        for name in COLUMNS:
            assert np.array_equal(column(whole, name), column(single, name)), name


def test_rows_say_what_the_estimator_says(protocol: Protocol) -> None:
    """Undamaged log: the same numbers as `estimate` gives for the samples as the wire rounds them."""
    frames = drive_frames(protocol, 0.6)
    blocks = rows_of(frames, [config()], protocol)[0]
    label = protocol.classify(frames.raw)
    values = protocol.codecs[MessageKind.DRIVE_SAMPLE].decode(frames.take(label == 0).words)
    result = estimate(values[:2].T, values[2:4].T, RATE, M2, alpha=5.0, gamma=50.0)
    assert np.array_equal(column(blocks, "sample"), np.arange(3000))
    assert not column(blocks, "filled").any()
    assert np.array_equal(column(blocks, "theta_rad"), result.theta)
    assert np.array_equal(column(blocks, "omega_rad_s"), result.omega)
    assert np.array_equal(column(blocks, "lambda_alpha"), result.flux[:, 0])
    assert np.array_equal(column(blocks, "lambda_beta"), result.flux[:, 1])
    assert np.array_equal(column(blocks, "excitation"), result.excitation)
    assert np.array_equal(column(blocks, "valid"), result.valid)
    assert np.array_equal(column(blocks, "locked"), result.locked)
    assert 0 < column(blocks, "valid").sum() < column(blocks, "locked").sum() <= 3000
    assert np.allclose(column(blocks, "time_s"), np.arange(3000) / RATE, rtol=0, atol=1e-12)


def test_filled_rows_are_where_frames_are_missing(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 0.4)
    label = protocol.classify(frames.raw)
    samples = np.flatnonzero(label == 0)
    gone = samples[[500, 501, 502, 900, 1500]]
    kept = frames.take(np.setdiff1d(np.arange(len(frames)), gone))
    blocks = rows_of(kept, [config()], protocol)[0]
    assert np.array_equal(column(blocks, "sample"), np.arange(2000))
    assert np.flatnonzero(column(blocks, "filled")).tolist() == [500, 501, 502, 900, 1500]


def test_injecting_follows_drive_status(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 1.0)
    label = protocol.classify(frames.raw)
    codec = protocol.codecs[MessageKind.DRIVE_STATUS]
    status = np.flatnonzero(label == MessageKind.DRIVE_STATUS * 16)
    said = codec.decode_rows(frames.words, status)[codec.index["active_waveform"]] != 0
    assert said.any() and not said.all()
    expected, now = [], False
    for row in range(len(frames)):
        # A DriveStatus follows the sample of the same instant on the wire.
        if label[row] == 0:
            expected.append(now)
        elif row in status:
            now = bool(said[np.flatnonzero(status == row)[0]])
    injecting = column(rows_of(frames, [config()], protocol, [700, 2900])[0], "injecting")
    assert injecting.astype(bool).tolist() == expected


def test_sample_rate_of_the_toml_yields_to_drive_timing(protocol: Protocol) -> None:
    """Samples before the first DriveTiming get their right 32-bit counters in hindsight."""
    frames = drive_frames(protocol, 0.4)
    late = frames.take(slice(300, None))
    samples = column(rows_of(late, [config(sample_rate=RATE)], protocol)[0], "sample")
    assert samples[0] > 200
    assert np.array_equal(np.diff(samples), np.ones(samples.size - 1))
    silent = late.take(protocol.classify(late.raw) != MessageKind.DRIVE_TIMING * 16)
    blocks = rows_of(silent, [config(sample_rate=RATE)], protocol)[0]
    assert column(blocks, "sample").size == samples.size
    assert np.array_equal(column(blocks, "theta_rad"),
                          column(rows_of(late, [config()], protocol)[0], "theta_rad"))


def test_encoder_comparison_by_hand() -> None:
    c = EncoderComparison()
    c.estimate(np.array([10, 11, 12]), np.array([3.1, 0.1, 0.2]), np.array([True, True, False]))
    c.reference(np.array([10, 11, 12, 14]), np.array([-3.1, 0.1, 1.0, 0.5]))
    c.estimate(np.array([13, 14]), np.array([0.0, 0.8]), np.array([True, True]))
    errors = [2 * math.pi - 6.2, 0.0, 0.3]
    assert (c.references, c.compared) == (4, 3)
    assert c.rms == pytest.approx(math.sqrt(sum(e * e for e in errors) / 3))
    assert c.largest == pytest.approx(0.3)


def test_encoder_error_is_that_of_the_truth(protocol: Protocol) -> None:
    frames = drive_frames(protocol, 1.0)
    found: list[RowBlock] = []
    replay = Replay([config()], protocol, lambda _, rows: found.append(rows))
    for begin in range(0, len(frames), 501):
        replay.feed(frames.take(slice(begin, begin + 501)))
    label = protocol.classify(frames.raw)
    codec = protocol.codecs[MessageKind.DRIVE_REFERENCE]
    truth = codec.decode(frames.take(label == MessageKind.DRIVE_REFERENCE * 16).words)
    at = truth[codec.index["sample_counter"]].astype(int)
    theta, valid = column(found, "theta_rad")[at], column(found, "valid")[at].astype(bool)
    error = np.angle(np.exp(1j * (theta - truth[codec.index["theta_e"]])))[valid]
    summary = replay.summaries[0]
    assert summary.encoder.compared == error.size > 400
    assert summary.encoder.rms == pytest.approx(np.sqrt(np.mean(error**2)))
    assert summary.encoder.largest == pytest.approx(np.abs(error).max())
    assert summary.rows == 5000 and summary.valid == column(found, "valid").sum()
    assert summary.first_valid == pytest.approx(np.argmax(column(found, "valid")) / RATE)
