"""Error frames in plain words: what the CAN controller says about the bus and about itself.

The controller's driver reports errors as rows with CAN_ERR_FLAG: the identifier holds class bits, the
eight data bytes the details.  Source of all constants: <linux/can/error.h>.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import CAN_EFF_MASK, CAN_ERR_FLAG, FrameBlock


class ErrorClass(IntFlag):
    """Class bits in the identifier of an error frame (CAN_ERR_*)."""

    TX_TIMEOUT = 0x001
    LOST_ARBITRATION = 0x002
    CONTROLLER = 0x004
    PROTOCOL = 0x008
    TRANSCEIVER = 0x010
    NO_ACK = 0x020
    BUS_OFF = 0x040
    BUS_ERROR = 0x080
    RESTARTED = 0x100
    COUNTERS = 0x200


class BusState(IntEnum):
    """What the controller may do: from ACTIVE on, each state is worse than the one before."""

    UNKNOWN = -1
    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


_CLASS_WORDS = {
    ErrorClass.TX_TIMEOUT: "transmit time-out",
    ErrorClass.LOST_ARBITRATION: "arbitration lost",
    ErrorClass.CONTROLLER: "controller problem",
    ErrorClass.PROTOCOL: "protocol violation",
    ErrorClass.TRANSCEIVER: "transceiver problem",
    ErrorClass.NO_ACK: "no acknowledgement (nobody else on the bus, or another bit rate)",
    ErrorClass.BUS_OFF: "bus-off",
    ErrorClass.BUS_ERROR: "bus error",
    ErrorClass.RESTARTED: "controller restarted",
}

_RX_OVERFLOW, _TX_OVERFLOW = 0x01, 0x02
_RX_WARNING, _TX_WARNING, _RX_PASSIVE, _TX_PASSIVE, _AGAIN_ACTIVE = 0x04, 0x08, 0x10, 0x20, 0x40

PROTOCOL_WORDS = {
    0x01: "single bit error", 0x02: "frame format error", 0x04: "bit stuffing error",
    0x08: "dominant bit not sent", 0x10: "recessive bit not sent", 0x20: "bus overload",
    0x40: "active error announcement", 0x80: "while transmitting",
}
LOCATION_WORDS = {
    0x02: "ID bits 28 to 21", 0x03: "start of frame", 0x04: "substitute RTR bit",
    0x05: "identifier extension",
    0x06: "ID bits 20 to 18", 0x07: "ID bits 17 to 13", 0x08: "CRC sequence", 0x09: "reserved bit 0",
    0x0A: "data", 0x0B: "data length code", 0x0C: "RTR bit", 0x0D: "reserved bit 1", 0x0E: "ID bits 4 to 0",
    0x0F: "ID bits 12 to 5", 0x12: "intermission", 0x18: "CRC delimiter", 0x19: "ACK slot",
    0x1A: "end of frame", 0x1B: "ACK delimiter",
}
STATE_WORDS = {
    BusState.UNKNOWN: "state not told", BusState.ACTIVE: "error active (normal)",
    BusState.WARNING: "error warning (a counter above 96)",
    BusState.PASSIVE: "error passive (a counter above 127)", BusState.BUS_OFF: "bus-off (silent)",
}


@dataclass(frozen=True, slots=True)
class ErrorFrames:
    """The M error frames of a block, as arrays.

    row: intp (M,), their rows in the block.  t_ns: int64 (M,).
    kind: uint32 (M,), `ErrorClass` bits.
    state: int8 (M,), the `BusState` the frame tells, UNKNOWN where it tells none.
    rx_overflow, tx_overflow: bool (M,), the controller lost frames of ours.
    protocol, location: uint8 (M,), CAN_ERR_PROT_* bits and where in the frame; 0 where not told.
    tx_errors, rx_errors: int16 (M,), the controller's error counters 0..255, -1 where not told.
    """

    row: NDArray[np.intp]
    t_ns: NDArray[np.int64]
    kind: NDArray[np.uint32]
    state: NDArray[np.int8]
    rx_overflow: NDArray[np.bool_]
    tx_overflow: NDArray[np.bool_]
    protocol: NDArray[np.uint8]
    location: NDArray[np.uint8]
    tx_errors: NDArray[np.int16]
    rx_errors: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.row)

    def sentence(self, index: int) -> str:
        """One error frame in plain words."""
        kind = int(self.kind[index])
        parts = [words for bit, words in _CLASS_WORDS.items() if kind & bit and bit not in
                 (ErrorClass.CONTROLLER, ErrorClass.PROTOCOL)]
        if kind & ErrorClass.CONTROLLER:
            told = [STATE_WORDS[BusState(int(self.state[index]))]] if self.state[index] >= 0 else []
            told += ["receive buffer overflow"] if self.rx_overflow[index] else []
            told += ["transmit buffer overflow"] if self.tx_overflow[index] else []
            parts.append("controller: " + (", ".join(told) or "unspecified"))
        if kind & ErrorClass.PROTOCOL:
            bits = [w for bit, w in PROTOCOL_WORDS.items() if self.protocol[index] & bit]
            place = LOCATION_WORDS.get(int(self.location[index]))
            parts.append("protocol violation: " + (" ".join(bits) or "unspecified")
                         + (f" in {place}" if place else ""))
        if self.tx_errors[index] >= 0:
            parts.append(f"error counters tx {self.tx_errors[index]} rx {self.rx_errors[index]}")
        return "; ".join(parts) or f"unknown error class 0x{kind:X}"


def decode_errors(block: FrameBlock) -> ErrorFrames:
    """Pick the error frames out of a block and decode them; never raises, whatever the rows hold."""
    row = np.flatnonzero(block.can_id & CAN_ERR_FLAG)
    kind = block.can_id[row] & np.uint32(CAN_EFF_MASK)
    data = block.data[row, :8].copy()
    # bytes beyond the frame's length tell nothing
    data[np.arange(8) >= np.minimum(block.length[row], 8)[:, None]] = 0

    def has(*classes: ErrorClass) -> NDArray[np.bool_]:
        found: NDArray[np.bool_] = (kind & np.uint32(sum(classes))) != 0
        return found

    controller = np.where(has(ErrorClass.CONTROLLER), data[:, 1], 0)
    state = np.full(len(row), BusState.UNKNOWN, np.int8)
    # in rising order: where a frame tells more than one, the worst holds
    state[has(ErrorClass.RESTARTED) | ((controller & _AGAIN_ACTIVE) != 0)] = BusState.ACTIVE
    state[(controller & (_RX_WARNING | _TX_WARNING)) != 0] = BusState.WARNING
    state[(controller & (_RX_PASSIVE | _TX_PASSIVE)) != 0] = BusState.PASSIVE
    state[has(ErrorClass.BUS_OFF)] = BusState.BUS_OFF
    protocol = has(ErrorClass.PROTOCOL)
    counted = has(ErrorClass.COUNTERS) & (block.length[row] >= 8)
    return ErrorFrames(
        row=row, t_ns=block.t_ns[row], kind=kind, state=state,
        rx_overflow=(controller & _RX_OVERFLOW) != 0, tx_overflow=(controller & _TX_OVERFLOW) != 0,
        protocol=np.where(protocol, data[:, 2], 0).astype(np.uint8),
        location=np.where(protocol, data[:, 3], 0).astype(np.uint8),
        tx_errors=np.where(counted, data[:, 6].astype(np.int16), -1).astype(np.int16),
        rx_errors=np.where(counted, data[:, 7].astype(np.int16), -1).astype(np.int16))


class ErrorCounters:
    """What error frames told since the start; fed with blocks, has no clock.

    frames: error frames in all.  counts: per `ErrorClass`.  state: last `BusState` told.
    worst: worst state so far.  tx_errors, rx_errors: last counters told, -1 before any.
    bus_offs, restarts: how often.  last: the last error frame in plain words, "" before any.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.counts = dict.fromkeys(_CLASS_WORDS, 0)
        self.state = BusState.UNKNOWN
        self.worst = BusState.UNKNOWN
        self.tx_errors = -1
        self.rx_errors = -1
        self.overflows = 0
        self.last = ""

    @property
    def bus_offs(self) -> int:
        return self.counts[ErrorClass.BUS_OFF]

    @property
    def restarts(self) -> int:
        return self.counts[ErrorClass.RESTARTED]

    def update(self, block: FrameBlock) -> ErrorFrames:
        """Count a block's error frames; returns them."""
        errors = decode_errors(block)
        if not len(errors):
            return errors
        self.frames += len(errors)
        for bit in self.counts:
            self.counts[bit] += int(np.count_nonzero(errors.kind & np.uint32(bit)))
        told = errors.state[errors.state >= 0]
        if len(told):
            self.state = BusState(int(told[-1]))
            self.worst = max(self.worst, BusState(int(told.max())))
        counted = np.flatnonzero(errors.tx_errors >= 0)
        if len(counted):
            self.tx_errors = int(errors.tx_errors[counted[-1]])
            self.rx_errors = int(errors.rx_errors[counted[-1]])
        self.overflows += int(np.count_nonzero(errors.rx_overflow | errors.tx_overflow))
        self.last = errors.sentence(len(errors) - 1)
        return errors

    def kinds(self) -> dict[str, int]:
        """How often each class came that came at all, in words."""
        return {_CLASS_WORDS[bit]: n for bit, n in self.counts.items() if n}

    def summary(self) -> str:
        """One line for people."""
        if not self.frames:
            return "no error frames"
        told = [f"{n} x {words}" for words, n in self.kinds().items()]
        text = f"{self.frames} error frame{'s' if self.frames > 1 else ''}: "
        text += ", ".join(told) or "unknown class"
        if self.state >= 0:
            text += f"; now {STATE_WORDS[self.state]}"
            if self.worst > self.state:
                text += f", worst {STATE_WORDS[self.worst]}"
        if self.overflows:
            text += f"; controller buffer overflowed {self.overflows} x"
        if self.tx_errors >= 0:
            text += f"; error counters tx {self.tx_errors} rx {self.rx_errors}"
        return text
