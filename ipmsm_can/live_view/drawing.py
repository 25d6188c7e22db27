"""The drawing process: statuses in through a pipe, the changed lines out to the terminal.

It draws the newest status and skips those that came while the terminal was busy; a line that has not changed is not
written again, which is what makes the screen bearable over a slow connection.  It owns the screen: whatever becomes
of the program that feeds it, the terminal is left as it was found.

`python -m ipmsm_can.live_view.drawing` is that process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable
from typing import IO

from rich.console import Console
from rich.text import Text

from ipmsm_can.live_view.picture import picture
from ipmsm_can.live_view.status import MonitorStatus

_ENTER = "\x1b[?1049h\x1b[?25l\x1b[2J"
_LEAVE = "\x1b[?25h\x1b[?1049l"
_RESIZE_S = 0.25
_LOCAL_FLAGS, _CHARACTERS = 3, 6
"""Places in what termios.tcgetattr returns."""


class Canvas:
    """Lines on a terminal; `show` writes only what differs from what is there."""

    def __init__(self, out: IO[str], console: Console) -> None:
        self._out = out
        self._console = console
        self._shown: list[Text] = []
        self._size = (0, 0)

    def show(self, lines: list[Text], size: tuple[int, int]) -> int:
        """Bring the terminal, of `size` (columns, rows), to these lines; returns how many characters that took."""
        parts = []
        if size != self._size:
            parts.append("\x1b[2J")
            self._shown, self._size = [], size
        for k, line in enumerate(lines):
            if k < len(self._shown) and self._shown[k] == line:
                continue
            with self._console.capture() as capture:
                self._console.print(line, end="", soft_wrap=True, highlight=False)
            # erased first: a terminal erases the last column when told to after writing it
            parts.append(f"\x1b[{k + 1};1H\x1b[2K{capture.get()}")
        for k in range(len(lines), len(self._shown)):
            parts.append(f"\x1b[{k + 1};1H\x1b[2K")
        self._shown = lines
        text = "".join(parts)
        if text:
            self._out.write(text)
            self._out.flush()
        return len(text)


class _Newest:
    """Reads statuses in a thread and keeps the newest."""

    def __init__(self, source: IO[bytes]) -> None:
        self._source = source
        self._status: MonitorStatus | None = None
        self._news = threading.Event()
        self.over = False
        threading.Thread(target=self._work, name="statuses", daemon=True).start()

    def _work(self) -> None:
        with contextlib.suppress(EOFError, pickle.UnpicklingError, OSError, ValueError):
            while True:
                self._status = pickle.load(self._source)
                self._news.set()
        self.over = True
        self._news.set()

    def wait(self, seconds: float) -> MonitorStatus | None:
        self._news.wait(seconds)
        self._news.clear()
        return self._status


def draw(source: IO[bytes], out: IO[str]) -> None:
    """Draw what comes out of a pipe until it is closed."""
    # NO_COLOR and TERM are rich's to obey
    console = Console(file=out, highlight=False, force_terminal=True, legacy_windows=False)
    canvas = Canvas(out, console)
    newest = _Newest(source)
    restore = _take_over(out)
    out.write(_ENTER)
    try:
        while not newest.over:
            status = newest.wait(_RESIZE_S)
            if status is None:
                continue
            size = _size(out)
            console.width = max(1, size[0])
            canvas.show(picture(status, *size), size)
    finally:
        with contextlib.suppress(OSError):
            out.write(_LEAVE)
            out.flush()
        restore()


def _size(out: IO[str]) -> tuple[int, int]:
    try:
        size = os.get_terminal_size(out.fileno())
    except (OSError, ValueError):
        return 80, 24
    # a terminal that does not know says 0
    return size.columns or 80, size.lines or 24


def _take_over(out: IO[str]) -> Callable[[], None]:
    """Set the terminal to give each key at once and not to show it; returns what puts it back as it was.

    Ctrl-Z does nothing: a program that is stopped loses what its buffers cannot hold.
    """
    if sys.platform == "win32":
        os.system("")  # the known way to make the console obey escape sequences
        return lambda: None
    import termios

    fd = out.fileno()
    try:
        before = termios.tcgetattr(fd)
        mode = termios.tcgetattr(fd)
        mode[_LOCAL_FLAGS] &= ~(termios.ICANON | termios.ECHO)
        disabled = bytes([os.fpathconf(fd, "PC_VDISABLE") & 0xFF])
        mode[_CHARACTERS][termios.VSUSP] = disabled
        mode[_CHARACTERS][termios.VMIN], mode[_CHARACTERS][termios.VTIME] = 1, 0
        termios.tcsetattr(fd, termios.TCSADRAIN, mode)
    except (termios.error, OSError, ValueError):
        return lambda: None

    def restore() -> None:
        with contextlib.suppress(termios.error, OSError):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)

    return restore


def main() -> int:
    """The drawing process: it ends when the program that feeds it does, not by the user's Ctrl-C."""
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGTTOU")
    for name in names:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    with contextlib.suppress(OSError):
        draw(sys.stdin.buffer, sys.stdout)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
