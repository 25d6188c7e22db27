"""What every bus access looks like, and how one is opened from the options python-can's users know."""

from __future__ import annotations

import argparse
import ctypes
import sys
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from ipmsm_can.frames import FrameBlock


class BusError(OSError):
    """The bus cannot be used: interface missing or down, adapter gone, no permission."""

    def __str__(self) -> str:
        return self.strerror or super().__str__()  # the sentence alone, without "[Errno 19]"


class BusOffError(BusError):
    """The controller has switched itself off the bus after too many faulty frames.

    interface: of SocketCAN, whose controller the kernel can restart; "" for any other adapter.
    Raised only by ports that were told to `watch_bus_off`, once for each time, and by every `send` meanwhile.
    """

    def __init__(self, sentence: str, interface: str = "") -> None:
        super().__init__(sentence)
        self.interface = interface


class Port(Protocol):
    """A CAN bus as blocks of frames.

    Not thread-safe, except that one thread may send while another receives.
    """

    @property
    def description(self) -> str:
        """Channel and kind for people, e.g. "vcan0 (SocketCAN, kernel time stamps)"."""

    @property
    def fd(self) -> bool:
        """CAN FD frames can pass."""

    @property
    def drops(self) -> int:
        """Frames that arrived and were lost before we read them; 0 where that is not known."""

    @property
    def unsent(self) -> int:
        """Frames given to `send` that the interface would not take in time."""

    def receive(self, timeout_s: float, expect: int = 1) -> FrameBlock:
        """Wait for a frame, at most timeout_s (0 does not wait), then take all there are, up to a maximum.

        With expect > 1 it waits for that many, at most timeout_s for each, and takes no more: a reader that
        knows when it will have something to do is not woken before.

        Returns an empty block on time-out or a signal.  The block stays valid.  t_ns is Unix time.
        Raises BusError when the interface went down or away.
        """

    def send(self, block: FrameBlock) -> int:
        """Send the rows in order (t_ns is ignored) and return how many were taken; the rest counts as unsent.

        Raises BusError when the interface cannot send such frames at all.
        """

    def close(self) -> None:
        """Let go of the bus; may be called twice."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None: ...


_KEYWORDS = ("channel", "interface", "bitrate", "fd", "data_bitrate", "can_filters", "timing")


def open_port(options: argparse.Namespace | Mapping[str, Any], *, prefix: str | None = None) -> Port:
    """Open the bus the user asked for.

    options: what `can.cli.add_bus_arguments` leaves in a namespace (or the same keys in a mapping):
        channel, interface, bitrate, fd, data_bitrate, can_filters, timing, bus_kwargs; all optional.
        What is missing comes from CAN_* environment variables and can.conf, as everywhere in python-can.
    prefix: the prefix given to `add_bus_arguments`, for programs with several buses.

    SocketCAN on 64-bit Linux is opened without python-can, whose import costs about a second: where both
    interface and channel are in `options`, python-can's configuration is not read at all.  SocketCAN takes
    its bit rates from the interface (`ip link`), and CAN FD frames pass whenever the interface has them.

    Raises ValueError for options that name no bus, BusError when the bus cannot be opened.
    """
    config, extra = bus_configuration(options, prefix=prefix)
    if config["interface"] == "socketcan" and _have_own_socketcan():
        return _open_socketcan(config, extra)
    from ipmsm_can.bus.pythoncan import PythonCanPort

    return PythonCanPort.open(config | extra)


def bus_configuration(options: argparse.Namespace | Mapping[str, Any], *, prefix: str | None = None
                      ) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `open_port` would open: (python-can's keywords, those of --bus-kwargs); nothing is opened.

    Raises ValueError for options that name no bus.
    """
    given = dict(options) if isinstance(options, Mapping) else vars(options)
    stem = f"{prefix}_" if prefix else ""
    chosen: dict[str, Any] = {k: given[stem + k] for k in _KEYWORDS if given.get(stem + k) is not None}
    extra: dict[str, Any] = dict(given.get(stem + "bus_kwargs") or {})
    explicit = "interface" in chosen and "channel" in chosen
    return (chosen if explicit else _with_configuration(chosen)), extra


def _have_own_socketcan() -> bool:
    # The rows of FrameBlock and of struct mmsghdr are laid out here for 64-bit little-endian machines.
    return sys.platform == "linux" and sys.byteorder == "little" and ctypes.sizeof(ctypes.c_void_p) == 8


def _with_configuration(chosen: dict[str, Any]) -> dict[str, Any]:
    import can
    from can.util import load_config

    try:
        config = dict(load_config(config=dict(chosen)))
    except can.CanInterfaceNotImplementedError:
        config = {}
    except ValueError as error:
        raise ValueError(f"the CAN configuration (can.conf or CAN_* variables) is wrong: {error}") from error
    for key in ("interface", "channel"):
        if config.get(key) is None:
            raise ValueError(
                f"no CAN {key} was given; name it with --{key}, with the environment variable "
                f"CAN_{key.upper()}, or in can.conf (for example --interface socketcan --channel can0)")
    return config


def _open_socketcan(config: Mapping[str, Any], extra: dict[str, Any]) -> Port:
    from ipmsm_can.bus.socketcan import SocketCanPort

    allowed = {"receive_own_messages": "receive_own", "local_loopback": "loopback",
               "receive_buffer": "receive_buffer", "can_filters": "filters"}
    unknown = sorted(set(extra) - set(allowed))
    if unknown:
        raise ValueError(f"bus keyword {unknown[0]!r} is unknown to SocketCAN; allowed are "
                         f"{', '.join(sorted(allowed))}")
    merged = {**config, **extra}
    options = {ours: merged[theirs] for theirs, ours in allowed.items() if theirs in merged}
    return SocketCanPort(str(config["channel"]), fd=True if config.get("fd") else None, **options)
