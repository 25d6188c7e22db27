"""Showing a status while a runner runs, without ever holding the runner up.

On a terminal the picture is drawn by a process of its own, which gets statuses through a pipe: drawing
costs some milliseconds of Python, and a terminal behind a slow line stops its writer.  A thread of this
process only takes the status, five times a second, and puts it into the pipe; where the pipe is full it
waits, and the runner does not.  Elsewhere (a pipe, a file, a dumb terminal) the thread prints a plain line
each second.

`python -m ipmsm_can.cli.screen` is the drawing process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import IO, Any, Generic, Self, TypeVar

from ipmsm_can.cli import plain

REFRESH_S = 0.2
LINE_S = 1.0
_PATIENCE_S = 2.0

S = TypeVar("S")


def is_terminal(out: IO[str]) -> bool:
    """Whether a picture can be drawn there."""
    return out.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown")


class Screen(Generic[S]):
    """Shows what `take` gives until the `with` block ends.

    take: called from a thread of this object.  live: a picture (True) or plain lines (False); None decides
    by what standard output is.
    drawer: module that is the drawing process of what `take` gives.  line: that as a plain line.  news: set by
    whoever wants it shown at once.
    """

    def __init__(self, take: Callable[[], S], live: bool | None = None, *, drawer: str = "ipmsm_can.cli.screen",
                 line: Callable[[Any], str] = plain.line, news: threading.Event | None = None) -> None:
        self._take = take
        self._drawer = drawer
        self._line = line
        self._news = threading.Event() if news is None else news
        self._live = is_terminal(sys.stdout) if live is None else live
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, name="screen", daemon=True)
        self._child: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        if self._live:
            self._child = subprocess.Popen([sys.executable, "-m", self._drawer],
                                           stdin=subprocess.PIPE, env=environment())
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._end.set()
        self._news.set()
        self._thread.join(_PATIENCE_S)
        child = self._child
        if child is None or child.stdin is None:
            return
        if self._thread.is_alive():  # stuck in a pipe whose reader is stuck in the terminal
            child.kill()
        else:
            with contextlib.suppress(OSError):
                child.stdin.close()  # the process restores the terminal and ends
        try:
            child.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _work(self) -> None:
        if self._child is not None and self._child.stdin is not None:
            self._draw(self._child.stdin)
        while not self._end.wait(LINE_S):
            print(self._line(self._take()), flush=True)

    def _draw(self, pipe: IO[bytes]) -> None:
        """Feed the drawing process; returns at the end, or when that process is gone."""
        while not self._end.is_set():
            self._news.wait(REFRESH_S)
            self._news.clear()
            try:
                pipe.write(pickle.dumps(self._take()))
                pipe.flush()
            except (OSError, ValueError):
                return


def environment() -> dict[str, str]:
    """For a process of ours, with the package's home in the path: this one may have been started in any folder."""
    home = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120
    path = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": f"{home}{os.pathsep}{path}" if path else home}


def draw(source: IO[bytes]) -> None:
    """Draw the statuses that come out of a pipe until it is closed."""
    from rich.console import Console
    from rich.live import Live

    from ipmsm_can.cli.render import render

    console = Console(highlight=False)
    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False,
              redirect_stderr=False) as live:
        while True:
            try:
                status = pickle.load(source)
            except (EOFError, pickle.UnpicklingError):
                return
            live.update(render(status, console.width, console.height), refresh=True)


def main() -> int:
    """The drawing process: it ends when the program that feeds it does, not by the user's Ctrl-C."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    draw(sys.stdin.buffer)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
