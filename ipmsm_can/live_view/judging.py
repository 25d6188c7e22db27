"""The findings' process: frames in through a pipe, findings out through another.

To judge a drive takes tenths of a second of computing every few seconds, in pieces that hold a Python process up
for tens of milliseconds: too long beside a thread that has to answer within one.  So it is done by a process of its
own, at low priority.

`python -m ipmsm_can.live_view.judging` is that process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import IO, TYPE_CHECKING, Any, Protocol

from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.status import SEVERITIES, Told

if TYPE_CHECKING:
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.diagnosis.live import LiveDiagnosis

JUDGE_S = 2.0
"""Time between two judgements [s]."""
DRIVE_S = 5.0
"""The least time between two judgements of a drive, the dearest [s]."""
_NICE = 10
_WAIT_S = 2.0
"""How long strangers alone are no finding."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be judged.  rates: nominal and data bit rate [bit/s].  error_classes: as in `BusHealth`.

    map: of the one drive, if it is another inverter: name or path, "" for our own wire; node: instead of the map's.
    """

    configs: tuple[DriveConfig, ...]
    rates: tuple[int, int]
    error_classes: bool
    map: str = ""
    node: int | None = None


@dataclass(frozen=True, slots=True)
class Batch:
    """Frames, and what the port knows as of then.

    drops: frames dropped by the kernel, -1 where nobody tells.  outages, outage_time [s].  no_bus: why there is
    none now, "" where there is one.
    """

    block: FrameBlock
    drops: int = -1
    outages: int = 0
    outage_time: float = 0.0
    no_bus: str = ""


class Source(Protocol):
    """Something that makes findings of frames, in memory that does not grow.  Two threads may call it."""

    def feed(self, batch: Batch) -> None:
        """Take in frames."""

    def findings(self) -> Sequence[Told]:
        """What is the matter as of now."""


class BusSource:
    """The bus's health."""

    def __init__(self, plan: Plan) -> None:
        from ipmsm_can.bus.health import BusHealth, warm_up
        from ipmsm_can.config.build import build_protocol

        protocol = build_protocol(plan.configs)
        warm_up(protocol)
        # another's messages may have our identifiers, and are no samples of ours
        self._health = BusHealth(*plan.rates, protocol=None if plan.map else protocol,
                                 error_classes=plan.error_classes)

    def feed(self, batch: Batch) -> None:
        """Take in frames."""
        self._health.note_port(batch.drops)
        self._health.note_outages(batch.outages, batch.outage_time, batch.no_bus)
        self._health.update(batch.block)

    def findings(self) -> list[Told]:
        """As of now."""
        return [Told(f.severity, f.sentence, f.advice) for f in self._health.report().findings]


class DriveSource:
    """The diagnosis of a drive.  name: put before each sentence, "" where there is but one drive."""

    def __init__(self, config: DriveConfig, name: str) -> None:
        from ipmsm_can.diagnosis.live import LiveDiagnosis

        self._diagnosis = LiveDiagnosis(config, every_s=DRIVE_S)
        self._name = name

    def feed(self, batch: Batch) -> None:
        """Take in frames."""
        self._diagnosis.feed(batch.block)

    def findings(self) -> list[Told]:
        """As of now; the cause of the rest first."""
        return _told(self._diagnosis, self._name)


DOUBTFUL = "signals.doubtful"
"""What this says is among the notes of the look at the signals, which are shown anyway."""


def _told(diagnosis: LiveDiagnosis, name: str = "") -> list[Told]:
    return [Told(f.severity if f.severity in SEVERITIES else "notice", name + f.sentence, f.advice)
            for f in diagnosis.findings() if f.code != DOUBTFUL]


class MappedSource:
    """Another inverter through its map: what is missing or doubtful of its signals, and, where they allow the fast
    observer or the steady-state checks, the diagnosis of the drive."""

    def __init__(self, plan: Plan) -> None:
        from ipmsm_can.diagnosis.live_mapped import MappedDiagnosis
        from ipmsm_can.mapping import load_map, make_plan

        config = plan.configs[0]
        pole_pairs = config.build_motor().pole_pairs
        self._drive = MappedDiagnosis(config, make_plan(load_map(plan.map), node=plan.node, pole_pairs=pole_pairs),
                                      every_s=DRIVE_S)

    def feed(self, batch: Batch) -> None:
        """Take in frames."""
        self._drive.feed(batch.block)

    def findings(self) -> list[Told]:
        """As of now: why there is no angle, what is wrong with the signals, what with the drive."""
        look, diagnosis = self._drive.look, self._drive.diagnosis
        found = [] if diagnosis is None else _told(diagnosis)
        if look.nothing_came and self._drive.silent_s > _WAIT_S:
            found.append(Told("warning", _sentence(self._drive.why_none("the bus")),
                              "Is it the right map, and --node the right number?"))
        elif look.allowed is None and look.notes:
            found.append(Told("warning", _sentence(look.verdict)))
        elif look.allowed is not None and not look.allowed.fast:
            found.append(Told("notice", _sentence(look.verdict), "docs/mapping.md says what each function needs."))
        return found + [Told("notice", f"Of the map: {note}.", "`ipmsm-can map --check` tells more, from a log.")
                        for note in look.notes]


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def build_sources(plan: Plan) -> dict[str, Source]:
    """What is looked at, by its name in words."""
    sources: dict[str, Source] = {"the bus": BusSource(plan)}
    if plan.map:
        return {**sources, f"drive {plan.configs[0].wire.node} through its map": MappedSource(plan)}
    for config in plan.configs:
        number, several = config.wire.node, len(plan.configs) > 1
        sources[f"drive {number}"] = DriveSource(config, f"drive {number}: " if several else "")
    return sources


class Judge:
    """Sources together; one that fails ends alone, with a sentence in its place."""

    def __init__(self, sources: Mapping[str, Source]) -> None:
        self._sources = sources
        self._broken: dict[str, str] = {}

    def feed(self, batch: Batch) -> None:
        """Take in frames."""
        for name, source in self._sources.items():
            self._guard(name, partial(source.feed, batch))

    def findings(self) -> tuple[Told, ...]:
        """As of now, gravest first."""
        found: list[Told] = []
        for name, source in self._sources.items():
            found += self._guard(name, source.findings) or ()
        found += [Told("warning", words) for words in self._broken.values()]
        return tuple(sorted(found, key=lambda told: SEVERITIES.index(told.severity)))

    def _guard(self, name: str, call: Callable[[], Any]) -> Any:
        if name in self._broken:
            return None
        try:
            return call()
        except Exception as error:
            self._broken[name] = f"The check of {name} failed and was ended: {type(error).__name__}: {error}"
            return None


def serve(source: IO[bytes], out: IO[bytes]) -> None:
    """Plan and batches come in; the names of what is looked at go out, then findings every JUDGE_S."""
    sources = build_sources(pickle.load(source))
    judge = Judge(sources)
    over = threading.Event()

    def read() -> None:
        with contextlib.suppress(EOFError, pickle.UnpicklingError, OSError, ValueError):
            while True:
                judge.feed(pickle.load(source))
        over.set()

    _tell(out, tuple(sources))
    threading.Thread(target=read, name="frames", daemon=True).start()
    while not over.wait(JUDGE_S):
        _tell(out, judge.findings())


def _tell(out: IO[bytes], what: object) -> None:
    out.write(pickle.dumps(what))
    out.flush()


def main() -> int:
    """The findings' process: it ends when the program that feeds it does, not by the user's Ctrl-C."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(_NICE)
    out = sys.stdout.buffer
    sys.stdout = sys.stderr  # what a library may print must not get among the findings
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
        serve(sys.stdin.buffer, out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
