"""The health of a bus: load, identifiers, losses by place, error frames, clocks; blocks of frames in, a report out.

It has no clock, no thread and no socket, and its memory does not grow.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np

from ipmsm_can.bus.bits import BusLoad, frame_bits
from ipmsm_can.bus.clock import ClockDrift
from ipmsm_can.bus.errors import LOCATION_WORDS, PROTOCOL_WORDS, STATE_WORDS, BusState, ErrorCounters
from ipmsm_can.bus.health_kernel import ENTRY, SLOTS, TOTAL, close_window, count_frames
from ipmsm_can.bus.health_report import DriveHealth, ErrorHealth, HealthReport, IdHealth
from ipmsm_can.bus.health_words import judge
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, FrameBlock
from ipmsm_can.wire.protocol import NODES, MessageKind, Protocol
from ipmsm_can.wire.receive import SampleReceiver
from ipmsm_can.wire.sequence_kernel import RESTARTED

_STEADY = 0.8
_NO_ROWS = np.zeros(0, np.intp)


class _Drive:
    """Samples of one node: what is missing, and how its clock runs."""

    def __init__(self, protocol: Protocol, node: int) -> None:
        self.node = node
        self.receiver = SampleReceiver(protocol, node, 8, None)
        self.clock = ClockDrift()
        self.rate = math.nan

    def update(self, block: FrameBlock, labels: np.ndarray[tuple[int], np.dtype[np.int16]]) -> None:
        rows = [np.flatnonzero(labels == kind * NODES + self.node) for kind in (
            MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_TIMING, MessageKind.DRIVE_SAMPLE_BLOCK)]
        for run in self.receiver.push(block, *rows):
            self.rate = run.sample_rate
            self.clock.update(run.counter, run.t_ns, run.sample_rate, run.filled | (run.doubt & np.uint8(1)),
                              run.gap == RESTARTED)

    def report(self) -> DriveHealth:
        sequencer = self.receiver.sequencer
        drift = self.clock.drift()
        count = sequencer.count
        return DriveHealth(
            node=self.node, sequenced=not sequencer.waiting, sample_rate=self.rate, received=count("received"),
            lost=count("lost"), gaps=count("gaps"), restarts=count("restarts"), duplicates=count("duplicates"),
            reordered=count("reordered"), bad_frames=self.receiver.bad_frames + count("bad_rate"),
            drift_ppm=drift.ppm if drift else math.nan, drift_sigma_ppm=drift.sigma_ppm if drift else math.nan,
            drift_span=drift.span_s if drift else 0.0)


class BusHealth:
    """Counts frames and makes a `HealthReport` of them.

    bitrate, data_bitrate: of the bus [bit/s], > 0.  assumed_rates: nobody said so, they are a guess.
    name: the message's name by (identifier, extended, least and greatest payload), "" for one that is not known;
        None where there is no database to know any.  database: what that is, in words.
    protocol: to follow the samples of drives that speak it; None does not look for any.
    error_classes: error frames come from SocketCAN, so that their identifier is Linux' error class; else they are
        only counted.
    Raises ValueError for a bit rate that is not above 0.

    `update` and `report` may be called from two threads.
    """

    def __init__(self, bitrate: float, data_bitrate: float, *, assumed_rates: bool = False,
                 name: Callable[[int, bool, tuple[int, int]], str] | None = None, database: str = "",
                 protocol: Protocol | None = None, error_classes: bool = True) -> None:
        self._load = BusLoad(bitrate, data_bitrate)
        self._rates = bitrate, data_bitrate, assumed_rates
        self._name = name
        self._database = database if name is not None else ""
        self._protocol = protocol
        self._error_classes = error_classes
        self._entries = np.zeros(SLOTS, ENTRY)
        self._entries["key"] = -1
        self._total = np.zeros(1, TOTAL)
        self._errors = ErrorCounters()
        self._violations = np.zeros(8, np.int64)
        self._places = np.zeros(256, np.int64)
        self._drives: dict[int, _Drive] = {}
        self._kernel_drops = -1
        self._outages = 0
        self._outage_time = 0.0
        self._no_bus = ""
        self._lock = threading.Lock()

    def update(self, block: FrameBlock) -> None:
        """Take in frames in the order of their arrival; the report is the same for any cut into blocks."""
        if not len(block):
            return
        with self._lock:
            nominal, data = frame_bits(block)
            self._load.update(block, (nominal, data))
            count_frames(np.ascontiguousarray(block.raw), np.ascontiguousarray(block.t_ns), nominal, data,
                         1e9 / self._rates[0], 1e9 / self._rates[1], self._entries, self._total)
            self._count_errors(block)
            self._follow_drives(block)

    def note_port(self, drops: int) -> None:
        """What the port counts: frames the kernel dropped since the beginning; -1 where nobody tells."""
        self._kernel_drops = drops

    def note_outages(self, outages: int, seconds: float, no_bus: str) -> None:
        """How often the bus went away, for how long in all [s], and why there is none now, "" where there is."""
        self._outages, self._outage_time, self._no_bus = outages, seconds, no_bus

    def _count_errors(self, block: FrameBlock) -> None:
        if not self._error_classes:
            self._errors.frames += int(np.count_nonzero(block.can_id & CAN_ERR_FLAG))
            return
        errors = self._errors.update(block)
        if len(errors):
            bits = (errors.protocol[:, None] >> np.arange(8, dtype=np.uint8)) & 1
            self._violations += bits.sum(axis=0, dtype=np.int64)
            self._places += np.bincount(errors.location, minlength=256)

    def _follow_drives(self, block: FrameBlock) -> None:
        if self._protocol is None:
            return
        labels = self._protocol.classify(block.raw)
        ours = labels[(labels >= 0) & (labels < (MessageKind.DRIVE_TIMING + 1) * NODES)]
        for node in np.unique(ours % NODES).tolist():
            if node not in self._drives:
                self._drives[node] = _Drive(self._protocol, node)
            self._drives[node].update(block, labels)

    def report(self, source: str = "", now_ns: int | None = None) -> HealthReport:
        """As of now.  source: what was looked at, in words; now_ns: the time [ns] on the frames' axis, where it is
        later than the last frame: silence counts, too."""
        with self._lock:
            return judge(self._report(source, now_ns))

    def _report(self, source: str, now_ns: int | None) -> HealthReport:
        total = self._total.copy()
        bitrate, data_bitrate, assumed = self._rates
        close_window(total[0], 1e9 / bitrate, 1e9 / data_bitrate)
        t = total[0]
        seen = int(t["frames"] + t["errors"]) > 0
        passed = 1e-9 * float(t["passed"])
        silence, silence_at = 1e-9 * float(t["silence"]), 1e-9 * float(t["silence_at"] - t["first_t"])
        since = 1e-9 * (now_ns - int(t["last_t"])) if seen and now_ns is not None else 0.0
        if since > silence:
            silence, silence_at = since, passed
        busy = float(t["nominal"]) / bitrate + float(t["data"]) / data_bitrate
        duration = passed + max(0.0, since)
        return HealthReport(
            source=source, duration=duration, first=1e-9 * float(t["first_t"]) if seen else math.nan,
            last=1e-9 * float(t["last_t"]) if seen else math.nan, bitrate=bitrate, data_bitrate=data_bitrate,
            assumed_rates=assumed, frames=int(t["frames"]), load=self._load.load(now_ns),
            mean_load=busy / duration if duration > 0.0 else 0.0, peak_load=1e-9 * float(t["peak"]),
            peak_at=1e-9 * float(t["peak_at"] - t["first_t"]), silence=silence, silence_at=silence_at,
            back=int(t["back"]), kernel_drops=self._kernel_drops, uncounted=int(t["unkept"]), outages=self._outages,
            outage_time=self._outage_time, no_bus=self._no_bus, database=self._database,
            ids=self._identifiers(int(t["first_t"]), busy, bitrate, data_bitrate),
            drives=tuple(self._drives[n].report() for n in sorted(self._drives)), errors=self._error_report())

    def _identifiers(self, first_ns: int, busy: float, bitrate: float, data_bitrate: float
                     ) -> tuple[IdHealth, ...]:
        used = self._entries[self._entries["key"] >= 0]
        used = used[np.lexsort((used["key"] & CAN_EFF_MASK, used["key"] & CAN_EFF_FLAG))]
        out = []
        for e in used:
            gaps, bins = int(e["gaps"]), e["bins"]
            near = 0
            period = jitter = rate = math.nan
            if gaps:
                middle = int(np.searchsorted(np.cumsum(bins), 0.5 * gaps))
                around = slice(max(0, middle - 1), middle + 2)
                period = 1e-9 * float(e["sums"][around].sum()) / int(bins[around].sum())
                near = int(bins[max(0, middle - 2):middle + 3].sum())
                jitter = 1e-9 * math.sqrt(max(0.0, float(e["m2"])) / gaps)
                rate = 1e9 / float(e["mean_gap"]) if e["mean_gap"] > 0.0 else math.nan
            key = int(e["key"])
            can_id, extended = key & CAN_EFF_MASK, bool(key & CAN_EFF_FLAG)
            took = float(e["nominal"]) / bitrate + float(e["data"]) / data_bitrate
            whole = int(e["windows"]) > 0
            out.append(IdHealth(
                can_id=can_id, extended=extended, name=self._name(
                    can_id, extended, (int(e["min_length"]), int(e["max_length"]))) if self._name else "",
                count=int(e["count"]), rate=rate, period=period, jitter=jitter, max_gap=1e-9 * float(e["max_gap"]),
                max_gap_at=1e-9 * float(e["max_gap_at"] - first_ns) if gaps else math.nan,
                steady=gaps >= 10 and near >= _STEADY * gaps, least=int(e["least"]) if whole else -1,
                most=int(e["most"]) if whole else -1, length=int(e["length"]), min_length=int(e["min_length"]),
                max_length=int(e["max_length"]), length_changes=int(e["changes"]), remote=int(e["remote"]),
                fd=bool(e["fd"]), share=took / busy if busy > 0.0 else 0.0))
        return tuple(out)

    def _error_report(self) -> ErrorHealth:
        e = self._errors
        told = e.state >= 0
        places = sorted(((int(n), LOCATION_WORDS.get(k, f"place 0x{k:02X}"))
                         for k, n in enumerate(self._places) if k and n), reverse=True)
        return ErrorHealth(
            frames=e.frames, decoded=self._error_classes, state=STATE_WORDS[e.state] if told else "",
            worst=STATE_WORDS[e.worst] if told else "", bus_offs=e.bus_offs, restarts=e.restarts,
            passive=e.worst >= BusState.PASSIVE, kinds=e.kinds(),
            violations={words: int(self._violations[k]) for k, words in enumerate(PROTOCOL_WORDS.values())
                        if self._violations[k]},
            places={words: n for n, words in places}, tx_errors=e.tx_errors, rx_errors=e.rx_errors,
            overflows=e.overflows)


def warm_up(protocol: Protocol) -> None:
    """Compile or load the kernels before there is anything to lose."""
    health = BusHealth(1e6, 1e6, protocol=protocol)
    block = FrameBlock.zeros(2)
    block.can_id[:] = protocol.base_ids[[MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_TIMING]]
    block.length[:] = 8
    timing = protocol.encode(MessageKind.DRIVE_TIMING, 0, {"sample_counter": 0.0, "sample_rate": 5000.0})
    block.raw[1] = timing[0]
    health.update(block)
    health.update(block)
    health.report()
