"""Takes what the screen shows: the drives through a `Sight`, and what keys, findings and recordings add."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from ipmsm_can.cli.monitor import RPM
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.control import BINS_EACH, Controls
from ipmsm_can.live_view.sight import Sight
from ipmsm_can.live_view.status import DriveView, MonitorStatus
from ipmsm_can.live_view.watch import Watch
from ipmsm_can.node import Tracked

COLUMNS = 240
"""Columns of the curves that are worked out: enough for a very wide terminal."""
_DAY = 86400 * 10**9
_LONGEST_ROUND_S = 0.5


class FrameClock:
    """The time on the frames' axis between rounds, and in words.

    of_day: live frames carry Unix time; else (a log) time is told from the first frame.
    """

    def __init__(self, of_day: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._newest = 0
        self._at = 0.0
        self._clock = clock
        self._first: int | None = None
        self._of_day = of_day

    def update(self, now_ns: int) -> None:
        """The runner's time after a round."""
        if self._first is None and now_ns > _DAY:
            self._first = now_ns
        self._newest, self._at = now_ns, self._clock()

    def now_ns(self) -> int:
        """As of now [ns]: rounds may be a quarter of a second apart."""
        passed = min(self._clock() - self._at, _LONGEST_ROUND_S) if self._newest else 0.0
        return self._newest + round(1e9 * passed)

    def words(self, t_ns: int) -> str:
        """14:03:12, or 0:12.345 from the first frame of a log."""
        if self._of_day:
            at = 1e-9 * t_ns if t_ns > _DAY else time.time()
            return time.strftime("%H:%M:%S", time.localtime(at))
        passed = max(0.0, 1e-9 * (t_ns - (self._first or 0))) if self._first is not None or t_ns < _DAY else 0.0
        return f"{int(passed // 60)}:{passed % 60:06.3f}"


class LiveView:
    """Hands out `MonitorStatus`: `observe` is the runner's observer, `status` may be called from another thread.

    sight: the drives.  source: where the frames come from, in words; None: what the port says.
    """

    def __init__(self, sight: Sight, controls: Controls, watch: Watch, clock: FrameClock,
                 source: str | None = None) -> None:
        self.sight = sight
        self.controls = controls
        self.watch = watch
        self.keys = True
        self.ascii = False
        self._clock = clock
        self._source = source
        self._rpm = {number: RPM / motor.pole_pairs for number, motor in sight.motors.items()}
        self._rated = {number: motor.rated_current / math.sqrt(2.0) for number, motor in sight.motors.items()}
        self._held: MonitorStatus | None = None
        self._taking = threading.Lock()
        self.over = False
        """What is played is over, and its last picture stays."""

    def observe(self, block: FrameBlock, tracked: Sequence[Tracked], answers: FrameBlock, now_ns: int) -> None:
        """Note a round: a few microseconds."""
        self._clock.update(now_ns)
        self.sight.observe(block, tracked, answers, now_ns)
        recording = self.controls.recording
        if recording is not None:
            recording.observe(block, tracked, answers, now_ns)
        self.watch.offer(block)
        if self.controls.orders:
            self.controls.lapse()

    def hold_at_end(self) -> None:
        """The recording that is played is over: its last picture stays, until somebody has seen it."""
        if not self.over:
            self.over = True
            self._held = self._fresh()
            self.controls.paused = True
            self.controls.note("the recording is over")

    def status(self) -> MonitorStatus:
        """As of now; while it is paused, with the numbers of then."""
        controls = self.controls
        if not controls.paused or self._held is None:
            self._held = self._fresh()
        held, recording = self._held, controls.recording
        runs = recording is not None and recording.running
        run = held.run
        if controls.paused:
            # the clock, the voice and the bus must not seem to stand still
            now = self.sight.status()
            run = replace(run, elapsed=now.elapsed, transmit=now.transmit,
                          bus=replace(run.bus, no_bus=now.bus.no_bus))
        return replace(
            held, run=run, source=f"{held.source}, over: q ends" if self.over else held.source,
            checked=self.watch.checked, findings=self.watch.findings,
            recording=recording.words if recording is not None and runs else "",
            record_trouble=recording.trouble if recording is not None and runs else "", selected=controls.selected,
            page=controls.page, paused=controls.paused, notice=controls.notice, events=controls.events)

    def _fresh(self) -> MonitorStatus:
        with self._taking:
            return self._take()

    def _take(self) -> MonitorStatus:
        run = self.sight.status()
        drives = []
        for node in run.nodes:
            number = node.node
            course = self.sight.courses[number]
            present = course.present()
            aside = self.sight.aside(number)
            factor = self._rpm[number]
            wanted = self.controls.orders.get(number)
            drives.append(DriveView(
                node=node, rpm=present.omega * factor, rpm_sigma=present.omega_sigma * factor, i_rms=present.i_rms,
                i_peak=present.i_peak, i_d=present.i_d, i_q=present.i_q, v_rms=present.v_rms,
                rated=self._rated[number], order="" if wanted is None else "on" if wanted else "off",
                course=course.columns(self._clock.now_ns(), COLUMNS, BINS_EACH[self.controls.zoom], factor),
                reported=aside.reported, figures=aside.figures))
        return MonitorStatus(
            run=run, drives=tuple(drives), source=run.bus.description if self._source is None else self._source,
            keys=self.keys, injectable=run.transmit, ascii=self.ascii)
