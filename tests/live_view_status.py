"""What the tests of the live view share: a status with everything in it, and frames of a drive."""

from __future__ import annotations

import math
from array import array

from ipmsm_can.cli.status import BusStatus, NodeStatus, RunStatus
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import RPM, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.status import Course, DriveView, Event, MonitorStatus, Told
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol

NODE = NodeStatus(
    node=3, motor="m2", state="locked", live=True, theta=math.radians(-30.0), sigma=math.radians(0.6), omega=314.2,
    rpm=1000.1, valid=True, locked=True, polarity_known=True, excitation=5.83, injection="on, 6.0 V: low speed",
    injecting=True, amplitude=6.0, hf_current=0.35, sample_rate=10000.0, samples_per_s=9999.0,
    estimates_per_s=1000.0, received=123456, lost=7, filled=5, gaps=1, duplicates=2, reordered=3, resyncs=4,
    restarts=6, bad_frames=8, rejected_commands=0)
BUS = BusStatus(
    description="can0 (SocketCAN, kernel time stamps)", load=0.573, frames=1234567, frames_per_s=5560.0, sent=99,
    unsent=11, late=9, unknown=12, remote=13, wrong_length=14, drops=15, error_frames=2,
    errors="2 error frames: 2 x bus-off; now bus-off (silent)", turnaround_p50=120e-6, turnaround_p99=240e-6)
_RAMP = array("f", [float(k) for k in range(240)])
COURSE = Course(0.4, _RAMP, array("f", [v + 5.0 for v in _RAMP]), array("f", [0.5] * 240), array("f", [2.0] * 240))
DRIVE = DriveView(node=NODE, rpm=999.9, rpm_sigma=0.41, i_rms=2.34, i_peak=3.61, i_d=-0.52, i_q=3.27, v_rms=87.6,
                  rated=1.66, order="", course=COURSE)
FINDINGS = (
    Told("error", "The frames take 97 % of the bus time, so others wait.", "Send less.", "14:03:12"),
    Told("warning", "Samples of drive 3 are missing: 7 of 123463, and 8 frames were damaged.", "", "14:03:13"),
    Told("notice", "12 identifiers are not in the database.", "Name it with --dbc.", "14:03:15"),
)
EVENTS = (Event("14:03:10", "recording to run.blf"), Event("14:03:11", "mark 1"), Event("14:03:12", "mark 2"))
STATUS = MonitorStatus(
    run=RunStatus("ipmsm-can monitor", 83.0, False, BUS, (NODE,)), drives=(DRIVE,), source=BUS.description,
    recording="run.blf 12.3 MB", checked="the bus, drive 3", findings=FINDINGS, events=EVENTS)


def samples(n: int, rate: float = 10_000.0, t0_ns: int = 10**18, rpm: float = 600.0) -> FrameBlock:
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=rate, current_noise=0.02),
                                 constant(rpm * RPM, 1.0, 60.0))
    return DriveNode(Protocol(), 0, simulation, DriveNodeSettings(fd=True)).step(n, t0_ns).frames
