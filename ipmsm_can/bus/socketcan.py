"""SocketCAN in blocks: one recvmmsg writes many frames straight into an array, one sendmmsg sends many.

The number of system calls decides what a receiver costs; here it is one per block when frames are
waiting, and one per wake-up when they are not.  The tables are those of `message_table`.
CAN specifics: Linux Documentation/networking/can.rst.
"""

from __future__ import annotations

import ctypes
import errno
import math
import os
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.busoff import OffWatch, restart_controller
from ipmsm_can.bus.message_table import (
    CONTROL_WORDS,
    DROPS,
    ERRORS,
    NO_STAMP,
    SO_RXQ_OVFL,
    SO_TIMESTAMPNS,
    SOL_SOCKET,
    STATES,
    MessageTable,
    unpack,
)
from ipmsm_can.bus.port import BusError, BusOffError
from ipmsm_can.frames import CAN_EFF_FLAG, CANFD_FDF, FRAME_BYTES, FrameBlock

# <sys/socket.h>, <asm-generic/socket.h>, <linux/can/raw.h>, <linux/sockios.h>, <linux/if_arp.h>; Python
# leaves some of them out, depending on the headers it was built with.
_AF_CAN, _CAN_RAW, _SOL_CAN_RAW, _ARPHRD_CAN = 29, 1, 101, 280
_RAW_FILTER, _RAW_ERR_FILTER, _RAW_LOOPBACK, _RAW_RECV_OWN, _RAW_FD_FRAMES = 1, 2, 3, 4, 5
_SO_RCVBUF, _SO_RCVBUFFORCE, _SO_RCVTIMEO, _SO_SNDTIMEO = 8, 33, 20, 21
_MSG_DONTWAIT, _MSG_WAITFORONE = 0x40, 0x10000
_SIOCGIFFLAGS, _SIOCGIFMTU, _SIOCGIFHWADDR, _IFF_UP = 0x8913, 0x8921, 0x8927, 1
_ALL_ERRORS = 0x1FFFFFFF

CAN_MTU, CANFD_MTU = 16, 72

_SEND_PATIENCE_S = 0.02
_SEND_NAP_S = 0.0002


class SocketCanPort:
    """A raw CAN socket as a `Port` (64-bit little-endian Linux).

    channel: name of the interface, e.g. "can0".
    fd: CAN FD frames; None means "if the interface can" (its mtu is 72).
    receive_own: also receive the frames sent here.  loopback: other programs on this machine see them.
    receive_buffer: bytes of kernel buffer asked for; the kernel grants twice that and a waiting frame takes
        768, so the default holds 21800 frames, 3 s of a full 1 Mbit/s bus.  Without CAP_NET_ADMIN the
        kernel cuts the wish to net.core.rmem_max; `buffer_bytes` says what was granted.
    filters: python-can's can_filters: mappings with can_id, can_mask and optionally extended; any match
        passes a frame; None passes all.  Error frames always pass.
    max_frames: largest block `receive` returns.

    The port stays usable after an interface went down and came back; `receive` then raised BusError once.
    `drops` is told by the kernel with the next frame that gets through, so it lags behind by that frame.

    Raises BusError when the interface is missing, down or no CAN, or the kernel has no SocketCAN.
    """

    def __init__(self, channel: str, *, fd: bool | None = None, receive_own: bool = False,
                 loopback: bool = True, receive_buffer: int = 8 << 20,
                 filters: Sequence[Mapping[str, Any]] | None = None, max_frames: int = 256) -> None:
        if not 1 <= max_frames <= 1024:
            raise ValueError(f"max_frames is {max_frames}; allowed is 1 to 1024")
        self._channel = channel
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._unsent = 0
        self._timeout_s = math.nan  # what SO_RCVTIMEO is set to
        self._watch: OffWatch | None = None
        self._errors = 0  # error frames that were looked at
        self._off = self._untold = False
        try:
            self._socket = socket.socket(_AF_CAN, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _CAN_RAW)
        except OSError as error:
            raise BusError(error.errno, f"this kernel gives no SocketCAN socket ({error.strerror}); is the "
                                        "module can-raw there?") from error
        try:
            self._fd = self._prepare(fd, receive_own, loopback, receive_buffer, filters)
        except BaseException:
            self._socket.close()
            raise
        self._handle = self._socket.fileno()
        self._rows = max_frames
        self._in = MessageTable(max_frames, CONTROL_WORDS)
        self._out = MessageTable(max_frames, 0)
        self._in_address = ctypes.c_void_p(self._in.headers.ctypes.data)
        self._state = np.zeros(STATES, np.int64)
        # compiled (or loaded from the cache) now and not while the first frames are waiting
        unpack(0, self._in.headers, self._in.control, self._in.frames,
                np.empty((0, FRAME_BYTES), np.uint8), np.empty(0, np.int64), self._state)

    def _prepare(self, fd: bool | None, receive_own: bool, loopback: bool, receive_buffer: int,
                 filters: Sequence[Mapping[str, Any]] | None) -> bool:
        mtu = self._check_interface()
        if fd and mtu < CANFD_MTU:
            raise BusError(errno.EINVAL, f"{self._channel} is not set up for CAN FD (its mtu is {mtu}, not "
                                         f"{CANFD_MTU}); `ip link set {self._channel} type can ... fd on` "
                                         "does it")
        use_fd = mtu >= CANFD_MTU if fd is None else fd
        option = self._socket.setsockopt
        option(_SOL_CAN_RAW, _RAW_FD_FRAMES, int(use_fd))
        option(_SOL_CAN_RAW, _RAW_ERR_FILTER, _ALL_ERRORS)
        option(_SOL_CAN_RAW, _RAW_LOOPBACK, int(loopback))
        option(_SOL_CAN_RAW, _RAW_RECV_OWN, int(receive_own))
        if filters is not None:
            option(_SOL_CAN_RAW, _RAW_FILTER, _pack_filters(filters))
        try:
            option(SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
        except OSError:
            option(SOL_SOCKET, _SO_RCVBUF, receive_buffer)
        option(SOL_SOCKET, SO_RXQ_OVFL, 1)
        option(SOL_SOCKET, SO_TIMESTAMPNS, 1)
        option(SOL_SOCKET, _SO_SNDTIMEO, struct.pack("@ll", 0, int(_SEND_PATIENCE_S * 1e6)))
        self._socket.bind((self._channel,))
        self._index = socket.if_nametoindex(self._channel)
        return use_fd

    def _check_interface(self) -> int:
        """The interface's mtu; BusError if there is no such CAN interface or it is down."""
        import fcntl

        name = os.fsencode(self._channel)
        if not 0 < len(name) < 16 or b"\0" in name:
            raise BusError(errno.ENODEV, f"there is no CAN interface {self._channel!r}; `ip link` lists "
                                         "those there are")

        def ask(request: int) -> bytes:
            return fcntl.ioctl(self._socket, request, struct.pack("16s24x", name))[16:]

        try:
            kind, flags, mtu = (struct.unpack_from("<H", ask(_SIOCGIFHWADDR))[0],
                                struct.unpack_from("<H", ask(_SIOCGIFFLAGS))[0],
                                struct.unpack_from("<i", ask(_SIOCGIFMTU))[0])
        except OSError as error:
            raise BusError(error.errno, f"there is no CAN interface {self._channel!r} ({error.strerror}); "
                                        "`ip link` lists those there are") from error
        if kind != _ARPHRD_CAN:
            raise BusError(errno.ENODEV, f"{self._channel} is a network interface, but not a CAN one")
        if not flags & _IFF_UP:
            raise self._down(errno.ENETDOWN)
        return int(mtu)

    def _down(self, code: int) -> BusError:
        self._off = self._untold = False  # a controller that is started anew is on the bus
        if self._watch is not None:
            self._watch.off = False
        return BusError(code, f"{self._channel} is down; bring it up with `ip link set {self._channel} up type can "
                              "bitrate 1000000` (a vcan without `type can ...`)")

    @property
    def description(self) -> str:
        stamps = "kernel time stamps" if not self._state[NO_STAMP] else "time stamps at reading"
        return f"{self._channel} (SocketCAN, {stamps})"

    @property
    def fd(self) -> bool:
        return self._fd

    @property
    def drops(self) -> int:
        return int(self._state[DROPS])

    @property
    def unsent(self) -> int:
        return self._unsent

    @property
    def buffer_bytes(self) -> int:
        """Bytes of receive buffer the kernel granted (it doubles what was asked, for its own overhead)."""
        return self._socket.getsockopt(SOL_SOCKET, _SO_RCVBUF)

    @property
    def tables(self) -> tuple[MessageTable, MessageTable]:
        """The tables that recvmmsg and sendmmsg work on, for a loop that calls them itself."""
        return self._in, self._out

    @property
    def state(self) -> NDArray[np.int64]:
        """The state of `unpack`."""
        return self._state

    def set_timeout(self, timeout_s: float) -> None:
        """How long a receive waits for each frame; costs a system call only when it changes."""
        if timeout_s != self._timeout_s:
            self._set_timeout(timeout_s)

    def watch_bus_off(self) -> None:
        """From now on bus-off counts as a bus that went away: `receive`, `send` and `check` raise BusOffError."""
        self._watch = self._watch or OffWatch()

    def look(self, block: FrameBlock) -> None:
        """Note what received frames say of the controller; for a loop that reads the tables itself."""
        errors = int(self._state[ERRORS])
        if self._watch is None or not (self._off or errors != self._errors):
            return
        self._errors = errors
        self._watch.update(block)
        if self._watch.off != self._off:
            self._off = self._untold = self._watch.off

    def restart(self) -> int:
        """Ask the kernel to restart the controller, see `restart_controller`; returns 0 or the errno."""
        code = restart_controller(self._index)
        if code == errno.EBUSY and self._watch is not None:
            self._off = self._untold = self._watch.off = False
        return code

    def _bus_off(self) -> BusOffError:
        self._untold = False
        return BusOffError(f"the controller of {self._channel} is bus-off after too many faulty frames (bit rate, "
                           "wiring, termination?)", self._channel)

    def check(self) -> None:
        """Raise BusError when the interface is down or gone, or was made anew: this socket is bound to the old; and
        while its controller is bus-off, where that is watched."""
        self._check_interface()
        try:
            index = socket.if_nametoindex(self._channel)
        except OSError:
            index = 0
        if index != self._index:
            raise BusError(errno.ENODEV, f"{self._channel} was taken away and another put in its place")
        if self._off:
            raise self._bus_off()

    def fileno(self) -> int:
        """The socket's handle, for select and event loops."""
        return self._handle

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        """See `Port.receive`.  A time-out that stays the same from call to call costs no extra system call;
        the kernel rounds it up to its tick (1 to 10 ms).

        Raises ValueError for a negative or not finite timeout_s.
        """
        if self._untold:
            raise self._bus_off()
        if timeout_s > 0.0:
            self.set_timeout(timeout_s)
            flags = _MSG_WAITFORONE if expect <= 1 else 0
        elif timeout_s == 0.0:
            flags = _MSG_DONTWAIT
        else:
            raise ValueError(f"timeout_s is {timeout_s!r}; allowed is 0 or more seconds")
        most = self._rows if flags else min(expect, self._rows)
        n = self._libc.recvmmsg(self._handle, self._in_address, most, flags, None)
        if n <= 0:
            self._check_receive(ctypes.get_errno() if n < 0 else 0)
            return FrameBlock(np.empty((0, FRAME_BYTES), np.uint8), np.empty(0, np.int64))
        raw, t_ns = np.empty((n, FRAME_BYTES), np.uint8), np.empty(n, np.int64)
        unstamped = self._state[NO_STAMP]
        rows = unpack(n, self._in.headers, self._in.control, self._in.frames, raw, t_ns, self._state)
        if self._state[NO_STAMP] != unstamped:
            t_ns[t_ns < 0] = time.time_ns()
        block = FrameBlock(raw[:rows], t_ns[:rows])
        if self._off or self._state[ERRORS] != self._errors:
            self.look(block)
        return block

    def _set_timeout(self, timeout_s: float) -> None:
        if not math.isfinite(timeout_s):
            raise ValueError(f"timeout_s is {timeout_s!r}; allowed is 0 or more seconds")
        # 0 would mean "for ever" to the kernel
        whole, micro = divmod(max(1, math.ceil(min(timeout_s, 1e6) * 1e6)), 1_000_000)
        self._socket.setsockopt(SOL_SOCKET, _SO_RCVTIMEO, struct.pack("@ll", whole, micro))
        self._timeout_s = timeout_s

    def _check_receive(self, code: int) -> None:
        if code in (0, errno.EAGAIN, errno.EINTR):
            return
        if code == errno.ENETDOWN:
            raise self._down(code)
        if code in (errno.ENODEV, errno.EBADF):
            raise BusError(code, f"{self._channel} is gone: {os.strerror(code)}")
        raise BusError(code, f"receiving from {self._channel} failed: {os.strerror(code)}")

    def send(self, block: FrameBlock) -> int:
        """See `Port.send`.  A full transmit queue is waited for 20 ms, then the rest is unsent."""
        sent, n = 0, len(block)
        if self._off:  # the kernel would take them, and some might go out much too late
            self._unsent += n
            raise self._bus_off()
        deadline = 0.0
        while sent < n:
            count = min(n - sent, self._rows)
            self._out.frames[:count] = block.raw[sent:sent + count]
            is_fd = (block.raw[sent:sent + count, 5] & CANFD_FDF) != 0
            self._out.iov[:count, 1] = np.where(is_fd, CANFD_MTU, CAN_MTU)
            self._out.frames[:count, 5][~is_fd] = 0
            first = 0
            while first < count:
                done = self._libc.sendmmsg(self._handle, ctypes.c_void_p(
                    self._out.headers.ctypes.data + 64 * first), count - first, 0)
                if done > 0:
                    first += done
                    sent += done
                    continue
                code = ctypes.get_errno()
                if code == errno.EINTR:
                    continue
                if code not in (errno.ENOBUFS, errno.EAGAIN):
                    self._unsent += n - sent
                    self._refuse_send(code, block, sent)
                # POLLOUT says nothing about a full device queue, so poll() cannot be used to wait for room
                now = time.monotonic()
                deadline = deadline or now + _SEND_PATIENCE_S
                if now >= deadline:
                    self._unsent += n - sent
                    return sent
                time.sleep(_SEND_NAP_S)
        return sent

    def _refuse_send(self, code: int, block: FrameBlock, row: int) -> None:
        if code in (errno.ENETDOWN, errno.ENXIO):
            raise self._down(code)
        if code in (errno.EINVAL, errno.EMSGSIZE):
            is_fd = bool(block.flags[row] & CANFD_FDF)
            why = ("the interface takes no CAN FD frames" if is_fd and not self._fd else
                   f"its payload of {int(block.length[row])} bytes is not allowed")
            raise BusError(code, f"{self._channel} refused the frame with identifier "
                                 f"0x{int(block.can_id[row]) & ~CAN_EFF_FLAG:X}: {why}")
        raise BusError(code, f"sending on {self._channel} failed: {os.strerror(code)}")

    def close(self) -> None:
        self._socket.close()
        self._handle = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def _pack_filters(filters: Sequence[Mapping[str, Any]]) -> bytes:
    packed = b""
    for one in filters:
        can_id, can_mask = int(one["can_id"]), int(one["can_mask"])
        if "extended" in one:  # match 11-bit or 29-bit identifiers only, as python-can does
            can_mask |= CAN_EFF_FLAG
            can_id |= CAN_EFF_FLAG if one["extended"] else 0
        packed += struct.pack("=II", can_id, can_mask)
    return packed
