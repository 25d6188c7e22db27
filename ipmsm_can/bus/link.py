"""A bus that comes back: what to do when an interface goes down, an adapter is unplugged, a driver gives up.

Nothing that had arrived is lost: it is read before the port is given up.  Then the port is tried again, and opened
again where it is another one by now, with a pause in between, until it works.

A controller that is bus-off is a bus that went away, too.  On SocketCAN the port stays open and goes on hearing
what the kernel says of it, and a process that transmits asks the kernel for a restart; any other adapter is closed
and opened again.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from ipmsm_can.bus.busoff import Recovery
from ipmsm_can.bus.port import BusError, BusOffError, Port
from ipmsm_can.frames import FrameBlock

PAUSE_S = 0.25
"""Time between two attempts [s]."""
OFF_PAUSE_S = 0.05
"""Time between two looks at a controller that is bus-off [s]; when it is restarted says `Recovery`."""
KEPT = 1000
"""Outages that are remembered one by one."""
_STUBBORN = 3
_DRAIN_MOST = 10_000


@dataclass(frozen=True, slots=True)
class Outage:
    """began_ns, ended_ns: Unix time [ns] of this computer.  reason: what was said when the bus went away."""

    began_ns: int
    ended_ns: int
    reason: str


class Link:
    """A port, opened again by whoever uses it when its bus goes away.

    port: open.  open_again: opens another like it; raises BusError where that does not work yet.
    pause_s: between attempts.  sleep, now_ns: for tests; now_ns gives Unix time [ns].
    transmits: this process sends frames, so it may restart the controller of an interface that is bus-off.
    outages: how often the bus went away; past: the last 1000 that are over.  recovery: from bus-off.
    Closes the port at the end of a `with` block.
    """

    def __init__(self, port: Port, open_again: Callable[[], Port], pause_s: float = PAUSE_S,
                 sleep: Callable[[float], None] = time.sleep, now_ns: Callable[[], int] = time.time_ns, *,
                 transmits: bool = False) -> None:
        self.port = port
        self.recovery = Recovery(transmits)
        self.outages = 0
        self.past: deque[Outage] = deque(maxlen=KEPT)
        self._open_again = open_again
        self._pause_s = pause_s
        self._sleep = sleep
        self._now_ns = now_ns
        self._since_ns: int | None = None
        self._cause = ""
        self._reason = ""
        self._over_ns = 0
        self._drops = 0
        self._unsent = 0
        self._closed = self._heard = False
        _watch(port)

    @property
    def down(self) -> bool:
        """There is no bus now."""
        return self._since_ns is not None

    @property
    def since_ns(self) -> int:
        """Unix time [ns] at which the present outage began; 0 where there is none."""
        return self._since_ns or 0

    @property
    def cause(self) -> str:
        """What was said when the bus went away last."""
        return self._cause

    @property
    def drops(self) -> int:
        """`Port.drops` of all ports so far."""
        return self._drops + self.port.drops

    @property
    def unsent(self) -> int:
        """`Port.unsent` of all ports so far."""
        return self._unsent + self.port.unsent

    @property
    def outage_time(self) -> float:
        """Time without a bus in all [s], the present outage included."""
        since = self._since_ns
        return 1e-9 * (self._over_ns + (0 if since is None else max(0, self._now_ns() - since)))

    @property
    def words(self) -> str:
        """"no bus since 14:03:12: can0 is down; ...", or "" where there is one."""
        since = self._since_ns
        if since is None:
            return ""
        return f"no bus since {time.strftime('%H:%M:%S', time.localtime(1e-9 * since))}: {self._reason}"

    def lose(self, error: BusError) -> FrameBlock:
        """The bus went away, as `error` of the port tells; returns what had arrived and was not read yet."""
        if self._since_ns is None:
            self._since_ns = self._now_ns()
            self._cause = str(error)
            self.outages += 1
        self._reason = str(error)
        if isinstance(error, BusOffError):
            self.recovery.begin(self._now_ns())
            self._reason += f"; {self.recovery.words(error.interface)}"
        return self._drain()

    def take(self) -> FrameBlock:
        """What came since the bus went away: while a controller is bus-off, what the kernel says of it, and, when
        it is back, the frames of the bus."""
        if not self.recovery.off or self._closed:
            return FrameBlock.zeros(0)
        block = self._drain()
        self._heard |= len(block) > 0
        return block

    def _drain(self) -> FrameBlock:
        blocks: list[FrameBlock] = []
        refused = 0
        while refused < _STUBBORN and len(blocks) < _DRAIN_MOST:
            try:
                blocks.append(self.port.receive(0.0))
            except BusError:
                refused += 1  # a pending error comes before the frames that wait behind it
                continue
            if not len(blocks[-1]):
                break
        return FrameBlock.concat(blocks)

    def pause(self) -> float:
        """Wait a while before the next attempt; returns the time that passed [s]."""
        pause_s = min(self._pause_s, OFF_PAUSE_S) if self.recovery.off else self._pause_s
        begin = self._now_ns()
        self._sleep(pause_s)
        passed = 1e-9 * (self._now_ns() - begin)
        # a clock that is set meanwhile must neither turn time back nor make hours of it
        return passed if pause_s <= passed <= 100.0 * pause_s else pause_s

    def retry(self) -> bool:
        """One attempt; True where there is a bus again: `port` then may be another one."""
        try:
            if not self._as_before():
                self._replace()
        except BusError as error:
            self._reason = str(error)
            return False
        if self._since_ns is not None:
            now = max(self._now_ns(), self._since_ns)
            self.past.append(Outage(self._since_ns, now, self._cause))
            self._over_ns += now - self._since_ns
            self._since_ns = None
        self.recovery.over(self._now_ns())
        self._heard = False
        return True

    def _as_before(self) -> bool:
        """Whether the same port works again; raises BusError where its interface is there, but down."""
        check = getattr(self.port, "check", None)
        if check is None and not self._closed:
            # an adapter that is bus-off may come back by itself: then frames arrive
            return self.recovery.off and self._heard
        if check is None or self._closed:
            return False
        try:
            check()
        except BusOffError as error:
            self._restart(error)
        except BusError as error:
            if error.errno == errno.ENETDOWN:
                raise
            return False
        except OSError:
            return False
        return True

    def _restart(self, error: BusOffError) -> None:
        """Restart the controller if it is time; raises the error anew while it is bus-off."""
        recovery, now = self.recovery, self._now_ns()
        recovery.begin(now)
        if recovery.allowed and recovery.due(now) and not recovery.hopeless:
            restart: Callable[[], int] = getattr(self.port, "restart")  # noqa: B009 - only this kind of port has it
            recovery.answered(restart(), now)
        if recovery.off:
            raise BusOffError(f"{error}; {recovery.words(error.interface)}", error.interface)

    def _replace(self) -> None:
        if self.recovery.off and not hasattr(self.port, "check"):
            now = self._now_ns()
            if not self.recovery.due(now):
                raise BusOffError(self._reason)
            self.recovery.answered(0, now)
        if not self._closed:
            # first, for many an adapter can be open only once
            self._closed = True
            self._close()
        port = self._open_again()
        self._drops += self.port.drops
        self._unsent += self.port.unsent
        self.port, self._closed = port, False
        _watch(port)

    def _close(self) -> None:
        with contextlib.suppress(Exception):  # a driver whose adapter is gone may raise anything
            self.port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._close()


def _watch(port: Port) -> None:
    """Let a port that can tell bus-off do so: whoever has a link can do something about it."""
    watch = getattr(port, "watch_bus_off", None)
    if watch is not None:
        watch()
