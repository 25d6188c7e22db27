"""Wire fuzz: random and mutated frames into the companion, which must neither raise nor answer nonsense.

    python -m tools.fuzz_wire --frames 1000000 --seed 1

Starts from what simulated drives really send (classical and CAN FD, with and without DriveTiming) and from
the companion's own answers; flips bits, cuts lengths, changes identifiers and flags, drops, repeats and
swaps frames, moves clocks, and forges frames whose checksums are right and whose content is extreme.  After
each block every estimate and every outgoing frame is looked at.  Exit code 1 when something is found.
"""

from __future__ import annotations

import argparse
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.companion import Companion
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FrameBlock
from ipmsm_can.motor import M1, M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import BLOCK_SAMPLES, NODES, MessageKind, Protocol

Ints = NDArray[np.int64]

POOL_SECONDS = 2.0
MUTATED = 0.1
"""Share of frames that each round of mutation touches."""
GROWTH_ALLOWED = 24e6
"""Growth of memory [byte] between the first fifth of a run and its end that passes as flat."""
_T0 = 1_700_000_000_000_000_000
_RAW_RATES = (0, 1, 99_999, 100_000, 100_001, 4_999_999, 5_000_000, 10_000_000, 99_999_999, 100_000_000,
              100_000_001, 0xFFFFFFFF)
_BLOCK_SIZES = ((1, 1), (1, 4), (2, 50), (50, 1000), (1000, 4000))


def configurations() -> list[DriveConfig]:
    """Drives the companion believes in: node 5 and above are strangers on its bus."""
    base = {"motor": {"preset": "m2"}}
    return [config_from(c) for c in (
        base,
        {**base, "wire": {"node": 1}, "observer": {"alpha": 5, "gamma": 50, "initial_flux": [0.5, 2.0]}},
        {**base, "wire": {"node": 2, "sample_rate": 5000.0}, "injection": {"waveform": "pulsating"}},
        {**base, "wire": {"node": 3, "max_gap": 0}, "injection": {"enabled": False}},
        {"motor": {"preset": "m1"}, "wire": {"node": 4, "max_gap": 64}, "observer": {"alpha": 200, "gamma": 200},
         "injection": {"excitation_on": 1e-3, "excitation_off": 2e-3, "speed_on": 1.0, "speed_off": 2.0}},
    )]


def honest_traffic(protocol: Protocol) -> FrameBlock:
    """What six drives send in POOL_SECONDS, in order of time."""
    parts = []
    for node in range(6):
        fd = node in (1, 4)
        motor, track = (M1, profile.paper_ramp()) if node == 4 else (M2, profile.demo() if node else
                                                                      profile.torque_pulses())
        rate = 10_000.0 if fd else 5000.0
        simulation = DriveSimulation(motor, DriveParameters(sample_rate=rate), track, seed=node)
        settings = DriveNodeSettings(fd=fd, timing_rate=0.0 if node == 2 else 50.0)
        drive = DriveNode(protocol, node, simulation, settings)
        parts.append(drive.step(int(POOL_SECONDS * rate), _T0).frames)
    together = FrameBlock.concat(parts)
    return together.take(np.argsort(together.t_ns, kind="stable"))


class Mutator:
    """Makes endless hostile traffic out of honest traffic; deterministic for a seed."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self._protocol = protocol
        self._pool = honest_traffic(protocol)
        self._at = 0
        self._clock = 0
        self._own: list[NDArray[np.uint8]] = []
        self._forgers: list[Callable[[int], NDArray[np.uint8]]] = [
            self._timings, self._blocks, self._samples, self._statuses]

    def overhear(self, answers: FrameBlock) -> None:
        """The companion's own frames, as another companion on the bus would send them."""
        if len(answers):
            self._own = [*self._own[-20:], answers.raw[:50].copy()]

    def frames(self, n: int) -> FrameBlock:
        """The next n frames or a few more or less."""
        at = (self._at + np.arange(n)) % len(self._pool)
        laps = (self._at + np.arange(n)) // len(self._pool)
        self._at += n
        if self.random.random() < 0.02:
            self._at += int(self.random.integers(len(self._pool)))
        out = self._pool.take(at)
        out.t_ns[:] += laps * int(1e9 * POOL_SECONDS) + self._clock
        if self.random.random() < 0.2:
            return out  # peace, so that estimators lock before the next blow
        out = self._rearranged(out)
        for change in (self._bits, self._headers, self._lengths, self._noise, self._forgeries, self._echoes):
            if self.random.random() < 0.5:
                change(out)
        if self.random.random() < 0.05:
            self._clock += int(self.random.choice([-1, 1]) * 10.0 ** self.random.uniform(3, 13))
        if self.random.random() < 0.05:
            out.t_ns[:] += self.random.integers(-10**7, 10**7, len(out))
        if self.random.random() < 0.002:
            out.t_ns[:] = self.random.choice([0, -(1 << 62), (1 << 62)])
        return out

    def _some(self, block: FrameBlock, share: float = MUTATED) -> NDArray[np.intp]:
        return np.flatnonzero(self.random.random(len(block)) < share * self.random.random())

    def _rearranged(self, block: FrameBlock) -> FrameBlock:
        """Losses, bursts, repeats and swaps."""
        n, rows = len(block), np.arange(len(block))
        if self.random.random() < 0.3:
            rows = rows[self.random.random(n) > 0.2 * self.random.random()]
        if self.random.random() < 0.2 and rows.size > 10:
            begin = int(self.random.integers(rows.size))
            rows = np.delete(rows, slice(begin, begin + int(self.random.integers(rows.size))))
        if self.random.random() < 0.3 and rows.size:
            rows = np.sort(np.concatenate([rows, self.random.choice(rows, rows.size // 10)]))
        if self.random.random() < 0.3 and rows.size > 2:
            swap = self.random.integers(0, rows.size - 1, rows.size // 20)
            rows[swap], rows[swap + 1] = rows[swap + 1].copy(), rows[swap].copy()
        if self.random.random() < 0.02:
            self.random.shuffle(rows)
        return block.take(rows)

    def _bits(self, block: FrameBlock) -> None:
        for row in self._some(block):
            for _ in range(int(self.random.integers(1, 9))):
                byte = int(self.random.integers(8, 8 + max(int(block.raw[row, 4]), 1)))
                block.raw[row, min(byte, 71)] ^= 1 << int(self.random.integers(8))

    def _headers(self, block: FrameBlock) -> None:
        for row in self._some(block):
            kind = int(self.random.integers(6))
            if kind == 0:
                block.can_id[row] ^= np.uint32(1 << int(self.random.integers(32)))
            elif kind == 1:
                block.can_id[row] = self._our_id()
            elif kind == 2:
                block.can_id[row] = int(self.random.integers(1 << 32))
            else:
                block.can_id[row] |= np.uint32((CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG)[kind - 3])
            block.raw[row, 5] = self.random.integers(256)

    def _our_id(self) -> int:
        return int(self._protocol.base_ids[self.random.integers(len(MessageKind))] + self.random.integers(NODES))

    def _lengths(self, block: FrameBlock) -> None:
        rows = self._some(block)
        block.raw[rows, 4] = self.random.integers(0, 65, rows.size)

    def _noise(self, block: FrameBlock) -> None:
        """Wholly random frames, half of them under our identifiers and with the right length."""
        for row in self._some(block):
            block.raw[row] = self.random.integers(0, 256, 72)
            block.raw[row, 4] = self.random.integers(65)
            if self.random.random() < 0.5:
                kind = MessageKind(int(self.random.integers(len(MessageKind))))
                block.can_id[row] = self._protocol.base_ids[kind] + self.random.integers(NODES)
                block.raw[row, 4] = self._protocol.codecs[kind].length

    def _echoes(self, block: FrameBlock) -> None:
        for row in self._some(block):
            if self._own:
                frames = self._own[int(self.random.integers(len(self._own)))]
                block.raw[row] = frames[int(self.random.integers(frames.shape[0]))]

    def _forgeries(self, block: FrameBlock) -> None:
        rows = self._some(block, 0.05)
        if rows.size:
            forged = self._forgers[int(self.random.integers(len(self._forgers)))](rows.size)
            block.raw[rows[:forged.shape[0]]] = forged[:rows.size]

    def _node(self) -> int:
        return int(self.random.integers(6))

    def _timings(self, n: int) -> NDArray[np.uint8]:
        """Extreme rates and counters that jump."""
        raw = self._protocol.encode(MessageKind.DRIVE_TIMING, self._node(),
                                    {"sample_counter": np.zeros(n), "sample_rate": np.zeros(n)})
        raw[:, 8:12] = self.random.integers(0, 256, (n, 4))
        rates = self.random.choice(np.array(_RAW_RATES, np.uint32), n)
        raw[:, 12:16] = rates.astype("<u4").view(np.uint8).reshape(n, 4)
        return raw

    def _blocks(self, n: int) -> NDArray[np.uint8]:
        """CAN FD blocks with right checksums and any content, at the ends of every range."""
        ends = self.random.choice([-1e9, 1e9, 0.0], (4 * BLOCK_SAMPLES, n))
        names = [f"{axis}_{j}" for j in range(BLOCK_SAMPLES) for axis in ("i_alpha", "i_beta", "v_alpha", "v_beta")]
        node = self._node()
        raw = self._protocol.encode(MessageKind.DRIVE_SAMPLE_BLOCK, node, {
            **dict(zip(names, ends, strict=True)),
            "first_sample": (int(self.random.integers(1 << 32)) + BLOCK_SAMPLES * np.arange(n)) & 0xFFFFFFFF,
            "sample_count": np.ones(n)}, np.arange(n) + int(self.random.integers(256)))
        if self.random.random() < 0.5:
            raw[:, 8 + 7] = self.random.integers(0, 256, n)  # sample_count
        if self.random.random() < 0.5:
            raw[:, 16:] = self.random.integers(0, 256, (n, 56))
        protection = self._protocol.protection(MessageKind.DRIVE_SAMPLE_BLOCK, node)
        assert protection is not None
        protection.protect(raw, np.arange(n) + int(self.random.integers(256)))
        return raw

    def _samples(self, n: int) -> NDArray[np.uint8]:
        """Classical samples at the ends of their ranges, held or alternating: nothing a motor could do."""
        ends = self.random.choice([-1e9, 1e9, 0.0], (4, n if self.random.random() < 0.5 else 1))
        values = np.broadcast_to(ends, (4, n))
        counter = (int(self.random.integers(16)) + np.arange(n)) & 15
        return self._protocol.encode(MessageKind.DRIVE_SAMPLE, self._node(), {
            "i_alpha": values[0], "i_beta": values[1], "v_alpha": values[2], "v_beta": values[3],
            "sample_counter": counter})

    def _statuses(self, n: int) -> NDArray[np.uint8]:
        raw = self._protocol.encode(MessageKind.DRIVE_STATUS, self._node(), {"mode": np.zeros(n)})
        raw[:, 8:16] = self.random.integers(0, 256, (n, 8))
        return raw


def faults_in(tracked: list[Tracked], answers: FrameBlock, protocol: Protocol) -> list[str]:
    """What is wrong with estimates and outgoing frames; empty when nothing is."""
    found = []
    for part in tracked:
        e, run = part.estimate, part.run
        for name, array in (("regression", e.regression), ("flux", e.flux), ("angle", e.angle),
                            ("excitation", e.excitation), ("sigma", e.sigma), ("samples", run.values)):
            if not np.isfinite(array).all():
                found.append(f"node {part.node}: {name} is not finite")
        if (np.abs(e.angle[:2]) > np.pi + 1e-9).any() or (e.sigma < 0).any() or (e.sigma > np.pi).any():
            found.append(f"node {part.node}: angle or sigma outside its range")
        if (run.counter < 0).any() or (run.counter > 0xFFFFFFFF).any():
            found.append(f"node {part.node}: counter outside 32 bits")
        lengths = {a.size for a in (run.counter, run.filled, run.gap, run.t_ns, part.injecting, e.sigma)}
        if len(lengths) != 1 or 0 in lengths:
            found.append(f"node {part.node}: arrays of lengths {lengths}")
    labels = protocol.classify(answers.raw)
    if (labels < MessageKind.POSITION_ESTIMATE * NODES).any():
        found.append("an outgoing frame is none of the companion's own")
    for label in np.unique(labels[labels >= 0]).tolist():
        kind, node = MessageKind(label // NODES), label % NODES
        values, intact, _ = protocol.decode(kind, node, answers.raw, np.flatnonzero(labels == label))
        if not np.isfinite(values).all() or not intact.all():
            found.append(f"outgoing {kind.message} of node {node} is not finite or not protected")
    return found


@dataclass(slots=True)
class FuzzResult:
    """What a run gave.  faults: at most one sentence per kind of trouble.  memory: (frames, byte) as it went."""

    frames: int = 0
    rounds: int = 0
    samples: int = 0
    answers: int = 0
    most_locked: int = 0
    faults: list[str] = field(default_factory=list)
    memory: list[tuple[int, float]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def growth(self) -> float:
        """Memory at the end minus the most of the first fifth of the run [byte]."""
        early = [size for at, size in self.memory if at <= self.frames / 5]
        return self.memory[-1][1] - max(early) if early else 0.0


def fuzz(frames: int, seed: int, report: Callable[[str], None] = lambda _: None) -> FuzzResult:
    """Feed about `frames` frames; stops at the first fault."""
    protocol = Protocol()
    companion = Companion(configurations(), protocol, transmit=True)
    mutator = Mutator(protocol, seed)
    random = np.random.default_rng([seed, 1])
    result = FuzzResult()
    tracemalloc.start()
    interval = max(frames // 20, 1)
    while result.frames < frames and not result.faults:
        least, most = _BLOCK_SIZES[int(random.integers(len(_BLOCK_SIZES)))]
        traffic = mutator.frames(int(random.integers(1, 400 if most < 50 else 8000)))
        at = 0
        while at < len(traffic) and not result.faults:
            size = int(random.integers(least, most + 1))
            block = traffic.take(slice(at, at + size))
            at += size
            _round(companion, block, random, mutator, result)
        if result.frames >= interval * (len(result.memory) + 1):
            memory = float(tracemalloc.get_traced_memory()[0])
            result.memory.append((result.frames, memory))
            report(f"{result.frames:>9} frames, {result.samples:>9} samples, {result.answers:>8} answers, "
                   f"{result.most_locked} of {len(companion.nodes)} nodes locked at once; "
                   f"{memory / 1e6:.1f} MB allocated, {resident() / 1e6:.0f} MB resident")
    tracemalloc.stop()
    result.counts = _counts(companion)
    return result


def _round(companion: Companion, block: FrameBlock, random: np.random.Generator, mutator: Mutator,
           result: FuzzResult) -> None:
    now = int(block.t_ns[-1])
    if random.random() < 0.01:
        now += int(random.integers(-10**10, 10**10))
    before = block.raw.copy()
    try:
        tracked = companion.feed(block)
        answers = companion.respond(tracked, now)
    except Exception as error:
        result.faults.append(f"frame {result.frames}: {type(error).__name__}: {error}")
        if "pytest" in sys.modules:
            raise
        import traceback

        traceback.print_exc()
        return
    result.frames += len(block)
    result.rounds += 1
    result.samples += sum(t.run.counter.size for t in tracked)
    result.answers += len(answers)
    if not np.array_equal(before, block.raw):
        result.faults.append("the companion wrote into the frames it was given")
    result.faults += faults_in(tracked, answers, companion.protocol)
    result.most_locked = max(result.most_locked, sum(n.view.flags & 1 for n in companion.nodes.values()))
    mutator.overhear(answers)


def _counts(companion: Companion) -> dict[str, int]:
    c = companion.counts
    counts = {"frames": c.frames, "unknown": c.unknown, "error frames": c.errors, "remote": c.remote,
              "wrong length": c.wrong_length}
    for number, node in companion.nodes.items():
        sequencer = node.receiver.sequencer
        for name in ("received", "filled", "duplicates", "reordered", "gaps", "resyncs", "restarts", "bad_rate"):
            counts[f"node {number} {name}"] = sequencer.count(name)
        counts[f"node {number} bad frames"] = node.bad_frames
    return counts


def resident() -> float:
    """Resident memory of this process [byte]; 0 where the system does not tell."""
    try:
        return 4096.0 * int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0.0


def main() -> int:
    """Run a campaign; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz_wire", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000, help="how many frames (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="the same seed gives the same frames (default 1)")
    args = parser.parse_args()
    result = fuzz(args.frames, args.seed, print)
    for name, count in result.counts.items():
        print(f"  {name:<22} {count:>9}")
    faults = list(result.faults)
    if result.growth > GROWTH_ALLOWED:
        faults.append(f"memory grew by {result.growth / 1e6:.1f} MB")
    print(f"{result.frames} frames in {result.rounds} blocks: "
          + ("; ".join(faults) if faults else "no exception, no NaN or infinity, memory flat "
             f"(grew by {result.growth / 1e6:.1f} MB)"))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
