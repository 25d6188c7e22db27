"""A program on a pseudo terminal, and what a person would see there: pyte, a terminal emulator, is the oracle."""

from __future__ import annotations

import errno
import fcntl
import os
import pty
import select
import struct
import subprocess
import termios
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import pyte

PLAIN = {"TERM": "xterm-256color", "LANG": "C.UTF-8", "COLUMNS": None, "LINES": None, "NO_COLOR": None,
         "LC_ALL": None, "LC_CTYPE": None}


class Terminal:
    """Runs `command` on a terminal of `columns` x `rows` until the `with` block ends.

    env: changes to the environment, None removes.  stdin: of the program, None for the terminal.
    sent: every byte that came.  code: exit code, None while it runs.
    """

    def __init__(self, command: Sequence[str], columns: int = 80, rows: int = 24,
                 env: Mapping[str, str | None] | None = None, stdin: int | None = None) -> None:
        self.screen: Any = pyte.Screen(columns, rows)
        self._stream: Any = pyte.ByteStream(self.screen)
        self.sent = b""
        self.code: int | None = None
        changed = {**PLAIN, **(env or {})}
        whole = {k: v for k, v in {**os.environ, **changed}.items() if v is not None}
        self.fd, self._tty = pty.openpty()
        self._set_size(columns, rows)
        self.before = termios.tcgetattr(self._tty)
        self._process = subprocess.Popen(command, stdin=self._tty if stdin is None else stdin, stdout=self._tty,
                                         stderr=self._tty, start_new_session=True, env=whole)
        self.pid = self._process.pid

    def _set_size(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self._tty, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))

    def resize(self, columns: int, rows: int) -> None:
        """The window gets another size."""
        self._set_size(columns, rows)
        self.screen.resize(rows, columns)

    def press(self, keys: str) -> None:
        """Type."""
        os.write(self.fd, keys.encode())

    @property
    def lines(self) -> list[str]:
        """What is on the screen."""
        return [line.rstrip() for line in self.screen.display]

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def look(self, seconds: float) -> None:
        """Let the program go on for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            if not self._take(left):
                return

    def _take(self, seconds: float) -> bool:
        if not select.select([self.fd], [], [], seconds)[0]:
            return True
        try:
            data = os.read(self.fd, 65536)
        except OSError as error:
            assert error.errno == errno.EIO
            return False
        self.sent += data
        self._stream.feed(data)
        return bool(data)

    def wait(self, words: str, seconds: float = 240.0) -> str:
        """Until the words are on the screen; returns its text, or fails with it.

        seconds: kernels may have to be compiled first.
        """
        end = time.monotonic() + seconds
        while words not in self.text:
            left = end - time.monotonic()
            assert left > 0.0 and self._take(min(left, 0.2)), f"{words!r} never came; there is:\n{self.text}"
        return self.text

    def finish(self, seconds: float = 30.0) -> int:
        """Until the program has ended; returns its exit code."""
        end = time.monotonic() + seconds
        while self.code is None:
            assert time.monotonic() < end, f"it does not end; there is:\n{self.text}"
            self.look(0.05)
            self.code = self._process.poll()
        self.look(0.1)
        return self.code

    @property
    def mode(self) -> list[Any]:
        """The terminal's mode now, as termios gives it."""
        return termios.tcgetattr(self._tty)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._tty)
        os.close(self.fd)
