"""Keys from the terminal, as they are pressed.  Its mode is the drawing process' business; here it is only read."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

TAB = "tab"
_SEQUENCE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|O.|.)?", re.DOTALL)
"""What arrows, function keys and pasted marks send: a key that means nothing here."""
_LOOK_S = 0.1


def decode(data: bytes) -> list[str]:
    """The keys in what a terminal sent: single characters, lower case, and TAB; escape sequences are left out."""
    text = _SEQUENCE.sub("", data.decode("utf-8", "replace"))
    return [TAB if c == "\t" else c.lower() for c in text if c == "\t" or c.isprintable()]


class Keys:
    """Calls `press` for every key from a thread of its own, while the `with` block lasts.

    fd: where they come from; None: standard input.  available: there is a keyboard.
    """

    def __init__(self, press: Callable[[str], None], fd: int | None = None) -> None:
        self._press = press
        self._fd = fd
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        if fd is None:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                self._fd = sys.stdin.fileno()
        self.available = self._fd is not None and os.isatty(self._fd)

    def __enter__(self) -> Self:
        if self.available:
            self._thread = threading.Thread(target=self._work, name="keys", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._end.set()
        if self._thread is not None:
            self._thread.join(2.0)

    def _work(self) -> None:
        while not self._end.is_set():
            data = self._read()
            if data is None:
                return
            for key in decode(data):
                self._press(key)

    def _read(self) -> bytes | None:
        """What was typed within a moment; None where the terminal is gone."""
        if sys.platform == "win32":
            import msvcrt

            if not msvcrt.kbhit():
                time.sleep(_LOOK_S)
                return b""
            key = msvcrt.getwch()
            if key in "\x00\xe0":  # arrows and function keys come in two
                msvcrt.getwch()
                return b""
            return key.encode()
        import select

        assert self._fd is not None
        try:
            if not select.select([self._fd], [], [], _LOOK_S)[0]:
                return b""
            return os.read(self._fd, 256) or None
        except (OSError, ValueError):
            return None
