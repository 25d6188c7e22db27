"""How fast logs are read: an hour of 5 kHz classical traffic, replayed from BLF on one core, reading included.

    python -m tools.read_logs                  an hour: 18 million samples and what a drive sends beside them
    python -m tools.read_logs --seconds 600    less of it
    python -m tools.read_logs --keep FOLDER    the BLF file goes there and stays

The traffic is a simulated drive's, 60 s of it again and again with counters and times that go on, written by the
package's own BLF writer.  python-can's reader runs alone over a slice of the same file, scaled up to all of it.
Then candump's text, packed or not, and MF4, on a shorter log: ns per frame of reading alone.
"""

from __future__ import annotations

import argparse
import gzip
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import islice
from pathlib import Path

import numpy as np

from ipmsm_can.frames import DATA_OFFSET, FrameBlock
from ipmsm_can.logs import LogWriter, read_log
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tools.bench.source import drive_frames

RATE = 5000
STRETCH_S = 60
START_NS = 1_700_000_000_000_000_000
SLICE = 200_000
DRIVE = '[motor]\npreset = "m2"\n[wire]\nnode = 0\n'


def traffic(seconds: int) -> Iterator[FrameBlock]:
    """Blocks of a minute; the sample counters of DriveTiming and DriveReference go on from one to the next."""
    protocol = Protocol()
    stretch = drive_frames(float(RATE), float(STRETCH_S), fd=False)
    label = protocol.base_ids
    # 60 s are a whole number of wraps of the 4-bit counter in DriveSample: it goes on by itself.
    assert STRETCH_S * RATE % 16 == 0
    kinds = (MessageKind.DRIVE_TIMING, MessageKind.DRIVE_REFERENCE)
    rows = {kind: np.flatnonzero(stretch.can_id == label[kind]) for kind in kinds}
    for begin in range(0, seconds, STRETCH_S):
        block = FrameBlock(stretch.raw.copy(), stretch.t_ns + START_NS + begin * 10**9)
        for kind in kinds:
            codec = protocol.codecs[kind]
            column = codec.index["sample_counter"]
            values = codec.decode_rows(block.words, rows[kind])
            values[column] += begin * RATE
            block.raw[rows[kind], DATA_OFFSET:] = codec.encode(values)[:, DATA_OFFSET:]
        if begin + STRETCH_S > seconds:
            block = block.take(block.t_ns < START_NS + seconds * 10**9)
        yield block


def python_can_reads(path: Path, count: int) -> float:
    """Seconds per frame of python-can's reader alone, over the first `count` frames."""
    import can

    begin = time.perf_counter()
    got = sum(1 for _ in islice(can.LogReader(path), count))
    return (time.perf_counter() - begin) / got


def ours(path: Path) -> tuple[float, int]:
    """(seconds of reading alone, frames)."""
    begin = time.perf_counter()
    count = sum(len(block) for block in read_log(path))
    return time.perf_counter() - begin, count


def cpu_of_children() -> float:
    """Processor time of the ended child processes [s]; what else runs on the core does not count in it."""
    times = os.times()
    return times.children_user + times.children_system


def one_core() -> None:
    """Everything from here on, child processes too, on the first core this process may use."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=3600)
    parser.add_argument("--keep", metavar="FOLDER")
    args = parser.parse_args()
    one_core()
    with tempfile.TemporaryDirectory() if args.keep is None else nullcontext(args.keep) as folder:
        measure(Path(folder), args.seconds)
        formats(Path(folder))
    return 0


def measure(folder: Path, seconds: int) -> None:
    """The replay of the whole log, as a process of its own, twice: the first may compile kernels."""
    path, drive = folder / "hour.blf", folder / "drive.toml"
    drive.write_text(DRIVE)
    begin, frames = time.perf_counter(), 0
    with LogWriter(path) as writer:
        for block in traffic(seconds):
            writer.write(block)
            frames += len(block)
    print(f"{frames} frames ({seconds * RATE} samples) in {path.stat().st_size / 1e6:.0f} MB of BLF, "
          f"written in {time.perf_counter() - begin:.0f} s", flush=True)
    command = [sys.executable, "-m", "ipmsm_can", "replay", str(path), "--drive", str(drive)]
    for turn in ("first run", "again"):
        begin, used = time.perf_counter(), cpu_of_children()
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        taken, used = time.perf_counter() - begin, cpu_of_children() - used
        print(f"replay of all, reading and start-up included, one core, {turn}: {taken:.1f} s "
              f"({used:.1f} s of it on the processor)", flush=True)
    print(run.stdout, end="")
    alone, count = ours(path)
    print(f"our reader alone: {alone:.1f} s, {1e9 * alone / count:.0f} ns a frame")
    each = python_can_reads(path, SLICE)
    print(f"python-can's reader alone: {1e6 * each:.1f} us a frame over the first {min(SLICE, count)} frames, so "
          f"{each * count:.0f} s for all ({each * count / alone:.0f} times as long)", flush=True)


def formats(folder: Path) -> None:
    """Reading alone, format by format, on the same minute; asammdf's writer is the tests' own."""
    from tests.mf4_files import write_mf4

    block = next(traffic(STRETCH_S))
    paths = [folder / name for name in ("minute.blf", "minute.log", "minute.log.gz", "minute.mf4")]
    for path in paths[:2]:
        with LogWriter(path) as writer:
            writer.write(block)
    paths[2].write_bytes(gzip.compress(paths[1].read_bytes(), 6))
    write_mf4(paths[3], block)
    print(f"\n{'format':10s} {'ours, ns/frame':>16s} {'python-can, ns/frame':>22s} {'ratio':>8s}")
    for path in paths:
        ours(path)
        taken, count = min(ours(path) for _ in range(3))
        assert count == len(block)
        if path.suffix == ".gz":
            print(f"{'.log.gz':10s} {1e9 * taken / count:16.0f}")
            continue
        theirs = python_can_reads(path, 20_000)
        print(f"{path.suffix:10s} {1e9 * taken / count:16.0f} {1e9 * theirs:22.0f} {theirs * count / taken:8.0f}",
              flush=True)


if __name__ == "__main__":
    sys.exit(main())
