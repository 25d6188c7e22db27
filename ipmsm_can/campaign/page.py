"""A campaign, or one of its runs, as one HTML file: nothing is loaded from anywhere, light and dark, any width."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.campaign.trial import LOOK_S, WRONG_DEG, Course
from ipmsm_can.drive.profile import RPM
from ipmsm_can.experiments.draw import Curve, Plot, draw, key
from ipmsm_can.experiments.page import STYLE
from ipmsm_can.report.palette import DARK, LIGHT, css_variables

Record = dict[str, Any]
Floats = NDArray[np.float64]

_MOST_VALUES = 2000
"""Points of a distribution's curve."""


def build(summary: Record, records: Sequence[Record], command: str) -> str:
    """The page of a campaign; command: what was called, for the footer and to repeat runs."""
    finished = [r for r in records if r["exception"] is None]
    plan = summary["campaign"]
    wrong, runs = summary["wrong"], summary["runs"]
    tally = (f"In {len(wrong)} of {runs} runs an angle was called valid while it was more than {WRONG_DEG:g}° off."
             if wrong else f"In none of {runs} runs was an angle called valid while it was more than "
                           f"{WRONG_DEG:g}° off.")
    within = summary["share_within_2_sigma"]
    told = (f"{_share(within)} of the errors are within twice the stated 1-sigma. " if within is not None else "")
    title = "Valid, and sometimes wrong" if wrong else "Valid, and never wrong"
    head = (f"<h1>{title}: {runs} random runs</h1>"
            '<p class="lead">Random motors, motor data, sensors, loads, speed profiles, losses and starts, through '
            f"the simulated drive, its frames and the companion with the observer <b>{escape(plan['kind'])}</b>; "
            f"seed {plan['seed']}. Angles are electrical.</p><p><b>{tally}</b> {told}The angle was valid for "
            f"{summary['seconds_valid']:.0f} s, {summary['estimates_valid']} of {summary['estimates']} estimates; "
            f"in {summary['never_valid']} runs it never was.</p>{_by_machine(summary)}{_troubles(summary)}")
    plots = [p for p in (
        _pooled(summary), _ratio(summary),
        _over_runs("Largest error while valid, run by run", "largest error, ° electrical", "share of the runs",
                   [(_values(finished, "worst"), "", "c0")], mark=WRONG_DEG),
        _over_runs("1-sigma and error, run by run", "° electrical", "share of the runs",
                   [(_values(finished, "sigma_p50"), "1-sigma, median of the run", "c1"),
                    (_values(finished, "rms"), "error, rms of the run", "c0")]),
        _over_runs("From switching on to lock and to valid", "s", "share of all runs",
                   [(_values(finished, "time_to_lock"), "locked", "c1"),
                    (_values(finished, "time_to_valid"), "valid", "c0")], of=len(records)),
        _share_valid(finished)) if p is not None]
    drawings = "".join(_drawing(p, f"plot-{k}") for k, p in enumerate(plots))
    body = f'{head}<div class="plots">{drawings}</div>{_percentiles(summary)}{_worst(summary)}'
    return _document("campaign", body, command)


def _document(title: str, body: str, footer: str) -> str:
    return ('<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f'<meta name="color-scheme" content="light dark"><title>{escape(title)} – ipmsm-can campaign</title>'
            f"<style>:root{{color-scheme:light dark;{css_variables(LIGHT)}}}"
            f"@media (prefers-color-scheme:dark){{:root{{{css_variables(DARK)}}}}}{STYLE}</style></head>"
            f"<body><main>{body}<footer>{escape(footer)}</footer></main></body></html>\n")


def _drawing(plot: Plot, name: str) -> str:
    return f"<figure><h4>{escape(plot.title)}</h4>{key(plot)}{draw(plot, name)}</figure>"


def _share(value: float) -> str:
    return f"{100.0 * value:.2f} %"


def _by_machine(summary: Record) -> str:
    parts = "; ".join(f"{name}: {n['wrong']} of {n['runs']}" for name, n in summary["by_machine"].items())
    return f'<p class="note">Runs wrong, by the magnetics of the machine: {parts}.</p>'


def _troubles(summary: Record) -> str:
    parts = [f"Run {k}: {escape(what)}" for k, what in summary["exceptions"].items()]
    if summary["not_finite"]:
        parts.append(f"Runs with numbers that are none: {', '.join(map(str, summary['not_finite']))}")
    return "".join(f'<p class="why bad">{p}.</p>' for p in parts)


def _values(records: Sequence[Record], name: str) -> Floats:
    return np.sort(np.array([r[name] for r in records if r[name] is not None], np.float64))


def _pooled(summary: Record) -> Plot | None:
    """Share of valid time by error, on a logarithmic axis: what the tail does is the question."""
    counts = np.array(summary["error_counts"], np.float64)
    if not counts.sum():
        return None
    x = np.array(summary["error_bins_deg"])
    beyond = 1.0 - np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    y = np.where(beyond > 0.5 / counts.sum(), beyond, np.nan)
    floor = float(10.0 ** math.floor(math.log10(np.nanmin(y))))
    return Plot("How often the error is larger", "error while valid, ° electrical", "share of the valid time",
                (Curve(x, y, "c0"), _upright(WRONG_DEG, floor, 1.0)), x=(0.01, 100.0), y=(floor, 1.0),
                log_x=True, log_y=True)


def _ratio(summary: Record) -> Plot | None:
    counts = np.array(summary["ratio_counts"], np.float64)
    if not counts.sum():
        return None
    x = np.array(summary["ratio_bins"])
    y = 100.0 * np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    normal = np.array([100.0 * math.erf(v / math.sqrt(2.0)) for v in x])
    return Plot("Does the 1-sigma tell the truth?", "error over 1-sigma", "% of the valid time",
                (Curve(x, normal, "truth", "as a normal distribution has it"),
                 Curve(x[:-1], y[:-1], "c0", "measured"), _upright(2.0, 0.0, 100.0)),
                x=(0.01, 10.0), y=(0.0, 100.0), log_x=True)


def _over_runs(title: str, x_label: str, y_label: str, parts: list[tuple[Floats, str, str]],
               mark: float | None = None, of: int | None = None) -> Plot | None:
    """Cumulative shares of the runs, in per cent."""
    curves = []
    for values, label, role in parts:
        if values.size:
            share = 100.0 * np.arange(1, values.size + 1) / (of or values.size)
            every = slice(None, None, max(1, values.size // _MOST_VALUES))
            x, y = np.append(values[every], values[-1]), np.append(share[every], share[-1])
            curves.append(Curve(np.maximum(x, 1e-4), y, role, label))
    if not curves:
        return None
    if mark is not None:
        curves.append(_upright(mark, 0.0, 100.0))
    return Plot(title, x_label, f"% {y_label.removeprefix('share ')}", tuple(curves), y=(0.0, 100.0), log_x=True)


def _share_valid(records: Sequence[Record]) -> Plot | None:
    values = _values(records, "valid_share")
    if not values.size:
        return None
    y = 100.0 * np.arange(1, values.size + 1) / values.size
    return Plot("For how long the angle is valid", "% of the run", "% of the runs",
                (Curve(100.0 * values, y, "c0"),), x=(0.0, 100.0), y=(0.0, 100.0))


def _upright(x: float, low: float, high: float) -> Curve:
    return Curve(np.array([x, x * (1.0 + 1e-9)]), np.array([low, high]), "limit")


_NAMES = {
    "worst": "largest error while valid [°]", "rms": "error while valid, rms [°]",
    "error_p99": "error while valid, 99 % [°]", "sigma_p50": "1-sigma while valid, median [°]",
    "within_2_sigma": "share of the error within 2 sigma", "time_to_lock": "time to lock [s]",
    "time_to_valid": "time to valid [s]", "valid_share": "share of the time valid",
}


def _percentiles(summary: Record) -> str:
    rows = []
    for name, words in _NAMES.items():
        p = summary["over_runs"][name]
        if p is not None:
            rows.append(f"<tr><td>{escape(words)}</td>" + "".join(f'<td class="n">{v:.3g}</td>' for v in p.values())
                        + "</tr>")
    if not rows:
        return ""
    head = "".join(f'<th class="n">{p}</th>' for p in ("5 %", "50 %", "95 %", "99 %", "largest"))
    return ('<section><h3>Over the runs</h3><div class="scroll"><table><thead><tr><th>of each run</th>'
            f"{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div></section>")


def _worst(summary: Record) -> str:
    plan = summary["campaign"]
    rows = []
    for r in summary["worst"]:
        at = f"{r['wrong_at']:.3f}" if r["wrong"] and r["wrong_at"] is not None else "–"
        rows.append(f"<tr><td>{r['number']}</td><td>{r['motor'].upper()}, {escape(r['shaft'])}</td>"
                    f'<td class="n">{r["worst"]:.2f}</td><td class="n">{r["rms"]:.2f}</td>'
                    f'<td class="n">{r["sigma_p50"]:.2f}</td><td class="n">{at}</td>'
                    f'<td class="n">{1e3 * r["wrong_longest"]:.1f}</td></tr>')
    if not rows:
        return ""
    repeat = f"ipmsm-can campaign --seed {plan['seed']} --kind {plan['kind']} --only RUN"
    return (f'<section><h3>The worst runs</h3><p class="note">Each is drawn from the seed {plan["seed"]} and its '
            f"number alone. To repeat one, with its course over time: {escape(repeat)}</p>"
            '<div class="scroll"><table><thead><tr><th>run</th><th>motor, shaft</th>'
            '<th class="n">largest error [°]</th><th class="n">rms [°]</th>'
            '<th class="n">1-sigma [°]</th><th class="n">wrong from [s]</th>'
            '<th class="n">longest [ms]</th></tr></thead>'
            f"<tbody>{''.join(rows)}</tbody></table></div></section>")


def course_page(course: Course, record: Record, command: str) -> str:
    """The page of one run: error, 1-sigma, what was called valid, and speed, over time."""
    c, s = course, course.scenario
    verdict = ("valid and wrong" if record["wrong"] else
               "never valid" if record["worst"] is None else f"at most {record['worst']:.2f}° off while valid")
    time = c.at / s.sample_rate
    valid, other = np.where(c.valid, c.error, np.nan), np.where(c.valid, np.nan, c.error)
    plots = [
        Plot("Error of the angle", "s", "° electrical",
             (Curve(time, other, "c3", "not called valid", dots=True), Curve(time, valid, "c1", "valid", dots=True),
              Curve(np.array([0.0, s.duration]), np.full(2, WRONG_DEG), "limit"),
              Curve(np.array([0.0, s.duration]), np.full(2, -WRONG_DEG), "limit")),
             x=(0.0, s.duration), y=(-180.0, 180.0)),
        Plot("The same, close up", "s", "° electrical",
             (Curve(time, c.sigma, "c2", "±1-sigma"), Curve(time, -c.sigma, "c2"),
              Curve(time, np.where(np.abs(valid) < 60.0, valid, np.nan), "c1", "error while valid", dots=True)),
             x=(0.0, s.duration), y=(-30.0, 30.0)),
        Plot("What the PositionEstimates said", "s", "1: valid, 0: not",
             (Curve(c.said_at / s.sample_rate, c.said_valid.astype(np.float64), "c0", dots=True),),
             x=(0.0, s.duration), y=(-0.2, 1.2)),
        Plot("Speed of the shaft", "s", "rpm", (Curve(c.time, c.speed / RPM, "truth"),), x=(0.0, s.duration)),
    ]
    drawings = "".join(_drawing(p, f"course-{k}") for k, p in enumerate(plots))
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(_told(value))}</td></tr>"
                   for name, value in record.items() if not name.endswith("_counts"))
    body = (f"<h1>Run {s.number} of seed {s.seed}: {verdict}</h1>"
            f'<p class="lead">{s.motor.upper()}, shaft {s.shaft}, {s.sample_rate / 1e3:g} kHz, companion from '
            f"{s.begins:g} s on, observer {escape(s.kind)}; both sides look at the bus every "
            f"{1e3 * LOOK_S:g} ms.</p>"
            f'<div class="plots">{drawings}</div><details open><summary>What was drawn, and what came out</summary>'
            f'<div class="scroll"><table><tbody>{rows}</tbody></table></div></details>')
    return _document(f"run {s.number}", body, command)


def _told(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return "  ".join(f"({t:g} s: {v:.4g})" for t, v in value)
    return "–" if value is None else str(value)
