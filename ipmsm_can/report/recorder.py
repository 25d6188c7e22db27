"""Recording a run for a report: estimates per sample, encoder angles and commands as they pass by.

Blocks are copied into arrays that grow by doubling, one kernel call per block, so that recording costs the
hot loop a few microseconds a round and no Python object per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.companion import Companion
from ipmsm_can.frames import FrameBlock
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import NODES, MessageKind

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

THETA, OMEGA, SIGMA, EXCITATION, CURRENT = range(5)
"""Rows of `Recorder`'s table of values."""
_ROWS = 5
_LOAD_EVERY_S = 0.1
_FIRST_ROOM = 1 << 16


@dataclass(frozen=True, slots=True)
class Record:
    """One drive's run.  Times are in seconds from the drive's first sample (counter 0 of the run).

    sample_rate [Hz].  counter (N,) int64: the drive's counter.  time (N,) [s].
    theta, sigma [rad electrical], omega [rad/s electrical], excitation [V^2 s], current: length of the
    measured current vector [A peak]; all (N,).  flags (N,) uint8: bits of `estimation.confidence`.
    injecting, filled (N,) bool: the drive said that it injects; the sample was interpolated.
    reference_counter (R,) int64, reference_theta [rad], reference_omega [rad/s electrical]: the encoder.
    command_time (C,) [s], command_amplitude (C,) [V peak]: InjectionCommands sent.
    load (L,): bus load 0..1, every 0.1 s, over the second before.
    frames: how many by kind, both directions.
    """

    sample_rate: float
    counter: NDArray[np.int64]
    time: Floats
    theta: Floats
    omega: Floats
    sigma: Floats
    excitation: Floats
    current: Floats
    flags: NDArray[np.uint8]
    injecting: NDArray[np.bool_]
    filled: NDArray[np.bool_]
    reference_counter: NDArray[np.int64]
    reference_theta: Floats
    reference_omega: Floats
    command_time: Floats
    command_amplitude: Floats
    load: Floats
    frames: dict[MessageKind, int]


@kernel
def _copy(counter: Ints, samples: Floats, filled: Bytes, injecting: Bytes, angle: Floats, sigma: Floats,
          excitation: Floats, flags: Bytes, at: int, out_counter: Ints, out_values: Floats, out_flags: Bytes,
          out_marks: Bytes) -> None:
    """Copy a block of M samples into the tables from column `at` on."""
    for k in range(counter.shape[0]):
        j = at + k
        out_counter[j] = counter[k]
        out_values[0, j] = angle[0, k]
        out_values[1, j] = angle[2, k]
        out_values[2, j] = sigma[k]
        out_values[3, j] = excitation[k]
        out_values[4, j] = np.sqrt(samples[0, k] * samples[0, k] + samples[1, k] * samples[1, k])
        out_flags[j] = flags[k]
        out_marks[j] = injecting[k] | filled[k] << 1


class Recorder:
    """Records what the companion does with one node; `observe` fits `bus.live.Observer`."""

    def __init__(self, companion: Companion, node: int) -> None:
        self.samples = 0
        self.latest_error = float("nan")
        """Angle error [rad electrical] at the latest encoder frame, NaN before the first."""
        self._companion = companion
        self._protocol = companion.protocol
        self._node = node
        self._rate = 0.0
        self._counter = np.empty(_FIRST_ROOM, np.int64)
        self._values = np.empty((_ROWS, _FIRST_ROOM))
        self._flags = np.empty(_FIRST_ROOM, np.uint8)
        self._marks = np.empty(_FIRST_ROOM, np.uint8)
        self._counts = np.zeros(len(MessageKind), np.int64)
        self._references: list[Floats] = []
        self._commands: list[tuple[int, float]] = []
        self._load: list[float] = []
        self._next_load: int | None = None
        index = self._protocol.codecs[MessageKind.DRIVE_REFERENCE].index
        self._reference_rows = [index[name] for name in ("theta_e", "omega_e", "sample_counter")]
        self._amplitude_row = self._protocol.codecs[MessageKind.INJECTION_COMMAND].index["amplitude"]

    @property
    def seconds(self) -> float:
        """Time [s] from counter 0 to the latest sample."""
        return float(self._counter[self.samples - 1]) / self._rate if self.samples and self._rate else 0.0

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Take in what came, what was estimated from it, and what was sent at now_ns."""
        for part in tracked:
            if part.node == self._node:
                self._add(part)
        for frames in (block, answers):
            if len(frames):
                self._look(frames)
        if self._next_load is None or now_ns >= self._next_load:
            self._next_load = now_ns + round(1e9 * _LOAD_EVERY_S)
            self._load.append(self._companion.bus_load)

    def _add(self, part: Tracked) -> None:
        run, e = part.run, part.estimate
        n = run.counter.size
        end = self.samples + n
        while end > self._counter.size:
            self._counter = np.concatenate([self._counter, np.empty_like(self._counter)])
            self._values = np.concatenate([self._values, np.empty_like(self._values)], axis=1)
            self._flags = np.concatenate([self._flags, np.empty_like(self._flags)])
            self._marks = np.concatenate([self._marks, np.empty_like(self._marks)])
        self._rate = run.sample_rate
        _copy(run.counter, run.values, run.filled, part.injecting, e.angle, e.sigma, e.excitation, e.flags,
              self.samples, self._counter, self._values, self._flags, self._marks)
        self.samples = end

    def _look(self, frames: FrameBlock) -> None:
        labels = self._protocol.classify(frames.raw)
        ours = labels[(labels >= 0) & (labels % NODES == self._node)] // NODES
        counts = np.bincount(ours, minlength=len(MessageKind))
        self._counts += counts
        if counts[MessageKind.DRIVE_REFERENCE]:
            rows = np.flatnonzero(labels == MessageKind.DRIVE_REFERENCE * NODES + self._node)
            values, _, _ = self._protocol.decode(MessageKind.DRIVE_REFERENCE, self._node, frames.raw, rows)
            reference = values[self._reference_rows]
            self._references.append(reference)
            self._note_error(reference[:, -1])
        if counts[MessageKind.INJECTION_COMMAND] and self.samples:
            rows = np.flatnonzero(labels == MessageKind.INJECTION_COMMAND * NODES + self._node)
            values, _, _ = self._protocol.decode(MessageKind.INJECTION_COMMAND, self._node, frames.raw, rows)
            latest = int(self._counter[self.samples - 1])
            self._commands += [(latest, amplitude) for amplitude in values[self._amplitude_row].tolist()]

    def _note_error(self, reference: Floats) -> None:
        back = int(self._counter[self.samples - 1]) - int(reference[2]) if self.samples else -1
        at = self.samples - 1 - back
        if 0 <= at < self.samples and self._counter[at] == reference[2]:
            self.latest_error = float(np.angle(np.exp(1j * (self._values[THETA, at] - reference[0]))))

    def record(self) -> Record:
        """Everything so far; the arrays are copies."""
        n = self.samples
        counter = self._counter[:n].copy()
        values = self._values[:, :n].copy()
        rate = self._rate or float("nan")
        reference = np.concatenate(self._references, axis=1) if self._references else np.zeros((3, 0))
        commands = np.array(self._commands, np.float64).reshape(-1, 2)
        marks = self._marks[:n]
        return Record(
            sample_rate=rate, counter=counter, time=counter / rate,
            theta=values[THETA], omega=values[OMEGA], sigma=values[SIGMA], excitation=values[EXCITATION],
            current=values[CURRENT], flags=self._flags[:n].copy(),
            injecting=marks & 1 != 0, filled=marks & 2 != 0,
            reference_counter=reference[2].astype(np.int64), reference_theta=reference[0],
            reference_omega=reference[1],
            command_time=commands[:, 0] / rate, command_amplitude=commands[:, 1],
            load=np.array(self._load), frames={kind: int(self._counts[kind]) for kind in MessageKind},
        )
