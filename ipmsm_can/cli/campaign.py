"""`ipmsm-can campaign`: thousands of random runs, and whether an angle called valid was ever wrong."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipmsm_can.campaign.execute import Plan

HELP = """\
Run thousands of random drives through the wire, and look for an angle that is called valid and is wrong.

Each run is drawn from (seed, number) alone: motor, motor data told wrong, sensors, dead time, speed and load, lost
frames, starts. An angle called valid that is more than 15 deg electrical off is a fault, printed with its run.
"""
EPILOG = """\
files, in the folder --out:
  runs.jsonl      a line a run, written as it comes; nothing recorded is lost when the campaign is killed
  summary.json    counts, percentiles and distributions over the runs, the worst runs
  campaign.html   the same as a page
  run-K.html      with --only K: that run over time

examples:
  ipmsm-can campaign                           10000 runs of seed 1 on all processors, to out/campaign
  ipmsm-can campaign --resume                  go on after Ctrl-C, a power cut, or for more --runs
  ipmsm-can campaign --only 42                 run 42 alone, with its course over time
  ipmsm-can campaign --scheduler tcp://host:8786   the same runs on a Dask cluster that has this program installed

exit codes: 0 no valid angle was wrong; 1 one was, or a run failed; 2 bad input
"""
_LINE_S = 10.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    from ipmsm_can.config import OBSERVER_KINDS

    parser.add_argument("--runs", type=int, default=10_000, metavar="N", help="how many (default: 10000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the campaign (default: 1)")
    parser.add_argument("--kind", default="riccati", metavar="KIND", choices=OBSERVER_KINDS,
                        help="observer (default: riccati)")
    parser.add_argument("--only", type=int, default=None, metavar="K", help="run number K alone, and draw it")
    parser.add_argument("--out", type=Path, default=Path("out/campaign"), metavar="FOLDER",
                        help="where the files go (default: out/campaign)")
    parser.add_argument("--resume", action="store_true", help="go on with the records that are there")
    parser.add_argument("--workers", type=int, default=None, metavar="N",
                        help="processes, 1 to 64 (default: one per processor); the results do not depend on it")
    parser.add_argument("--scheduler", default=None, metavar="ADDRESS",
                        help="run on this Dask cluster in place of processes here; needs ipmsm_can[dask]")


def main(args: argparse.Namespace) -> int:
    """Run; returns the exit code."""
    from ipmsm_can.campaign.execute import Plan

    if args.workers is not None and not 1 <= args.workers <= 64:
        raise ValueError(f"--workers is {args.workers}; allowed is 1 to 64")
    if args.workers is not None and args.scheduler is not None:
        raise ValueError("--workers and --scheduler are both given; allowed is one of them")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out is {args.out}, which is a file; allowed is a folder")
    plan = Plan(args.runs, args.seed, args.kind)
    plan.check()
    if args.only is not None:
        return _only(plan, args.only, args.out)
    return _campaign(plan, args)


def _campaign(plan: Plan, args: argparse.Namespace) -> int:
    from ipmsm_can.campaign.execute import RecordFile, execute, plan_as_dict

    begin = time.monotonic()
    file = RecordFile(args.out / "runs.jsonl", plan, args.resume)
    try:
        had = sum(k < plan.runs for k in file.done)
        with _progress(plan.runs, had) as note:
            records = execute(plan, file, args.workers or _processors(), args.scheduler, note)
    except KeyboardInterrupt:
        print(f"\nstopped; {len(file.done)} runs are in {file.path}, --resume goes on", file=sys.stderr)
        raise
    finally:
        file.close()
    from ipmsm_can.campaign import page
    from ipmsm_can.campaign.summary import summarise

    summary = summarise(records, plan_as_dict(plan))
    (args.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    command = f"ipmsm-can campaign --runs {plan.runs} --seed {plan.seed} --kind {plan.kind}"
    (args.out / "campaign.html").write_text(page.build(summary, records, command), encoding="utf-8")
    _report(summary, args.out, time.monotonic() - begin)
    return 1 if summary["wrong"] or summary["exceptions"] or summary["not_finite"] else 0


def _report(summary: dict[str, Any], out: Path, seconds: float) -> None:
    wrong, plan = summary["wrong"], summary["campaign"]
    within = summary["share_within_2_sigma"]
    print(f"{len(wrong)} of {summary['runs']} runs valid while more than {summary['limit_deg']:g} deg off; "
          + (f"{100 * within:.2f} % of the errors within 2 sigma; " if within is not None else "")
          + f"valid for {summary['seconds_valid']:.0f} s; {seconds:.0f} s.\n"
            f"  page: {out / 'campaign.html'}\n  data: {out / 'summary.json'}, {out / 'runs.jsonl'}")
    machines = "; ".join(f"{name}: {n['wrong']} of {n['runs']}" for name, n in summary["by_machine"].items())
    print(f"wrong by the magnetics of the machine: {machines}")
    for number in wrong:
        print(f"valid and wrong: run {number} (ipmsm-can campaign --seed {plan['seed']} --kind {plan['kind']} "
              f"--only {number})")
    for number, what in summary["exceptions"].items():
        print(f"failed: run {number}: {what}")
    for number in summary["not_finite"]:
        print(f"a number that is none: run {number}")


def _only(plan: Plan, number: int, out: Path) -> int:
    if number < 0:
        raise ValueError(f"--only is {number}; allowed is the number of a run, 0 or more")
    from ipmsm_can.campaign import page
    from ipmsm_can.campaign.scenario import draw
    from ipmsm_can.campaign.trial import score, simulate

    scenario = draw(plan.seed, number, plan.kind)
    course = simulate(scenario)
    record = {**scenario.as_dict(), **score(course)}
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"run-{number}.html"
    command = f"ipmsm-can campaign --seed {plan.seed} --kind {plan.kind} --only {number}"
    path.write_text(page.course_page(course, record, command), encoding="utf-8")
    worst = "never valid" if record["worst"] is None else f"at most {record['worst']:.2f} deg off while valid"
    print(f"run {number} of seed {plan.seed}: {worst}, valid for {record['time_valid']:.3f} s"
          + (f", wrong from {record['wrong_at']:.4f} s on" if record["wrong_at"] is not None else "")
          + f"\n  page: {path}")
    return 1 if record["wrong"] or record["not_finite"] else 0


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _progress(runs: int, had: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar on a terminal, a line every ten seconds elsewhere."""
    from ipmsm_can.cli.screen import is_terminal

    done, wrong = had, 0
    if not is_terminal(sys.stdout):
        last = time.monotonic()

        def line(record: dict[str, Any]) -> None:
            nonlocal done, wrong, last
            done, wrong = done + 1, wrong + bool(record["wrong"])
            if time.monotonic() - last >= _LINE_S:
                last = time.monotonic()
                print(f"[{done:{len(str(runs))}}/{runs}] valid and wrong: {wrong}", flush=True)

        yield line
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    with Progress(TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                  TextColumn("valid and wrong: {task.fields[wrong]}")) as bar:
        task = bar.add_task("runs", total=runs, completed=had, wrong=0)

        def step(record: dict[str, Any]) -> None:
            nonlocal wrong
            wrong += bool(record["wrong"])
            bar.update(task, advance=1, wrong=wrong)

        yield step
