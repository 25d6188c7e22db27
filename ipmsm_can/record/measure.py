"""A measurement file (ASAM MDF 4) with the decoded signals of the drives and the estimates, through asammdf.

One channel group per drive and rate: the samples together with the estimates at the sample rate, on the time of the
sample counter; and one for each of the other messages, on the time of arrival, with the names, units, scalings and
value tables of the DBC.  Time 0 is the first frame.

Rows gather in memory up to BATCH and go to a temporary file beside the measurement, from which that is put together
at the end.  So memory stays flat, but a program that is killed leaves no measurement: the raw log is what survives,
and `ipmsm-can replay LOG --drive drive.toml --out run.mf4` makes it anew from that.
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.bus.replay import SampleClock
from ipmsm_can.estimation import confidence, speed
from ipmsm_can.estimation.observers import common
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.marks import Mark, one_line
from ipmsm_can.logs.source import LogError
from ipmsm_can.node import Tracked
from ipmsm_can.record.background import Background
from ipmsm_can.record.recorder import FLUSH_S, ROOM, words_of_failure
from ipmsm_can.record.status import RecordStatus
from ipmsm_can.wire.codec import MessageCodec, SignalLayout
from ipmsm_can.wire.protocol import NODES, MessageKind, Protocol

if TYPE_CHECKING:
    from asammdf import MDF

BATCH = 1 << 14
"""Rows of a channel group that are written at once."""
_MARKS_KEPT = 1000

Columns = dict[str, NDArray[Any]]

SAMPLE_CHANNELS: Mapping[str, tuple[str, str]] = {
    "sample_counter": ("", "the drive's 32-bit counter"),
    "i_alpha": ("A", "current, peak, stationary frame"),
    "i_beta": ("A", "current, peak, stationary frame"),
    "v_alpha": ("V", "mean voltage of the interval that ended at the sample, peak"),
    "v_beta": ("V", "mean voltage of the interval that ended at the sample, peak"),
    "theta_e": ("rad", "estimated angle, electrical, -pi to pi"),
    "omega_e": ("rad/s", "estimated speed, electrical"),
    "sigma_theta": ("rad", "1-sigma of theta_e, electrical; pi: unknown"),
    "valid": ("", "1: the angle may be used"),
    "locked": ("", "1: the observer has converged"),
    "polarity_known": ("", "1: north and south are told apart"),
    "injecting": ("", "1: the drive said that it injects"),
    "filled": ("", "1: the sample was lost and stands on a straight line between its neighbours"),
    "excitation": ("V^2 s", "smallest eigenvalue of the windowed integral of Phi Phi^T"),
    "innovation": ("V Wb", "y - Phi^T x_hat"),
    "lambda_alpha": ("Wb", "estimated stator flux linkage, peak"),
    "lambda_beta": ("Wb", "estimated stator flux linkage, peak"),
    "arrival_delay": ("s", "time of arrival less the time of the sample counter"),
}
"""Channels of the samples' group: unit and meaning."""

_MESSAGES = [k for k in MessageKind if k not in (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_SAMPLE_BLOCK)]


def check_measure_path(path: str | Path) -> None:
    """Raise LogError where a measurement cannot be made there: wrong suffix, no folder, no asammdf."""
    path = Path(path)
    if path.suffix.lower() != ".mf4":
        raise LogError(f"{path} has the suffix {path.suffix!r}; allowed for a measurement is .mf4")
    if path.is_dir() or not path.parent.is_dir():
        raise LogError(f"{path} is a folder; allowed is a file" if path.is_dir() else
                       f"{path}: the folder {path.parent} does not exist")
    try:
        import asammdf  # noqa: F401
    except ImportError:
        raise LogError(f"{path}: MF4 needs the package asammdf, which is not installed; install it "
                       "(pip install 'ipmsm_can[mf4]')") from None


@dataclass(slots=True)
class _Group:
    """A channel group: rows that wait, and where it is in the file once it has any."""

    name: str
    channels: dict[str, tuple[str, str, dict[str, Any] | None]]
    waiting: list[tuple[NDArray[np.float64], Columns]] = field(default_factory=list)
    rows: int = 0
    index: int = -1
    last: float = 0.0


def _is_enumeration(layout: SignalLayout) -> bool:
    """Its values are words; a quantity may have a word for one of its values, too, and stays a quantity."""
    return bool(layout.choices) and layout.scale == 1.0 and layout.offset == 0.0 and not layout.unit


def _about(layout: SignalLayout) -> str:
    """Its comment, and what single values of a quantity mean."""
    if not layout.choices or _is_enumeration(layout):
        return layout.comment
    words = ", ".join(f"{value * layout.scale + layout.offset:g}: {text}" for value, text in layout.choices.items())
    return f"{layout.comment} ({words})".strip()


def _stored(layout: SignalLayout) -> tuple[np.dtype[Any], dict[str, Any] | None]:
    """How the raw values of a signal are stored, and how MDF makes physical ones of them."""
    if layout.kind == "float":
        return np.dtype(np.float64), None
    size = next(n for n in (1, 2, 4, 8) if 8 * n >= layout.length)
    kind = np.dtype(f"{'i' if layout.kind == 'signed' else 'u'}{size}")
    if _is_enumeration(layout):
        words: dict[str, Any] = {"default": ""}
        for k, (value, text) in enumerate(sorted(layout.choices.items())):
            words |= {f"val_{k}": value, f"text_{k}": text}
        return kind, words
    if layout.scale == 1.0 and layout.offset == 0.0:
        return kind, None
    return kind, {"a": layout.scale, "b": layout.offset}


def _values(codec: MessageCodec, block: FrameBlock, rows: NDArray[np.intp]) -> Columns:
    """The signals of a message as they are stored, each (len(rows),)."""
    raw = codec.decode_raw(block.words, rows)
    physical = codec.decode_rows(block.words, rows) if any(x.kind == "float" for x in codec.layouts) else None
    return {x.name: physical[k] if physical is not None and x.kind == "float" else raw[k].astype(_stored(x)[0])
            for k, x in enumerate(codec.layouts)}


class MeasureFile:
    """Takes frames and estimates, and makes a measurement file of them at the end.

    path: replaced where it exists.  nodes: numbers of the drives.
    rows: samples so far; size: bytes of all rows so far.
    Raises what asammdf and the disk raise; LogError where there is no asammdf.
    """

    def __init__(self, path: str | Path, nodes: Sequence[int], protocol: Protocol) -> None:
        check_measure_path(path)
        from asammdf import MDF

        self.path = Path(path)
        self.rows = self.size = 0
        self._nodes = list(nodes)
        self._protocol = protocol
        self._file: MDF = MDF(version="4.10", temporary_folder=str(self.path.resolve().parent))
        self._start_ns: int | None = None
        self._clocks = {n: SampleClock() for n in nodes}
        self._offset: dict[int, float] = {}
        self._marks: list[str] = []
        many = len(self._nodes) > 1
        self._samples = {n: _Group(f"Drive {n} samples" if many else "Samples",
                                   {name: (*about, None) for name, about in SAMPLE_CHANNELS.items()})
                         for n in nodes}
        self._messages = {(kind, n): self._message_group(kind, n, many) for kind in _MESSAGES for n in nodes}

    def _message_group(self, kind: MessageKind, node: int, many: bool) -> _Group:
        codec = self._protocol.codecs[kind]
        return _Group(f"{codec.name} {node}" if many else codec.name, {
            x.name: (x.unit, _about(x), _stored(x)[1]) for x in codec.layouts})

    def feed(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock | None = None) -> None:
        """Take in frames, received and sent, and what was estimated from them."""
        if self._start_ns is None:
            if not len(block):
                return
            self._start_ns = int(block.t_ns[0])
        for part in (block, sent):
            if part is not None and len(part):
                self._decode(part)
        for one in tracked:
            self._track(one)

    def mark(self, mark: Mark) -> None:
        """A remark; the file has them in its comment."""
        if len(self._marks) < _MARKS_KEPT:
            at = 0.0 if self._start_ns is None else 1e-9 * (mark.t_ns - self._start_ns)
            self._marks.append(f"{at:.6f} s: {one_line(mark.text)}")

    def _seconds(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(1e-9 * (t_ns - (self._start_ns or 0)), np.float64)

    def _decode(self, block: FrameBlock) -> None:
        labels = self._protocol.classify(block.raw)
        for (kind, node), group in self._messages.items():
            rows = np.flatnonzero(labels == kind * NODES + node)
            if rows.size:
                self._gather(group, self._seconds(block.t_ns[rows]),
                             _values(self._protocol.codecs[kind], block, rows))

    def _track(self, part: Tracked) -> None:
        run, e = part.run, part.estimate
        arrived = self._seconds(run.t_ns)
        since = self._clocks[part.node].times(run)
        offset = self._offset.setdefault(part.node, float(arrived[0] - since[0]))
        time_s = since + offset
        columns: Columns = {"sample_counter": (run.counter & 0xFFFFFFFF).astype(np.uint32)}
        for row, name in enumerate(("i_alpha", "i_beta", "v_alpha", "v_beta")):
            columns[name] = run.values[row]
        columns |= {"theta_e": e.angle[speed.THETA_HAT], "omega_e": e.angle[speed.OMEGA], "sigma_theta": e.sigma}
        for name, bit in (("valid", confidence.VALID), ("locked", confidence.LOCKED),
                          ("polarity_known", confidence.POLARITY_KNOWN)):
            columns[name] = (e.flags & bit != 0).astype(np.uint8)
        columns |= {"injecting": part.injecting, "filled": run.filled, "excitation": e.excitation,
                    "innovation": e.flux[common.INNOVATION], "lambda_alpha": e.flux[common.LAMBDA_A],
                    "lambda_beta": e.flux[common.LAMBDA_B], "arrival_delay": arrived - time_s}
        self.rows += time_s.size
        self._gather(self._samples[part.node], time_s, {
            name: column.astype(np.float32) if column.dtype == np.float64 else column
            for name, column in columns.items()})

    def _gather(self, group: _Group, time_s: NDArray[np.float64], columns: Columns) -> None:
        # Viewers want time that never runs back; a clock that was set does it.
        time_s = np.maximum(np.maximum.accumulate(time_s), group.last)
        group.last = float(time_s[-1])
        group.waiting.append((time_s, columns))
        group.rows += time_s.size
        if group.rows >= BATCH:
            self._write(group)

    def _write(self, group: _Group) -> None:
        if not group.waiting:
            return
        from asammdf import Signal

        parts, group.waiting, group.rows = group.waiting, [], 0
        time_s = np.concatenate([t for t, _ in parts])
        columns = {name: np.concatenate([c[name] for _, c in parts]) for name in group.channels}
        self.size += time_s.nbytes + sum(c.nbytes for c in columns.values())
        if group.index < 0:
            group.index = self._file.append(
                [Signal(samples=columns[name], timestamps=time_s, name=name, unit=unit, comment=comment,
                        conversion=conversion)
                 for name, (unit, comment, conversion) in group.channels.items()],
                acq_name=group.name, comment=group.name, common_timebase=True)
            return
        self._file.extend(group.index, [(time_s, None), *((columns[name], None) for name in group.channels)])

    def close(self) -> None:
        """Put the file together."""
        try:
            for group in (*self._samples.values(), *self._messages.values()):
                self._write(group)
            if self._start_ns is not None:
                self._file.header.start_time = datetime.datetime.fromtimestamp(
                    self._start_ns // 10**9, datetime.UTC) + datetime.timedelta(
                        microseconds=self._start_ns % 10**9 // 1000)
            if self._marks:
                self._file.header.comment = "\n".join(["Marked while it was recorded:", *self._marks])
            self._file.save(self.path, overwrite=True, compression=1)
        finally:
            self.drop()

    def drop(self) -> None:
        """Let go of the temporary file; what is not saved is gone."""
        with contextlib.suppress(Exception):
            self._file.close()


_Item = tuple[FrameBlock, Sequence[Tracked], FrameBlock] | Mark


class MeasureRecorder:
    """A `MeasureFile` with a thread of its own, as `Recorder` is one for frames; never waits, but in `close`.

    Raises LogError where the file exists or cannot be made.
    """

    def __init__(self, path: str | Path, nodes: Sequence[int], protocol: Protocol, *, room: int = ROOM,
                 flush_s: float = FLUSH_S) -> None:
        if Path(path).exists():
            raise LogError(f"{path} exists, and recordings are never overwritten; allowed is a new name")
        self._file = MeasureFile(path, nodes, protocol)
        self._problem = ""
        self._saved = 0
        self._frames = 0
        self._background: Background[_Item] = Background("measure", self._work, room, flush_s)

    def take(self, block: FrameBlock, tracked: Sequence[Tracked], sent: FrameBlock) -> None:
        """What came in, what was estimated, what was sent."""
        self._background.put((block, tracked, sent), len(block) + len(sent))

    def mark(self, mark: Mark) -> None:
        """A remark."""
        self._background.put(mark, 0)

    def status(self) -> RecordStatus:
        """As of now; the size is that of the rows so far, before they are packed."""
        b = self._background
        return RecordStatus("measure", str(self._file.path), 1, self._frames, self._saved or self._file.size,
                            b.waiting, b.refused, b.lost, self._problem)

    def _work(self, items: list[_Item]) -> None:
        try:
            for item in items:
                if isinstance(item, Mark):
                    self._file.mark(item)
                else:
                    self._file.feed(*item)
                    self._frames += len(item[0]) + len(item[2])
        except Exception as error:
            self._problem = words_of_failure(self._file.path, error)
            self._file.drop()
            raise

    def close(self) -> None:
        """Put the file together; never raises."""
        self._background.close()
        if self._problem:
            return
        try:
            self._file.close()
            self._saved = self._file.path.stat().st_size
        except Exception as error:
            self._problem = words_of_failure(self._file.path, error)
