"""A thread with a bounded queue: who hands something over never waits, and what finds no room is counted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """Does `work` on what was put, in order, in a thread of its own: on all that has gathered, every period_s.

    room: weight that may wait.  A `work` that raises is not called again: `error` then says why, and what is put is
    counted as lost.  waiting, refused, lost: weights.
    """

    def __init__(self, name: str, work: Callable[[list[T]], None], room: int, period_s: float) -> None:
        self.waiting = self.refused = self.lost = 0
        self.error: Exception | None = None
        self._work = work
        self._room = room
        self._period_s = period_s
        self._items: deque[tuple[T, int]] = deque()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T, weight: int) -> bool:
        """Hand over an item; False where there is no room for it, or no use."""
        with self._lock:
            if self.error is not None or self._closing:
                self.lost += weight
                return False
            if self.waiting + weight > self._room:
                self.refused += weight
                return False
            self._items.append((item, weight))
            self.waiting += weight
            if 4 * self.waiting > self._room:
                self._wake.set()
        return True

    def close(self, patience_s: float | None = None) -> bool:
        """Let the thread finish what waits; False where it does not within patience_s."""
        with self._lock:
            self._closing = True
        self._wake.set()
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            closing = self._closing
            self._turn()
            if closing:
                return
            self._wake.wait(self._period_s)
            self._wake.clear()

    def _turn(self) -> None:
        with self._lock:
            batch = list(self._items)
            self._items.clear()
        if not batch:
            return
        weight = sum(w for _, w in batch)
        try:
            if self.error is None:
                self._work([item for item, _ in batch])
        except Exception as error:  # a full disk, or whatever a library raises
            with self._lock:
                self.error = error
                # what of the batch was done already nobody can tell
                self.lost += weight + sum(w for _, w in self._items)
                self._items.clear()
                self.waiting = 0
            return
        with self._lock:
            self.waiting -= weight
