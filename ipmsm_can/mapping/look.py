"""A look at the signals of a live drive, as `ipmsm-can map --check` looks at a log: what do they allow?

How often they come, how evenly, how fast the motor turns is known only once they have been seen for a moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping.check import abilities, doubtful, missing
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.mapping.survey import Survey

LOOK_S = 2.0
"""How long the signals are looked at [s], from the first frame of the map."""
MOST_FRAMES = 1 << 18
"""Frames that are held for it at most: a clock that stands still must not fill the memory."""

_NOTHING_CAME = "no frame of the map has come yet"


@dataclass(frozen=True, slots=True)
class Allowed:
    """What the signals allow.  fast: the fast observer, else the steady-state quantities only.  rate: of the
    samples [Hz]."""

    fast: bool
    rate: float


class Look:
    """Holds frames until it can say what they allow; any partition of them gives the same.

    plan: from `make_plan`.  rate: of the samples [Hz], where the drive.toml says it.  look_s: how long [s].
    allowed: None while it looks, and where the signals allow nothing: then it goes on looking.
    verdict: what is done and why, in a sentence.  notes: what is missing or doubtful.
    """

    def __init__(self, plan: Plan, rate: float | None, look_s: float = LOOK_S) -> None:
        self.plan = plan
        self.allowed: Allowed | None = None
        self.verdict = _NOTHING_CAME
        self.notes: list[str] = []
        self._rate = rate
        self._look_ns = round(1e9 * look_s)
        self._ids = np.array(sorted({s.can_id for s in plan.sources}), np.uint32)
        self._held: list[FrameBlock] = []
        self._count = 0
        self._from_ns: int | None = None

    @property
    def nothing_came(self) -> bool:
        """No frame of the map did."""
        return self.verdict == _NOTHING_CAME

    def feed(self, block: FrameBlock) -> FrameBlock | None:
        """Take in frames; once it is decided, all of them from the beginning of the look on, else None."""
        while len(block):
            if self._from_ns is None and not self._begin(block):
                return None
            assert self._from_ns is not None
            # a clock that was set back ends the look, too, which else would go on until it has caught up
            late = np.flatnonzero(np.abs(block.t_ns - self._from_ns) > self._look_ns)
            over = bool(late.size)
            cut = int(late[0]) if over else len(block)
            if self._count + cut >= MOST_FRAMES:
                over, cut = True, MOST_FRAMES - self._count
            self._held.append(block.take(slice(0, cut)))
            self._count += cut
            if not over:
                return None
            block = block.take(slice(cut, None))
            held = self.flush()
            if held is not None:
                return FrameBlock.concat([held, block])
        return None

    def _begin(self, block: FrameBlock) -> bool:
        ours = np.flatnonzero(np.isin(block.can_id, self._ids))
        if not ours.size and self.plan.map.map.identifiers != "either length":
            return False
        self._from_ns = int(block.t_ns[ours[0] if ours.size else 0])
        if self.nothing_came:
            self.verdict = "looking at the signals"
        return True

    def flush(self) -> FrameBlock | None:
        """Decide by what there is: the frames, else None."""
        if not self._held:
            return None
        held = FrameBlock.concat(self._held)
        self._held, self._count, self._from_ns = [], 0, None
        survey = Survey(self.plan, self._rate)
        survey.run([held])
        fast, steady = abilities(survey)[:2]
        self.notes = [*missing(survey), *doubtful(survey)]
        if fast.able:
            self.verdict = f"fast observer: {fast.why}"
        elif steady.able:
            self.verdict = f"steady-state quantities only: {fast.why}"
        else:
            self.verdict = f"nothing can be made of the signals: {fast.why}; {steady.why}"
            return None
        self.allowed = Allowed(fast.able, survey.rate)
        return held
