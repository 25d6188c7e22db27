"""Co-simulation: drives and companion on one bus in virtual time, as fast as the machine goes.

Everything is deterministic: the same nodes, knobs and seed give the same frames and the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.companion import Companion
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.simulation import DriveSamples
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import Tracked


@dataclass(frozen=True, slots=True)
class BusFaults:
    """What the bus does to frames, both ways, drawn independently for each frame.

    loss, duplication, reordering: probabilities 0..1; a reordered frame is delayed by `reorder_ns`.
    burst: probability per frame that it and the next `burst_length` - 1 frames are lost.
    delay_ns: constant transport delay; jitter_ns: uniform extra delay up to this, order kept.
    """

    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    burst: float = 0.0
    burst_length: int = 50
    delay_ns: int = 0
    jitter_ns: int = 0
    reorder_ns: int = 500_000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("loss", "duplication", "reordering", "burst"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} is {value!r}; allowed is a probability from 0 to 1")
        for name in ("delay_ns", "jitter_ns", "reorder_ns", "burst_length"):
            value = getattr(self, name)
            if value < 0:
                raise ValueError(f"{name} is {value!r}; allowed is 0 or more")


class Channel:
    """One direction of the bus: frames go in when they are sent and come out when they arrive."""

    def __init__(self, faults: BusFaults, stream: int) -> None:
        self.faults = faults
        self.sent = 0
        self.lost = 0
        self._random = np.random.default_rng([faults.seed, stream])
        self._waiting = FrameBlock.zeros(0)
        self._burst_left = 0
        self._latest = -(1 << 62)

    def send(self, block: FrameBlock) -> None:
        """Put frames on the bus at their t_ns."""
        f, n = self.faults, len(block)
        self.sent += n
        # A fixed number of draws per frame: what happens to a frame does not depend on the blocks.
        draws = self._random.random((n, 5))
        lost = draws[:, 0] < f.loss
        if f.burst > 0.0:
            lost |= self._bursts(draws[:, 1] < f.burst)
        self.lost += int(lost.sum())
        arrival = block.t_ns + f.delay_ns + (draws[:, 4] * f.jitter_ns).astype(np.int64)
        if n:
            arrival = np.maximum(np.maximum.accumulate(arrival), self._latest)
            self._latest = int(arrival[-1])
        arrival = arrival + np.where(draws[:, 3] < f.reordering, f.reorder_ns, 0)
        again = np.flatnonzero((draws[:, 2] < f.duplication) & ~lost)
        keep = np.flatnonzero(~lost)
        rows = np.concatenate([keep, again])
        together = FrameBlock(np.concatenate([self._waiting.raw, block.raw[rows]]),
                              np.concatenate([self._waiting.t_ns, arrival[rows]]))
        self._waiting = together.take(np.argsort(together.t_ns, kind="stable"))

    def _bursts(self, begins: NDArray[np.bool_]) -> NDArray[np.bool_]:
        lost = np.zeros(begins.size, np.bool_)
        for k in range(begins.size):
            if self._burst_left == 0 and begins[k]:
                self._burst_left = self.faults.burst_length
            if self._burst_left > 0:
                self._burst_left -= 1
                lost[k] = True
        return lost

    def receive(self, now_ns: int) -> FrameBlock:
        """Frames that have arrived by now, in order of arrival."""
        n = int(np.searchsorted(self._waiting.t_ns, now_ns, side="right"))
        out = self._waiting.take(slice(0, n))
        self._waiting = self._waiting.take(slice(n, None))
        return out


@dataclass(slots=True)
class Recording:
    """What a co-simulation gave, by node: the truth, the estimates, and all frames of the bus as sent."""

    truth: dict[int, list[DriveSamples]] = field(default_factory=dict)
    tracked: dict[int, list[Tracked]] = field(default_factory=dict)
    frames: list[FrameBlock] = field(default_factory=list)


class CoSimulation:
    """Drives and a companion on one virtual bus.

    period_s: how often both sides look at the bus; commands of the companion reach a drive at its next look, and
    never act on a sample taken before they arrive.
    keep_frames: whether all frames are kept in the recording, as a bus logger would see them.
    """

    def __init__(self, drives: Sequence[DriveNode], companion: Companion, faults: BusFaults | None = None,
                 period_s: float = 1e-3, keep_frames: bool = False) -> None:
        faults = faults or BusFaults()
        self.drives = drives
        self.companion = companion
        self.to_companion = Channel(faults, 0)
        self.to_drives = Channel(faults, 1)
        self.recording = Recording({d.node: [] for d in drives}, {d.node: [] for d in drives})
        self._period_ns = round(1e9 * period_s)
        self._keep_frames = keep_frames
        self._now_ns = 0
        self._looked_ns = 0
        self._done = [0] * len(drives)

    def run(self, seconds: float) -> Recording:
        """Let `seconds` go by; may be called again to go on."""
        end = self._now_ns + round(1e9 * seconds)
        while self._now_ns < end:
            self._now_ns = min(self._now_ns + self._period_ns, end)
            self._tick(self._now_ns)
        return self.recording

    def _tick(self, now_ns: int) -> None:
        heard = self.to_drives.receive(self._looked_ns)  # the samples of this tick begin there
        self._looked_ns = now_ns
        for k, drive in enumerate(self.drives):
            drive.receive(heard)
            target = int(now_ns * drive.simulation.parameters.sample_rate / 1e9)
            step = drive.step(target - self._done[k])
            self._done[k] = target
            self.recording.truth[drive.node].append(step.samples)
            self._record(step.frames)
            self.to_companion.send(step.frames)
        tracked = self.companion.feed(self.to_companion.receive(now_ns))
        for part in tracked:
            self.recording.tracked.setdefault(part.node, []).append(part)
        answers = self.companion.respond(tracked, now_ns)
        self._record(answers)
        self.to_drives.send(answers)

    def _record(self, frames: FrameBlock) -> None:
        if self._keep_frames and len(frames):
            self.recording.frames.append(frames)
