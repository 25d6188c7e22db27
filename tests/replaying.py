"""What the tests of replay share: a drive's frames, its configuration, and the rows that come of them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ipmsm_can.bus.replay import Replay, prepare
from ipmsm_can.bus.rows import RowBlock
from ipmsm_can.config import DriveConfig, config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import Protocol, Waveform

T0 = 1_700_000_000_000_000_000
RATE = 5000.0
DRIVE = '[motor]\npreset = "m2"\n[observer]\nalpha = 5\ngamma = 50\n[wire]\nnode = {node}\n{wire}'


def drive_frames(protocol: Protocol, seconds: float, node: int = 0, fd: bool = False, noise: float = 0.02,
                 **rates: Any) -> FrameBlock:
    """What a drive at 1000 rpm with load pulses sends, an injection in the middle included."""
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=RATE, current_noise=noise),
                                 profile.torque_pulses(), seed=node)
    drive = DriveNode(protocol, node, simulation, DriveNodeSettings(fd=fd, **rates))
    n = int(seconds * RATE)
    first = drive.step(n // 2, T0).frames
    simulation.command_injection(int(Waveform.ROTATING), 6.0, 400.0, 0.0, int(0.25 * RATE))
    return FrameBlock.concat([first, drive.step(n - n // 2, T0).frames])


def config(node: int = 0, **wire: object) -> DriveConfig:
    return config_from({"motor": {"preset": "m2"}, "observer": {"alpha": 5, "gamma": 50},
                        "wire": {"node": node, **wire}})


def toml(tmp_path: Path, node: int = 0, wire: str = "") -> str:
    path = tmp_path / f"drive{node}.toml"
    path.write_text(DRIVE.format(node=node, wire=wire))
    return str(path)


def rows_of(frames: FrameBlock, configs: list[DriveConfig], protocol: Protocol,
            edges: list[int] | None = None) -> dict[int, list[RowBlock]]:
    found: dict[int, list[RowBlock]] = {c.wire.node: [] for c in configs}
    cuts = [0, *(edges or []), len(frames)]
    pieces = [frames.take(slice(a, b)) for a, b in pairwise(cuts)]
    chosen, again = prepare(configs, protocol, pieces)
    replay = Replay(chosen, protocol, lambda node, rows: found[node].append(rows))
    for piece in again:
        replay.feed(piece)
    return found


def column(blocks: list[RowBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(b, name) for b in blocks])
