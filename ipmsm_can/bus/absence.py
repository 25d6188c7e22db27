"""Why a log has no samples of a drive, in one sentence: which identifiers were looked for, and which were seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, CAN_SFF_MASK, FrameBlock
from ipmsm_can.wire.protocol import MessageKind, Protocol

_IDS_SHOWN = 12
_EXTENDED_KEPT = 1000


class Identifiers:
    """The identifiers of a log.  standard (2048,), extended: frames by identifier, and which there were."""

    def __init__(self) -> None:
        self.standard = np.zeros(CAN_SFF_MASK + 1, np.int64)
        self.extended: set[int] = set()

    def note(self, block: FrameBlock) -> None:
        """Take in the next frames."""
        ids = block.can_id
        plain = ids[(ids & np.uint32(CAN_EFF_FLAG | CAN_ERR_FLAG)) == 0] & np.uint32(CAN_SFF_MASK)
        self.standard += np.bincount(plain, minlength=CAN_SFF_MASK + 1)
        extended = ids[(ids & np.uint32(CAN_EFF_FLAG | CAN_ERR_FLAG)) == CAN_EFF_FLAG]
        if extended.size and len(self.extended) < _EXTENDED_KEPT:
            self.extended.update(np.unique(extended & np.uint32(CAN_EFF_MASK)).tolist())

    def sample_frames(self, node: int, protocol: Protocol) -> int:
        """How many frames had the identifiers of this drive's samples."""
        return sum(int(self.standard[protocol.base_ids[kind] + node])
                   for kind in (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK))

    def __str__(self) -> str:
        names = [f"0x{k:X}" for k in self.standard.nonzero()[0].tolist()]
        names += [f"0x{k:08X}" for k in sorted(self.extended)]
        if not names:
            return "no identifiers at all"
        more = f" and {len(names) - _IDS_SHOWN} more" if len(names) > _IDS_SHOWN else ""
        return ", ".join(names[:_IDS_SHOWN]) + more


def absence(node: int, seen: Identifiers, protocol: Protocol, waiting: bool, bad_frames: int, log: Path,
            channel: str | None) -> str:
    """Why there is not one sample of this node.

    waiting: samples came, and no DriveTiming; bad_frames: of this node, that were dropped.
    """
    came = seen.sample_frames(node, protocol)
    if came and waiting:
        return (f"{log} holds {came} sample frames of node {node} but no DriveTiming, so their rate is unknown; "
                "set wire.sample_rate in the drive's TOML file")
    if came:
        return f"none of the {came} sample frames of node {node} in {log} could be used ({bad_frames} bad)"
    ids = " and ".join(f"0x{protocol.base_ids[kind] + node:X}"
                       for kind in (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK))
    if channel is not None and not (seen.standard.any() or seen.extended):
        return f"{log} holds no frame of channel {channel!r}; without --channel those of every channel are taken"
    where = "" if channel is None else f" on channel {channel!r}"
    return f"{log} holds no sample frame of node {node}{where} (identifiers {ids}); seen were {seen}"
