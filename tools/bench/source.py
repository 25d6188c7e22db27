"""Traffic for the measurements on a bus: a drive's frames, simulated beforehand, sent in real time.

Run as a process of its own: `python -m tools.bench.source vcan0 --rate 5000 --seconds 10 [--fd]`.  Prints how
many frames of each kind went out.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol


def drive_frames(rate: float, seconds: float, fd: bool) -> FrameBlock:
    """What a drive at 1000 rpm with torque pulses puts on the bus; t_ns counts from 0."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=rate), profile.torque_pulses())
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings(fd=fd))
    return node.step(int(rate * seconds)).frames


def send_in_real_time(port: SocketCanPort, frames: FrameBlock) -> tuple[int, float]:
    """Send each frame when it is due, as exactly as sleeping allows; returns (frames sent, latest lag in s)."""
    due = frames.t_ns
    begin = time.monotonic_ns()
    at, sent, lag = 0, 0, 0
    while at < len(frames):
        now = time.monotonic_ns() - begin
        upto = int(np.searchsorted(due, now, side="right"))
        if upto > at:
            lag = max(lag, now - int(due[at]))
            sent += port.send(frames.take(slice(at, upto)))
            at = upto
        else:
            time.sleep(max(1e-6, 1e-9 * (int(due[at]) - now)))
    return sent, 1e-9 * lag


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("channel")
    parser.add_argument("--rate", type=float, default=5000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--fd", action="store_true")
    args = parser.parse_args()
    frames = drive_frames(args.rate, args.seconds, args.fd)
    with SocketCanPort(args.channel) as port:
        print("ready", flush=True)
        input()
        sent, lag = send_in_real_time(port, frames)
    print(f"{sent} {len(frames)} {lag}", flush=True)


if __name__ == "__main__":
    main()
