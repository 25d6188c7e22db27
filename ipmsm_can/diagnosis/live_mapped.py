"""The live diagnosis of another inverter, through its map: first a look at what its signals allow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ipmsm_can.analysis.pieces import MapPieces
from ipmsm_can.analysis.steady import SteadyBuilder
from ipmsm_can.diagnosis.live import EVERY_S, WINDOW_S, LiveDiagnosis
from ipmsm_can.frames import CAN_ERR_FLAG, FrameBlock
from ipmsm_can.mapping.check import no_frame
from ipmsm_can.mapping.look import Look

if TYPE_CHECKING:
    from ipmsm_can.config.model import DriveConfig
    from ipmsm_can.mapping.plan import Plan

_STRANGERS_KEPT = 1000


class MappedDiagnosis:
    """A drive through its map: the diagnosis, once its signals have been looked at and allow the fast observer or
    the steady-state checks.

    config: the drive.  plan: from `make_plan`.  window_s, every_s: as in `LiveDiagnosis`.
    look: at the signals.  diagnosis: None until they allow it.
    """

    def __init__(self, config: DriveConfig, plan: Plan, *, window_s: float = WINDOW_S,
                 every_s: float = EVERY_S) -> None:
        self.look = Look(plan, config.wire.sample_rate)
        self.diagnosis: LiveDiagnosis | None = None
        self.silent_s = 0.0
        """For how long frames have come, none of them the map's [s]."""
        self._config = config
        self._window, self._every = window_s, every_s
        self._strangers: set[int] = set()
        self._first_ns: int | None = None

    def feed(self, block: FrameBlock) -> None:
        """Take in frames; never raises for what is in them."""
        if self.look.nothing_came and len(block):
            self._note_strangers(block)
        held = block if self.look.allowed is not None else self.look.feed(block)
        self._judge(held)

    def finish(self) -> None:
        """Nothing more comes: decide by what there is; samples count that wait for later reports."""
        if self.look.allowed is None:
            self._judge(self.look.flush())
        if self.diagnosis is not None:
            self.diagnosis.finish()

    def _judge(self, block: FrameBlock | None) -> None:
        allowed = self.look.allowed
        if block is None or allowed is None:
            return
        if self.diagnosis is None and allowed.fast:
            voltage = self.look.plan.map.voltage
            self.diagnosis = LiveDiagnosis(
                self._config, window_s=self._window, every_s=self._every,
                pieces=MapPieces(self.look.plan, allowed.rate),
                voltage_delay=0.0 if voltage is None else voltage.delay)
        elif self.diagnosis is None:
            self.diagnosis = LiveDiagnosis(
                self._config, every_s=self._every,
                builder=SteadyBuilder(self.look.plan, allowed.rate, window_s=self._window))
        self.diagnosis.feed(block)

    def _note_strangers(self, block: FrameBlock) -> None:
        if self._first_ns is None:
            self._first_ns = int(block.t_ns[0])
        self.silent_s = 1e-9 * (int(block.t_ns[-1]) - self._first_ns)
        if len(self._strangers) < _STRANGERS_KEPT:
            self._strangers |= set(block.can_id[block.can_id & CAN_ERR_FLAG == 0].tolist())

    def why_none(self, where: str) -> str:
        """Why there is no diagnosis, a sentence without its end; "" where there is one.  where: what was read."""
        if self.diagnosis is not None:
            return ""
        if self.look.nothing_came:
            return no_frame(self.look.plan, sorted(self._strangers), where) if self._strangers else (
                f"no frame came on {where}")
        return f"through the map, {where} does not hold the samples that this takes: {self.look.verdict}"
