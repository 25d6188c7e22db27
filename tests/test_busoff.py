"""A controller that went bus-off comes back: by the kernel's restart where this process transmits, by opening other
adapters again; never hammered, and nothing sent meanwhile or too late."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence

import can
import numpy as np
import pytest

from ipmsm_can.bus.busoff import PAUSES_NS, WELL_NS, OffWatch, Recovery, restart_controller
from ipmsm_can.bus.link import Link
from ipmsm_can.bus.port import BusError, BusOffError
from ipmsm_can.bus.pythoncan import PythonCanPort
from ipmsm_can.frames import FrameBlock
from ipmsm_can.wire.protocol import Protocol

PROTOCOL = Protocol()
MS, SECOND = 1_000_000, 1_000_000_000
# <linux/can/error.h>: CAN_ERR_FLAG with CAN_ERR_BUSOFF, CAN_ERR_RESTARTED, CAN_ERR_CRTL
BUS_OFF, RESTARTED, CONTROLLER = 0x20000040, 0x20000100, 0x20000004


def frame(can_id: int, t_ns: int, *data: int) -> FrameBlock:
    block = FrameBlock.zeros(1)
    block.raw[0, :4] = np.frombuffer(can_id.to_bytes(4, "little"), np.uint8)
    block.raw[0, 4] = 8
    block.raw[0, 8:8 + len(data)] = data
    block.t_ns[0] = t_ns
    return block


# ---- told from the frames

@pytest.mark.parametrize(("frames", "off"), [
    ([(BUS_OFF, 0)], True),
    ([(0x123, 0)], False),
    ([(CONTROLLER, 0, 0, 0x30)], False),                      # error passive is not bus-off
    ([(BUS_OFF | CONTROLLER, 0, 0, 0x30)], True),             # both in one frame
    ([(BUS_OFF, 0), (RESTARTED, 100)], False),
    ([(BUS_OFF, 0), (CONTROLLER, 100, 0, 0x40)], False),      # back to error active
    ([(BUS_OFF, 0), (RESTARTED, 100), (BUS_OFF, 103)], True),
    ([(BUS_OFF, 0), (0x123, 10)], True),                      # it had waited in the controller
    ([(BUS_OFF, 0), (0x123, 80)], False),                     # who hears frames is on the bus
    ([(BUS_OFF, 0), (0x20000020, 80)], True),                 # an error frame is no frame of the bus
    ([(BUS_OFF, 0), (BUS_OFF, 60), (0x123, 80)], True),
])
@pytest.mark.parametrize("together", [False, True])
def test_bus_off_is_told_from_error_frames(frames: Sequence[tuple[int, ...]], off: bool, together: bool) -> None:
    blocks = [frame(can_id, t * MS, *data) for can_id, t, *data in frames]
    watch = OffWatch()
    for block in [FrameBlock.concat(blocks)] if together else blocks:
        watch.update(block)
    assert watch.off is off


# ---- when to try

def test_the_pauses_grow_and_begin_anew_after_a_good_while() -> None:
    recovery = Recovery(allowed=True)
    now, tries = 5 * SECOND, []
    recovery.begin(now)
    for _ in range(6):
        begin = now
        recovery.begin(now)  # said again: not a new one
        while not recovery.due(now):
            now += MS
        tries.append(now - begin)
        recovery.answered(0, now)
    assert tries == [*PAUSES_NS, PAUSES_NS[-1], PAUSES_NS[-1]] and tries[0] == 100 * MS
    assert recovery.restarts == 6 and "6 times so far" in recovery.words("can0")
    recovery.over(now)
    recovery.begin(now + 3 * SECOND)  # the fault is still there: no quicker than before
    due = now + 3 * SECOND + PAUSES_NS[-1]
    assert not recovery.due(due - MS) and recovery.due(due)
    recovery.over(now)
    recovery.begin(now + WELL_NS)
    assert not recovery.due(now + WELL_NS + 99 * MS) and recovery.due(now + WELL_NS + 100 * MS)
    assert recovery.due(now - 3600 * SECOND)  # a clock that was set back


@pytest.mark.parametrize(("code", "said"), [
    (errno.EPERM, "restarting it needs root: `sudo ip link set can0 type can restart`"),
    (errno.EOPNOTSUPP, "cannot restart a controller of this kind; `sudo ip link set can0 down` and `up` does"),
    (errno.EINVAL, "the kernel restarts it by itself (restart-ms)"),
    (errno.ETIMEDOUT, "restarting it failed: Connection timed out"),
])
def test_a_refused_restart_says_who_has_to_do_what(code: int, said: str) -> None:
    recovery = Recovery(allowed=True)
    recovery.begin(0)
    recovery.answered(code, 0)
    assert said in recovery.words("can0")
    assert (recovery.off, recovery.restarts, recovery.refused) == (True, 0, 1)
    assert recovery.hopeless is (code != errno.ETIMEDOUT)
    recovery.over(0)
    recovery.begin(1)
    assert not recovery.hopeless  # another time it may be another answer


def test_a_controller_that_is_not_bus_off_is_left_alone() -> None:
    recovery = Recovery(allowed=True)
    recovery.begin(0)
    recovery.answered(errno.EBUSY, 1)
    assert (recovery.off, recovery.restarts, recovery.refused) == (False, 0, 0)


def test_who_only_listens_says_so() -> None:
    assert "only listens and restarts nothing; `sudo ip link set can3" in Recovery(allowed=False).words("can3")
    assert "closed and opened again" in Recovery(allowed=False).words("")


def test_the_kernel_is_asked_as_ip_would() -> None:
    """Loopback is no CAN controller: whatever the rights, it is refused, and nothing is changed."""
    if not hasattr(socket, "AF_NETLINK"):
        pytest.skip("no netlink here")
    assert restart_controller(socket.if_nametoindex("lo")) in (errno.EOPNOTSUPP, errno.EPERM)
    assert restart_controller(1 << 30) in (errno.ENODEV, errno.EPERM)


# ---- other adapters, through python-can

class Adapter(can.BusABC):
    """An adapter that goes bus-off, and is well once it was opened again often enough."""

    opened: int
    well_after = 3
    tells = "state"

    def __init__(self, channel: str = "x", **_: object) -> None:
        super().__init__(channel)
        type(self).opened += 1
        self.number = type(self).opened
        self.waiting: list[can.Message] = []

    @property
    def ill(self) -> bool:
        return self.number <= self.well_after

    @property  # type: ignore[misc]
    def state(self) -> can.BusState:
        return can.BusState.ERROR if self.ill and self.tells == "state" else can.BusState.ACTIVE

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.waiting:
            return self.waiting.pop(0), False
        if self.ill and self.tells == "receive":
            raise can.CanOperationError("Controller is in BUSOFF state")
        return None, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.ill and self.tells == "send":
            raise can.CanOperationError("Bus error: the CAN controller is in bus-off state")


@pytest.mark.parametrize("tells", ["state", "receive", "send"])
def test_another_adapter_is_closed_and_opened_again_with_growing_pauses(tells: str) -> None:
    Adapter.opened, Adapter.tells = 0, tells
    now = [SECOND]
    opened: list[int] = []

    def open_again() -> PythonCanPort:
        opened.append(now[0])
        return PythonCanPort(Adapter(), name="x")

    def sleep(seconds: float) -> None:
        now[0] += round(1e9 * seconds)

    link = Link(PythonCanPort(Adapter(), name="x"), open_again, sleep=sleep, now_ns=lambda: now[0])
    said = []
    for _ in range(60):
        try:
            assert len(link.port.receive(0.0)) == 0
            if tells == "send":
                link.port.send(FrameBlock.zeros(1))
        except BusError as error:
            link.lose(error)
            said.append(link.words)
            while not link.retry():
                link.pause()
                link.take()
    assert Adapter.opened == 4 and link.outages == 3 and not link.down
    assert np.allclose(np.diff([SECOND, *opened]), [0.1e9, 1.0e9, 2.0e9], atol=60 * MS)
    assert all("the controller of x is bus-off" in s and "closed and opened again" in s for s in said)


def test_an_adapter_that_comes_back_by_itself_is_not_opened_again() -> None:
    Adapter.opened, Adapter.tells = 0, "state"
    bus = Adapter()
    link = Link(PythonCanPort(bus, name="x"), lambda: pytest.fail("opened again"), sleep=lambda _: None)
    with pytest.raises(BusOffError) as off:
        link.port.receive(0.0)
    link.lose(off.value)
    assert not link.retry()
    bus.number = 99
    bus.waiting.append(can.Message(arbitration_id=0x12, data=[1]))
    assert len(link.take()) == 1
    assert link.retry() and not link.down and link.port._bus is bus  # type: ignore[attr-defined]


def test_without_a_link_nobody_is_told() -> None:
    """A simulated drive goes on as before: what it sends counts as unsent."""
    Adapter.opened, Adapter.tells = 0, "state"
    port = PythonCanPort(Adapter(), name="x")
    assert len(port.receive(0.0)) == 0
    Adapter.tells = "send"
    assert port.send(FrameBlock.zeros(2)) == 0 and port.unsent == 2
