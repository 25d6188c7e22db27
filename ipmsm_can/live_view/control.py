"""What the keys do.  Called by the thread that reads them; the receiving thread only looks at plain attributes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from ipmsm_can.companion import Companion
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.keys import TAB
from ipmsm_can.live_view.status import FINDINGS, HELP, MAIN, Event, Told
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import CompanionState, InjectionReason, InjectionState

EVENTS_KEPT = 200
BINS_EACH = (1, 2, 4, 8)
"""Tenths of a second that a column of the curves stands for, in the order of the key."""
NOTICE_S = 5.0
ONLY_LISTENED = "SILENT: a mapped inverter is only listened to; it knows none of our messages"
_FLOWING = (CompanionState.STARTING, CompanionState.TRACKING, CompanionState.LOCKED, CompanionState.FAULT)


class Recording(Protocol):
    """What records, when told to.  `observe` is an observer of the runner and does not wait for a disk."""

    def start(self) -> None:
        """Begin a new file; raises OSError or ValueError where that cannot be."""

    def stop(self) -> None:
        """Finish the file; may take a moment."""

    def mark(self, t_ns: int, words: str) -> None:
        """Note an event at t_ns on the frames' axis."""

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Take in a round."""

    @property
    def running(self) -> bool:
        """A file is being written."""

    @property
    def path(self) -> str:
        """The file that is, or was last, written."""

    @property
    def words(self) -> str:
        """Where it is, or was last, written, and how much, for people."""

    @property
    def trouble(self) -> str:
        """Why it is not written any more, or not completely; "" where all is well."""


class Controls:
    """State behind the keys.

    companion: whose injection they order; None: there is one drive, which is only listened to.  recording: None
    where there is nothing to record.  quit: ends the program.  now_ns: the time on the frames' axis.  stamp: that
    in words.  news: set after each key, so that the screen answers at once.
    """

    def __init__(self, companion: Companion | None, recording: Recording | None, quit_: Callable[[], None],
                 now_ns: Callable[[], int], stamp: Callable[[int], str], news: threading.Event,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.companion = companion
        self._nodes = {} if companion is None else companion.nodes
        self.page = MAIN
        self.paused = False
        self.selected = 0
        self.zoom = 2
        self.marks = 0
        self.recording = recording
        self.orders: dict[int, bool] = {}
        """What was ordered of the injection, by node: True on, False off."""
        self._quit = quit_
        self._now_ns = now_ns
        self._stamp = stamp
        self._news = news
        self._clock = clock
        self._events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self._notice, self._notice_until = "", 0.0
        self._asked: Callable[[], None] | None = None
        self._acts: dict[str, Callable[[], None]] = {
            "r": self.toggle_record, "m": self._mark, "p": self._pause, " ": self._pause, "t": self._next_zoom,
            "f": lambda: self._turn(FINDINGS), "h": lambda: self._turn(HELP), "?": lambda: self._turn(HELP),
            "q": self._quit, TAB: self._next_drive, "i": self._ask_to_inject, "o": lambda: self._order(False),
            "a": lambda: self._order(None),
        }

    def press(self, key: str) -> None:
        """One key of `keys.decode`; one that means nothing is ignored."""
        asked, self._asked = self._asked, None
        if asked is not None:
            if key == "y":
                asked()
            elif self._notice_until > self._clock():
                self.tell("nothing done")
        elif key in self._acts:
            self._acts[key]()
        elif self.page != MAIN:
            self.page = MAIN
        self._news.set()

    @property
    def events(self) -> tuple[Event, ...]:
        """The last of them, oldest first."""
        return tuple(self._events)

    @property
    def notice(self) -> str:
        """What is to be read below the picture now; a question that was not answered in time is withdrawn."""
        if self._clock() < self._notice_until:
            return self._notice
        self._asked = None
        return ""

    def tell(self, words: str) -> None:
        """Say something for a moment."""
        self._notice, self._notice_until = words, self._clock() + NOTICE_S

    def note(self, words: str, severity: str = "notice") -> None:
        """Put an event on the list."""
        self._events.append(Event(self._stamp(self._now_ns()), words, severity))

    def note_finding(self, told: Told) -> None:
        """A finding that is new goes on the list, too."""
        self.note(f"{told.severity}: {told.sentence}", told.severity)

    # Record and marks

    def toggle_record(self) -> None:
        """Start a record, or finish the one that runs."""
        recording = self.recording
        if recording is None:
            self.tell("nothing to record: this is a recording already")
        elif recording.running:
            self.stop_record()
        else:
            try:
                recording.start()
            except (OSError, ValueError) as error:
                self.tell(f"cannot record: {error}")
                self.note(f"cannot record: {error}", "error")
                return
            self.note(f"recording to {recording.path}")

    def stop_record(self) -> None:
        """Finish the record, where one runs."""
        recording = self.recording
        if recording is not None and recording.running:
            recording.stop()
            trouble = recording.trouble
            self.note(trouble or f"recorded {recording.words}", "error" if trouble else "notice")

    def _mark(self) -> None:
        now, recording = self._now_ns(), self.recording
        self.marks += 1
        words = f"mark {self.marks}"
        recorded = recording is not None and recording.running
        if recording is not None and recorded:
            recording.mark(now, words)
        self._events.append(Event(self._stamp(now), words if recorded else f"{words} (not recorded)"))

    # Display

    def _pause(self) -> None:
        self.paused = not self.paused

    def _next_zoom(self) -> None:
        self.zoom = (self.zoom + 1) % len(BINS_EACH)

    def _turn(self, page: str) -> None:
        self.page = MAIN if self.page == page else page

    def _next_drive(self) -> None:
        self.selected = (self.selected + 1) % max(1, len(self._nodes))

    # Injection

    @property
    def _node(self) -> int:
        return list(self._nodes)[self.selected]

    def _cannot_inject(self) -> str:
        """Why there is nothing to order, "" where there is."""
        if self.companion is None:
            return ONLY_LISTENED
        if not self.companion.transmit:
            return "SILENT: nothing is transmitted, so nothing can be ordered; start with --transmit for that"
        scheduler = self._nodes[self._node].scheduler
        if (scheduler.state is InjectionState.DISABLED
                and scheduler.reason is InjectionReason.DISABLED_BY_CONFIGURATION):
            return "the drive's TOML file says injection.enabled = false"
        return ""

    def _ask_to_inject(self) -> None:
        why = self._cannot_inject()
        if why:
            self.tell(why)
            return
        number = self._node
        node = self._nodes[number]
        if node.view.state not in _FLOWING:
            self.tell(f"drive {number} sends no samples: there is nothing to inject into")
            return
        s = node.scheduler.settings
        self.tell(f"inject {s.amplitude:.1f} V at {s.frequency:.0f} Hz into drive {number}?  "
                  "y: yes, any other key: no")
        self._asked = lambda: self._order(True)

    def _order(self, wanted: bool | None) -> None:
        why = self._cannot_inject()
        if why:
            self.tell(why)
            return
        number = self._node
        self._carry_out(number, wanted)
        told = {True: "on", False: "off", None: "automatic"}[wanted]
        self.note(f"drive {number}: injection ordered {told}")
        self.tell(f"drive {number}: injection ordered {told}")

    def _carry_out(self, number: int, wanted: bool | None) -> None:
        assert self.companion is not None
        self.companion.order_injection(number, wanted)
        if wanted is None:
            self.orders.pop(number, None)
        else:
            self.orders[number] = wanted

    def lapse(self) -> None:
        """An order to inject ends where the samples do: whoever switches the drive on again must not find it
        injecting for an order that was given before.  The receiving thread's, once a round."""
        for number, wanted in list(self.orders.items()):
            if wanted and self._nodes[number].view.state not in _FLOWING:
                self._carry_out(number, None)
                self.note(f"drive {number}: no samples, so the order to inject has ended")
