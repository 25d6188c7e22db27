"""`ipmsm-can replay`: a recorded log through the companion."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipmsm_can.bus.replay import NodeSummary, Replay
    from ipmsm_can.bus.rows import RowBlock, RowFile
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.logs.marks import Mark
    from ipmsm_can.record.measure import MeasureFile
    from ipmsm_can.wire.protocol import Protocol

HELP = """\
Run the companion over a recorded log: a summary on the terminal and, with --out, one row per sample.

LOG is BLF (.blf), candump text (.log, as `candump -L` writes it), MF4 (.mf4, needs asammdf) or another format
python-can reads (.asc .csv .db .trc; much slower), packed with .gz or not. Nothing is transmitted.
"""
EPILOG = """\
columns of --out, one row per sample of the drive, filled ones included:
  sample         the drive's 32-bit sample counter
  filled         1: the sample was lost and stands on a straight line between its neighbours
  time_s         time of the SAMPLE [s], 0 at the first sample of the log: counter over sample rate, so it is
                 free of the jitter of arrival. Where the counter says nothing (the drive restarted or changed
                 its sample rate) the arrival times bridge the step. It never runs backwards.
  theta_rad      the observer's angle [rad ELECTRICAL, -pi to pi]
  omega_rad_s    speed of the phase-locked loop behind it [rad/s ELECTRICAL]
  valid, locked  1: the angle may be used; 1: the observer has converged
  injecting      1: the drive said (DriveStatus) that it injects
  excitation     smallest eigenvalue of the windowed integral of Phi Phi^T [V^2 s]
  lambda_alpha, lambda_beta   estimated stator flux linkage [Wb peak]

--out run.mf4 is a measurement file instead (docs/record.md): decoded signals of the drives and the estimates, with
units, for CANape, asammdf and other viewers of MDF; with several --drive one file for all.

With several --drive, the node number is added to the name: --out run.csv gives run.node0.csv and so on.
An existing file is replaced. After Ctrl-C everything replayed so far is in the file.

examples:
  ipmsm-can replay run.blf --drive drive.toml
  ipmsm-can replay run.log.gz --drive drive.toml --out estimates.parquet
  ipmsm-can replay run.blf --drive drive.toml --out run.mf4
  ipmsm-can replay both.asc --drive a.toml --drive b.toml --out estimates.csv
  ipmsm-can replay car.blf --drive drive.toml --map cascadia_pm_dq

exit codes: 0 all well, 2 bad input; a log that is cut off or damaged is bad input, too: what was readable of it is
replayed, and one sentence says what was wrong
"""

_PROGRESS_S = 0.2
_BLOCK_FRAMES = 65536
_MARKS_SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", metavar="LOG", help="the recorded log")
    parser.add_argument("--drive", action="append", required=True, metavar="drive.toml",
                        help="configuration of a drive in the log; may be given several times")
    parser.add_argument("--out", metavar="FILE",
                        help="one row per sample into this .csv or .parquet file, or all signals into this .mf4")
    parser.add_argument("--map", metavar="MAP", help="the log is of another inverter: a map, or the name of one "
                        "(docs/mapping.md, ipmsm-can map list)")
    parser.add_argument("--node", type=int, metavar="N", help="with --map: number of the drive, if not the map's")
    parser.add_argument("--channel", metavar="NAME", help="take only the frames of this channel of the log")


def main(args: argparse.Namespace) -> int:
    """Replay; returns the exit code."""
    if args.map is not None:
        from ipmsm_can.cli.mapped import replay_mapped

        _leave_on_sigterm()
        return replay_mapped(args)
    if args.node is not None:
        raise ValueError("--node goes with --map; without a map the drive.toml has wire.node")
    from ipmsm_can.config import load_configs
    from ipmsm_can.config.build import build_protocol
    from ipmsm_can.logs import read_log

    log = Path(args.log)
    configs = load_configs(args.drive)
    inputs = [log, *map(Path, args.drive)]
    measure = _measure_path(args.out, inputs)
    paths = _row_paths(None if measure else args.out, configs, inputs)
    reader = read_log(log, block_frames=_BLOCK_FRAMES, channel=args.channel)
    protocol = build_protocol(configs)
    session = Session(configs, protocol, paths, measure)
    _leave_on_sigterm()
    try:
        session.run(reader)
    except KeyboardInterrupt:
        print(f"ipmsm-can replay: interrupted after {session.rows} samples"
              + (", which are written" if paths else ""), file=sys.stderr)
        raise
    print(session.report())
    for line in _marked(reader.marks, session.begin_ns):
        print(line)
    if reader.passed_over:
        print(f"{reader.passed_over} objects of the log hold no CAN frame and were passed over")
    absent = [c for c in configs if not session.replay.summaries[c.wire.node].rows]
    for config in absent:
        print(f"ipmsm-can replay: {_absence(config, session.replay, protocol, log, args.channel)}", file=sys.stderr)
    if reader.problem or reader.bad_lines:
        told = reader.problem or f"{log} is damaged: {reader.bad_lines} of its lines cannot be read"
        print(f"ipmsm-can replay: {told}; what was readable is replayed", file=sys.stderr)
    return 2 if absent or reader.problem or reader.bad_lines else 0


def _leave_on_sigterm() -> None:
    """A polite kill ends the run as Ctrl-C does, so that files are closed."""
    def leave(_number: int, _frame: Any) -> None:
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGTERM, leave)
    except ValueError:
        return  # not in the main thread: then somebody else looks after signals


def _measure_path(out: str | None, inputs: Sequence[Path]) -> Path | None:
    """The measurement file, if --out names one; raises ValueError where it cannot be written or is an input."""
    if out is None or Path(out).suffix.lower() != ".mf4":
        return None
    from ipmsm_can.record.measure import check_measure_path

    check_measure_path(out)
    if any(Path(out).exists() and given.exists() and Path(out).samefile(given) for given in inputs):
        raise ValueError(f"--out {out} is one of the input files; allowed is another file")
    return Path(out)


def _marked(marks: Sequence[Mark], begin_ns: int) -> list[str]:
    """The remarks of a recording, with their time from its first frame."""
    lines = [f"marked at {1e-9 * (mark.t_ns - begin_ns):.3f} s: {mark.text}" for mark in marks[:_MARKS_SHOWN]]
    more = len(marks) - len(lines)
    return [*lines, f"... and {more} more marks"] if more else lines


def _row_paths(out: str | None, configs: Sequence[DriveConfig], inputs: Sequence[Path]) -> dict[int, Path]:
    """File by node number; raises ValueError where one cannot be written or is an input."""
    from ipmsm_can.bus.rows import check_rows_path

    if out is None:
        return {}
    path = Path(out)
    if len(configs) == 1:
        paths = {configs[0].wire.node: path}
    else:
        numbers = [c.wire.node for c in configs]
        paths = {n: path.with_name(f"{path.stem}.node{n}{path.suffix}") for n in numbers}
    for target in paths.values():
        check_rows_path(target)
        if any(target.exists() and given.exists() and target.samefile(given) for given in inputs):
            raise ValueError(f"--out {target} is one of the input files; allowed is another file")
    return paths


class Session:
    """One replay with its files and its clock.

    compute_s: time spent on everything but reading the log [s], writing rows included; read_s: on that.
    Neither holds the loading of compiled kernels, or their compilation on the first run ever.
    """

    def __init__(self, configs: Sequence[DriveConfig], protocol: Protocol, paths: dict[int, Path],
                 measure: Path | None = None) -> None:
        self.replay: Replay
        self.begin_ns = 0
        """Time of the first frame [ns]."""
        self._measure_path = measure
        self._measure: MeasureFile | None = None
        self.files: dict[int, RowFile] = {}
        self.compute_s = 0.0
        self.read_s = 0.0
        self._configs = configs
        self._protocol = protocol
        self._paths = paths
        self._shown = time.monotonic()
        self._progress = sys.stderr.isatty()

    @property
    def rows(self) -> int:
        """Samples so far, of all drives."""
        return sum(s.rows for s in self.replay.summaries.values()) if hasattr(self, "replay") else 0

    def run(self, blocks: Any) -> None:
        """Replay all blocks; files are complete afterwards, whatever happens."""
        from ipmsm_can.bus.replay import Replay, prepare
        from ipmsm_can.bus.rows import warm_up
        from ipmsm_can.bus.warmup import warm_up_companion

        warm_up_companion(self._configs, self._protocol)
        warm_up()
        begin = time.monotonic()
        configs, source = prepare(self._configs, self._protocol, blocks)
        if self._measure_path is not None:
            from ipmsm_can.record.measure import MeasureFile

            self._measure = MeasureFile(self._measure_path, [c.wire.node for c in configs], self._protocol)
        self.replay = Replay(configs, self._protocol, self._write if self._paths else None,
                             self._measure.feed if self._measure else None)
        self.read_s += time.monotonic() - begin
        try:
            while True:
                begin = time.monotonic()
                block = next(source, None)
                self.read_s += time.monotonic() - begin
                if block is None:
                    break
                self.begin_ns = self.begin_ns or (int(block.t_ns[0]) if len(block) else 0)
                begin = time.monotonic()
                self.replay.feed(block)
                self.compute_s += time.monotonic() - begin
                self._show(getattr(blocks, "done", 0.0))
        finally:
            begin = time.monotonic()
            for file in self.files.values():
                file.close()
            if self._measure is not None:
                for mark in getattr(blocks, "marks", ()):
                    self._measure.mark(mark)
                self._measure.close()
            self.compute_s += time.monotonic() - begin
            if self._progress:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _write(self, node: int, rows: RowBlock) -> None:
        from ipmsm_can.bus.rows import open_rows

        if node not in self.files:
            self.files[node] = open_rows(self._paths[node])
        self.files[node].write(rows)

    def _show(self, done: float) -> None:
        now = time.monotonic()
        if self._progress and now - self._shown > _PROGRESS_S:
            self._shown = now
            reached = max((s.duration for s in self.replay.summaries.values()), default=0.0)
            share = f"{100.0 * done:.0f} %, " if done else ""
            print(f"\r\x1b[Kreplaying: {share}{self.rows} samples, {reached:.0f} s of the log", end="",
                  file=sys.stderr, flush=True)

    def report(self) -> str:
        """The summary for a person."""
        lines: list[str] = []
        for number, summary in self.replay.summaries.items():
            lines += _node_lines(number, summary, self.replay)
        counts = self.replay.companion.counts
        lines.append(f"log: {counts.frames} frames, {counts.unknown} with identifiers that are not ours, "
                     f"{counts.wrong_length} of wrong length, {counts.remote} remote, {counts.errors} error frames")
        if self.rows and self.compute_s > 0.0:
            lines.append(f"replayed {self.rows} samples in {self.compute_s:.2f} s "
                         f"({self.rows / self.compute_s:.3g} samples/s); "
                         f"reading the log took another {self.read_s:.2f} s")
        lines += [f"wrote {file.path}" for file in self.files.values()]
        lines += [f"wrote {self._measure.path}"] if self._measure is not None else []
        return "\n".join(lines)


def _node_lines(number: int, s: NodeSummary, replay: Replay) -> list[str]:
    node = replay.companion.nodes[number]
    count = node.receiver.sequencer.count
    lines = [f"node {number}: {s.rows} samples over {s.duration:.3f} s at {s.sample_rate:g} Hz",
             f"  wire       {count('lost')} lost, {count('filled')} of them filled; {count('gaps')} gaps, "
             f"{count('duplicates')} duplicates, {count('reordered')} late, {count('restarts')} restarts, "
             f"{count('resyncs')} resyncs, {node.bad_frames} bad frames, {count('clipped')} cut off"]
    if not s.rows:
        return [f"node {number}: no samples", lines[1]]
    lines.append(f"  lock       {_when('first locked', s.first_locked)}, locked {_share(s.locked, s.rows)}; "
                 f"{_when('first valid', s.first_valid)}, valid {_share(s.valid, s.rows)} of the samples")
    timing = node.estimator.voltage_delay.words if node.estimator is not None else ""
    if timing:
        lines.append(f"  timing     {timing}")
    encoder = s.encoder
    if encoder.compared:
        lines.append(f"  encoder    error {math.degrees(encoder.rms):.3f} deg rms, "
                     f"{math.degrees(encoder.largest):.3f} deg at most (electrical), "
                     f"at {encoder.compared} valid samples")
    elif encoder.references:
        lines.append(f"  encoder    {encoder.references} DriveReference frames, none at a valid sample")
    else:
        lines.append("  encoder    no DriveReference frames to compare with")
    return lines


def _when(what: str, at: float | None) -> str:
    return f"never {what.removeprefix('first ')}" if at is None else f"{what} at {at:.3f} s"


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.1f} %"


def _absence(config: DriveConfig, replay: Replay, protocol: Protocol, log: Path, channel: str | None) -> str:
    """Why there is not one row of this drive, in one sentence."""
    from ipmsm_can.bus.absence import absence

    node = replay.companion.nodes[config.wire.node]
    waiting = node.receiver.sequencer.waiting
    return absence(node.number, replay.seen, protocol, waiting, node.bad_frames, log, channel)
