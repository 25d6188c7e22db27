"""What recording costs: processor time per frame of each format, and what a queue and a thread add to a live round.

    python -m tools.record_cost [--frames 500000]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import can
import numpy as np

from ipmsm_can.bus.pythoncan import messages_from_block
from ipmsm_can.bus.replay import Replay
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.writer import LogWriter, warm_up
from ipmsm_can.motor import M2
from ipmsm_can.record.measure import MeasureFile
from ipmsm_can.record.recorder import Recorder
from ipmsm_can.wire.protocol import Protocol

NOTHING = FrameBlock.zeros(0)
PIECE = 4000
"""Frames of a block: half a second of a full bus, as the recorder writes it."""
BASELINE = 20_000


def traffic(frames: int) -> FrameBlock:
    """What a drive sends at 5 kHz."""
    seconds = frames / 5560.0
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0), constant(600.0 * RPM, 1.0, seconds))
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings())
    return node.step(int(5000 * seconds), 1_700_000_000_000_000_000).frames


def write(path: Path, block: FrameBlock) -> float:
    """Processor time [s]."""
    begin = time.process_time()
    with LogWriter(path) as writer:
        for k in range(0, len(block), PIECE):
            writer.write(block.take(slice(k, k + PIECE)))
            writer.flush()
    return time.process_time() - begin


def baseline(path: Path, block: FrameBlock) -> float:
    """python-can's writer, its messages made beforehand: processor time [s]."""
    messages = messages_from_block(block, "can0")
    begin = time.process_time()
    with can.Logger(path) as logger:
        for message in messages:
            logger.on_message_received(message)
    return time.process_time() - begin


def resident() -> float:
    """Memory of this process now [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def formats(folder: Path, block: FrameBlock) -> None:
    warm_up()
    write(folder / "warm.mf4", block.take(slice(0, 10)))
    small = block.take(slice(0, BASELINE))
    print(f"{'format':10}{'ours us/frame':>15}{'python-can us/frame':>21}{'bytes/frame':>13}")
    for suffix in (".blf", ".log", ".log.gz", ".mf4", ".asc", ".csv", ".trc", ".db"):
        own = suffix in (".blf", ".log", ".log.gz", ".mf4")
        part = block if own else small
        took = write(folder / f"run{suffix}", part)
        size = (folder / f"run{suffix}").stat().st_size / len(part)
        other = f"{1e6 * baseline(folder / f'base{suffix}', small) / len(small):.2f}" if own else "same writer"
        print(f"{suffix:10}{1e6 * took / len(part):15.2f}{other:>21}{size:13.1f}")


def rounds(folder: Path, block: FrameBlock) -> None:
    """What `take` costs the runner: many small rounds, as on a live bus."""
    pieces = [block.take(slice(k, k + 5)) for k in range(0, 50_000, 5)]
    took = []
    for k in range(9):
        recorder = Recorder(folder / f"rounds{k}.blf", "can0")
        begin = time.thread_time()
        for piece in pieces:
            recorder.take(piece, (), NOTHING)
        took.append(1e6 * (time.thread_time() - begin) / len(pieces))
        recorder.close()
    print(f"handing over a round of 5 frames: {np.median(took):.2f} us, at most {max(took):.2f}")


def measurement(folder: Path, block: FrameBlock) -> None:
    protocol = Protocol()
    file = MeasureFile(folder / "run.mf4", [0], protocol)
    took = [0.0]

    def tap(part: FrameBlock, tracked: object) -> None:
        begin = time.process_time()
        file.feed(part, tracked)  # type: ignore[arg-type]
        took[0] += time.process_time() - begin

    replay = Replay([config_from({"motor": {"preset": "m2"}})], protocol, tap=tap)
    peaks = []
    for k in range(0, len(block), PIECE):
        replay.feed(block.take(slice(k, k + PIECE)))
        peaks.append(resident())
    begin = time.process_time()
    file.close()
    closing = time.process_time() - begin
    end = resident()
    size = (folder / "run.mf4").stat().st_size
    print(f"measurement: {1e6 * took[0] / file.rows:.2f} us and {size / file.rows:.1f} bytes a sample, "
          f"{closing:.2f} s to put {file.rows} samples together; memory {peaks[len(peaks) // 4]:.0f} MB after a "
          f"quarter, {peaks[-1]:.0f} MB before the end, {end:.0f} MB behind it")


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=500_000)
    args = parser.parse_args()
    block = traffic(args.frames)
    print(f"{len(block)} frames of a drive at 5 kHz, {np.ptp(block.t_ns) * 1e-9:.0f} s")
    with tempfile.TemporaryDirectory() as folder:
        formats(Path(folder), block)
        rounds(Path(folder), block)
        measurement(Path(folder), block)
    return 0


if __name__ == "__main__":
    sys.exit(main())
