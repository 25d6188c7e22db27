"""One drive as the companion sees it: its wire, its estimator, its injection, and what it is answered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.config.build import estimator_settings, injection_settings, probing_frequency, startup_settings
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.encoder import Agreement, EncoderCheck
from ipmsm_can.estimation import clipping, confidence, speed
from ipmsm_can.estimation.estimator import EstimateBlock, Estimator
from ipmsm_can.estimation.observers.kinds import KINDS
from ipmsm_can.frames import FrameBlock
from ipmsm_can.injection import meter
from ipmsm_can.injection.scheduler import Command, InjectionScheduler
from ipmsm_can.startup import Phase, StartUp
from ipmsm_can.wire.answers import (
    FLUX_SIGNALS,
    POSITION_SIGNALS,
    due_rows,
    flux_values,
    position_values,
    tracking_state,
)
from ipmsm_can.wire.protocol import (
    BLOCK_SAMPLES,
    PROTOCOL_VERSION,
    CompanionState,
    DriveMode,
    MessageKind,
    ObserverKind,
    Protocol,
    Waveform,
)
from ipmsm_can.wire.receive import SampleReceiver
from ipmsm_can.wire.sequence import SampleRun
from ipmsm_can.wire.sequence_kernel import CLIPPED

STALE_AFTER_NS = 50_000_000
"""Silence of the drive [ns] after which nothing is claimed any more."""
STARTUP_PERIOD = 0.005
"""Time between commands [s] while the start-up waits for what they bring about."""
PULSES_TIME_TO_LIVE = 0.03
"""Time to live of polarity pulses [s], or the waveform's if that is less: at their current no drive is to be
without orders for long."""
OLDEST_ANSWER = 0.02
"""An estimate for a sample older than this [s] is not worth a frame: a reader that fell behind skips it."""
ENCODER_LAP_NS = 10_000_000
"""How often an encoder that may show the angle to be wrong must be looked at [ns]."""
_CLEAR_EMF = 4.0
"""Back-EMF, in units of the voltage uncertainty, above which the estimate rests on rotation."""
STATUS_VERSION = 1
INJECTING, NOT_RUNNING = 1, 2
"""Bits of what is remembered of a DriveStatus."""
_STATUSES_KEPT = 4096

_REFERENCE = MessageKind.DRIVE_REFERENCE
_SAMPLE, _BLOCK, _TIMING, _STATUS = (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK,
                                     MessageKind.DRIVE_TIMING, MessageKind.DRIVE_STATUS)


@dataclass(frozen=True, slots=True)
class Tracked:
    """Samples of one node and what was estimated from them.

    injecting (M,): uint8, 1 where the drive said that it injects.
    """

    node: int
    run: SampleRun
    estimate: EstimateBlock
    injecting: NDArray[np.uint8]


@dataclass(slots=True)
class NodeView:
    """The latest of one node, for displays: NaN or 0 before the first estimate.

    theta [rad electrical], omega [rad/s electrical], sigma [rad electrical], excitation [V^2 s],
    hf_current: high-frequency current [A peak]; flags: bits of `confidence`.
    """

    sample: int = 0
    sample_rate: float = 0.0
    theta: float = math.nan
    omega: float = 0.0
    sigma: float = math.pi
    excitation: float = 0.0
    hf_current: float = 0.0
    flags: int = 0
    state: CompanionState = CompanionState.WAITING_FOR_SAMPLES
    estimates: int = 0


class Node:
    """One drive: its wire, its estimator, its injection."""

    def __init__(self, protocol: Protocol, config: DriveConfig, transmit: bool) -> None:
        self.config = config
        self.number = config.wire.node
        self.view = NodeView()
        self.receiver = SampleReceiver(protocol, self.number, config.wire.max_gap, config.wire.sample_rate)
        self.scheduler = InjectionScheduler(injection_settings(config), transmit)
        self.wrong_length = 0
        self.injecting = False
        self.running = True
        """The drive runs, as far as it has said."""
        self.foreign = False
        """The drive speaks another version of the protocol."""
        self._said_at = np.zeros(0, np.int64)
        self._said = np.zeros(1, np.uint8)
        """What the drive said, bits INJECTING and NOT_RUNNING: entry k from after _said_at[k - 1] on."""
        self.rejected_commands = 0
        self._protocol = protocol
        self._motor = config.build_motor()
        self._settings = estimator_settings(config, 0.0)
        self._startup_settings = startup_settings(config) if transmit else None
        self.estimator: Estimator | None = None
        self._clipping = clipping.new_state()
        self.encoder = EncoderCheck()
        self._latest: Tracked | None = None
        self._may_doubt = transmit
        self.startup: StartUp | None = None
        """The start-up at standstill; None before the first sample, and where it may not ask for pulses."""
        self.meter = meter.new_state(0.0, 1.0)
        self._last_arrival: int | None = None
        self.samples_per_frame = 1
        self.next_status = _AT_ONCE
        """When CompanionStatus is due [ns]."""
        self._next_command: int | None = None
        self._probing_axis = 0.0
        """Last angle [rad electrical] worth turning the probing signal to: each jump costs extra current."""
        self.position_counter = 0
        self._command_counter = 0
        status = protocol.codecs[_STATUS].index
        self._waveform_row, self._rejected_row = status["active_waveform"], status["rejected_commands"]
        self._mode_row, self._version_row = status["mode"], status["protocol_version"]
        reference = protocol.codecs[_REFERENCE].index
        self._reference_rows = reference["theta_e"], reference["sample_counter"]
        position = protocol.codecs[MessageKind.POSITION_ESTIMATE]
        self._position_width = len(position.signals)
        self.position_rows = np.array([position.index[name] for name in POSITION_SIGNALS], np.intp)
        flux = protocol.codecs[MessageKind.ACTIVE_FLUX_ESTIMATE]
        self._flux_width = len(flux.signals)
        self.flux_rows = np.array([flux.index[name] for name in FLUX_SIGNALS], np.intp)
        self.status_period = round(1e9 / config.estimate.status_rate)
        self.position_step = position.layouts[position.index["theta_e"]].scale

    # Frames in

    def feed(self, block: FrameBlock, rows: dict[MessageKind, NDArray[np.intp]]) -> list[Tracked]:
        """Take in this node's frames (row numbers by kind) and estimate from the samples they complete."""
        none = _NO_ROWS
        blocks = rows.get(_BLOCK, none)
        runs = self.receiver.push(block, rows.get(_SAMPLE, none), rows.get(_TIMING, none), blocks)
        if runs:
            self.samples_per_frame = BLOCK_SAMPLES if blocks.size else 1
        status = rows.get(_STATUS, none)
        if status.size:
            values, _, _ = self._protocol.decode(_STATUS, self.number, block.raw, status)
            self._hear(block.t_ns[status], values)
            self.rejected_commands = int(np.nan_to_num(values[self._rejected_row, -1]))
        tracked = [self._track(run) for run in runs]
        self.hear_encoder(block, rows.get(_REFERENCE, none), tracked)
        if not self.receiver.sequencer.waiting and self._said_at.size > 1:
            # Only samples from the time of the last DriveStatus on can still come.
            self._forget(int(np.searchsorted(self._said_at, self._said_at[-1], side="left")))
        return tracked

    def hear_encoder(self, block: FrameBlock, rows: NDArray[np.intp], tracked: Sequence[Tracked]) -> None:
        """Compare DriveReference frames with the estimates of the same samples, which `tracked` holds.

        Where they part at standstill, and the companion answers, the angle is not valid until it is found anew.
        """
        if tracked:
            self._latest = tracked[-1]
        if not rows.size or self._latest is None:
            return
        values, _, _ = self._protocol.decode(_REFERENCE, self.number, block.raw, rows)
        theta, counter = values[self._reference_rows[0]], values[self._reference_rows[1]]
        good = np.isfinite(theta) & np.isfinite(counter) & (np.abs(counter) < 2.0**32)
        numbers = counter[good].astype(np.int64)
        parts = tracked or [self._latest]
        # Each reference goes with the last run of samples that had begun by then.
        which = np.clip(np.searchsorted([p.run.counter[0] for p in parts], numbers, side="right") - 1, 0, None)
        begins = False
        for k, part in enumerate(parts):
            e, own = part.estimate, which == k
            valid = e.flags & confidence.VALID != 0
            begins |= self.encoder.compare(part.run.counter, e.angle[speed.THETA_HAT], e.angle[speed.OMEGA],
                                           e.sigma, valid, part.run.sample_rate, numbers[own], theta[good][own])
        if not begins:
            return
        self.encoder.settle()
        if self._may_doubt and self.estimator is not None and not self.turns:
            self.estimator.doubt()
            self.view.flags &= 0xFF ^ (confidence.VALID | confidence.POLARITY_KNOWN)
            if self.startup is not None:
                self.startup.doubt()

    @property
    def turns(self) -> bool:
        """The angle rests on rotation: the back-EMF stands clear of what the voltage may be wrong by."""
        emf = abs(self.view.omega) * self._motor.psi_m
        return bool(self.view.flags & confidence.LOCKED) and emf > _CLEAR_EMF * self._settings.voltage_uncertainty

    @property
    def lap_ns(self) -> int:
        """How long a runner may go on before the encoder has to be heard [ns]."""
        listening = self.encoder.agreement is not Agreement.NONE and not self.turns
        return ENCODER_LAP_NS if listening else _LONG_NS

    def _hear(self, t_ns: NDArray[np.int64], status: NDArray[np.float64]) -> None:
        """Keep what DriveStatus said, and when, for the samples that come after it."""
        injecting = status[self._waveform_row] != 0
        self.foreign = bool(status[self._version_row, -1] != PROTOCOL_VERSION)
        # A drive that does not switch does not apply the voltage it reports; another version means other things.
        running = (status[self._mode_row] == DriveMode.RUNNING) & (status[self._version_row] == PROTOCOL_VERSION)
        self._said_at = np.concatenate([self._said_at, t_ns])
        self._said = np.concatenate([self._said, (INJECTING * injecting + NOT_RUNNING * ~running).astype(np.uint8)])
        self.injecting = bool(self._said[-1] & INJECTING)
        self.running = not self._said[-1] & NOT_RUNNING
        self._forget(self._said_at.size - _STATUSES_KEPT)
        set_back = np.flatnonzero(np.diff(self._said_at) < 0)
        if set_back.size:
            self._forget(int(set_back[-1]) + 1)

    def _forget(self, oldest: int) -> None:
        if oldest > 0:
            self._said_at, self._said = self._said_at[oldest:], self._said[oldest:]

    def _track(self, run: SampleRun) -> Tracked:
        said = self._heard(run)
        withheld = (run.doubt != 0) | (said & NOT_RUNNING != 0)
        return Tracked(self.number, run, self._estimate(run, withheld), said & np.uint8(INJECTING))

    def _heard(self, run: SampleRun) -> NDArray[np.uint8]:
        """What the last DriveStatus before each sample said: by time, so that blocks make no difference."""
        if not self._said_at.size or self._said_at[-1] < run.t_ns[0]:
            return np.full(run.t_ns.size, self._said[-1], np.uint8)
        return self._said[np.searchsorted(self._said_at, run.t_ns, side="left")]

    def _estimate(self, run: SampleRun, withheld: NDArray[np.bool_]) -> EstimateBlock:
        estimator = self.estimator
        if estimator is None or estimator.sample_rate != run.sample_rate:
            self._settings = estimator_settings(self.config, run.sample_rate)
            estimator = self.estimator = Estimator(self._motor, run.sample_rate, self._settings)
            frequency = min(probing_frequency(self.config, run.sample_rate), 0.5 * run.sample_rate)
            self.meter = meter.new_state(frequency, run.sample_rate)
            self.scheduler.use(injection_settings(self.config, run.sample_rate))
            if self._startup_settings is not None:
                self.startup = StartUp(self._motor, estimator, self._startup_settings)
        if self.startup is None:
            estimate = estimator.process(run.values, run.gap)
        else:
            estimate = self.startup.process(run.values, run.gap, run.filled)
        if withheld.any():
            confidence.withhold(estimate.flags, withheld)
        clipped = run.doubt & np.uint8(CLIPPED)
        if self.distrusting or clipped.any():
            clipping.hold_block(clipped, estimate.regression, estimate.flux, estimate.angle, self._settings.alpha,
                                1.0 / run.sample_rate, KINDS[self._settings.kind], self._clipping, estimate.flags)
        self.note(run, estimate, meter.meter_block(run.values, self.meter))
        return estimate

    @property
    def distrusting(self) -> bool:
        """Samples were cut off at the end of their range, and what they spoiled has not faded yet."""
        return bool(self._clipping["holding"][0])

    def note(self, run: SampleRun, estimate: EstimateBlock, hf_current: float) -> None:
        """Keep the newest of these samples as the view; hf_current [A peak]."""
        view = self.view
        view.hf_current = hf_current
        view.sample = int(run.counter[-1])
        view.sample_rate = run.sample_rate
        view.theta = float(estimate.angle[speed.THETA_HAT, -1])
        view.omega = float(estimate.angle[speed.OMEGA, -1])
        view.sigma = float(estimate.sigma[-1])
        view.excitation = float(estimate.excitation[-1])
        view.flags = int(estimate.flags[-1])
        self._last_arrival = int(run.t_ns[-1])

    # Frames out

    def answers(self, tracked: Sequence[Tracked]) -> list[NDArray[np.uint8]]:
        """PositionEstimate and ActiveFluxEstimate frames for the samples that are due, newest last."""
        frames = []
        for part in tracked:
            counter, rate = part.run.counter, part.run.sample_rate
            oldest = int(OLDEST_ANSWER * rate)
            due = due_rows(counter, _every(rate, self.config.estimate.rate), oldest)
            if due.size:
                frames.append(self._position(part, due))
        return frames + self._flux_answers(tracked)

    def count_due(self, tracked: Sequence[Tracked]) -> int:
        """How many PositionEstimates `answers` would give."""
        return sum(due_rows(t.run.counter, _every(t.run.sample_rate, self.config.estimate.rate),
                            int(OLDEST_ANSWER * t.run.sample_rate)).size for t in tracked)

    def _flux_answers(self, tracked: Sequence[Tracked]) -> list[NDArray[np.uint8]]:
        """ActiveFluxEstimate frames for the samples that are due."""
        frames = []
        for part in tracked:
            rate = part.run.sample_rate
            oldest = int(OLDEST_ANSWER * rate)
            due = due_rows(part.run.counter, _every(rate, self.config.estimate.flux_rate), oldest)
            if due.size:
                frames.append(self._flux(part, due))
        return frames

    @property
    def samples_per_answer(self) -> int:
        """Every how many samples a PositionEstimate is due."""
        return _every(self.view.sample_rate, self.config.estimate.rate)

    @property
    def samples_per_flux_answer(self) -> int:
        """Every how many samples an ActiveFluxEstimate is due."""
        return _every(self.view.sample_rate, self.config.estimate.flux_rate)

    def _position(self, part: Tracked, due: NDArray[np.intp]) -> NDArray[np.uint8]:
        e = part.estimate
        values = np.zeros((self._position_width, due.size))
        position_values(part.run.counter, e.angle, e.sigma, e.flags, part.injecting, due, self.position_step,
                        self.position_rows, values)
        counters = np.arange(self.position_counter, self.position_counter + due.size)
        self.position_counter += due.size
        self.view.estimates += due.size
        return self._protocol.encode(MessageKind.POSITION_ESTIMATE, self.number, values, counters)

    def _flux(self, part: Tracked, due: NDArray[np.intp]) -> NDArray[np.uint8]:
        e = part.estimate
        values = np.full((self._flux_width, due.size), np.nan)
        flux_values(e.regression, e.flux, e.excitation, due, self.flux_rows, values)
        return self._protocol.encode(MessageKind.ACTIVE_FLUX_ESTIMATE, self.number, values)

    def due(self, now_ns: int, bus_load: float, turnaround: float) -> list[NDArray[np.uint8]]:
        """InjectionCommand and CompanionStatus frames that are due by the clock."""
        frames = []
        command = self._command(now_ns)
        if command is not None:
            frames.append(self._protocol.encode(MessageKind.INJECTION_COMMAND, self.number, {
                "waveform": float(command.waveform), "amplitude": command.amplitude,
                "frequency": command.frequency,
                "axis_angle": self._protocol.angle(MessageKind.INJECTION_COMMAND, "axis_angle",
                                                   command.axis_angle),
                "time_to_live": 1e3 * command.time_to_live,
            }, self._command_counter))
            self._command_counter += 1
        if not self.next_status - self.status_period < now_ns < self.next_status:
            # Due; or the clock was set back, which must not silence us until it has caught up.
            self.next_status = now_ns + self.status_period
            frames.append(self._protocol.encode(MessageKind.COMPANION_STATUS, self.number,
                                                self.status_values(now_ns, bus_load, turnaround)))
        return frames

    def quiet_ns(self, now_ns: int) -> int:
        """How long the scheduler can do without being asked [ns]: until its next command, if it has any to give."""
        if self.startup is not None and self.startup.busy:
            return 0  # it has to see the samples as they come
        if self.scheduler.rests:
            return _LONG_NS
        return 0 if self._next_command is None else self._next_command - now_ns

    def _command(self, now_ns: int) -> Command | None:
        startup = self.startup
        period = self.config.injection.period
        if startup is not None and startup.phase in (Phase.AXIS, Phase.PULSES):
            period = min(period, STARTUP_PERIOD)
        if self._next_command is None:
            self._next_command = now_ns
        if self._next_command - round(1e9 * period) < now_ns < self._next_command:
            return None
        late = max(0, now_ns - self._next_command)
        self._next_command = now_ns + round(period * 1e9) - min(late, round(0.5e9 * period))
        view = self.view
        if view.flags & confidence.LOCKED:
            self._probing_axis = view.theta
        refused = startup is not None and startup.phase is Phase.REFUSED
        standing = abs(view.omega) * self._motor.psi_m
        if (startup is not None and startup.phase is Phase.WATCH and view.flags & confidence.LOCKED
                and view.flags & confidence.POLARITY_KNOWN and self.scheduler.amplitude > 0.0
                and standing < 0.5 * startup.still_below):
            startup.resume(view.theta, view.sigma)
        found = refused or view.flags & confidence.POLARITY_KNOWN
        return self.scheduler.update(period, view.omega, view.excitation, self._probing_axis, view.hf_current,
                                     self._fresh(now_ns), self.running, self._pulses(), refused,
                                     view.sigma if found else math.pi, view.flags & confidence.VALID != 0,
                                     view.flags & confidence.LOCKED != 0)

    def _pulses(self) -> Command | None:
        wanted = None if self.startup is None else self.startup.pulses
        if wanted is None:
            return None
        return Command(Waveform.POLARITY_PULSES, wanted.amplitude, wanted.frequency, wanted.axis,
                       min(self.config.injection.time_to_live, PULSES_TIME_TO_LIVE))

    def _fresh(self, now_ns: int) -> bool:
        return self._last_arrival is not None and now_ns - self._last_arrival <= STALE_AFTER_NS

    def flowing(self, now_ns: int) -> bool:
        """Whether samples come in and their rate is known."""
        return self.view.sample_rate > 0.0 and self._fresh(now_ns)

    def frames_until_due(self, now_ns: int) -> int:
        """Sample frames to come up to the next one that gets a PositionEstimate, or up to the moment at which a
        command or status is due; 0 while samples do not flow."""
        if not self.flowing(now_ns):
            return 0
        view = self.view
        every = _every(view.sample_rate, self.config.estimate.rate)
        left_ns = max(0, min(self.quiet_ns(now_ns), self.next_status - now_ns))
        left = min(every - view.sample % every, int(left_ns * 1e-9 * view.sample_rate) + 1)
        return -(-left // self.samples_per_frame)

    def update_state(self, now_ns: int) -> CompanionState:
        """The state as of now, which is also what CompanionStatus says."""
        view = self.view
        if self._last_arrival is None:
            waiting = self.receiver.sequencer.waiting
            view.state = CompanionState.WAITING_FOR_TIMING if waiting else CompanionState.WAITING_FOR_SAMPLES
        elif not self._fresh(now_ns):
            view.state = CompanionState.STALE
        elif self.foreign:
            view.state = CompanionState.FAULT
        else:
            view.state = CompanionState(tracking_state(view.flags, view.sigma))
        return view.state

    @property
    def bad_frames(self) -> int:
        """Frames of this node that were dropped: wrong length, wrong CRC, impossible content."""
        return self.wrong_length + self.receiver.bad_frames + self.receiver.sequencer.count("bad_rate")

    def status_values(self, now_ns: int, bus_load: float, turnaround: float) -> NDArray[np.float64]:
        """Physical values of CompanionStatus as of now, float64 (n_signals, 1); turnaround [s], bus_load 0..1."""
        index = self._protocol.codecs[MessageKind.COMPANION_STATUS].index
        values = np.full((len(index), 1), np.nan)
        for name, value in {
            "state": float(self.update_state(now_ns)),
            "observer": float(ObserverKind[self._settings.kind.upper()]),
            "injection_state": float(self.scheduler.state),
            "injection_reason": float(self.scheduler.reason),
            "bus_load": 100.0 * bus_load,
            "lost_samples": self.receiver.sequencer.count("lost") & 0xFFF,
            "bad_frames": self.bad_frames & 0x3FF,
            "turnaround": 1e6 * turnaround,
            "version": float(STATUS_VERSION),
        }.items():
            values[index[name], 0] = value
        return values


def _every(sample_rate: float, rate: float) -> int:
    """Every how many samples something with this rate [Hz] falls due."""
    return max(1, round(sample_rate / rate))


_NO_ROWS = np.zeros(0, np.intp)
_AT_ONCE = -(1 << 62)
_LONG_NS = 1 << 60
