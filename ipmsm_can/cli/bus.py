"""What the commands on a bus share: python-can's own bus options, the port behind them, a clean end.

Nothing heavy is imported before a command that needs it is parsed.
"""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from ipmsm_can.bus.port import Port
    from ipmsm_can.cli.status import DriveStatus, RunStatus
    from ipmsm_can.config import DriveConfig

S = TypeVar("S", "RunStatus", "DriveStatus")

_FILTER_HELP = ("Let only these identifiers in, hexadecimal: <id>:<mask> passes what equals id in the bits of "
                "mask, so 100:70F passes everything of drive 0 below 0x200")
_SLOW_S = 1.5


def _load_python_can() -> None:
    """Load python-can without asammdf, which it would take for its own MF4 files, and pandas with it: half of the
    time that a command takes to start.  MF4 is read and written here without it."""
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # what is None there cannot be imported
    try:
        import can  # noqa: F401
    finally:
        del sys.modules["asammdf"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """python-can's bus options: -i -c -b --fd --data-bitrate --timing --filter --bus-kwargs."""
    _load_python_can()
    from can.cli import add_bus_arguments

    add_bus_arguments(parser, filter_arg=True,
                      group_title="bus, as in every python-can program (also CAN_* variables and can.conf)")
    for action in parser._actions:
        if action.dest == "interface" and action.choices:
            # twenty names in braces would drown the usage line
            action.metavar = "INTERFACE"
            action.help = f"Kind of CAN interface, one of: {', '.join(action.choices)}."
        if action.dest == "can_filters":
            action.metavar = "ID:MASK"
            action.help = _FILTER_HELP


def check_named(args: argparse.Namespace) -> None:
    """Raise ValueError where no bus is named: before work is done for it."""
    from ipmsm_can.bus.port import bus_configuration

    bus_configuration(args)


def open_bus(args: argparse.Namespace, fd: bool = False) -> Port:
    """The port that the options, CAN_* variables and can.conf name.

    fd: CAN FD is needed, whether --fd was given or not.
    Raises ValueError where no bus is named, BusError where it cannot be opened.
    """
    from ipmsm_can.bus.port import open_port

    options: dict[str, Any] = vars(args)
    return open_port({**options, "fd": True} if fd else options)


def bit_rates(args: argparse.Namespace, configs: Sequence[DriveConfig]) -> tuple[int, int]:
    """(nominal, data) bit rate [bit/s] for the bus load: from the options, else from [wire].

    Raises ValueError when the configurations do not agree.
    """
    rates = {(c.wire.bitrate, c.wire.data_bitrate) for c in configs}
    if len(rates) > 1:
        found = " and ".join(f"{nominal}/{data}" for nominal, data in sorted(rates))
        raise ValueError(f"wire.bitrate/wire.data_bitrate are {found} bit/s; "
                         "allowed is one pair for all drives on a bus")
    nominal, data = rates.pop()
    given = getattr(args, "bitrate", None)
    given_data = getattr(args, "data_bitrate", None)
    nominal = given if given is not None else nominal
    return nominal, given_data if given_data is not None else max(nominal, data)


def seconds(text: str) -> float:
    """Type of an option that is a time above 0 s."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"it is {text!r}; allowed is a number of seconds above 0")
    return value


class Stop:
    """Says when a runner is to end: after `duration` seconds from the first question, or on a signal.

    name: of the signal that came, "" if none.
    """

    def __init__(self, duration: float | None = None) -> None:
        self.name = ""
        self._duration = duration
        self._end = math.inf
        self._asked = False

    def __call__(self) -> bool:
        if not self._asked:
            self._asked = True
            if self._duration is not None:
                self._end = time.monotonic() + self._duration
        return bool(self.name) or time.monotonic() >= self._end

    def now(self, name: str = "stop") -> None:
        """End at the next question."""
        self.name = name


@contextmanager
def stop_on_signals(duration: float | None = None) -> Iterator[Stop]:
    """A `Stop` that Ctrl-C and SIGTERM set; a second Ctrl-C ends the program the hard way.

    Outside the main thread, where Python takes no signals, only the duration counts.
    """
    stop = Stop(duration)

    def on_signal(number: int, frame: object) -> None:
        stop.now(signal.Signals(number).name)
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def serve(command: str, run: Callable[[], None], status: Callable[[], S], quiet: bool) -> tuple[int, S]:
    """Run until it ends, with the status shown meanwhile unless quiet, and print how it went.

    run, status: of a runner and its monitor.  Returns the exit code, 1 where the bus went away, else 0, and the
    last status.
    """
    from ipmsm_can.bus.port import BusError
    from ipmsm_can.cli import plain
    from ipmsm_can.cli.screen import Screen

    went_away: BusError | None = None
    with nullcontext() if quiet else Screen(status):
        try:
            run()
        except BusError as error:
            went_away = error
    last = status()
    print(plain.summary(last))
    if went_away is None:
        return 0, last
    print(f"ipmsm-can {command}: the bus went away after {last.elapsed:.1f} s: {went_away}", file=sys.stderr)
    return 1, last


@contextmanager
def patience(what: str = "compiling kernels (first time only) ...") -> Iterator[None]:
    """Say what takes so long, on stderr, if the body takes longer than a moment."""
    timer = threading.Timer(_SLOW_S, lambda: print(what, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


