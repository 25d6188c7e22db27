"""Takes a status from a running companion or simulated drive, for displays and summaries.

Taking one only reads what the runners count anyway, without a lock; a number may therefore be one round
younger than its neighbour.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ipmsm_can.bus.errors import BusState, ErrorCounters
from ipmsm_can.cli.status import BusStatus, DriveNodeStatus, DriveStatus, NodeStatus, RunStatus
from ipmsm_can.encoder import NOTABLE, EncoderCheck
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import CompanionState, InjectionReason, InjectionState

if TYPE_CHECKING:
    from ipmsm_can.bus.drive_runner import DriveRunner
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.drive.node import Step
    from ipmsm_can.node import Node, Tracked
    from ipmsm_can.record.status import RecordStatus

_RATE_WINDOW_S = 1.0
_QUANTILES_EVERY_S = 1.0
_SETTLED = confidence.LOCKED | confidence.VALID
RPM = 30.0 / math.pi

STATE_WORDS = {
    CompanionState.WAITING_FOR_SAMPLES: "waiting for samples",
    CompanionState.WAITING_FOR_TIMING: "waiting for DriveTiming (sample rate unknown)",
    CompanionState.STARTING: "starting",
    CompanionState.TRACKING: "tracking, not locked",
    CompanionState.LOCKED: "locked",
    CompanionState.STALE: "no samples any more",
    CompanionState.FAULT: "fault",
}
REASON_WORDS = {
    InjectionReason.NONE: "",
    InjectionReason.DISABLED_BY_CONFIGURATION: "injection.enabled is false",
    InjectionReason.TRANSMIT_NOT_ENABLED: "--transmit was not given",
    InjectionReason.LOW_SPEED: "low speed",
    InjectionReason.POOR_EXCITATION: "poor excitation",
    InjectionReason.SPEED_HIGH_ENOUGH: "speed is high enough",
    InjectionReason.CURRENT_LIMIT: "current limit",
    InjectionReason.NO_SAMPLES: "no samples from the drive",
    InjectionReason.DRIVE_NOT_RUNNING: "the drive does not run",
    InjectionReason.OPERATOR: "asked for by the operator",
    InjectionReason.POLARITY_UNKNOWN: "the magnet's polarity is unknown",
    InjectionReason.POLARITY_UNKNOWABLE: "the iron does not tell the magnet's polarity at standstill",
}
INJECTION_WORDS = {
    InjectionState.DISABLED: "disabled", InjectionState.OFF: "off", InjectionState.RAMP_UP: "rising",
    InjectionState.ON: "on", InjectionState.RAMP_DOWN: "falling", InjectionState.LIMITED: "limited",
    InjectionState.POLARITY_PULSES: "polarity pulses",
}


class RunMonitor:
    """Takes `RunStatus` from a runner: `observe` is the runner's observer, `status` may be called from
    another thread, a few times a second."""

    def __init__(self, runner: LiveRunner, title: str = "ipmsm-can run",
                 records: Callable[[], tuple[RecordStatus, ...]] = tuple) -> None:
        self.runner = runner
        self.title = title
        self._records = records
        self.errors = ErrorCounters()
        self._begin = time.monotonic()
        self._errors_seen = 0
        self._ever: dict[int, int] = {}
        self._rates = Rates(self._begin)
        self._turnaround = (math.nan, math.nan)
        self._next_quantiles = 0.0

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Count error frames, and note who locks; next to nothing when there is nothing new."""
        for part in tracked:
            seen = self._ever.setdefault(part.node, 0)
            if seen & _SETTLED != _SETTLED:
                self._ever[part.node] = seen | int(np.bitwise_or.reduce(part.estimate.flags))
        seen = self.runner.companion.counts.errors
        if seen != self._errors_seen:
            self._errors_seen = seen
            self.errors.update(block)

    def status(self) -> RunStatus:
        """As of now."""
        now = time.monotonic()
        companion, port = self.runner.companion, self.runner.port
        link = self.runner.link
        counts = companion.counts
        counted = {"frames": counts.frames}
        for number, node in companion.nodes.items():
            counted[f"samples {number}"] = node.receiver.sequencer.count("received")
            counted[f"estimates {number}"] = node.view.estimates
        rates = self._rates.update(now, counted)
        if now >= self._next_quantiles:
            # over up to 65536 answers: a millisecond that five displays a second need not pay
            self._next_quantiles = now + _QUANTILES_EVERY_S
            p50, p99 = self.runner.turnaround.quantiles((0.5, 0.99)).tolist()
            self._turnaround = (p50, p99)
        bus = BusStatus(
            description=port.description, load=companion.bus_load, frames=counts.frames,
            frames_per_s=rates["frames"], sent=self.runner.sent, unsent=self.runner.unsent,
            late=companion.late, unknown=counts.unknown,
            remote=counts.remote, wrong_length=counts.wrong_length, drops=self.runner.drops,
            error_frames=self.errors.frames, errors=self.errors.summary(),
            turnaround_p50=self._turnaround[0], turnaround_p99=self._turnaround[1],
            no_bus=self._no_bus(), outages=0 if link is None else link.outages,
            outage_time=0.0 if link is None else link.outage_time)
        nodes = tuple(_node_status(node, rates[f"samples {number}"], rates[f"estimates {number}"],
                                   self._ever.get(number, 0))
                      for number, node in companion.nodes.items())
        return RunStatus(self.title, now - self._begin, companion.transmit, bus, nodes, self._records())

    def _no_bus(self) -> str:
        """Why there is no bus now: the interface is gone, or its controller has switched itself off."""
        link = self.runner.link
        if link is not None:
            return link.words
        if self.errors.state is BusState.BUS_OFF:
            return "no bus: the controller is bus-off (`sudo ip link set can0 type can restart` restarts it)"
        return ""


def _node_status(node: Node, samples_per_s: float, estimates_per_s: float, ever: int) -> NodeStatus:
    view, scheduler = node.view, node.scheduler
    count = node.receiver.sequencer.count
    motor = node.config.build_motor()
    live = view.state in (CompanionState.STARTING, CompanionState.TRACKING, CompanionState.LOCKED)
    flags = view.flags if live else 0
    delay = node.estimator.voltage_delay if node.estimator is not None else None
    return NodeStatus(
        node=node.number, motor=motor.name, state=STATE_WORDS[view.state], live=live,
        theta=view.theta, sigma=view.sigma, omega=view.omega, rpm=view.omega / motor.pole_pairs * RPM,
        valid=bool(flags & confidence.VALID), locked=bool(flags & confidence.LOCKED),
        polarity_known=bool(flags & confidence.POLARITY_KNOWN), excitation=view.excitation,
        injection=injection_words(scheduler.state, scheduler.reason, scheduler.amplitude),
        injecting=node.injecting, amplitude=scheduler.amplitude, hf_current=view.hf_current,
        sample_rate=view.sample_rate, samples_per_s=samples_per_s, estimates_per_s=estimates_per_s,
        received=count("received"), lost=count("lost"), filled=count("filled"), gaps=count("gaps"),
        duplicates=count("duplicates"), reordered=count("reordered"), resyncs=count("resyncs"),
        restarts=count("restarts"), bad_frames=node.bad_frames, rejected_commands=node.rejected_commands,
        clipped=count("clipped"), distrusting=node.distrusting,
        timing=delay.words if delay is not None and delay.applied else "",
        ever_locked=bool(ever & confidence.LOCKED), ever_valid=bool(ever & confidence.VALID),
        encoder=encoder_words(node.encoder), late=bool(node.receiver.sequencer.state["doubt"][0]))


def encoder_words(check: EncoderCheck) -> str:
    """What is notable of the encoder beside the estimate; empty where nothing is."""
    said = []
    if check.disagreements:
        said.append(f"parted from the estimate {check.disagreements} times, slipped {check.slips} times")
    if abs(check.offset) > NOTABLE:
        said.append(f"its zero is off by {math.degrees(check.offset):+.1f} deg electrical")
    return "; ".join(said)


def injection_words(state: InjectionState, reason: InjectionReason, amplitude: float) -> str:
    """State and reason of an injection: "on, 6.0 V: low speed"."""
    text = INJECTION_WORDS[state]
    if amplitude > 0.0:
        text += f", {amplitude:.1f} V"
    return f"{text}: {REASON_WORDS[reason]}" if REASON_WORDS[reason] else text


class Rates:
    """Events per second from counters that begin at 0, over about the last second.

    begin: time [s] on the clock of `update`.
    """

    def __init__(self, begin: float) -> None:
        self._past: deque[tuple[float, dict[str, int]]] = deque([(begin, {})])

    def update(self, now: float, counted: dict[str, int]) -> dict[str, float]:
        """The rates [1/s] now."""
        past = self._past
        past.append((now, counted))
        while len(past) > 2 and past[1][0] <= now - _RATE_WINDOW_S:
            past.popleft()
        then, before = past[0]
        span = now - then
        return {name: (n - before.get(name, 0)) / span if span > 0.0 else 0.0 for name, n in counted.items()}


class DriveMonitor:
    """Takes `DriveStatus` from a runner, as `RunMonitor` does."""

    def __init__(self, runner: DriveRunner, duration: float, title: str = "ipmsm-can drive") -> None:
        self.runner = runner
        self.title = title
        self._duration = duration
        self._begin = time.monotonic()
        self._latest: dict[int, Step] = {}
        self._rates = Rates(self._begin)

    def observe(self, node: int, step: Step) -> None:
        """Keep the latest stretch of simulation."""
        self._latest[node] = step

    def status(self) -> DriveStatus:
        """As of now."""
        now = time.monotonic()
        rates = self._rates.update(now, {"sent": self.runner.sent})
        nodes = []
        for drive in self.runner.drives:
            step = self._latest.get(drive.node)
            if step is None or not len(step.samples):
                continue
            s, simulation = step.samples, drive.simulation
            nodes.append(DriveNodeStatus(
                node=drive.node, motor=simulation.motor.name, profile=simulation.profile.name,
                time=float(s.sample[-1]) / simulation.parameters.sample_rate,
                rpm=float(s.omega_e[-1]) / simulation.motor.pole_pairs * RPM,
                reference_rpm=float(s.speed_reference[-1]) * RPM, torque=float(s.torque[-1]),
                load_torque=float(s.load_torque[-1]),
                current=math.hypot(float(s.i_d[-1]), float(s.i_q[-1])),
                waveform=drive.waveform.name.lower(), amplitude=float(s.injection_amplitude[-1]),
                rejected=drive.rejected))
        port = self.runner.port
        return DriveStatus(self.title, now - self._begin, self._duration, port.description, self.runner.sent,
                           rates["sent"], port.unsent, self.runner.slips, tuple(nodes))
