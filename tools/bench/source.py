"""Traffic for the measurements on a bus: a drive's frames, simulated beforehand, sent in real time.

Run as a process of its own: `python -m tools.bench.source vcan0 --rate 5000 --seconds 10 [--fd] [--tick 0.001]`.
Prints how many frames went out.
"""

from __future__ import annotations

import argparse
import ctypes
import socket
import time

import numpy as np

from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CANFD_FDF, FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol


def drive_frames(rate: float, seconds: float, fd: bool) -> FrameBlock:
    """What a drive at 1000 rpm with torque pulses puts on the bus; t_ns counts from 0."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=rate), profile.torque_pulses())
    node = DriveNode(Protocol(), 0, simulation, DriveNodeSettings(fd=fd))
    return node.step(int(rate * seconds)).frames


class Sender:
    """Sends frames at their times with two system calls a group and next to no work between: everything that
    the kernel needs is laid out beforehand.

    tick_s: frames that fall due within a tick go out together at its end; 0: each frame by itself.
    """

    def __init__(self, channel: str, frames: FrameBlock, tick_s: float) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        self._socket.bind((channel,))
        n = len(frames)
        self._raw = frames.raw.copy()
        is_fd = self._raw[:, 5] & CANFD_FDF != 0
        self._raw[~is_fd, 5] = 0
        self._iov = np.zeros((n, 2), np.int64)
        self._iov[:, 0] = self._raw.ctypes.data + 72 * np.arange(n)
        self._iov[:, 1] = np.where(is_fd, 72, 16)
        self._headers = np.zeros((n, 8), np.int64)
        self._headers[:, 2] = self._iov.ctypes.data + 16 * np.arange(n)
        self._headers[:, 3] = 1
        due = frames.t_ns if tick_s == 0.0 else -(-frames.t_ns // round(1e9 * tick_s)) * round(1e9 * tick_s)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(due)) + 1, [n]])
        self._groups = list(zip(starts[:-1].tolist(), np.diff(starts).tolist(), due[starts[:-1]].tolist(),
                                strict=True))

    def run(self) -> int:
        """Send everything in real time; returns how many frames went out."""
        libc = ctypes.CDLL(None, use_errno=True)
        handle, base = self._socket.fileno(), self._headers.ctypes.data
        nanosleep, sendmmsg = libc.clock_nanosleep, libc.sendmmsg
        moment = (ctypes.c_long * 2)()
        begin = time.monotonic_ns() + 10_000_000
        sent = 0
        for first, count, due in self._groups:
            moment[0], moment[1] = divmod(begin + due, 1_000_000_000)
            nanosleep(time.CLOCK_MONOTONIC, 1, moment, None)
            sent += max(0, sendmmsg(handle, ctypes.c_void_p(base + 64 * first), count, 0))
        return sent


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("channel")
    parser.add_argument("--rate", type=float, default=5000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--fd", action="store_true")
    parser.add_argument("--tick", type=float, default=0.0)
    args = parser.parse_args()
    sender = Sender(args.channel, drive_frames(args.rate, args.seconds, args.fd), args.tick)
    print("ready", flush=True)
    input()
    print(sender.run(), flush=True)


if __name__ == "__main__":
    main()
