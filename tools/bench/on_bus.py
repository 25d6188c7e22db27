"""Measurements on a real SocketCAN interface: CPU per frame and turnaround, companion against rivals.

`tools/vcan/run .venv/bin/python -m tools.bench.on_bus [--seconds 10]`.  Each subject runs as a process of its own
against the same traffic, one after the other; a recorder takes the kernel's time stamps of samples and
answers, so nobody measures itself.  CPU is what a process at idle priority could not have while the subject ran,
less the same without a subject (see tools/bench/soaker.py); everything is held on one processor for it.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol


class Soaker:
    """Counts what idle priority gets of the processor that everything runs on."""

    def __init__(self) -> None:
        self._file = tempfile.NamedTemporaryFile()  # noqa: SIM115 - lives as long as the soaker
        self._file.write(bytes(8))
        self._file.flush()
        self._process = _start(["tools.bench.soaker", self._file.name])
        time.sleep(0.5)
        self.full = self.rate(2.0)

    def count(self) -> int:
        """The count so far."""
        return int(struct.unpack("<q", Path(self._file.name).read_bytes())[0])

    def rate(self, seconds: float) -> float:
        """Counts per second over the next seconds."""
        begin, start = self.count(), time.monotonic()
        time.sleep(seconds)
        return (self.count() - begin) / (time.monotonic() - start)

    def stop(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self._file.close()


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


def measure(name: str, arguments: Sequence[str] | None, channel: str, rate: float, seconds: float, fd: bool,
            soaker: Soaker, others: float) -> Result:
    """Run one subject (None: nobody) against the traffic; others: share of the processor used without it."""
    protocol = Protocol()
    subject = None if arguments is None else _start(arguments)
    source = _start(["tools.bench.source", channel, "--rate", str(rate), "--seconds", str(seconds),
                     *(["--fd"] if fd else [])])
    assert source.stdin is not None
    assert source.stdout is not None
    with SocketCanPort(channel, receive_buffer=1 << 26) as port:
        source.stdin.write("\n")
        source.stdin.flush()
        blocks = []
        begin, start = soaker.count(), time.monotonic()
        while time.monotonic() < start + seconds:
            time.sleep(0.05)
            while len(block := port.receive(0.0)):
                blocks.append(block)
        soaked = (soaker.count() - begin) / (time.monotonic() - start) / soaker.full
        time.sleep(0.5)
        while len(block := port.receive(0.0)):
            blocks.append(block)
        drops = port.drops
    offered = int(source.stdout.readline().split()[0])
    source.wait(10)
    says = "0"
    if subject is not None:
        assert subject.stdout is not None
        subject.terminate()
        says = subject.stdout.readline().strip()
        subject.wait(10)
    frames = FrameBlock.concat(blocks)
    if drops:
        print(f"  (the recorder itself lost {drops} frames)")
    answers = int((frames.can_id == protocol.base_ids[MessageKind.POSITION_ESTIMATE]).sum())
    took = turnaround(frames, protocol) if not fd else np.zeros(0)
    return Result(name, int(says.split()[0]), (1.0 - soaked - others) * seconds, offered, answers, took, seconds,
                  says)


def table(results: Sequence[Result]) -> None:
    """Print all subjects side by side."""
    print(f"{'subject':28s} {'received':>9s} {'of':>9s} {'CPU us/frame':>13s} {'CPU %':>6s} {'answers/s':>10s} "
          f"{'p50 us':>8s} {'p99 us':>8s} {'p99.9':>8s}")
    for r in results:
        print(f"{r.name:28s} {r.received:9d} {r.offered:9d} {r.cpu_us_per_frame:13.1f} "
              f"{100 * r.cpu_s / r.seconds:6.1f} "
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
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    soaker = Soaker()
    results = []
    others: dict[bool, float] = {}
    for key, (name, arguments, r, fd) in subjects.items():
        if args.only in (None, key):
            if fd not in others:
                nobody = measure("nobody", None, c, r, min(s, 10.0), fd, soaker, 0.0)
                others[fd] = nobody.cpu_s / nobody.seconds
                print(f"  traffic {'FD' if fd else 'classical'} without a subject: {100 * others[fd]:.1f} % "
                      "of the processor", flush=True)
            results.append(measure(name, arguments, c, r, s, fd, soaker, others[fd]))
            print(f"  {name}: {results[-1].says}", flush=True)
    soaker.stop()
    table(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
