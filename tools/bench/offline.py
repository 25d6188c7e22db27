"""Measurements that need no bus: codec, observer, simulated drive, replay, start-up."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation.observers.kinds import KINDS
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tools.bench import observer
from tools.bench.source import drive_frames


def seconds(run: Callable[[], object], repeats: int = 7) -> float:
    """Median time of a call after one that does not count."""
    run()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)


def paired(ours: Callable[[], object], theirs: Callable[[], object],
           repeats: int = 7) -> tuple[float, float, float]:
    """Median times of both, taken in turns, and the median of the ratios theirs / ours."""
    ours()
    theirs()
    pairs = []
    for _ in range(repeats):
        a = time.perf_counter()
        ours()
        b = time.perf_counter()
        theirs()
        pairs.append((b - a, time.perf_counter() - b))
    return (statistics.median(p[0] for p in pairs), statistics.median(p[1] for p in pairs),
            statistics.median(p[1] / p[0] for p in pairs))


def row(what: str, ours: str, other: str, ratio: str, target: str = "") -> None:
    """One line of the table."""
    print(f"{what:46s} {ours:>16s} {other:>26s} {ratio:>12s}  {target}", flush=True)


def decoding() -> None:
    """Block decode against cantools, per frame."""
    import cantools

    database: Any = cantools.database.load_file(str(default_dbc_path()))
    protocol = Protocol()
    for kind, target in ((MessageKind.DRIVE_SAMPLE, "300"), (MessageKind.DRIVE_SAMPLE_BLOCK, "100"),
                         (MessageKind.POSITION_ESTIMATE, "100"), (MessageKind.DRIVE_STATUS, "100")):
        codec = protocol.codecs[kind]
        n, few, times = 4096, 500, 50
        block = FrameBlock.zeros(n)
        block.length[:] = codec.length  # a frame that is too short for its signals is another, slower matter
        block.raw[:, 8:8 + codec.length] = np.random.default_rng(1).integers(0, 256, (n, codec.length),
                                                                             np.uint8)
        message = database.get_message_by_name(kind.message)
        payloads = [bytes(r[8:8 + codec.length]) for r in block.raw[:few]]
        expected = message.decode(payloads[0], decode_choices=False)
        assert np.array_equal(codec.decode(block.words)[:, 0], [expected[s] for s in codec.signals])

        def theirs(message: Any = message, payloads: list[bytes] = payloads) -> None:
            for payload in payloads:
                message.decode(payload, decode_choices=False)

        def ours(codec: Any = codec, block: FrameBlock = block, times: int = times) -> None:
            for _ in range(times):
                codec.decode(block.words)

        mine, other, ratio = paired(ours, theirs)
        row(f"decode {kind.message}", f"{1e9 * mine / n / times:.1f} ns/frame",
            f"cantools {1e6 * other / few:.2f} us/frame", f"{ratio * n * times / few:.0f} x",
            f"at least {target} x")


def observers() -> None:
    """Observer step (regression and Proposition 1) in all the ways."""
    n, few = 100_000, 3000
    block = observer.samples(n)
    ours = observer.compiled(block)
    in_c = observer.in_c(block)
    if in_c is None:
        print("  (no C compiler: the comparison with C is left out)")
    else:
        assert np.allclose(ours(), in_c(), rtol=1e-9, atol=1e-12)
        a, b, ratio = paired(ours, in_c, 15)
        row("observer step in a block", f"{1e9 * a / n:.1f} ns", f"C -O2 {1e9 * b / n:.1f} ns",
            f"{1 / ratio:.2f} x C", "at most 1.3 x C")
    small = np.ascontiguousarray(block[:, :few])
    reference = observer.compiled(small)()[:2].copy()
    per_step = seconds(ours) / n
    for name, run in (("plain Python", observer.in_python(small)), ("NumPy vectors", observer.in_numpy(small))):
        assert np.allclose(run()[:2], reference, rtol=1e-9, atol=1e-12)
        t = seconds(run, 3) / few
        row(f"observer step, against {name}", f"{1e9 * per_step:.1f} ns", f"{name} {1e6 * t:.2f} us",
            f"{t / per_step:.0f} x")
    t = seconds(observer.single_calls(block, few)) / few
    row("observer step, one sample a call", f"{1e9 * t:.0f} ns", "", f"{t / per_step:.0f} x block")


def kinds() -> None:
    """Regression and observer of every kind, ns per sample in a block; all taken in turns."""
    n = 100_000
    block = observer.probed_samples(n)
    runs = {name: observer.of_kind(name, block) for name in KINDS}
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(8):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            if turn:
                taken[name].append(time.perf_counter() - begin)
    own = {name: statistics.median(t) / n for name, t in taken.items()}
    for name, t in own.items():
        row(f"kind {name}, in a block", f"{1e9 * t:.0f} ns", "", f"{t / own['ges']:.2f} x ges", "under 2000 ns")


def simulation() -> None:
    """10 s of the simulated drive at 10 kHz, compiled and in plain Python."""
    def drive(n: int) -> Callable[[], object]:
        return lambda: DriveSimulation(M2, DriveParameters(sample_rate=10_000.0), profile.demo()).run(n)

    ours = seconds(drive(100_000), 5)
    script = ("import time\nfrom ipmsm_can.drive import profile\n"
              "from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation\n"
              "from ipmsm_can.motor import M2\n"
              "s = DriveSimulation(M2, DriveParameters(sample_rate=10_000.0), profile.demo())\n"
              "b = time.perf_counter()\ns.run(5000)\nprint(time.perf_counter() - b)\n")
    plain = subprocess.run([sys.executable, "-c", script], env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
                           capture_output=True, text=True, check=True)
    theirs = 20.0 * float(plain.stdout)
    row("simulated drive, 10 s at 10 kHz", f"{ours:.3f} s", f"plain Python {theirs:.1f} s",
        f"{theirs / ours:.0f} x", "at least 30 x")


def replaying() -> None:
    """Samples per second through decoding, sequencing and estimation, without reading a file."""
    frames = drive_frames(5000.0, 120.0, fd=False)
    blocks = [frames.take(slice(k, k + 65_536)) for k in range(0, len(frames), 65_536)]
    config = config_from({"motor": {"preset": "m2"}})
    protocol = Protocol()

    def run() -> None:
        companion = Companion([config], protocol, transmit=False)
        for block in blocks:
            companion.feed(block)

    t = seconds(run, 5)
    row("replay without reading the file", f"{600_000 / t / 1e6:.2f} M samples/s", "", "", "at least 2 M/s")


def start_up() -> None:
    """`ipmsm-can --help` against a bare interpreter."""
    def call(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], capture_output=True, check=True)

    a, b, _ = paired(call("-m", "ipmsm_can", "--help"), call("-c", "pass"))
    row("ipmsm-can --help", f"{a:.3f} s", f"python -c pass {b:.3f} s", f"+{a - b:.3f} s", "at most +0.3 s")


def main() -> None:
    """Print the table."""
    row("what", "ours", "against", "ratio", "target")
    for part in (decoding, observers, kinds, simulation, replaying, start_up):
        part()


if __name__ == "__main__":
    main()
