"""A measurement: what a log, or the last seconds of live traffic, hold of one drive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.analysis.pieces import EncoderPiece, MapPieces, Pieces, SamplePiece, StatusPiece, WirePieces
from ipmsm_can.bus.absence import Identifiers, absence
from ipmsm_can.bus.replay import prepare
from ipmsm_can.config.build import build_protocol
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs import read_log
from ipmsm_can.mapping import load_map, make_plan
from ipmsm_can.mapping.check import abilities, wrong_bus
from ipmsm_can.mapping.survey import Survey
from ipmsm_can.wire.protocol import DriveMode, Protocol

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_FAR = 1 << 31
_WRAP = 1 << 32


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a log holds of one drive, as arrays.  Electrical, peak, per phase, amplitude-invariant.

    sample_rate: [Hz].  sample (N,): numbers of the samples, rising; neighbours differ by 1, and by more where
    samples are missing.  time (N,): [s] from the first sample.  t_ns (N,): arrival [ns].
    i_alpha, i_beta (N,): [A].  v_alpha, v_beta (N,): [V], mean of the interval that ended at the sample.
    usable (N,): received, finite, not filled, not cut off, and its number beyond doubt.
    clipped (N,): cut off at the end of the wire's range.  running, injecting (N,): as the drive last said (True and
    False where it never did); a drive that does not run does not apply the voltage that it reports.
    encoder_sample, encoder_theta, encoder_omega (R,): the sample a report belongs to, angle [rad electrical] and
    speed [rad/s electrical, NaN where not reported]; empty without an encoder.
    status_sample, status_mode (a DriveMode), status_v_dc [V], status_temperature [degC], status_faults (bits),
    status_waveform (a Waveform), (Q,): what the drive said of itself, NaN where it did not.
    voltage_delay: by how many samples a map says that the voltage is late; 0 on our own wire.
    counts: of the wire by name - received, lost, filled, gaps, duplicates, reordered, restarts, clipped, ...
    source: what it was read from.  problem: why reading ended before the end of the log, "" where it did not.
    """

    sample_rate: float
    sample: Ints
    time: Floats
    t_ns: Ints
    i_alpha: Floats
    i_beta: Floats
    v_alpha: Floats
    v_beta: Floats
    usable: Bools
    clipped: Bools
    running: Bools
    injecting: Bools
    encoder_sample: Ints
    encoder_theta: Floats
    encoder_omega: Floats
    status_sample: Ints
    status_mode: Floats
    status_v_dc: Floats
    status_temperature: Floats
    status_faults: Floats
    status_waveform: Floats
    voltage_delay: float = 0.0
    counts: Mapping[str, int] = field(default_factory=dict)
    source: str = ""
    problem: str = ""

    def __len__(self) -> int:
        return len(self.sample)

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.time[-1]) if len(self) else 0.0


class MeasurementBuilder:
    """Collects a measurement from blocks of frames, of a log or live.

    config: the drive.  protocol: the wire; None builds the one of wire.dbc.
    pieces: what reads the frames instead of the project's own wire, such as `MapPieces`.
    window_s: keep only so many of the last seconds [s], in bounded memory; None keeps all.
    """

    def __init__(self, config: DriveConfig, protocol: Protocol | None = None, *,
                 pieces: WirePieces | MapPieces | None = None, window_s: float | None = None,
                 voltage_delay: float = 0.0, source: str = "") -> None:
        self.pieces = pieces or WirePieces(config, protocol or build_protocol([config]))
        self.source = source
        self.problem = ""
        self._delay = voltage_delay
        self._window = window_s
        self._samples: deque[SamplePiece] = deque()
        self._encoder: deque[EncoderPiece] = deque()
        self._status: deque[StatusPiece] = deque()

    def feed(self, block: FrameBlock) -> None:
        """Take in the next frames; never raises for what is in them."""
        self._take(self.pieces.feed(block))

    def finish(self) -> None:
        """Nothing more comes."""
        self._take(self.pieces.finish())

    def _take(self, new: Pieces) -> None:
        self._samples += new.samples
        self._encoder += new.encoder
        self._status += new.status
        if self._window is None or not self._samples:
            return
        last = self._samples[-1]
        oldest = int(last.sample[-1]) - math.ceil(self._window * last.sample_rate)
        while int(self._samples[0].sample[-1]) < oldest:
            self._samples.popleft()
        # One report more, as it holds for what follows; a bus without samples must not fill the memory either.
        since = int(self._samples[0].t_ns[0])
        for reports in (self._encoder, self._status):
            while len(reports) > 1 and int(reports[1].t_ns[0]) < since:
                reports.popleft()

    @property
    def samples(self) -> int:
        """How many are held."""
        return sum(piece.sample.size for piece in self._samples)

    def measurement(self, window_s: float | None = None) -> Measurement:
        """What was collected; window_s: of the last seconds [s] only.

        Where the drive changed its sample rate, the part with the rate that most samples have.
        """
        weight: dict[float, int] = {}
        for piece in self._samples:
            weight[piece.sample_rate] = weight.get(piece.sample_rate, 0) + piece.sample.size
        rate = max(weight, key=lambda r: weight[r], default=math.nan)
        chosen = [p for p in self._samples if p.sample_rate == rate]
        sample = _joined([p.sample for p in chosen], np.int64)
        begin = 0
        if window_s is not None and sample.size:
            begin = int(np.searchsorted(sample, sample[-1] - math.ceil(window_s * rate)))
        values = (np.concatenate([p.values for p in chosen], axis=1)[:, begin:] if chosen else np.zeros((4, 0)))
        sample = sample[begin:]
        t_ns = _joined([p.t_ns for p in chosen], np.int64)[begin:]
        counter = _joined([p.counter for p in chosen], np.int64)[begin:]
        usable = _joined([p.good for p in chosen], np.bool_)[begin:] & np.isfinite(values).all(axis=0)
        clipped = _joined([p.clipped for p in chosen], np.bool_)[begin:]
        arrival = np.maximum.accumulate(t_ns) if t_ns.size else t_ns
        status = {name: _joined([getattr(p, name) for p in self._status], np.float64)
                  for name in ("mode", "v_dc", "temperature", "faults", "waveform")}
        status_t = _joined([p.t_ns for p in self._status], np.int64)
        encoder_sample, encoder_theta, encoder_omega = self._reports(sample, counter, arrival)
        return Measurement(
            rate, sample, (sample - (sample[0] if sample.size else 0)) / rate, t_ns,
            values[0], values[1], values[2], values[3], usable, clipped,
            _held(arrival, status_t, status["mode"], DriveMode.RUNNING) == DriveMode.RUNNING,
            _held(arrival, status_t, status["waveform"], 0.0) != 0.0,
            encoder_sample, encoder_theta, encoder_omega,
            _at(arrival, sample, status_t), status["mode"], status["v_dc"], status["temperature"],
            status["faults"], status["waveform"], self._delay, dict(self.pieces.counts), self.source, self.problem)

    def _reports(self, sample: Ints, counter: Ints, arrival: Ints) -> tuple[Ints, Floats, Floats]:
        """Encoder reports at the samples they name: counters count from the sample that arrived nearest."""
        t_ns = _joined([p.t_ns for p in self._encoder], np.int64)
        theta = _joined([p.theta for p in self._encoder], np.float64)
        omega = _joined([p.omega for p in self._encoder], np.float64)
        if not (sample.size and t_ns.size):
            return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
        near = np.clip(np.searchsorted(arrival, t_ns), 0, sample.size - 1)
        ahead = _joined([p.counter for p in self._encoder], np.int64) - counter[near]
        ahead = (ahead + _FAR) % _WRAP - _FAR
        at = sample[near] + ahead
        good = (at >= sample[0]) & (at <= sample[-1])
        at, first = np.unique(at[good], return_index=True)
        return at, theta[good][first], omega[good][first]


def _joined(parts: Iterable[NDArray[np.generic]], kind: type) -> NDArray:  # type: ignore[type-arg]
    parts = list(parts)
    return np.concatenate(parts) if parts else np.zeros(0, kind)


def _at(arrival: Ints, sample: Ints, t_ns: Ints) -> Ints:
    """Number of the sample that a report came with."""
    if not sample.size:
        return np.zeros(t_ns.size, np.int64)
    return sample[np.clip(np.searchsorted(arrival, t_ns), 0, sample.size - 1)]


def _held(arrival: Ints, t_ns: Ints, said: Floats, unless_said: float) -> Floats:
    """What the last report before each sample said."""
    order = np.argsort(t_ns, kind="stable")
    said, t_ns = said[order], t_ns[order]
    known = np.flatnonzero(np.isfinite(said))
    if not known.size:
        return np.full(arrival.size, unless_said)
    # What a drive says first held before, too, as far as anybody can tell.
    at = np.maximum(np.searchsorted(t_ns[known], arrival, side="left") - 1, 0)
    return np.asarray(said[known][at], np.float64)


def read_measurement(log: Path, config: DriveConfig, *, map_name: str | None = None, node: int | None = None,
                     channel: str | None = None, progress: Callable[[float], None] | None = None,
                     window_s: float | None = None) -> Measurement:
    """The measurement that a log holds of the drive of `config`.

    map_name: the log is of another inverter: name or path of its map; node: instead of the map's.
    channel: only the frames of this channel.  progress: told the share of the file read, 0..1.
    window_s: only the last seconds [s].
    A log that is cut off gives its readable part, and `Measurement.problem` says so.
    Raises ValueError (LogError, MapError, DbcError) with one sentence: a log that cannot be read or holds no sample
    of the drive; a map that gives no alpha-beta currents and mean voltages at a rate that is enough.
    """
    log = Path(log)
    if map_name is not None:
        return _read_mapped(log, config, map_name, node, channel, progress, window_s)
    if node is not None:
        raise ValueError("--node goes with --map; without a map the drive.toml has wire.node")
    reader = read_log(log, channel=channel)
    protocol = build_protocol([config])
    seen = Identifiers()
    chosen, blocks = prepare([config], protocol, reader)
    wire = WirePieces(chosen[0], protocol)
    builder = MeasurementBuilder(chosen[0], protocol, pieces=wire, window_s=window_s, source=str(log))
    for block in blocks:
        seen.note(block)
        builder.feed(block)
        if progress is not None:
            progress(reader.done)
    builder.finish()
    if not builder.samples:
        bad = wire.receiver.bad_frames + wire.receiver.sequencer.count("bad_rate")
        raise ValueError(reader.problem or absence(wire.node, seen, protocol, wire.waiting, bad, log, channel))
    builder.problem = log_problem(reader.problem, reader.bad_lines, log)
    return builder.measurement()


def _read_mapped(log: Path, config: DriveConfig, map_name: str, node: int | None, channel: str | None,
                 progress: Callable[[float], None] | None, window_s: float | None) -> Measurement:
    survey = surveyed(log, config, map_name, node, channel)
    fast = abilities(survey)[0]
    if not fast.able:
        raise ValueError(f"{log} with the map {map_name} does not hold the samples that this takes: {fast.why}")
    return measure_mapped(log, config, survey, channel, progress, window_s, f"{log} with the map {map_name}")


def surveyed(log: Path, config: DriveConfig, map_name: str, node: int | None, channel: str | None) -> Survey:
    """The survey of a log of another inverter.  Raises ValueError with one sentence where it holds no sample."""
    plan = make_plan(load_map(map_name), node=node, pole_pairs=config.build_motor().pole_pairs)
    survey = Survey(plan, config.wire.sample_rate)
    survey.run(read_log(log, channel=channel))
    if not survey.found:
        raise ValueError(wrong_bus(survey, str(log)))
    if not survey.rows:
        raise ValueError(f"{log} holds no sample of the map {map_name}; `ipmsm-can map --check` says why")
    return survey


def measure_mapped(log: Path, config: DriveConfig, survey: Survey, channel: str | None,
                   progress: Callable[[float], None] | None, window_s: float | None, source: str) -> Measurement:
    """The measurement of another inverter's log whose survey allows the fast observer."""
    inverter = survey.plan.map
    delay = inverter.voltage.delay if inverter.voltage is not None else 0.0
    reader = read_log(log, channel=channel)
    builder = MeasurementBuilder(config, pieces=MapPieces(survey.plan, survey.rate), window_s=window_s,
                                 voltage_delay=delay, source=source)
    for block in reader:
        builder.feed(block)
        if progress is not None:
            progress(reader.done)
    builder.finish()
    builder.problem = log_problem(reader.problem, reader.bad_lines, log)
    return builder.measurement()


def log_problem(problem: str, bad_lines: int, log: Path) -> str:
    """Why a log was not read to its end or not all of it, "" where it was."""
    return problem or (f"{log} is damaged: {bad_lines} of its lines cannot be read" if bad_lines else "")
