"""What a display shows, as plain numbers and words.

Nothing here imports more than the standard library: a display runs in a process of its own, which is to be
there at once, and gets these objects through a pipe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ipmsm_can.bus.health_report import HealthReport
from ipmsm_can.record.status import RecordStatus


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """One drive as the companion sees it.

    live: samples are coming in; without it the numbers of the estimate are old and say nothing.
    theta, sigma [rad electrical], omega [rad/s electrical], rpm [1/min mechanical], excitation [V^2 s].
    hf_current, amplitude: measured current [A peak] and asked voltage [V peak] of the probing signal.
    injection: state and reason in words.  injecting: what the drive says.
    clipped: samples cut off at the end of their range; distrusting: what they spoiled has not faded yet.
    timing: how the voltage's timing is set right, "" where it is taken as it comes.
    ever_locked, ever_valid: the angle was, at some time since the beginning.
    encoder: what the drive's encoder says of the estimate, in words; empty where there is none or all is well.
    late: samples came so late that whole wraps of their counter may be missing.
    sample_rate: as the drive states it [Hz]; samples_per_s, estimates_per_s: counted.
    """

    node: int
    motor: str
    state: str
    live: bool
    theta: float
    sigma: float
    omega: float
    rpm: float
    valid: bool
    locked: bool
    polarity_known: bool
    excitation: float
    injection: str
    injecting: bool
    amplitude: float
    hf_current: float
    sample_rate: float
    samples_per_s: float
    estimates_per_s: float
    received: int
    lost: int
    filled: int
    gaps: int
    duplicates: int
    reordered: int
    resyncs: int
    restarts: int
    bad_frames: int
    rejected_commands: int
    clipped: int = 0
    distrusting: bool = False
    timing: str = ""
    ever_locked: bool = True
    ever_valid: bool = True
    encoder: str = ""
    late: bool = False

    @property
    def known(self) -> bool:
        """There is an angle at all, valid or not."""
        return self.live and self.sigma < math.pi and math.isfinite(self.theta)

    @property
    def trust(self) -> str:
        """How far to trust the angle, in words."""
        if not self.live:
            return "no estimate"
        if self.valid:
            return "VALID"
        if not self.known:
            return "NOT VALID: angle unknown"
        if not self.polarity_known:
            return "NOT VALID: may be half a turn off"
        if self.distrusting:
            return "NOT VALID: samples were cut off"
        if self.late:
            return "NOT VALID: samples too late"
        return "NOT VALID: not locked" if not self.locked else "NOT VALID: too uncertain"


@dataclass(frozen=True, slots=True)
class BusStatus:
    """The bus as this program sees it; load 0..1, turnaround [s], NaN before the first answer.

    unknown: identifiers that are none of ours.  drops: frames the kernel lost for want of buffer.
    errors: what error frames told, in words; error_frames: how many.
    late: estimates withheld because the program read their samples too late.
    no_bus: since when and why there is no bus, "" where there is.  outages: how often it went away, outage_time [s]
    in all.
    """

    description: str
    load: float
    frames: int
    frames_per_s: float
    sent: int
    unsent: int
    late: int
    unknown: int
    remote: int
    wrong_length: int
    drops: int
    error_frames: int
    errors: str
    turnaround_p50: float
    turnaround_p99: float
    no_bus: str = ""
    outages: int = 0
    outage_time: float = 0.0


@dataclass(frozen=True, slots=True)
class RunStatus:
    """Companion on a bus.  elapsed [s]; transmit: it may send.  records: what is recorded meanwhile."""

    title: str
    elapsed: float
    transmit: bool
    bus: BusStatus
    nodes: tuple[NodeStatus, ...]
    records: tuple[RecordStatus, ...] = ()


@dataclass(frozen=True, slots=True)
class DriveNodeStatus:
    """One simulated drive.

    time [s] of simulation.  rpm, reference_rpm: true and asked speed [1/min mechanical].  torque,
    load_torque [N m].  current: |i| [A peak].  waveform, amplitude [V peak]: probing signal it makes now.
    rejected: commands it refused.
    """

    node: int
    motor: str
    profile: str
    time: float
    rpm: float
    reference_rpm: float
    torque: float
    load_torque: float
    current: float
    waveform: str
    amplitude: float
    rejected: int


@dataclass(frozen=True, slots=True)
class DriveStatus:
    """Simulated drives on a bus.  elapsed [s]; slips: how often the machine was too slow for real time."""

    title: str
    elapsed: float
    duration: float
    description: str
    sent: int
    sent_per_s: float
    unsent: int
    slips: int
    nodes: tuple[DriveNodeStatus, ...]


@dataclass(frozen=True, slots=True)
class HealthStatus:
    """A bus that is listened to.  elapsed [s].  records: what is recorded meanwhile."""

    title: str
    elapsed: float
    report: HealthReport
    records: tuple[RecordStatus, ...] = ()


Status = RunStatus | DriveStatus | HealthStatus
