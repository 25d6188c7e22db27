"""A slice of the wire fuzz campaign; `python -m tools.fuzz_wire` runs the whole of it."""

from __future__ import annotations

import numpy as np
import pytest

from ipmsm_can.companion import Companion
from ipmsm_can.wire.protocol import MessageKind, Protocol
from tools.fuzz_wire import Mutator, configurations, faults_in, fuzz


def test_thirty_thousand_hostile_frames() -> None:
    result = fuzz(30_000, seed=1)
    assert result.faults == []
    assert result.frames >= 30_000
    assert result.most_locked >= 1
    # the campaign is worth something only if it gets everywhere
    for name in ("unknown", "error frames", "remote", "wrong length", "node 0 filled", "node 0 duplicates",
                 "node 0 reordered", "node 0 gaps", "node 0 bad_rate", "node 1 bad frames",
                 "node 2 received"):
        assert result.counts[name] > 0, name
    assert result.growth < 24e6


def test_the_same_seed_gives_the_same_frames() -> None:
    protocol = Protocol()
    a, b = Mutator(protocol, 7), Mutator(protocol, 7)
    for n in (1, 500, 3000):
        one, two = a.frames(n), b.frames(n)
        assert np.array_equal(one.raw, two.raw) and np.array_equal(one.t_ns, two.t_ns)


def test_the_checks_see_what_they_are_for() -> None:
    protocol = Protocol()
    companion = Companion(configurations(), protocol, transmit=True)
    mutator = Mutator(protocol, 3)
    tracked, answers = [], None
    for _ in range(20):
        block = mutator.frames(2000)
        tracked = companion.feed(block)
        answers = companion.respond(tracked, int(block.t_ns[-1]))
        assert faults_in(tracked, answers, protocol) == []
        if tracked and (protocol.classify(answers.raw) // 16 == MessageKind.POSITION_ESTIMATE).any():
            break
    assert answers is not None and tracked
    row = int(np.flatnonzero(protocol.classify(answers.raw) // 16 == MessageKind.POSITION_ESTIMATE)[0])
    answers.raw[row, 12] ^= 1
    tracked[0].estimate.sigma[0] = np.nan
    faults = faults_in(tracked, answers, protocol)
    assert any("sigma is not finite" in f for f in faults) and any("not protected" in f for f in faults)


@pytest.mark.parametrize("seed", [2, 3])
def test_other_seeds(seed: int) -> None:
    assert fuzz(5_000, seed).faults == []
