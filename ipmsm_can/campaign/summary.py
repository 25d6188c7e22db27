"""What a campaign gave: counts, distributions over the runs, and the worst runs, as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ipmsm_can.campaign.trial import ERROR_BINS, RATIO_BINS, WRONG_DEG

Record = dict[str, Any]
WORST = 20
"""Runs in the table of the worst."""
_OVER_RUNS = ("worst", "rms", "error_p50", "error_p95", "error_p99", "sigma_p50", "within_2_sigma", "time_to_lock",
              "time_to_valid", "valid_share")
_PERCENTILES = (5, 50, 95, 99, 100)


def summarise(records: Sequence[Record], plan: Record) -> dict[str, Any]:
    """Counts, and percentiles over the runs: times in s, angles in deg electrical.

    The same records in the same order give the same summary, wherever they were made.
    """
    finished = [r for r in records if r["exception"] is None]
    claimed = [r for r in finished if r["worst"] is not None]
    error = _pooled(finished, "error_counts", len(ERROR_BINS) - 1)
    ratio = _pooled(finished, "ratio_counts", len(RATIO_BINS) - 1)
    valid = sum(r["samples_valid"] for r in finished)
    within = sum(r["samples_within_2_sigma"] for r in finished)
    return {
        "campaign": plan,
        "runs": len(records), "never_valid": len(finished) - len(claimed),
        "wrong": [r["number"] for r in records if r["wrong"]],
        "by_machine": {name: {"runs": sum((r["saturation"] > 0.0) == soft for r in finished),
                              "wrong": sum((r["saturation"] > 0.0) == soft and r["wrong"] for r in finished)}
                       for name, soft in (("linear", False), ("saturating", True))},
        "exceptions": {str(r["number"]): r["exception"] for r in records if r["exception"] is not None},
        "not_finite": [r["number"] for r in finished if r["not_finite"]],
        "limit_deg": WRONG_DEG,
        "estimates": sum(r["estimates"] for r in finished),
        "estimates_valid": sum(r["estimates_valid"] for r in finished),
        "estimates_wrong": sum(r["estimates_wrong"] for r in finished),
        "samples": sum(r["samples"] for r in finished), "samples_valid": valid,
        "seconds_valid": sum(r["time_valid"] for r in finished),
        "share_within_2_sigma": within / valid if valid else None,
        "over_runs": {name: _percentiles([r[name] for r in finished if r[name] is not None])
                      for name in _OVER_RUNS},
        "error_bins_deg": list(ERROR_BINS), "error_counts": error.tolist(),
        "ratio_bins": list(RATIO_BINS), "ratio_counts": ratio.tolist(),
        "worst": [{name: r[name] for name in ("number", "motor", "shaft", "worst", "wrong_at", "wrong_longest",
                                              "rms", "sigma_p50", "wrong")}
                  for r in sorted(claimed, key=lambda r: (-r["worst"], r["number"]))[:WORST]],
    }


def _pooled(records: Sequence[Record], name: str, bins: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    total = np.zeros(bins, np.int64)
    for r in records:
        total += np.array(r[name], np.int64)
    return total


def _percentiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, np.percentile(values, _PERCENTILES), strict=True)}
