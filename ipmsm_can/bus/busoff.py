"""Back from bus-off: told from error frames, when to ask for a restart, and how the kernel is asked.

A CAN controller that sent too many faulty frames switches itself off the bus (ISO 11898-1: transmit error counter
above 255) and stays off until somebody restarts it; it then waits for 128 times 11 recessive bits.  Where the
fault is still there it is off again within milliseconds, so the pauses between two restarts grow.
"""

from __future__ import annotations

import errno
import os
import socket
import struct

import numpy as np

from ipmsm_can.bus.errors import BusState, decode_errors
from ipmsm_can.frames import CAN_ERR_FLAG, FrameBlock

PAUSES_NS = (100_000_000, 1_000_000_000, 2_000_000_000, 4_000_000_000)
"""Before the first restart, the second, ...; the last for all further ones [ns].  The kernel looks once a second at
links that went down, and empties their transmit queues then: so only the first pause may be shorter."""
WELL_NS = 10_000_000_000
"""A controller that was on the bus for so long [ns] is restarted as at first."""
HEARS_NS = 50_000_000
"""Frames that come later than this after the bus-off [ns] did not wait in the controller: it is on the bus."""
_FINAL = (errno.EPERM, errno.EACCES, errno.EOPNOTSUPP, errno.EINVAL)

# <linux/netlink.h>, <linux/rtnetlink.h>, <linux/if_link.h>, <linux/can/netlink.h>
_NETLINK_ROUTE, _RTM_NEWLINK, _REQUEST_ACK, _NLMSG_ERROR = 0, 16, 0x5, 2
_IFLA_LINKINFO, _IFLA_INFO_KIND, _IFLA_INFO_DATA, _IFLA_CAN_RESTART = 18, 1, 2, 7
_ANSWER_S = 1.0


class OffWatch:
    """Whether a SocketCAN controller is off the bus, from the frames in their order.  off: it is."""

    def __init__(self) -> None:
        self.off = False
        self._since_ns = 0

    def update(self, block: FrameBlock) -> None:
        """Take in the next frames: every block while `off`, else those with error frames suffice."""
        errors = decode_errors(block)
        told = np.flatnonzero(errors.state >= 0)
        if told.size:
            self.off = bool(errors.state[told[-1]] == BusState.BUS_OFF)
            self._since_ns = int(errors.t_ns[told[-1]])
        if self.off:
            # should the news of the restart be lost: a controller that hears frames is not bus-off
            ordinary = block.t_ns[(block.can_id & np.uint32(CAN_ERR_FLAG)) == 0]
            self.off = not (ordinary > self._since_ns + HEARS_NS).any()


class Recovery:
    """When a controller is to be restarted, and what is said about it; has no clock and does nothing itself.

    allowed: this process transmits; one that only listens has not caused the bus-off, and restarts nothing.
    off: it is bus-off.  restarts, refused: how often a restart was carried out, or not.
    """

    def __init__(self, allowed: bool) -> None:
        self.allowed = allowed
        self.off = False
        self.restarts = 0
        self.refused = 0
        self._code = 0
        self._tries = 0
        self._next_ns = 0
        self._back_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        """It is bus-off, since now [ns] at first."""
        if self.off:
            return
        if self._back_ns is not None and not 0 <= now_ns - self._back_ns < WELL_NS:
            self._tries = 0
        self.off = True
        self._code = 0
        self._wait(now_ns)

    def due(self, now_ns: int) -> bool:
        """Whether now is the time to try."""
        # a clock that was set back must not put it off for hours
        return self.off and not 0 < self._next_ns - now_ns <= PAUSES_NS[-1]

    def answered(self, code: int, now_ns: int) -> None:
        """What came of a try: 0 it was carried out, else the errno; EBUSY: the controller is not bus-off."""
        self._tries += 1
        self._code = code
        self._wait(now_ns)
        if code == errno.EBUSY:
            self.over(now_ns)
        elif code:
            self.refused += 1
        else:
            self.restarts += 1

    @property
    def hopeless(self) -> bool:
        """The last answer will be the same another time."""
        return self._code in _FINAL

    def over(self, now_ns: int) -> None:
        """It is on the bus again."""
        if self.off:
            self.off = False
            self._back_ns = now_ns

    def _wait(self, now_ns: int) -> None:
        self._next_ns = now_ns + PAUSES_NS[min(self._tries, len(PAUSES_NS) - 1)]

    def words(self, interface: str) -> str:
        """What is being done, or has to be done by whom; interface: of SocketCAN, "" for any other adapter."""
        restart = f"`sudo ip link set {interface} type can restart`"
        if not interface:
            return "it is closed and opened again until it works"
        if not self.allowed:
            return f"this program only listens and restarts nothing; {restart} does"
        if self._code in (errno.EPERM, errno.EACCES):
            return f"restarting it needs root: {restart}"
        if self._code == errno.EOPNOTSUPP:
            return (f"the kernel cannot restart a controller of this kind; `sudo ip link set {interface} down` and "
                    "`up` does")
        if self._code == errno.EINVAL:
            return "the kernel restarts it by itself (restart-ms)"
        if self._code:
            return f"restarting it failed: {os.strerror(self._code)}"
        return "it is being restarted" + (f", {self.restarts} times so far" if self.restarts > 1 else "")


def restart_controller(index: int) -> int:
    """Ask the kernel to restart the CAN controller of the interface with this index; returns 0 or the errno.

    EPERM: without CAP_NET_ADMIN.  EOPNOTSUPP: no controller (vcan).  EINVAL: restart-ms is set, the kernel does it.
    EBUSY: it is not bus-off.  As `ip link set can0 type can restart`.
    """
    kind = _attribute(_IFLA_INFO_KIND, b"can\0")
    data = _attribute(_IFLA_INFO_DATA, _attribute(_IFLA_CAN_RESTART, struct.pack("=I", 1)))
    body = struct.pack("=BxHiII", 0, 0, index, 0, 0) + _attribute(_IFLA_LINKINFO, kind + data)
    message = struct.pack("=IHHII", 16 + len(body), _RTM_NEWLINK, _REQUEST_ACK, 1, 0) + body
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_ROUTE) as netlink:
            netlink.settimeout(_ANSWER_S)
            netlink.sendto(message, (0, 0))
            answer = netlink.recv(8192)
    except OSError as error:
        return error.errno or errno.ETIMEDOUT
    if len(answer) < 20 or struct.unpack_from("=H", answer, 4)[0] != _NLMSG_ERROR:
        return errno.EPROTO
    return -int(struct.unpack_from("=i", answer, 16)[0])


def _attribute(kind: int, payload: bytes) -> bytes:
    length = 4 + len(payload)
    return struct.pack("=HH", length, kind) + payload + bytes(-length % 4)
