"""Another inverter, live: look at its signals for a moment, then follow it as far as they allow.

The first LOOK_S of the signals are looked at (`look`); then the same frames go through the fast observer, or
through the steady-state equations, and all that follow, too.  No clock, no thread, no socket; any partition of the
frames gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable

from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping.look import LOOK_S, Look
from ipmsm_can.mapping.mapper import MappedBlock, Mapper
from ipmsm_can.mapping.plan import Plan
from ipmsm_can.mapping.steady import SteadyState
from ipmsm_can.mapping.track import MappedTracking
from ipmsm_can.node import Tracked


class Follower:
    """Follows one mapped drive.

    config: of the drive, for its motor and the observer.  plan: from `make_plan`.
    reports: is shown the samples that there is no estimate for, as the drive reports them: those of the first look,
    and all where only the steady-state quantities are possible.  estimates: those with their estimates.  What was
    shown while it looked is shown again once it is decided.
    tracking: the fast observer, where the signals allow it; steady: the steady-state quantities, where only those;
    both None while it looks, and where neither is possible: then it goes on looking.
    verdict: what is done and why, in a sentence.  notes: what is missing or doubtful.  samples: so far; rate: of
    them [Hz], 0 while it looks.
    """

    def __init__(self, config: DriveConfig, plan: Plan, look_s: float = LOOK_S,
                 reports: Callable[[MappedBlock], None] | None = None,
                 estimates: Callable[[Tracked], None] | None = None) -> None:
        self.config = config
        self.plan = plan
        self.tracking: MappedTracking | None = None
        self.steady: SteadyState | None = None
        self.samples = 0
        self.shown = 0
        """Samples that were shown while it looked."""
        self.rate = 0.0
        self.last_ns = 0
        """Arrival of the newest sample [ns]."""
        self._look = Look(plan, config.wire.sample_rate, look_s)
        self._reports = reports
        self._estimates = estimates
        self._showing = Mapper(plan)
        self._mapper: Mapper | None = None

    @property
    def decided(self) -> bool:
        """It has found out what the signals allow."""
        return self._mapper is not None

    @property
    def verdict(self) -> str:
        """What is done and why, in a sentence."""
        return self._look.verdict

    @property
    def notes(self) -> list[str]:
        """What is missing or doubtful."""
        return self._look.notes

    def feed(self, block: FrameBlock) -> None:
        """Take in frames in the order of their arrival; never raises for what is in them."""
        if not len(block):
            return
        if self._mapper is not None:
            self._take(self._mapper, block)
            return
        if self._reports is not None:
            self._show(self._reports, self._showing.feed(block))
        held = self._look.feed(block)
        if held is not None:
            self._take(self._begin(), held)

    def flush(self) -> None:
        """No more frames will come: decide by what there is, and take in what waits for later reports."""
        held = self._look.flush()
        if held is not None:
            self._take(self._begin(), held)
        if self._mapper is not None:
            self._sampled(self._mapper.flush())
        elif self._reports is not None:
            self._show(self._reports, self._showing.flush())

    def _begin(self) -> Mapper:
        allowed = self._look.allowed
        assert allowed is not None
        if allowed.fast:
            self.tracking = MappedTracking(self.config, self.plan.map, allowed.rate, observer=self._estimates)
        else:
            self.steady = SteadyState(self.config.build_motor(), self.plan.map)
        self.rate = allowed.rate
        self._mapper = Mapper(self.plan, allowed.rate)
        return self._mapper

    def _show(self, reports: Callable[[MappedBlock], None], part: MappedBlock) -> None:
        if len(part):
            self.shown += len(part)
            self.last_ns = int(part.t_ns[-1])
            reports(part)

    def _take(self, mapper: Mapper, block: FrameBlock) -> None:
        self._sampled(mapper.feed(block))

    def _sampled(self, part: MappedBlock) -> None:
        if not len(part):
            return
        self.samples += len(part)
        self.last_ns = int(part.t_ns[-1])
        if self.tracking is not None:
            self.tracking.feed(part)
        elif self.steady is not None:
            self.steady.feed(part)
            if self._reports is not None:
                self._reports(part)
