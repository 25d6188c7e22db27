"""Status in plain text: one line now and then for logs and pipes, and the summary at the end."""

from __future__ import annotations

import math

from ipmsm_can.bus import health_words
from ipmsm_can.cli.status import BusStatus, DriveStatus, HealthStatus, NodeStatus, RunStatus, Status
from ipmsm_can.record.status import RecordStatus

SILENT = "SILENT (listening only)"
TRANSMITTING = "TRANSMITTING"


def voice(status: RunStatus) -> str:
    """Whether the program sends: the one thing that must never be in doubt."""
    return TRANSMITTING if status.transmit else SILENT


def clock(seconds: float) -> str:
    """h:mm:ss."""
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def angle(node: NodeStatus) -> str:
    """Electrical angle 0..360 with its 1-sigma, or that there is none."""
    if not node.known:
        return "unknown"
    return f"{math.degrees(node.theta) % 360.0:5.1f} deg +/- {math.degrees(node.sigma):.1f}"


def turnaround(bus: BusStatus) -> str:
    """p50 and p99."""
    if math.isnan(bus.turnaround_p50):
        return "no answer sent yet"
    return f"p50 {1e6 * bus.turnaround_p50:.0f} us  p99 {1e6 * bus.turnaround_p99:.0f} us"


def losses(node: NodeStatus) -> list[tuple[str, int]]:
    """What went wrong with the samples, in the order of the display."""
    return [("lost", node.lost), ("filled", node.filled), ("gaps", node.gaps), ("bad frames", node.bad_frames),
            ("duplicates", node.duplicates), ("reordered", node.reordered), ("resyncs", node.resyncs),
            ("restarts", node.restarts), ("cut off", node.clipped)]


def bus_troubles(bus: BusStatus) -> list[tuple[str, int]]:
    """What went wrong on the bus, in the order of the display."""
    return [("unknown ids", bus.unknown), ("wrong length", bus.wrong_length), ("remote", bus.remote),
            ("kernel drops", bus.drops)]


def recorded(records: tuple[RecordStatus, ...]) -> str:
    """"REC run.blf 1.2 MB | ", or "" where nothing is recorded."""
    return "".join(f"{record.words} | " for record in records)


def line(status: Status) -> str:
    """One line."""
    if isinstance(status, HealthStatus):
        return health_line(status)
    if isinstance(status, DriveStatus):
        drives = " | ".join(
            f"drive {n.node} {n.rpm:+.1f} rpm (asked {n.reference_rpm:+.1f}), {n.torque:+.2f} N m, "
            f"probing {n.waveform} {n.amplitude:.1f} V" for n in status.nodes)
        return (f"{clock(status.elapsed)} {TRANSMITTING} {status.sent_per_s:.0f} frames/s unsent {status.unsent} "
                f"| {drives}")
    bus = status.bus
    if bus.no_bus:
        return f"{clock(status.elapsed)} {voice(status)} {recorded(status.records)}{bus.no_bus}"
    text = (f"{clock(status.elapsed)} {voice(status)} {recorded(status.records)}load {100 * bus.load:.1f} % "
            f"{bus.frames_per_s:.0f} frames/s drops {bus.drops}")
    if bus.outages:
        text += f" outages {bus.outages}"
    if bus.error_frames:
        text += f" error frames {bus.error_frames}"
    for n in status.nodes:
        text += f" | drive {n.node} {n.state}"
        if n.live:
            text += (f", {n.trust}, {angle(n).strip()}, {n.rpm:+.1f} rpm, probing {n.injection}, "
                     f"lost {n.lost} bad {n.bad_frames}" + (f", {n.timing}" if n.timing else ""))
            if n.encoder:
                text += f", encoder {n.encoder}"
    return text


def health_line(status: HealthStatus) -> str:
    """One line of a bus that is listened to."""
    r = status.report
    begin = f"{clock(status.elapsed)} {SILENT} {recorded(status.records)}"
    if r.no_bus:
        return begin + r.no_bus
    text = begin + f"load {100 * r.load:.1f} % frames {r.frames} ids {len(r.ids)}"
    if r.kernel_drops >= 0:
        text += f" drops {r.kernel_drops}"
    if r.errors.frames:
        text += f" error frames {r.errors.frames}"
    first = next((f for f in r.findings if f.severity != "notice"), None)
    return text + (f" | {first.sentence}" if first else "")


def summary(status: Status) -> str:
    """What happened, when all is over."""
    if isinstance(status, HealthStatus):
        return health_words.text(status.report)
    if isinstance(status, DriveStatus):
        text = f"{status.sent} frames sent in {status.elapsed:.1f} s, {status.unsent} unsent"
        if status.slips:
            text += f"; this machine was too slow for real time {status.slips} times"
        refused = [f"drive {n.node} refused {n.rejected} commands" for n in status.nodes if n.rejected]
        return "; ".join([text, *refused])
    bus = status.bus
    lines = [f"{voice(status)} for {status.elapsed:.1f} s on {bus.description}: {bus.frames} frames received, "
             f"{bus.sent} sent, load at the end {100 * bus.load:.1f} %",
             "bus: " + ", ".join(f"{name} {n}" for name, n in bus_troubles(bus)) + f"; {bus.errors}"]
    if bus.outages:
        times = "once" if bus.outages == 1 else f"{bus.outages} times"
        lines.append(f"the bus went away {times}, for {bus.outage_time:.1f} s in all"
                     + (f"; {bus.no_bus}" if bus.no_bus else "; it came back by itself"))
    if status.transmit:
        lines.append(f"answers: turnaround {turnaround(bus)}, unsent {bus.unsent}, too late {bus.late}")
    for n in status.nodes:
        if not n.received:
            why = f"no sample could be used: {n.state}" if "DriveTiming" in n.state else "no samples came"
            lines.append(f"drive {n.node} ({n.motor}): {why}")
            continue
        lines.append(f"drive {n.node} ({n.motor}): {n.received} samples, "
                     + ", ".join(f"{name} {count}" for name, count in losses(n)))
        known = f", {n.trust}, {angle(n).strip()}, {n.rpm:+.1f} rpm" if n.live else ""
        lines.append(f"  last: {n.state}{known}")
        if n.timing:
            lines.append(f"  {n.timing}")
        if n.encoder:
            lines.append(f"  encoder: {n.encoder}")
        if not n.ever_locked:
            lines.append("  the observer never locked: no angle of this drive could be used")
        elif not n.ever_valid:
            lines.append("  the angle was never valid")
    return "\n".join(lines)
