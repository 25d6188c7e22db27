"""Measurements on a real SocketCAN interface: CPU per frame and turnaround, companion against rivals.

`tools/vcan/run .venv/bin/python -m tools.bench.on_bus [--seconds 10]`.  Each subject runs as a process of its own
against the same traffic, one after the other; a recorder takes the kernel's time stamps of samples and
answers, so nobody measures itself.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol

TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Result:
    """One subject: frames it received, CPU seconds, frames offered, answers, turnaround [s]."""

    name: str
    received: int
    cpu_s: float
    offered: int
    answers: int
    turnaround: NDArray[np.float64]
    seconds: float
    says: str

    def quantile_us(self, q: float) -> float:
        return float(1e6 * np.quantile(self.turnaround, q)) if self.turnaround.size else float("nan")

    @property
    def cpu_us_per_frame(self) -> float:
        return 1e6 * self.cpu_s / max(1, self.received)


def _cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def _start(arguments: Sequence[str]) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-m", *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                               text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    if line.strip() != "ready":
        raise RuntimeError(f"{' '.join(arguments)} did not start: {line!r}")
    return process


def turnaround(frames: FrameBlock, protocol: Protocol) -> NDArray[np.float64]:
    """Seconds from each answered sample to its answer, by the kernel's time stamps.

    A rival answers with the sample's own 4-bit counter somewhere; the order tells: each answer belongs to the
    last sample before it whose counter is due.  The companion names its sample by ten bits.
    """
    ids = frames.can_id & 0x7FF
    base = protocol.base_ids
    answers = np.flatnonzero(ids == base[MessageKind.POSITION_ESTIMATE])
    codec = protocol.codecs[MessageKind.POSITION_ESTIMATE]
    low = codec.decode_rows(frames.words, answers)[codec.index["sample_counter"]].astype(int) & 0xF
    samples = np.flatnonzero(ids == base[MessageKind.DRIVE_SAMPLE])
    counters = (frames.data[samples, 7] >> 4).astype(int)
    out = []
    for row, nibble in zip(answers, low, strict=True):
        k = int(np.searchsorted(samples, row)) - 1
        while k >= 0 and counters[k] != nibble and samples[k] > row - 64:
            k -= 1
        if k >= 0 and counters[k] == nibble:
            out.append(1e-9 * (frames.t_ns[row] - frames.t_ns[samples[k]]))
    return np.array(out)


def measure(name: str, arguments: Sequence[str], channel: str, rate: float, seconds: float, fd: bool) -> Result:
    """Run one subject against the traffic."""
    protocol = Protocol()
    subject = _start(arguments)
    source = _start(["tools.bench.source", channel, "--rate", str(rate), "--seconds", str(seconds),
                     *(["--fd"] if fd else [])])
    assert source.stdin is not None
    assert source.stdout is not None
    assert subject.stdout is not None
    with SocketCanPort(channel, receive_buffer=1 << 26) as port:
        cpu = _cpu(subject.pid)
        source.stdin.write("\n")
        source.stdin.flush()
        blocks = []
        end = time.monotonic() + seconds + 0.5
        while time.monotonic() < end:
            time.sleep(0.05)
            while len(block := port.receive(0.0)):
                blocks.append(block)
        cpu = _cpu(subject.pid) - cpu
        drops = port.drops
    offered = int(source.stdout.readline().split()[0])
    subject.terminate()
    says = subject.stdout.readline().strip()
    subject.wait(10)
    source.wait(10)
    frames = FrameBlock.concat(blocks)
    if drops:
        print(f"  (the recorder itself lost {drops} frames)")
    answers = int((frames.can_id == protocol.base_ids[MessageKind.POSITION_ESTIMATE]).sum())
    took = turnaround(frames, protocol) if not fd else np.zeros(0)
    return Result(name, int(says.split()[0]), cpu, offered, answers, took, seconds, says)


def table(results: Sequence[Result]) -> None:
    """Print all subjects side by side."""
    print(f"{'subject':28s} {'received':>9s} {'of':>9s} {'CPU us/frame':>13s} {'answers/s':>10s} "
          f"{'p50 us':>8s} {'p99 us':>8s} {'p99.9':>8s}")
    for r in results:
        print(f"{r.name:28s} {r.received:9d} {r.offered:9d} {r.cpu_us_per_frame:13.1f} "
              f"{r.answers / r.seconds:10.1f} {r.quantile_us(0.5):8.0f} {r.quantile_us(0.99):8.0f} "
              f"{r.quantile_us(0.999):8.0f}", flush=True)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=5000.0)
    parser.add_argument("--only", help="one subject: companion, companion_fd, echo, loop, recv")
    args = parser.parse_args()
    c, rate, s = args.channel, args.rate, args.seconds
    subjects = {
        "companion": ("companion", ["tools.bench.companion", c, "--rate", str(rate)], rate, False),
        "echo": ("bare Python echo", ["tools.bench.rivals", "echo", c], rate, False),
        "recv": ("python-can recv alone", ["tools.bench.rivals", "recv", c], rate, False),
        "loop": ("python-can + cantools loop", ["tools.bench.rivals", "loop", c], rate, False),
        "companion_fd": ("companion, FD, 10 kHz", ["tools.bench.companion", c, "--rate", "10000", "--fd"],
                         10_000.0, True),
    }
    results = []
    for key, (name, arguments, r, fd) in subjects.items():
        if args.only in (None, key):
            results.append(measure(name, arguments, c, r, s, fd))
            print(f"  {name}: {results[-1].says}", flush=True)
    table(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
