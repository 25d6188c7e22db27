"""The simulated drive on the wire: samples out as frames, injection commands in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive.angle_source import AngleState
from ipmsm_can.drive.estimates import EstimateReceiver
from ipmsm_can.drive.faults import DriveFaults, FaultyEncoder
from ipmsm_can.drive.parameters import DriveNodeSettings as DriveNodeSettings
from ipmsm_can.drive.simulation import DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.e2e import E2EStatus, SequenceChecker
from ipmsm_can.wire.protocol import (
    BLOCK_SAMPLES,
    NODES,
    PROTOCOL_VERSION,
    TWO_PI,
    DriveMode,
    MessageKind,
    Protocol,
    Waveform,
)

COMMAND_REJECTED = 1 << 5
"""Bit of DriveStatus.faults that says a command was refused since the last DriveStatus."""
ENCODER_FAILED = 1 << 4
"""Bit of DriveStatus.faults that says that the encoder has failed."""
NO_ANGLE = 1 << 6
"""Bit of DriveStatus.faults ("can") that says that the control needs the companion's angle and cannot use it."""
COMMANDS_MISSED = 7
"""Largest step of a command's counter that is taken for loss.  A larger one is an old command that was held up
somewhere; after a loss that long it costs one command more."""
_AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")
TEMPERATURE = 40.0
"""What it says of its heat-sink [degC]."""


@dataclass(frozen=True, slots=True)
class Step:
    """What a stretch of simulation gave: frames to send, in order, and the truth behind them."""

    frames: FrameBlock
    samples: DriveSamples


class DriveNode:
    """A `DriveSimulation` that speaks the protocol as node `node`.

    A command is obeyed only if its CRC is right, its counter moved on, and it can be executed; every other
    one is counted in `rejected`, and the one in force runs out by its time to live.
    faults: what it reports wrongly.
    """

    def __init__(self, protocol: Protocol, node: int, simulation: DriveSimulation,
                 settings: DriveNodeSettings, faults: DriveFaults | None = None) -> None:
        self.node = node
        self._faults = faults
        self.simulation = simulation
        self.settings = settings
        self.rejected = 0
        self.waveform = Waveform.OFF
        self._protocol = protocol
        self._label = MessageKind.INJECTION_COMMAND * NODES + node
        self._checker = SequenceChecker(16, COMMANDS_MISSED)
        index = protocol.codecs[MessageKind.INJECTION_COMMAND].index
        self._rows = [index[s] for s in ("waveform", "amplitude", "frequency", "axis_angle", "time_to_live")]
        p = simulation.parameters
        self._rate = p.sample_rate
        self.estimates = EstimateReceiver(protocol, node, p.estimate_max_age, p.angle_sigma_limit)
        self._faulty_encoder = None if faults is None else FaultyEncoder(
            faults, simulation.motor.pole_pairs, p.sample_rate)
        self._needs_companion = p.angle_source != "encoder"
        self._encoder_fails = p.encoder_fails_sample
        self._last_state = math.nan
        self._block_counter = 0
        self._refused = False
        self._left: NDArray[np.float64] = np.zeros((4, 0))

    def receive(self, block: FrameBlock) -> None:
        """Take in frames from the bus; only InjectionCommands and PositionEstimates for this node matter."""
        labels = self._protocol.classify(block.raw)
        if self._needs_companion:
            rows = np.flatnonzero(labels == MessageKind.POSITION_ESTIMATE * NODES + self.node)
            estimate = self.estimates.take(block.raw, rows, self.simulation.next_sample) if rows.size else None
            if estimate is not None:
                self.simulation.take_estimate(estimate)
        rows = np.flatnonzero(labels == self._label)
        if not rows.size:
            return
        values, intact, counters = self._protocol.decode(MessageKind.INJECTION_COMMAND, self.node, block.raw,
                                                         rows)
        status = self._checker.update(intact, counters)
        for column, verdict in zip(values[self._rows].T, status, strict=True):
            if verdict <= E2EStatus.OK_SOME_LOST and self._obey(column):
                continue
            self.rejected += 1
            self._refused = True

    def _obey(self, command: NDArray[np.float64]) -> bool:
        waveform, amplitude, frequency, axis_angle, time_to_live = command.tolist()
        if not all(map(math.isfinite, command)):
            return False
        try:
            self.simulation.command_injection(int(waveform), amplitude, frequency, axis_angle,
                                              int(1e-3 * time_to_live * self._rate))
        except ValueError:
            return False
        return True

    def step(self, n: int, t0_ns: int = 0) -> Step:
        """Run n samples; frames carry t0_ns plus the time of their sample."""
        s = self.simulation.run(n)
        first = self.simulation.next_sample - n
        if n:
            self.waveform = Waveform(int(s.injection_waveform[-1]))
        parts: list[tuple[NDArray[np.int64], NDArray[np.uint8]]] = []
        samples = np.array([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])
        if self._faults is not None:
            samples = self._faults.samples(samples)
        parts.append(self._blocks(samples, first) if self.settings.fd else self._singles(samples, s.sample))
        parts += [self._timing(s), self._status(s), self._reference(s)]
        at = np.concatenate([p[0] for p in parts])
        order = np.argsort(at, kind="stable")
        raw = np.concatenate([p[1] for p in parts])[order]
        return Step(FrameBlock(raw, self.time_of(at[order], t0_ns)), s)

    def time_of(self, sample: NDArray[np.int64], t0_ns: int) -> NDArray[np.int64]:
        """When these samples are taken [ns]; t0_ns is the time of sample 0."""
        return t0_ns + np.round(sample * (1e9 / self._rate)).astype(np.int64)

    def _singles(self, samples: NDArray[np.float64],
                 counter: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        values = dict(zip(_AXES, samples, strict=True))
        return counter, self._protocol.encode(MessageKind.DRIVE_SAMPLE, self.node,
                                              {**values, "sample_counter": counter & 15})

    def _blocks(self, samples: NDArray[np.float64], first: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Full blocks of seven; the rest waits for the next call."""
        first -= self._left.shape[1]
        together = np.concatenate([self._left, samples], axis=1)
        m = together.shape[1] // BLOCK_SAMPLES
        self._left = together[:, m * BLOCK_SAMPLES:]
        starts = first + BLOCK_SAMPLES * np.arange(m, dtype=np.int64)
        values = {f"{axis}_{j}": together[r, j:m * BLOCK_SAMPLES:BLOCK_SAMPLES]
                  for r, axis in enumerate(_AXES) for j in range(BLOCK_SAMPLES)}
        raw = self._protocol.encode(MessageKind.DRIVE_SAMPLE_BLOCK, self.node,
                                    {**values, "first_sample": starts & 0xFFFFFFFF,
                                     "sample_count": np.full(m, BLOCK_SAMPLES)},
                                    self._block_counter + np.arange(m))
        self._block_counter += m
        return starts + BLOCK_SAMPLES - 1, raw

    def every(self, rate: float) -> int:
        """Samples between two messages that are due `rate` times a second [Hz]; 0 for never."""
        return max(1, round(self._rate / rate)) if rate > 0.0 else 0

    def _due(self, s: DriveSamples, rate: float) -> NDArray[np.intp]:
        every = self.every(rate)
        return np.flatnonzero(s.sample % every == 0) if every else np.zeros(0, np.intp)

    def _timing(self, s: DriveSamples) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        due = sent = s.sample[self._due(s, self.settings.timing_rate)]
        if self.settings.fd:  # the block that holds a sample goes out with the last of its samples
            sent = (due + 1) // BLOCK_SAMPLES * BLOCK_SAMPLES - 1
            due, sent = due[sent >= 0], sent[sent >= 0]
        return due, self._protocol.encode(MessageKind.DRIVE_TIMING, self.node, {
            "sample_counter": sent & 0xFFFFFFFF, "sample_rate": np.full(sent.size, self._rate)})

    def _status(self, s: DriveSamples) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        due = self._due(s, self.settings.status_rate)
        if self.settings.status_rate > 0.0:
            due = np.union1d(due, self._changes(s))  # what happened to the angle is said at once
        mode, faults = self._condition(s)
        refused = self._refused
        if due.size:
            self._refused = False
        return s.sample[due], self._protocol.encode(MessageKind.DRIVE_STATUS, self.node, {
            "mode": mode[due],
            "active_waveform": s.injection_waveform[due],
            "encoder_available": (s.sample[due] < self._encoder_fails) & (self.settings.reference_rate > 0.0),
            "faults": faults[due] + (COMMAND_REJECTED if refused else 0),
            "v_dc": np.full(due.size, self.simulation.parameters.v_dc),
            "temperature": np.full(due.size, TEMPERATURE),
            "protocol_version": np.full(due.size, PROTOCOL_VERSION),
            "rejected_commands": np.full(due.size, self.rejected & 0xFF)})

    def _condition(self, s: DriveSamples) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(DriveMode, bits of DriveStatus.faults) at every sample; of rejected commands it knows nothing."""
        state = s.angle_state
        no_angle = (state != AngleState.ENCODER) & (state != AngleState.COMPANION) & self._needs_companion
        faults = ENCODER_FAILED * (s.sample >= self._encoder_fails) + NO_ANGLE * no_angle
        return np.where(state == AngleState.STOPPED, int(DriveMode.SAFE_STOP), int(DriveMode.RUNNING)), faults

    def _changes(self, s: DriveSamples) -> NDArray[np.intp]:
        """Samples at which the control went over to something else, or the encoder failed; not the first of all."""
        before = np.append(self._last_state, s.angle_state[:-1])[:len(s)]
        if len(s):
            self._last_state = s.angle_state[-1]
        return np.flatnonzero(((s.angle_state != before) & ~np.isnan(before)) | (s.sample == self._encoder_fails))

    def _reference(self, s: DriveSamples) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        due = self._due(s, self.settings.reference_rate)
        due = due[s.sample[due] < self._encoder_fails]
        theta, omega = s.theta_e, s.omega_e
        if self._faulty_encoder is not None:
            theta, omega = self._faulty_encoder.read(s.sample, theta, omega)
        theta_e = self.encoder(theta[due])
        return s.sample[due], self._protocol.encode(MessageKind.DRIVE_REFERENCE, self.node, {
            "theta_e": self._protocol.angle(MessageKind.DRIVE_REFERENCE, "theta_e", theta_e),
            "omega_e": omega[due], "sample_counter": s.sample[due] & 0xFFFFFFFF})

    def encoder(self, theta_e: NDArray[np.float64]) -> NDArray[np.float64]:
        """The angle [rad electrical] as the encoder tells it."""
        if not self.settings.encoder_counts:
            return theta_e
        step = TWO_PI * self.simulation.motor.pole_pairs / self.settings.encoder_counts
        return step * np.round(theta_e / step)
