"""Another inverter, live: look at its signals for a moment, then follow it as far as they allow.

What a map allows is known only once its signals have been seen: how often they come, how evenly, how fast the motor
turns.  So the first LOOK_S of them are looked at as `ipmsm-can map --check` looks at a log; then the same frames go
through the fast observer, or through the steady-state equations, and all that follow, too.  No clock, no thread, no
socket; any partition of the frames gives the same bits.
"""

from __future__ import annotations

import numpy as np

from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping.check import abilities, doubtful, missing
from ipmsm_can.mapping.mapper import MappedBlock, Mapper
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.mapping.steady import SteadyState
from ipmsm_can.mapping.survey import Survey
from ipmsm_can.mapping.track import MappedTracking

LOOK_S = 2.0
"""How long the signals are looked at [s], from the first frame of the map."""

_NOTHING_CAME = "no frame of the map has come yet"


class Follower:
    """Follows one mapped drive.

    config: of the drive, for its motor and the observer.  plan: from `make_plan`.
    tracking: the fast observer, where the signals allow it; steady: the steady-state quantities, where only those;
    both None while it looks, and where neither is possible: then it goes on looking.
    verdict: what is done and why, in a sentence.  notes: what is missing or doubtful.  samples: so far; rate: of
    them [Hz], 0 while it looks.
    """

    def __init__(self, config: DriveConfig, plan: Plan, look_s: float = LOOK_S) -> None:
        self.config = config
        self.plan = plan
        self.tracking: MappedTracking | None = None
        self.steady: SteadyState | None = None
        self.verdict = _NOTHING_CAME
        self.notes: list[str] = []
        self.samples = 0
        self.rate = 0.0
        self.last_ns = 0
        """Arrival of the newest sample [ns]."""
        self._look_ns = round(1e9 * look_s)
        self._ids = np.array(sorted({s.can_id for s in plan.sources}), np.uint32)
        self._held: list[FrameBlock] = []
        self._from_ns: int | None = None
        self._mapper: Mapper | None = None

    @property
    def decided(self) -> bool:
        """It has found out what the signals allow."""
        return self._mapper is not None

    def feed(self, block: FrameBlock) -> None:
        """Take in frames in the order of their arrival; never raises for what is in them."""
        if not len(block):
            return
        if self._mapper is not None:
            self._take(self._mapper.feed(block))
            return
        self._look(block)

    def _look(self, block: FrameBlock) -> None:
        if self._from_ns is None:
            ours = np.flatnonzero(np.isin(block.can_id, self._ids))
            if not ours.size and self.plan.map.map.identifiers != "either length":
                return
            self._from_ns = int(block.t_ns[ours[0] if ours.size else 0])
            if self.verdict == _NOTHING_CAME:
                self.verdict = "looking at the signals"
        late = np.flatnonzero(block.t_ns > self._from_ns + self._look_ns)
        cut = int(late[0]) if late.size else len(block)
        self._held.append(block.take(slice(0, cut)))
        if late.size:
            held, self._held = FrameBlock.concat(self._held), []
            if self._decide(held):
                self.feed(held)
            else:
                self._from_ns = None
            self.feed(block.take(slice(cut, None)))

    def flush(self) -> None:
        """No more frames will come: decide by what there is, and take in what waits for later reports."""
        if self._held:
            held, self._held = FrameBlock.concat(self._held), []
            if self._decide(held):
                self.feed(held)
        if self._mapper is not None:
            self._take(self._mapper.flush())

    def _decide(self, held: FrameBlock) -> bool:
        survey = Survey(self.plan, self.config.wire.sample_rate)
        survey.run([held])
        fast, steady = abilities(survey)[:2]
        self.notes = [*missing(survey), *doubtful(survey)]
        if fast.able:
            self.verdict = f"fast observer: {fast.why}"
            self.tracking = MappedTracking(self.config, self.plan.map, survey.rate)
        elif steady.able:
            self.verdict = f"steady-state quantities only: {fast.why}"
            self.steady = SteadyState(self.config.build_motor(), self.plan.map)
        else:
            self.verdict = f"nothing can be made of the signals: {fast.why}; {steady.why}"
            return False
        self.rate = survey.rate
        self._mapper = Mapper(self.plan, survey.rate)
        return True

    def _take(self, part: MappedBlock) -> None:
        if not len(part):
            return
        self.samples += len(part)
        self.last_ns = int(part.t_ns[-1])
        if self.tracking is not None:
            self.tracking.feed(part)
        elif self.steady is not None:
            self.steady.feed(part)
