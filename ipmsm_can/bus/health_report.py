"""What is known of a bus as plain numbers and words; made by `BusHealth`, shown by `ipmsm-can bus`.

Nothing here imports more than the standard library: a display in a process of its own gets these objects through a
pipe.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Finding:
    """severity: "error", "warning" or "notice".  sentence: what is the matter.  advice: what to do, or ""."""

    severity: str
    sentence: str
    advice: str = ""


@dataclass(frozen=True, slots=True)
class IdHealth:
    """One identifier.

    name: of the message, "" where no database knows it.  rate [1/s]; NaN before the second frame.
    period [s]: the usual gap between two frames (mean of those within a factor of 2 around the median).
    jitter [s]: standard deviation of the gap.  max_gap [s] and when it began, max_gap_at [s from the first frame].
    steady: at least 80 % of the gaps are within half and twice the usual one, so it is sent by the clock.
    least, most: frames in a whole second, -1 before there was one.  length: payload bytes, the last;
    min_length, max_length; length_changes: how often it differed from the one before.  share: of the bus time that
    all frames took, 0..1.
    """

    can_id: int
    extended: bool
    name: str
    count: int
    rate: float
    period: float
    jitter: float
    max_gap: float
    max_gap_at: float
    steady: bool
    least: int
    most: int
    length: int
    min_length: int
    max_length: int
    length_changes: int
    remote: int
    fd: bool
    share: float

    @property
    def label(self) -> str:
        """Identifier as in candump, and its name."""
        number = f"{self.can_id:08X}" if self.extended else f"{self.can_id:03X}"
        return f"0x{number} {self.name}" if self.name else f"0x{number}"


@dataclass(frozen=True, slots=True)
class DriveHealth:
    """Samples of one drive by its counter.

    sequenced: False while samples wait for a DriveTiming, so that nothing can be said.  lost: counter values that
    never came; gaps: silences too long to fill; bad_frames: wrong checksum or impossible content.
    drift_ppm: how much faster its clock runs than this computer's, and its 1-sigma; NaN where not known.
    """

    node: int
    sequenced: bool
    sample_rate: float
    received: int
    lost: int
    gaps: int
    restarts: int
    duplicates: int
    reordered: int
    bad_frames: int
    drift_ppm: float
    drift_sigma_ppm: float
    drift_span: float


@dataclass(frozen=True, slots=True)
class ErrorHealth:
    """What error frames told.  decoded: their classes mean something (they come from SocketCAN).

    state, worst: of the controller, in words, "" where not told.  kinds: how often each class; violations: how
    often each protocol error; places: where in the frame, most frequent first.  tx_errors, rx_errors: the
    controller's counters, -1 where not told.  overflows: frames the controller itself lost for want of room.
    """

    frames: int
    decoded: bool
    state: str
    worst: str
    bus_offs: int
    restarts: int
    passive: bool
    kinds: dict[str, int]
    violations: dict[str, int]
    places: dict[str, int]
    tx_errors: int
    rx_errors: int
    overflows: int


@dataclass(frozen=True, slots=True)
class HealthReport:
    """A bus.  All times in s, loads 0..1, first and last frame as Unix time [s], NaN before any.

    assumed_rates: nobody said the bit rates.  load: of the last second; mean_load: since the first frame;
    peak_load: of the busiest second by the clock, peak_at: when it began.
    kernel_drops: frames the kernel lost for want of buffer, -1 where nobody tells.  uncounted: frames of
    identifiers beyond those that are told apart.  outages: how often the bus went away, outage_time in all.
    no_bus: why there is none now, "" where there is.  known_ids: identifiers the database has, 0 for none given.
    """

    source: str
    duration: float
    first: float
    last: float
    bitrate: float
    data_bitrate: float
    assumed_rates: bool
    frames: int
    load: float
    mean_load: float
    peak_load: float
    peak_at: float
    silence: float
    silence_at: float
    back: int
    kernel_drops: int
    uncounted: int
    outages: int
    outage_time: float
    no_bus: str
    database: str
    ids: tuple[IdHealth, ...]
    drives: tuple[DriveHealth, ...]
    errors: ErrorHealth
    findings: tuple[Finding, ...] = ()

    @property
    def unknown(self) -> list[IdHealth]:
        """Identifiers that the database does not have."""
        return [one for one in self.ids if not one.name] if self.database else []

    def to_dict(self) -> dict[str, Any]:
        """For JSON: numbers that are not known are None."""
        plain: dict[str, Any] = _plain(dataclasses.asdict(self))
        for one, row in zip(self.ids, plain["ids"], strict=True):
            row["label"] = one.label
        return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
