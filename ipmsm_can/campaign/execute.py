"""Running a campaign: here on some processes, or on a Dask cluster; records are written as they come.

Every run is a function of (seed, number, kind) alone, so it does not matter where or in which order the runs are
done.  The file of records is JSON Lines: a first line that says which campaign it is, then a line a run.  A
campaign that was killed is continued from it; at most the line that was being written is lost, and that run done
again.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

Record = dict[str, Any]

FORMAT = 1
"""Version of the records' file."""
_CHUNK = 20
"""Runs in one task of a cluster: some seconds of work."""
_CONNECT_S = 20.0


@dataclass(frozen=True, slots=True)
class Plan:
    """Which campaign: runs 0 to runs - 1 of a seed, with an observer of this kind."""

    runs: int
    seed: int
    kind: str

    def check(self) -> None:
        """Raises ValueError with one sentence for a number that cannot be."""
        if not 1 <= self.runs <= 10_000_000:
            raise ValueError(f"--runs is {self.runs}; allowed is 1 to 10000000")
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"--seed is {self.seed}; allowed is 0 to 2^63 - 1")


class RecordFile:
    """The file of records.

    resume: go on with what is there.  Raises ValueError where the file holds another campaign, or is there and was
    not to be continued.
    """

    def __init__(self, path: Path, plan: Plan, resume: bool) -> None:
        self.path = path
        self.done: dict[int, Record] = {}
        head = {"campaign": {"format": FORMAT, "seed": plan.seed, "kind": plan.kind}}
        if resume and path.exists():
            kept = self._read(head)
            with path.open("r+b") as file:
                file.truncate(kept)  # the line that was being written when the campaign was killed
        elif path.exists():
            raise ValueError(f"{path} is there already; --resume continues it, --out names another folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", encoding="utf-8")
        if not path.stat().st_size:
            self._line(head)

    def _read(self, head: Record) -> int:
        """Take in the records; returns how many bytes hold whole lines."""
        data = self.path.read_bytes()
        kept = data.rfind(b"\n") + 1
        lines = data[:kept].splitlines()
        try:
            parsed = [json.loads(line) for line in lines]
            if parsed and "campaign" not in parsed[0]:
                raise ValueError
            records = {int(r["number"]): r for r in parsed[1:]}
        except (ValueError, TypeError, KeyError):
            raise ValueError(f"{self.path} is not a file of a campaign's records") from None
        if parsed and parsed[0] != head:
            found, asked = parsed[0]["campaign"], head["campaign"]
            raise ValueError(f"{self.path} holds the campaign {_words(found)}; to resume it, {_words(asked)} "
                             "has to be the same")
        self.done = records
        return kept

    def add(self, record: Record) -> None:
        """Write a record, at once."""
        self.done[record["number"]] = record
        self._line(record)

    def _line(self, what: Record) -> None:
        self._file.write(json.dumps(what, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _words(campaign: Record) -> str:
    return f"seed {campaign.get('seed')}, kind {campaign.get('kind')}, format {campaign.get('format')}"


def execute(plan: Plan, file: RecordFile, workers: int, scheduler: str | None = None,
            progress: Callable[[Record], None] | None = None) -> list[Record]:
    """Do the runs of the plan that the file does not hold yet; returns the plan's records in order.

    workers: processes here; scheduler: address of a Dask scheduler to use in their place.  progress: called with
    each record as it comes.
    """
    plan.check()
    missing = [k for k in range(plan.runs) if k not in file.done]
    source = _on_cluster(plan, missing, scheduler) if scheduler else _here(plan, missing, workers)
    for record in source:
        file.add(record)
        if progress is not None:
            progress(record)
    return [file.done[k] for k in range(plan.runs)]


def run_one(seed: int, number: int, kind: str) -> Record:
    """One run; the import is the worker's, for it loads the compiler."""
    from ipmsm_can.campaign.trial import run

    return run(seed, number, kind)


def run_some(seed: int, numbers: Sequence[int], kind: str) -> list[Record]:
    """Some runs, one after another."""
    return [run_one(seed, number, kind) for number in numbers]


def warm_up(kind: str) -> None:
    """Compile, or load, every kernel that a run needs: once, before several processes would do it side by side."""
    from ipmsm_can.campaign.scenario import draw
    from ipmsm_can.campaign.trial import simulate

    for number in WARMING:
        simulate(draw(0, number, kind))


WARMING = (0, 1)
"""Runs of seed 0 that take every path: CAN FD and classical, with and without losses, with probing and pulses."""


def _here(plan: Plan, numbers: Sequence[int], workers: int) -> Iterator[Record]:
    if not numbers:
        return
    if workers == 1:
        for number in numbers:
            yield run_one(plan.seed, number, plan.kind)
        return
    warm_up(plan.kind)
    # A forked process would inherit locks of the compiler; a spawned one starts clean on every system.
    pool = ProcessPoolExecutor(min(workers, len(numbers)), mp_context=multiprocessing.get_context("spawn"))
    waiting = iter(numbers)
    try:
        # Few at a time, so that an end by Ctrl-C does not have to wait for ten thousand.
        pending: set[Future[Record]] = {pool.submit(run_one, plan.seed, k, plan.kind)
                                        for k in islice(waiting, 4 * workers)}
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            pending |= {pool.submit(run_one, plan.seed, k, plan.kind) for k in islice(waiting, len(done))}
            for future in done:
                yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _on_cluster(plan: Plan, numbers: Sequence[int], address: str) -> Iterator[Record]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise ValueError("--scheduler needs the package distributed, which is not installed; "
                         "pip install 'ipmsm_can[dask]' installs it") from None
    if not numbers:
        return
    try:
        client = distributed.Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise ValueError(f"--scheduler is {address!r}, where no Dask scheduler answers ({error}); allowed is its "
                         "address, such as tcp://host:8786") from None
    with client:
        hosts = {info["host"]: worker for worker, info in client.scheduler_info(n_workers=-1)["workers"].items()}
        if not hosts:
            raise ValueError(f"--scheduler {address} has no workers; start some with `dask worker {address}`")
        client.run(warm_up, plan.kind, workers=list(hosts.values()))
        chunks = [list(numbers[k:k + _CHUNK]) for k in range(0, len(numbers), _CHUNK)]
        waiting = iter(chunks)

        def submit(chunk: list[int]) -> Any:
            return client.submit(run_some, plan.seed, chunk, plan.kind, pure=False)

        most = 2 * sum(client.nthreads().values()) + 2
        pending = distributed.as_completed([submit(chunk) for chunk in islice(waiting, most)])
        for future in pending:
            yield from future.result()
            for chunk in islice(waiting, 1):
                pending.add(submit(chunk))


def plan_as_dict(plan: Plan) -> Record:
    """The plan as plain data."""
    return asdict(plan)
