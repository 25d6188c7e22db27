"""MF4 bus logging written by asammdf itself, whole blocks at a time: python-can's writer takes 0.2 ms a message."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FrameBlock,
)

DLC = {length: dlc for dlc, length in enumerate([*range(9), 12, 16, 20, 24, 32, 48, 64])}


def write_mf4(path: Path, block: FrameBlock, channel: int | np.ndarray = 0, dlc_only: bool = False) -> None:
    """A group each of data, error and remote frames; the file's time 0 is whole seconds before the first frame.

    dlc_only: data frames without DataLength, IDE in bit 31 of the identifier, no EDL: as the least a file may have.
    """
    from asammdf import MDF, Signal, Source
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

    start_s = int(block.t_ns[0]) // 10**9
    seconds = (block.t_ns - start_s * 10**9) * 1e-9
    ids = block.can_id.astype(np.int64)
    error, remote = ids & CAN_ERR_FLAG != 0, ids & CAN_RTR_FLAG != 0
    channels = np.broadcast_to(np.asarray(channel, np.uint8), len(block))
    with MDF(version="4.10") as file:
        file.header.start_time = datetime.datetime.fromtimestamp(start_s, datetime.UTC)
        for name, rows in (("CAN_DataFrame", ~error & ~remote), ("CAN_ErrorFrame", error),
                           ("CAN_RemoteFrame", remote & ~error)):
            part, stored = block.take(rows), ids[rows]
            length = part.length
            fields: dict[str, Any] = {"BusChannel": channels[rows], "ID": (stored & CAN_EFF_MASK).astype(np.uint32),
                                      "DLC": np.array([DLC[n] for n in length.tolist()], np.uint8)}
            if dlc_only:
                fields["ID"] = stored.astype(np.uint32)
            else:
                fields["IDE"] = (stored & CAN_EFF_FLAG != 0).astype(np.uint8)
                for bit, flag in (("EDL", CANFD_FDF), ("BRS", CANFD_BRS), ("ESI", CANFD_ESI)):
                    fields[bit] = (part.flags & flag != 0).astype(np.uint8)
                fields["DataLength"] = length.copy()
            if name != "CAN_RemoteFrame":
                fields["DataBytes"] = part.data.copy()
            record = np.dtype([(f"{name}.{key}", value.dtype, value.shape[1:]) for key, value in fields.items()])
            samples = np.zeros(len(part), record)
            for key, value in fields.items():
                samples[f"{name}.{key}"] = value
            if len(part):
                file.append(Signal(name=name, samples=samples, timestamps=seconds[rows],
                                   source=Source("bus", "bus", "", SOURCE_BUS, BUS_TYPE_CAN)))
        file.save(path, overwrite=True, compression=2)
