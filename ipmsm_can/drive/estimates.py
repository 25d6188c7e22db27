"""What the drive makes of PositionEstimates: the rules of the C library (firmware_stub/src/receiver.c)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive.angle_source import AngleVerdict
from ipmsm_can.wire.e2e import E2EStatus, SequenceChecker
from ipmsm_can.wire.protocol import MessageKind, Protocol

FRAMES_MISSED = 7
"""Largest step of a counter that is taken for loss.  A larger one is an old frame that was held up somewhere; after
a loss that long it costs one frame more."""
SAMPLE_MASK = 0x3FF
"""PositionEstimate carries ten bits of the sample counter."""
_SIGNALS = ("theta_e", "omega_e", "sigma_theta", "sample_counter", "valid", "locked", "polarity_known")


@dataclass(frozen=True, slots=True)
class Estimate:
    """A PositionEstimate that was taken over.

    theta_e [rad electrical], omega_e [rad/s electrical].  sample: the drive's own counter of the sample it belongs
    to.  verdict: what it says of itself, whatever its age.
    """

    theta_e: float
    omega_e: float
    sample: int
    verdict: AngleVerdict


class EstimateReceiver:
    """PositionEstimates for one node.

    max_age: oldest estimate taken [samples], 1..1023.  sigma_limit: largest 1-sigma of a usable angle
    [deg electrical].
    For the first 1024 samples none is taken: the companion may still speak of samples of the drive's last run, and
    ten bits do not tell them from the new ones.  The C library also asks a clock how long ago an estimate came; a
    simulated drive has no clock but its samples.
    """

    def __init__(self, protocol: Protocol, node: int, max_age: int, sigma_limit: float) -> None:
        self.late = 0
        """Estimates too old when they came, or too early after the start."""
        self.counts = dict.fromkeys(E2EStatus, 0)
        self._protocol = protocol
        self._node = node
        self._max_age = max_age
        self._sigma_limit = sigma_limit
        self._checker = SequenceChecker(16, FRAMES_MISSED)
        index = protocol.codecs[MessageKind.POSITION_ESTIMATE].index
        self._rows = [index[name] for name in _SIGNALS]

    def take(self, raw: NDArray[np.uint8], rows: NDArray[np.intp], sample: int) -> Estimate | None:
        """The last estimate among these rows that can be taken over, None if there is none.

        raw: uint8 (N, 72); rows: those that are PositionEstimates of this node, in order of arrival.
        sample: counter of the drive's latest sample.
        """
        values, intact, counters = self._protocol.decode(MessageKind.POSITION_ESTIMATE, self._node, raw, rows)
        taken = None
        for column, status in zip(values[self._rows].T, self._checker.update(intact, counters), strict=True):
            self.counts[E2EStatus(status)] += 1
            if status > E2EStatus.OK_SOME_LOST or not all(map(math.isfinite, column)):
                continue
            theta, omega, sigma, counter, valid, locked, polarity_known = column.tolist()
            age = (sample - int(counter)) & SAMPLE_MASK
            if sample <= SAMPLE_MASK or age > self._max_age:
                self.late += 1
                continue
            certain = sigma <= self._sigma_limit  # "unknown" is the largest value there is
            taken = Estimate(theta, omega, sample - age,
                             _verdict(bool(valid), bool(locked and polarity_known), certain))
        return taken


def _verdict(valid: bool, holds: bool, certain: bool) -> AngleVerdict:
    """holds: locked, and of known polarity; certain: 1-sigma within the limit."""
    if not (holds and (valid or certain)):
        return AngleVerdict.INVALID
    if not certain:
        return AngleVerdict.UNCERTAIN
    return AngleVerdict.USABLE if valid else AngleVerdict.DOUBTFUL
