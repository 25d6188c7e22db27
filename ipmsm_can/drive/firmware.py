"""The simulated drive that speaks through the C library of firmware_stub instead of the package's own wire.

The machine, its control and its sensors are those of `DriveSimulation`; frames, checks of what is heard, and the
probing voltage are the library's, called in every control period as an interrupt would call it; where the control
runs on the companion's angle, the library decides whether it may and carries the angle on to the sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive.angle_source import T_SIZE, T_THETA, T_VERDICT
from ipmsm_can.drive.firmware_library import FirmwareError as FirmwareError
from ipmsm_can.drive.firmware_library import load
from ipmsm_can.drive.node import TEMPERATURE, DriveNode, DriveNodeSettings, Step
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.frames import FRAME_BYTES, FrameBlock
from ipmsm_can.wire.dbc import default_dbc_path
from ipmsm_can.wire.protocol import Protocol, Waveform

ANGLE_USABLE, ANGLE_MISSING, ANGLE_INVALID, ANGLE_UNCERTAIN, ANGLE_DOUBTFUL = range(5)
"""What the library says of the companion's angle: enum ipmsm_angle_verdict."""


@dataclass(frozen=True, slots=True)
class FirmwareStep(Step):
    """A `Step`, and what the drive thinks of the companion's angle, sample by sample.

    verdict: uint8 (n,), ANGLE_...  theta_e: float64 (n,), the angle at t_k [rad electrical], 0..2 pi; NaN where it
    may not be used.
    """

    verdict: NDArray[np.uint8]
    theta_e: NDArray[np.float64]


class Verdicts(NamedTuple):
    """Frames by what the end-to-end check said of them; lost ones are missing before those of `some_lost`."""

    ok: int
    some_lost: int
    repeated: int
    wrong_sequence: int
    wrong_crc: int


@dataclass(frozen=True, slots=True)
class FirmwareCounts:
    """estimates, commands: frames by verdict.  late: estimates too old when they came, or taken for the last run's.
    rejected: commands refused, whether by the check or because they cannot be executed."""

    estimates: Verdicts
    commands: Verdicts
    late: int
    rejected: int


class FirmwareNode(DriveNode):
    """A `DriveNode` whose wire is the C library.

    Its clock is the sample counter: what the library measures in microseconds passes in virtual time.  Frames
    are taken in with the next sample, 16 a sample at most.  The library never probes with more than the limit it
    was compiled with, 30 V, whatever the simulation allows.

    Raises FirmwareError where the library cannot be had, for a database that is not the project's own (the
    library's codec is generated from that), and for settings the library refuses.
    """

    def __init__(self, protocol: Protocol, node: int, simulation: DriveSimulation,
                 settings: DriveNodeSettings) -> None:
        super().__init__(protocol, node, simulation, settings)
        if protocol.database.source != str(default_dbc_path()):
            raise FirmwareError(f"wire.dbc is {protocol.database.source}; allowed with the C library is the "
                                "project's own, from which its codec is generated")
        self._ffi, self._library = load()
        # A cdata of the struct's size; uint64_t makes it aligned.
        self._memory = self._ffi.new("uint64_t[]", (self._library.blocks_size() + 7) // 8)
        self._drive = self._ffi.cast("struct blocks_drive *", self._memory)
        self._heard = FrameBlock.zeros(0)
        parameters = simulation.parameters
        wanted = self._ffi.new("struct blocks_settings *", {
            "node": node, "fd": settings.fd, "sample_rate": parameters.sample_rate,
            "probing_limit": parameters.injection_limit, "probing_ramp": parameters.injection_ramp,
            "sigma_limit": parameters.angle_sigma_limit,
            "estimate_time_to_live_us": round(1e6 * parameters.estimate_time_to_live),
            "timing_every": self.every(settings.timing_rate), "status_every": self.every(settings.status_rate),
            "reference_every": self.every(settings.reference_rate), "v_dc": parameters.v_dc,
            "temperature": TEMPERATURE})
        if not self._library.blocks_init(self._drive, wanted):
            raise FirmwareError(f"the C library refuses node {node}, {parameters.sample_rate:g} Hz, probing limit "
                                f"{parameters.injection_limit:g} V, ramp {parameters.injection_ramp:g} V/s")

    def receive(self, block: FrameBlock) -> None:
        """Lay frames ready; they are looked at with the next sample."""
        self._heard = FrameBlock.concat([self._heard, block])

    def step(self, n: int, t0_ns: int = 0) -> FirmwareStep:
        """Run n samples; frames carry t0_ns plus the time of their sample."""
        probe, told = np.empty((4, n)), np.empty((T_SIZE, n))
        self._library.blocks_rehearse(self._drive, *self._waiting(), n, self._at("double *", probe),
                                      self._at("double *", told))
        s = self.simulation.run(n, probe, told)
        if n:
            self.waveform = Waveform(int(s.injection_waveform[-1]))
        samples = np.array([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta, self.encoder(s.theta_e), s.omega_e])
        out, at = np.empty((4 * n, FRAME_BYTES), np.uint8), np.empty(4 * n, np.int64)
        mode, faults = self._condition(s)
        at_once = np.zeros(n, np.int64)
        if self.settings.status_rate > 0.0:
            at_once[self._changes(s)] = 1
        condition = np.array([mode, faults, at_once]).astype(np.uint8)
        used = self._ffi.new("size_t *")
        sent = self._library.blocks_run(
            self._drive, *self._waiting(), n, self._at("double *", samples), self._at("uint8_t *", condition),
            self._at("uint8_t *", out), self._at("int64_t *", at), used)
        self._heard = self._heard.take(slice(used[0], None))
        self.rejected = self.counts().rejected
        return FirmwareStep(FrameBlock(out[:sent].copy(), self.time_of(at[:sent], t0_ns)), s,
                            told[T_VERDICT].astype(np.uint8), told[T_THETA])

    def counts(self) -> FirmwareCounts:
        """What became of the frames it heard."""
        counts = self._ffi.new("struct blocks_counts *")
        self._library.blocks_count(self._drive, counts)
        return FirmwareCounts(Verdicts(*counts.estimates), Verdicts(*counts.commands), counts.late, counts.rejected)

    def _waiting(self) -> tuple[Any, int]:
        return self._at("uint8_t *", self._heard.raw), len(self._heard)

    def _at(self, kind: str, array: NDArray[Any]) -> Any:
        return self._ffi.cast(kind, array.ctypes.data)
