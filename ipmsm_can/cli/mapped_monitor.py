"""Takes the status of another inverter that is followed through its map, next to `cli.monitor`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from ipmsm_can.bus.health_report import HealthReport
from ipmsm_can.bus.listen import Listener
from ipmsm_can.cli.monitor import RPM, Rates
from ipmsm_can.cli.status import BusStatus, NodeStatus, RunStatus
from ipmsm_can.estimation import confidence
from ipmsm_can.mapping.follow import Follower
from ipmsm_can.record.status import RecordStatus

_SILENT_NS = 500_000_000


class MappedMonitor:
    """Takes a `RunStatus` from a listener and a follower; may be called from another thread.

    title: of the screen.  records: what is recorded.  flowing: samples came in, as of the last status.
    """

    def __init__(self, listener: Listener, follower: Follower, title: str = "ipmsm-can run --map",
                 records: Callable[[], tuple[RecordStatus, ...]] = tuple) -> None:
        self.flowing = False
        self._listener = listener
        self._follower = follower
        self._title = title
        self._records = records
        # a sample may wait so long for later reports
        self._silent_ns = _SILENT_NS + round(1e9 * follower.plan.map.timing.wait)
        self._begin = time.monotonic()
        self._rates = Rates(self._begin)
        self._ever = 0

    def status(self) -> RunStatus:
        """As of now."""
        now = time.monotonic()
        report = self._listener.report()
        rates = self._rates.update(now, {"frames": report.frames, "samples": self._received})
        return RunStatus(self._title, now - self._begin, False, self._bus(report, rates["frames"]),
                         (self._node(report, rates["samples"]),), self._records())

    @property
    def _received(self) -> int:
        """Samples, those included that were shown while the signals were looked at."""
        return max(self._follower.samples, self._follower.shown)

    def _bus(self, r: HealthReport, frames_per_s: float) -> BusStatus:
        link = self._listener.link
        e = r.errors
        told = f"{e.frames} error frames" + (f", controller {e.state}" if e.state else "") if e.frames else (
            "no error frames")
        return BusStatus(
            description=r.source, load=r.load, frames=r.frames, frames_per_s=frames_per_s, sent=0, unsent=0, late=0,
            unknown=0, remote=sum(i.remote for i in r.ids), wrong_length=0, drops=max(0, r.kernel_drops),
            error_frames=e.frames, errors=told, turnaround_p50=math.nan, turnaround_p99=math.nan, no_bus=r.no_bus,
            outages=link.outages, outage_time=link.outage_time)

    def _node(self, r: HealthReport, samples_per_s: float) -> NodeStatus:
        follower = self._follower
        tracking = follower.tracking
        motor = follower.config.build_motor()
        silent_ns = self._listener.now_ns() - follower.last_ns  # a bus with nothing else on it is silent, too
        flowing = self._received > 0 and silent_ns < self._silent_ns and not r.no_bus
        self.flowing, live = flowing, flowing and tracking is not None
        theta, omega, sigma, flags, excitation = (tracking.latest if tracking is not None else
                                                  (math.nan, 0.0, math.pi, 0, 0.0))
        self._ever |= flags
        flags = flags if live else 0
        state = follower.verdict.partition(":")[0]  # the reason is told at the end: it takes more than a line
        if follower.decided and not flowing:
            state = "no samples any more"
        elif tracking is not None:
            state = "locked" if flags & confidence.LOCKED else "tracking, not locked"
        delay = tracking.estimator.voltage_delay if tracking is not None else None
        return NodeStatus(
            node=follower.config.wire.node, motor=motor.name, state=state, live=live, theta=theta, sigma=sigma,
            omega=omega, rpm=omega / motor.pole_pairs * RPM, valid=bool(flags & confidence.VALID),
            locked=bool(flags & confidence.LOCKED), polarity_known=bool(flags & confidence.POLARITY_KNOWN),
            excitation=excitation, injection="none: a mapped inverter is only listened to", injecting=False,
            amplitude=0.0, hf_current=0.0, sample_rate=follower.rate,
            samples_per_s=samples_per_s, estimates_per_s=samples_per_s if live else 0.0, received=self._received,
            lost=tracking.lost if tracking else 0, filled=tracking.filled if tracking else 0, gaps=0, duplicates=0,
            reordered=0, resyncs=0, restarts=0, bad_frames=tracking.unusable if tracking else 0,
            rejected_commands=0, timing=delay.words if delay is not None and delay.applied else "",
            ever_locked=tracking is None or bool(self._ever & confidence.LOCKED),
            ever_valid=tracking is None or bool(self._ever & confidence.VALID))
