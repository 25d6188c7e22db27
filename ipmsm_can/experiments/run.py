"""Run experiments, on as many processors as there are, and hand back what the page needs.

Every task is a function of its name alone, so the results do not depend on the number of workers.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field

from ipmsm_can.experiments import bench, extraction, findings, pe, sensitivity, simulations
from ipmsm_can.experiments.compare import SCENES, Row, rows_of
from ipmsm_can.experiments.draw import draw, key
from ipmsm_can.experiments.model import Experiment, Figure, Verdict
from ipmsm_can.experiments.rig import observe

EXPERIMENTS: dict[str, Experiment] = {
    e.name: e for part in (simulations, bench, sensitivity, extraction, pe, findings) for e in part.EXPERIMENTS}
"""All experiments by name, in the order of the page."""
COMPARISON = "comparison"
"""The name of the comparison of all observers, beside the experiments' names."""
NAMES = (*EXPERIMENTS, COMPARISON)


@dataclass(frozen=True)
class Drawing:
    """A plot ready for the page: title, key and svg as HTML."""

    title: str
    key: str
    svg: str


@dataclass(frozen=True)
class Result:
    """What an experiment gave; trouble: why it could not be judged, "" if it could."""

    name: str
    verdict: Verdict | None
    figures: tuple[Figure, ...]
    drawings: tuple[Drawing, ...]
    trouble: str = ""


@dataclass
class Results:
    """Results in the order of the page, and the comparison's rows."""

    experiments: list[Result] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)

    @property
    def troubles(self) -> list[str]:
        """What could not be run or judged."""
        return [f"{r.name}: {r.trouble}" for r in self.experiments if r.trouble]


def chosen(names: Sequence[str]) -> list[str]:
    """The names asked for, in the order of the page and once each; all of them if none is given.

    Raises ValueError for a name that is none.
    """
    for name in names:
        if name not in NAMES:
            raise ValueError(f"--only is {name!r}; allowed is {', '.join(NAMES)}")
    return [name for name in NAMES if not names or name in names]


def run_experiment(name: str) -> Result:
    """Run, measure, judge and draw one experiment."""
    e = EXPERIMENTS[name]
    tracks = {run.name: observe(run) for run in e.runs}
    figures = tuple(e.measure(tracks))
    nothing = [f.name for f in figures if math.isnan(f.value)]
    if nothing:
        return Result(name, None, figures, (), f"nothing could be measured for {', '.join(nothing)}")
    verdict = e.judge({f.name: f for f in figures})
    drawings = tuple(Drawing(p.title, key(p), draw(p, f"{name}-{k}")) for k, p in enumerate(e.plots(tracks)))
    return Result(name, verdict, figures, drawings)


def _task(name: str) -> Result | list[Row]:
    if name in EXPERIMENTS:
        try:
            return run_experiment(name)
        except (RuntimeError, ArithmeticError, ValueError) as error:
            return Result(name, None, (), (), str(error))
    return rows_of(next(s for s in SCENES if s.name == name))


def run(names: Sequence[str], workers: int | None = None,
        progress: Callable[[int, int, str, Result | list[Row]], None] | None = None) -> Results:
    """Run what is named (see `chosen`).

    workers: processes; None for one per processor.  progress: called with (done, all, name, what it gave) as each
    task ends, in the order in which they end.
    """
    wanted = chosen(names)
    tasks = [n for n in wanted if n in EXPERIMENTS]
    if COMPARISON in wanted:
        tasks += [s.name for s in SCENES]
    workers = min(workers or len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else workers or 1,
                  len(tasks))
    done: dict[str, Result | list[Row]] = {}

    def note(name: str, gave: Result | list[Row]) -> None:
        done[name] = gave
        if progress is not None:
            progress(len(done), len(tasks), name, gave)

    if workers <= 1:
        for name in tasks:
            note(name, _task(name))
    else:
        # A forked process would inherit locks of the compiler; a spawned one starts clean on every system.
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            futures: dict[Future[Result | list[Row]], str] = {pool.submit(_task, name): name for name in tasks}
            for future in as_completed(futures):
                note(futures[future], future.result())
    results = Results()
    for name in tasks:
        gave = done[name]
        if isinstance(gave, Result):
            results.experiments.append(gave)
        else:
            results.rows += gave
    return results
