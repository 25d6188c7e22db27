"""Measurements on a real SocketCAN interface: CPU per frame and turnaround, companion against rivals.

`tools/vcan/run .venv/bin/python -m tools.bench.on_bus [--seconds 10]`.  Each subject runs as a process of its own
against the same traffic, one after the other; a recorder takes the kernel's time stamps of samples and
answers, so nobody measures itself.  Where the kernel counts CPU time by the tick, marks are printed instead, and
`python -m tools.bench`, outside, works out the CPU time from them (see tools/bench/cpu.py); traffic without a
subject before and after each one is what is taken off.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tools.bench import cpu

MARK = "@mark"
TICK = 0.001


@dataclass(frozen=True)
class Result:
    """One subject: frames it received, CPU seconds, frames offered, answers, turnaround [s]."""

    name: str
    received: int
    cpu_s: float | None
    offered: int
    answers: int
    turnaround: NDArray[np.float64]
    seconds: float
    says: str

    def quantile_us(self, q: float) -> float:
        return float(1e6 * np.quantile(self.turnaround, q)) if self.turnaround.size else float("nan")

    @property
    def cpu(self) -> str:
        if self.cpu_s is None:
            return f"{'':>13s} {'':>6s}"
        return f"{1e6 * self.cpu_s / max(1, self.received):13.1f} {100 * self.cpu_s / self.seconds:6.1f}"


def _start(arguments: Sequence[str]) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-m", *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                               text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    if line.strip() != "ready":
        raise RuntimeError(f"{' '.join(arguments)} did not start: {line!r}")
    return process


def turnaround(frames: FrameBlock, protocol: Protocol, echoed: bool) -> NDArray[np.float64]:
    """Seconds from each answered sample to its answer, by the kernel's time stamps.

    An answer names its sample by the low bits of the counter; the echo sends the sample's payload back.
    """
    ids = frames.can_id & 0x7FF
    base = protocol.base_ids
    answers = np.flatnonzero(ids == base[MessageKind.POSITION_ESTIMATE])
    codec = protocol.codecs[MessageKind.POSITION_ESTIMATE]
    low = codec.decode_rows(frames.words, answers)[codec.index["sample_counter"]].astype(int) & 0xF
    if echoed:
        low = frames.data[answers, 7] >> 4
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
            tick: float, marks: bool) -> Result:
    """Run one subject (None: nobody) against the traffic."""
    protocol = Protocol()
    subject = None if arguments is None else _start(arguments)
    source = _start(["tools.bench.source", channel, "--rate", str(rate), "--seconds", str(seconds),
                     "--tick", str(tick), *(["--fd"] if fd else [])])
    assert source.stdin is not None
    assert source.stdout is not None
    with SocketCanPort(channel, receive_buffer=1 << 26) as port:
        source.stdin.write("\n")
        source.stdin.flush()
        blocks = []
        time.sleep(0.3)
        start = time.monotonic()
        before = None if subject is None or marks else cpu.of_process(subject.pid)
        if marks:
            print(f"{MARK} begin {name}", flush=True)
        while time.monotonic() < start + seconds - 0.6:
            time.sleep(0.05)
            while len(block := port.receive(0.0)):
                blocks.append(block)
        took_s = time.monotonic() - start
        used = cpu.of_process(subject.pid) - before if subject is not None and before is not None else None
        if marks:
            print(f"{MARK} end {name}", flush=True)
        time.sleep(1.0)
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
    took = turnaround(frames, protocol, "echo" in name) if not fd else np.zeros(0)
    # Frames and CPU time of the same stretch: the traffic is even, so a share of the whole is right.
    received = int(says.split()[0])
    if marks and subject is not None:
        print(f"{MARK} frames {round(received * took_s / seconds)} {name}", flush=True)
    return Result(name, received, None if used is None else used * seconds / took_s, offered, answers, took,
                  seconds, says)


def table(results: Sequence[Result]) -> None:
    """Print all subjects side by side."""
    print(f"{'subject':38s} {'received':>9s} {'of':>9s} {'CPU us/frame':>13s} {'CPU %':>6s} {'answers/s':>10s} "
          f"{'p50 us':>8s} {'p99 us':>8s} {'p99.9':>8s}")
    for r in results:
        print(f"{r.name:38s} {r.received:9d} {r.offered:9d} {r.cpu} "
              f"{r.answers / r.seconds:10.1f} {r.quantile_us(0.5):8.0f} {r.quantile_us(0.99):8.0f} "
              f"{r.quantile_us(0.999):8.0f}", flush=True)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=5000.0)
    parser.add_argument("--only", help="subjects, by comma: companion, companion_ges, listening, recv, loop, echo, "
                                       "spaced, recv_spaced, echo_spaced, companion_fd")
    args = parser.parse_args()
    c, rate, s = args.channel, args.rate, args.seconds
    ours = ["tools.bench.companion", c]
    # Five samples at once every millisecond, as `ipmsm-can drive` sends, answered at 1 kHz; and each sample by
    # itself, at half the rate, as both together are too much for one slow processor.
    subjects: dict[str, tuple[str, list[str], float, bool, float]] = {
        "companion": ("companion, answering at 1 kHz", ours, rate, False, TICK),
        "companion_ges": ("companion, the paper's observer", [*ours, "--observer", "ges"], rate, False, TICK),
        "listening": ("companion, listening only", [*ours, "--silent"], rate, False, TICK),
        "recv": ("python-can recv alone", ["tools.bench.rivals", "recv", c, "5"], rate, False, TICK),
        "loop": ("python-can + cantools loop", ["tools.bench.rivals", "loop", c, "5"], rate, False, TICK),
        "echo": ("bare Python echo", ["tools.bench.rivals", "echo", c, "5"], rate, False, TICK),
        "spaced": ("companion, single samples", ours, rate / 2, False, 0.0),
        "recv_spaced": ("python-can recv, single samples", ["tools.bench.rivals", "recv", c, "2"], rate / 2, False,
                        0.0),
        "echo_spaced": ("bare Python echo, single samples", ["tools.bench.rivals", "echo", c, "2"], rate / 2, False,
                        0.0),
        "companion_fd": ("companion, FD, 10 kHz", ours, 10_000.0, True, 0.0),
    }
    marks = cpu.is_counted_by_tick()
    results = []
    nobody: tuple[float, bool, float] | None = None
    for key, (name, arguments, r, fd, tick) in subjects.items():
        if args.only is None or key in args.only.split(","):
            if marks and nobody != (r, fd, tick):
                measure("nobody", None, c, r, min(s, 10.0), fd, tick, marks)
                nobody = (r, fd, tick)
            results.append(measure(name, arguments, c, r, s, fd, tick, marks))
            print(f"  {name}: {results[-1].says}", flush=True)
            if marks:
                measure("nobody", None, c, r, min(s, 10.0), fd, tick, marks)
    table(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
