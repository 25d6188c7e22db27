"""`ipmsm-can paper`: every experiment of the paper, run, judged and put on one page."""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipmsm_can.experiments.compare import Row
    from ipmsm_can.experiments.run import Result, Results

HELP = """\
Run the paper again: every figure through the simulated drive and the wire, with a verdict on each claim.

The page holds every figure with its claim, what was measured and the verdict (reproduced, reproduced with a
condition, not reproduced, and why); what the paper leaves open; and all observers side by side.
"""
EPILOG = """\
examples:
  ipmsm-can paper                                  everything, to out/paper.html
  ipmsm-can paper --list                           the names and claims of the experiments
  ipmsm-can paper --only fig5 --only solver-step   two of them; --only fig5 solver-step is the same
  ipmsm-can paper --json paper.json                the figures and verdicts as data, too

exit codes: 0 all that was asked for was run and judged, whatever the verdicts; 1 an experiment could not be run
or judged (it says why); 2 bad input
"""
_NAME_WIDTH = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--only", action="extend", nargs="+", default=[], metavar="NAME",
                        help="run just these experiments (see --list)")
    parser.add_argument("--out", type=Path, default=Path("out/paper.html"), metavar="FILE.html",
                        help="the page (default: out/paper.html)")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write figures and verdicts as "
                                                                                "JSON, too")
    parser.add_argument("--list", action="store_true", help="print names, figures and claims, and run nothing")
    parser.add_argument("--workers", type=int, default=None, metavar="N",
                        help="processes, 1 to 64 (default: one per processor); the results do not depend on it")


def main(args: argparse.Namespace) -> int:
    """Run; returns the exit code."""
    if args.workers is not None and not 1 <= args.workers <= 64:
        raise ValueError(f"--workers is {args.workers}; allowed is 1 to 64")
    from ipmsm_can.experiments import run

    if args.list:
        _list()
        return 0
    names = run.chosen(args.only)
    for path in (args.out, args.json):
        if path is not None:
            if path.is_dir():
                raise ValueError(f"{path} is a directory; allowed is the name of a file")
            path.parent.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    results = run.run(names, args.workers, _progress)
    costs = _costs() if results.rows else {}
    from ipmsm_can.experiments import page

    asked = f" --only {' '.join(names)}" if args.only else ""
    args.out.write_text(page.build(results, costs, f"ipmsm-can paper{asked}"), encoding="utf-8")
    if args.json is not None:
        args.json.write_text(json.dumps(as_data(results, costs), indent=1, ensure_ascii=False) + "\n",
                             encoding="utf-8")
    print(f"\n{_tally(results)} {time.monotonic() - begin:.0f} s.\n  page: {args.out}"
          + (f"\n  data: {args.json}" if args.json is not None else ""))
    for trouble in results.troubles:
        print(f"could not be judged: {trouble}")
    return 1 if results.troubles else 0


def _list() -> None:
    from ipmsm_can.experiments.compare import SCENES
    from ipmsm_can.experiments.run import COMPARISON, EXPERIMENTS

    for e in EXPERIMENTS.values():
        print(f"{e.name:{_NAME_WIDTH - 4}} {e.figure or 'finding':9} {e.claim}")
    print(f"{COMPARISON:{_NAME_WIDTH - 4}} {'':9} All observers on {len(SCENES)} of the drives above.")


def _progress(done: int, of: int, name: str, gave: Result | list[Row]) -> None:
    from ipmsm_can.experiments.run import Result

    if isinstance(gave, Result):
        what = gave.verdict.status.value if gave.verdict else f"could not be judged: {gave.trouble}"
    else:
        what = f"{len(gave)} observers and gains compared"
    print(f"[{done:2}/{of}] {name:{_NAME_WIDTH}} {what}", flush=True)


def _costs() -> dict[str, float]:
    from ipmsm_can.config import OBSERVER_KINDS
    from ipmsm_can.experiments.compare import cost_per_sample

    return {kind: cost_per_sample(kind) for kind in OBSERVER_KINDS}


def _tally(results: Results) -> str:
    from ipmsm_can.experiments.model import Status

    found = [r.verdict.status for r in results.experiments if r.verdict]
    parts = [f"{found.count(s)} {s.value}" for s in Status if s in found]
    return (", ".join(parts) + "." if parts else "Compared.")


def as_data(results: Results, costs: dict[str, float]) -> dict[str, Any]:
    """Everything on the page as plain data; what never happened is null."""
    from ipmsm_can.experiments.run import EXPERIMENTS

    def number(value: float | None) -> float | None:
        return value if value is not None and math.isfinite(value) else None

    return {
        "experiments": [{
            "name": r.name, "figure": EXPERIMENTS[r.name].figure, "claim": EXPERIMENTS[r.name].claim,
            "verdict": r.verdict.status.value if r.verdict else None,
            "why": r.verdict.why if r.verdict else r.trouble,
            "measured": [{"what": f.name, "value": number(f.value), "unit": f.unit, "margin": number(f.margin)}
                         for f in r.figures],
        } for r in results.experiments],
        "comparison": [{
            "scene": row.scene, "observer": row.kind, "published_gains": row.published, "lock_s": number(row.lock),
            "rms_deg": number(row.rms), "largest_deg": number(row.largest), "from_180_deg": number(row.opposite),
            "from_180_lock_s": number(row.opposite_lock),
        } for row in results.rows],
        "seconds_per_sample": costs,
    }
