"""Compile or load every kernel that a live bus will need, before the bus is opened.

numba compiles at the first call: for a minute on a machine that never ran the program, and for tens of
milliseconds out of its cache.  The first frames of a live bus must not wait for that.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence

import numpy as np

from ipmsm_can.bus import lane
from ipmsm_can.bus.bits import BusLoad
from ipmsm_can.companion import Companion
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import (
    BLOCK_SAMPLES,
    PROTOCOL_VERSION,
    DriveMode,
    MessageKind,
    Protocol,
    Waveform,
)

_RATE = 5000.0
_SAMPLES = 420
_STEP = 42


def warm_up_companion(configs: Sequence[DriveConfig], protocol: Protocol) -> None:
    """Run a companion like the one to come over a tenth of a second of made-up frames of either kind."""
    for fd in (False, True):
        companion = Companion(configs, protocol, transmit=True)
        load = BusLoad(1e6, 5e6)
        for begin in range(0, _SAMPLES, _STEP):
            frames = FrameBlock.concat([_frames(protocol, c.wire.node, begin, fd) for c in configs])
            if begin == 3 * _STEP:
                frames = frames.take(np.arange(len(frames)) != 5)  # one loss, to be filled
            elif begin == 5 * _STEP:
                continue  # and a gap
            now = int(frames.t_ns[-1]) if len(frames) else 0
            for part in (frames.take(slice(0, 1)), frames.take(slice(1, None))):
                load.update(part)
                load.update(companion.respond(companion.feed(part), now))
            companion.bus_load = load.load(now)
        if len(configs) == 1 and not fd:
            lane.warm_up(companion)
    _set_aside()


def _set_aside() -> None:
    """Keep what has been loaded out of the garbage collector's rounds.

    A full round over the objects of numba and python-can stops the process for 0.1 s, in the middle of a run.
    """
    gc.collect()
    gc.freeze()


def _frames(protocol: Protocol, node: int, begin: int, fd: bool) -> FrameBlock:
    """_STEP samples of a turning rotor from sample `begin` on, and one each of the drive's other messages."""
    k = np.arange(begin, begin + _STEP)
    turn = 0.06 * k
    values = {"i_alpha": np.cos(turn), "i_beta": np.sin(turn), "v_alpha": 100 * np.cos(turn),
              "v_beta": 100 * np.sin(turn)}
    last, one = k[-1:], np.ones(1)
    others = [
        protocol.encode(MessageKind.DRIVE_TIMING, node, {"sample_counter": last, "sample_rate": _RATE * one}),
        protocol.encode(MessageKind.DRIVE_STATUS, node, {"mode": DriveMode.RUNNING * one, "v_dc": 300 * one,
                                                         "protocol_version": PROTOCOL_VERSION * one}),
        protocol.encode(MessageKind.DRIVE_REFERENCE, node, {"sample_counter": last})]
    if fd:
        values["i_alpha"][0] = 1e9  # cut off
        starts = k[::BLOCK_SAMPLES]
        blocks = {f"{axis}_{j}": v[j::BLOCK_SAMPLES] for axis, v in values.items() for j in range(BLOCK_SAMPLES)}
        samples = protocol.encode(MessageKind.DRIVE_SAMPLE_BLOCK, node, {
            **blocks, "first_sample": starts, "sample_count": np.full(starts.size, BLOCK_SAMPLES)},
            starts // BLOCK_SAMPLES)
    else:
        samples = protocol.encode(MessageKind.DRIVE_SAMPLE, node, {**values, "sample_counter": k & 15})
    raw = np.concatenate([samples, *others])  # samples before the first DriveTiming: those have to wait for it
    # as if all had just arrived: what was sent first may be a tenth of a second old by now
    return FrameBlock(raw, np.full(raw.shape[0], round(1e9 * (begin + _STEP) / _RATE), np.int64))


def warm_up_drives(drives: Sequence[DriveNode], protocol: Protocol) -> None:
    """Let drives run for some samples and hear a command.  They are used up: build others for the bus."""
    for drive in drives:
        drive.step(_STEP)
        drive.receive(FrameBlock(protocol.encode(MessageKind.INJECTION_COMMAND, drive.node, {
            "waveform": float(Waveform.ROTATING), "amplitude": 1.0, "frequency": 400.0, "axis_angle": 0.0,
            "time_to_live": 100.0}, 0), np.zeros(1, np.int64)))
        drive.step(_STEP)
    _set_aside()
