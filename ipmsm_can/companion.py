"""The companion: frames in, frames out, for any number of drives on one bus.

It has no clock, no thread and no socket.  A runner gives it blocks of frames and the time, and sends what
comes back.  Bad input never raises: it is dropped, counted, and shown in CompanionStatus.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import CAN_SFF_MASK, FrameBlock
from ipmsm_can.node import Node, Tracked
from ipmsm_can.wire.protocol import (
    ERROR_FRAME,
    NODES,
    REMOTE_FRAME,
    UNKNOWN,
    WRONG_LENGTH,
    MessageKind,
    Protocol,
)


@dataclass(slots=True)
class FrameCounts:
    """What came in, by kind of trouble."""

    frames: int = 0
    unknown: int = 0
    errors: int = 0
    remote: int = 0
    wrong_length: int = 0
    by_kind: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(MessageKind), np.int64))


class Companion:
    """All nodes of one bus.

    configs: one per drive, node numbers all different.  transmit: whether answers may be sent; without it
    nothing is ever returned for sending.
    Raises ValueError when two drives have the same node number or different wire scalings.
    """

    def __init__(self, configs: Sequence[DriveConfig], protocol: Protocol, transmit: bool) -> None:
        numbers = [c.wire.node for c in configs]
        twice = {n for n in numbers if numbers.count(n) > 1}
        if twice:
            raise ValueError(f"node {min(twice)} is given twice; allowed is one drive per node number")
        self.protocol = protocol
        self.transmit = transmit
        self.nodes = {c.wire.node: Node(protocol, c, transmit) for c in configs}
        self.counts = FrameCounts()
        self.bus_load = 0.0
        self.turnaround = 0.0
        self.late = 0
        """PositionEstimates withheld because their samples were read too late."""

    def feed(self, block: FrameBlock) -> list[Tracked]:
        """Take in frames; returns the samples they complete, with their estimates, in order per node."""
        n = len(block)
        if not n:
            return []
        self.counts.frames += n
        labels = self.protocol.classify(block.raw)
        order = np.empty(n, np.intp)
        begin = np.empty(_LABELS + 1, np.intp)
        group_rows(labels, order, begin)
        ends = begin.tolist()
        self._count_strangers(block, order, ends)
        tracked: list[Tracked] = []
        for number, node in self.nodes.items():
            rows = {}
            for kind in MessageKind:
                at = kind * NODES + number - WRONG_LENGTH
                if ends[at + 1] > ends[at]:
                    rows[kind] = order[ends[at]:ends[at + 1]]
                    self.counts.by_kind[kind] += ends[at + 1] - ends[at]
            if rows:
                tracked += node.feed(block, rows)
        return tracked

    def _count_strangers(self, block: FrameBlock, order: NDArray[np.intp], ends: list[int]) -> None:
        if ends[-WRONG_LENGTH] == 0:
            return
        counts = self.counts
        for label, name in ((UNKNOWN, "unknown"), (ERROR_FRAME, "errors"), (REMOTE_FRAME, "remote"),
                            (WRONG_LENGTH, "wrong_length")):
            at = label - WRONG_LENGTH
            setattr(counts, name, getattr(counts, name) + ends[at + 1] - ends[at])
        wrong = order[:ends[1]]
        if wrong.size:
            owners = self.protocol.id_lut[block.can_id[wrong] & CAN_SFF_MASK] % NODES
            for number, node in self.nodes.items():
                node.wrong_length += int((owners == number).sum())

    def frames_until_due(self, now_ns: int) -> int:
        """How many frames a runner may wait for without being late with an answer, at least 1."""
        flowing = [n for n in (node.frames_until_due(now_ns) for node in self.nodes.values()) if n]
        return min(flowing) if flowing else 1

    def order_injection(self, node: int, wanted: bool | None) -> None:
        """The operator's order: True inject, False do not, None leave it to the scheduler; within the limits of the
        configuration, from the node's next command on.  May be called from another thread.

        Without `transmit` it has no effect: nothing is ever sent then.
        """
        if self.transmit:
            self.nodes[node].scheduler.operator(wanted)

    def process(self, block: FrameBlock, now_ns: int) -> FrameBlock:
        """Take in frames and give back what is to be sent now.

        now_ns: the runner's clock, on the same axis as block.t_ns.  To be called at least every
        few milliseconds, with an empty block where nothing came.
        """
        return self.respond(self.feed(block), now_ns)

    def count_usual(self, by_kind: Mapping[MessageKind, int], unknown: int = 0) -> None:
        """Count frames that a runner dealt with itself."""
        self.counts.frames += unknown
        self.counts.unknown += unknown
        for kind, frames in by_kind.items():
            self.counts.frames += frames
            self.counts.by_kind[kind] += frames

    def respond(self, tracked: Sequence[Tracked], now_ns: int, late: bool = False) -> FrameBlock:
        """The answers to what `feed` gave, and whatever the clock makes due.

        late: the samples lay in a buffer for too long.  They are not answered: a PositionEstimate names its sample
        by the low bits of the counter, which would then stand for a younger sample.
        """
        frames: list[NDArray[np.uint8]] = []
        for number, node in self.nodes.items():
            own = [t for t in tracked if t.node == number]
            if own and late:
                self.late += node.count_due(own)
            elif own:
                frames += node.answers(own)
            frames += node.due(now_ns, self.bus_load, self.turnaround)
        if not frames or not self.transmit:
            return _NOTHING
        raw = frames[0] if len(frames) == 1 else np.concatenate(frames)
        return FrameBlock(raw, np.full(raw.shape[0], now_ns, np.int64))


@kernel
def group_rows(labels: NDArray[np.int16], order: NDArray[np.intp], begin: NDArray[np.intp]) -> None:
    """Sort rows by label, in order of arrival within each: rows of label w stand in
    order[begin[w - WRONG_LENGTH]:begin[w - WRONG_LENGTH + 1]].  labels as from Protocol.classify.
    """
    begin[:] = 0
    for k in range(labels.shape[0]):
        begin[labels[k] - WRONG_LENGTH + 1] += 1
    for w in range(1, begin.shape[0]):
        begin[w] += begin[w - 1]
    place = begin.copy()
    for k in range(labels.shape[0]):
        w = labels[k] - WRONG_LENGTH
        order[place[w]] = k
        place[w] += 1


_LABELS = len(MessageKind) * NODES - WRONG_LENGTH
_NOTHING = FrameBlock.zeros(0)
