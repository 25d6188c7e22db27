"""Any bus python-can can open as a `Port`, and its messages as rows and back."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ipmsm_can.bus.port import BusError, BusOffError
from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FRAME_BYTES,
    SENT,
    FrameBlock,
)

if TYPE_CHECKING:
    import can

_HEADER = struct.Struct("<IBB")
_SEND_PATIENCE_S = 0.02
_BUS_OFF = re.compile("bus[ _-]?off", re.IGNORECASE)


def block_from_messages(messages: Iterable[can.Message]) -> FrameBlock:
    """Rows of python-can messages, in their order; time stamps rounded to whole ns (a float holds about 240).

    A payload longer than its kind of frame allows is cut off.
    """
    rows = list(messages)
    raw = bytearray(FRAME_BYTES * len(rows))
    stamps = []
    at = 0
    for m in rows:
        room = 64 if m.is_fd else 8
        can_id = m.arbitration_id & (CAN_EFF_MASK if m.is_extended_id else CAN_SFF_MASK)
        if m.is_error_frame:
            can_id = (m.arbitration_id & CAN_EFF_MASK) | CAN_ERR_FLAG
        elif m.is_extended_id:
            can_id |= CAN_EFF_FLAG
        flags = 0
        if m.is_fd:
            flags = CANFD_FDF | (CANFD_BRS if m.bitrate_switch else 0) | (
                CANFD_ESI if m.error_state_indicator else 0)
        if m.is_remote_frame:
            can_id |= CAN_RTR_FLAG
            length, data = min(m.dlc, 8), b""
        else:
            data = bytes(m.data[:room])
            length = len(data)
        _HEADER.pack_into(raw, at, can_id, length, flags)
        raw[at + 8:at + 8 + len(data)] = data
        stamps.append(round(m.timestamp * 1e9))
        at += FRAME_BYTES
    return FrameBlock(np.frombuffer(raw, np.uint8).reshape(-1, FRAME_BYTES), np.array(stamps, np.int64))


def messages_from_block(block: FrameBlock, channel: str | None = None) -> list[can.Message]:
    """The rows as python-can messages, with `channel` written into each."""
    import can

    raw = np.ascontiguousarray(block.raw).tobytes()
    messages = []
    for row, t_ns in enumerate(block.t_ns.tolist()):
        at = FRAME_BYTES * row
        can_id, length, flags = _HEADER.unpack_from(raw, at)
        is_fd = bool(flags & CANFD_FDF)
        is_error = bool(can_id & CAN_ERR_FLAG)
        is_extended = bool(can_id & CAN_EFF_FLAG)
        is_remote = bool(can_id & CAN_RTR_FLAG)
        length = min(length, 64 if is_fd else 8)
        messages.append(can.Message(
            timestamp=t_ns * 1e-9,
            arbitration_id=can_id & (CAN_EFF_MASK if is_extended or is_error else CAN_SFF_MASK),
            is_extended_id=is_extended, is_remote_frame=is_remote, is_error_frame=is_error, is_fd=is_fd,
            bitrate_switch=bool(flags & CANFD_BRS), error_state_indicator=bool(flags & CANFD_ESI),
            is_rx=not raw[at + 6] & SENT, dlc=length, data=None if is_remote else raw[at + 8:at + 8 + length],
            channel=channel))
    return messages


class PythonCanPort:
    """A python-can bus as a `Port`.

    bus: any open `can.BusABC`; `close` shuts it down.
    name: for `description`; default is what the bus calls itself.
    max_frames: largest block `receive` returns.

    `drops` is always 0: python-can does not say.  Time stamps are the adapter's; a message without one
    gets the time of reading.
    """

    def __init__(self, bus: can.BusABC, *, name: str | None = None, max_frames: int = 256) -> None:
        self._bus = bus
        self._name = name or str(bus.channel_info)
        self._max_frames = max_frames
        self._unsent = 0
        self._closed = False
        self._watching = False

    @classmethod
    def open(cls, config: Mapping[str, Any]) -> PythonCanPort:
        """Open with the keywords of `can.Bus`.

        Raises ValueError for an unknown interface, BusError when the adapter cannot be opened.
        """
        import can

        options = dict(config)
        name = f"{options.get('interface')} {options.get('channel')}"
        if options.get("interface") not in can.VALID_INTERFACES:
            raise ValueError(f"CAN interface is {options.get('interface')!r}; allowed is one of "
                             f"{', '.join(sorted(can.VALID_INTERFACES))}")
        if options.get("interface") == "virtual" and options.get("fd"):
            options.setdefault("protocol", can.CanProtocol.CAN_FD)
        try:
            bus = can.Bus(**options)
        except Exception as error:  # adapters raise what their vendor's library raises
            raise BusError(f"CAN bus {name!r} cannot be opened: {error}") from error
        return cls(bus, name=f"{options.get('channel')} ({options.get('interface')} through python-can)")

    @property
    def description(self) -> str:
        return self._name

    @property
    def fd(self) -> bool:
        import can

        return self._bus.protocol in (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_FD_NON_ISO)

    @property
    def drops(self) -> int:
        return 0

    @property
    def unsent(self) -> int:
        return self._unsent

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        """See `Port.receive`.  Raises ValueError for a negative timeout_s."""
        import can

        if not timeout_s >= 0.0:
            raise ValueError(f"timeout_s is {timeout_s!r}; allowed is 0 or more seconds")
        messages: list[can.Message] = []
        most = self._max_frames if expect <= 1 else min(expect, self._max_frames)
        try:
            message = self._bus.recv(timeout_s)
            while message is not None:
                if not message.timestamp:
                    message.timestamp = time.time()
                messages.append(message)
                if len(messages) == most:
                    break
                message = self._bus.recv(timeout_s if expect > 1 else 0)
        except (can.CanError, OSError) as error:
            if not messages:  # else hand over what we have; the error comes back with the next call
                raise self._failed("receiving from", error) from error
        if not messages and self._is_off():
            raise self._bus_off()
        return block_from_messages(messages)

    def send(self, block: FrameBlock) -> int:
        """See `Port.send`.  What python-can refuses within 20 ms a block counts as unsent."""
        import can

        if self._closed:
            self._unsent += len(block)
            raise BusError(f"sending on {self._name} failed: it is closed")
        deadline = time.monotonic() + _SEND_PATIENCE_S
        for sent, message in enumerate(messages_from_block(block)):
            try:
                self._bus.send(message, timeout=max(0.001, deadline - time.monotonic()))
            except can.CanOperationError as error:
                self._unsent += len(block) - sent
                if self._watching and (_BUS_OFF.search(str(error)) or self._is_off()):
                    raise self._bus_off() from error
                return sent
            except (can.CanError, OSError) as error:
                self._unsent += len(block) - sent
                raise self._failed("sending on", error) from error
        return len(block)

    def watch_bus_off(self) -> None:
        """From now on bus-off counts as a bus that went away: `receive` and `send` raise BusOffError where the
        adapter's state or its error says so; asked only when nothing comes, or nothing can be sent."""
        self._watching = True

    def _is_off(self) -> bool:
        import can

        if not self._watching:
            return False
        try:
            return self._bus.state is can.BusState.ERROR
        except Exception:  # not every driver can say, and a vendor's library may raise anything
            return False

    def _bus_off(self) -> BusOffError:
        return BusOffError(f"the controller of {self._name} is bus-off after too many faulty frames (bit rate, "
                           "wiring, termination?)")

    def _failed(self, doing: str, error: Exception) -> BusError:
        if self._watching and _BUS_OFF.search(str(error)):
            return self._bus_off()
        return BusError(f"{doing} {self._name} failed: {error}")

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
