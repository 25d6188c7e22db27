"""The report as one HTML file: nothing is loaded from anywhere; light and dark; wide and as narrow as a phone."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape

from ipmsm_can.experiments.compare import SCENES, TITLES, Row, variants
from ipmsm_can.experiments.errata import ERRATA
from ipmsm_can.experiments.model import Experiment, Figure, Status
from ipmsm_can.experiments.run import EXPERIMENTS, Result, Results
from ipmsm_can.report.palette import DARK, LIGHT, css_variables

_MARKS = {Status.REPRODUCED: "✓", Status.CONDITION: "≈", Status.NOT: "✗"}
_CLASSES = {Status.REPRODUCED: "good", Status.CONDITION: "half", Status.NOT: "bad"}
STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;-webkit-text-size-adjust:100%;overflow-wrap:break-word}
main{max-width:1180px;margin:0 auto;padding:28px 20px 48px}
h1{font-size:clamp(1.4rem,1.1rem + 1.5vw,2.1rem);line-height:1.2;margin:0 0 8px}
h2{font-size:1.4rem;line-height:1.25;margin:52px 0 6px}
h3{font-size:1.1rem;line-height:1.3;margin:0 0 4px}h3 span{color:var(--muted);font-weight:400}
h4{font-size:.9rem;font-weight:600;margin:0 0 1px}
p{margin:.2em 0 .6em;max-width:92ch}.lead,.note{color:var(--muted)}.note{font-size:.9rem}
a{color:var(--estimate)}
section{border-top:1px solid var(--line);padding-top:16px;margin-top:26px}
.overview td:first-child{white-space:nowrap}
.badge{display:inline-block;border:1.5px solid;border-radius:4px;padding:0 9px;font-weight:600;font-size:.92rem;
white-space:nowrap}
.good{border-color:var(--valid)}.half{border-color:var(--sigma)}.bad{border-color:var(--error)}
.why{border-width:0 0 0 3px;border-style:solid;padding-left:12px;margin:8px 0}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(330px,100%),1fr));gap:18px 22px;
margin:14px 0 6px}
figure{margin:0}
.key{display:flex;flex-wrap:wrap;gap:0 14px;font-size:.8rem;color:var(--muted);margin:0;padding:0;list-style:none}
.key svg{width:26px;height:10px;margin-right:5px}
.plots>figure>svg{display:block;width:100%;height:auto}
text{font:12px system-ui,-apple-system,"Segoe UI",Roboto,Arial,sans-serif;fill:var(--muted);
font-variant-numeric:tabular-nums}text.unit{fill:var(--ink)}
path{fill:none;stroke-linejoin:round;stroke-width:1.4}
.grid{stroke:var(--grid);stroke-width:1}.zero,.axis{stroke:var(--line);stroke-width:1}
.truth{stroke:var(--encoder);stroke-width:4}.c0{stroke:var(--estimate)}.c1{stroke:var(--error);stroke-dasharray:7 2}
.c2{stroke:var(--probe);stroke-dasharray:3 2}.c3{stroke:var(--current);stroke-dasharray:8 2 2 2}
.limit{stroke:var(--ink);stroke-width:1;stroke-dasharray:1 3}
.dots{stroke-width:7;stroke-linecap:round;stroke-dasharray:none}.dots.fine{stroke-width:2.6}
.scroll{overflow-x:auto;margin:6px 0 18px}
table{border-collapse:collapse;font-size:.88rem}
th,td{text-align:left;vertical-align:top;padding:4px 14px 4px 0;border-top:1px solid var(--grid);font-weight:400}
tbody th{min-width:9.5em}thead th{color:var(--muted);border-top:0;vertical-align:bottom}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
td.best{font-weight:700}td.far{color:var(--muted)}
details{margin:6px 0}summary{cursor:pointer;color:var(--muted);font-size:.9rem}
footer{color:var(--muted);font-size:.85rem;margin-top:40px}
@media (max-width:640px){main{padding:16px 10px 36px}
.overview td:nth-child(3),.overview th:nth-child(3){display:none}
.overview .badge{white-space:normal;line-height:1.25;font-size:.84rem}th,td{padding-right:9px}h2{margin-top:40px}}
@media print{section{break-inside:avoid}}
"""


def build(results: Results, costs: Mapping[str, float], footer: str) -> str:
    """The page as text.  costs: seconds a sample by kind of observer, empty if not measured."""
    done = {r.name: r for r in results.experiments}
    figures = [(e, done[e.name]) for e in EXPERIMENTS.values() if e.name in done and e.figure]
    findings = [(e, done[e.name]) for e in EXPERIMENTS.values() if e.name in done and not e.figure]
    body = [_head([*figures, *findings])]
    if figures:
        body.append('<h2 id="figures">The paper’s figures</h2>')
        body += [_experiment(e, r) for e, r in figures]
    if findings:
        body.append('<h2 id="findings">Where the paper is silent, or explains otherwise</h2>')
        body += [_experiment(e, r) for e, r in findings]
    if results.rows:
        body.append(_comparison(results.rows, costs))
    body.append(_errata())
    body.append(f"<footer>{escape(footer)}</footer>")
    return ('<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            '<meta name="color-scheme" content="light dark"><title>The paper, run again – ipmsm-can paper</title>'
            f"<style>:root{{color-scheme:light dark;{css_variables(LIGHT)}}}"
            f"@media (prefers-color-scheme:dark){{:root{{{css_variables(DARK)}}}}}{STYLE}</style></head>"
            f"<body><main>{''.join(body)}</main></body></html>\n")


def _head(parts: Sequence[tuple[Experiment, Result]]) -> str:
    counts = Counter(r.verdict.status for _, r in parts if r.verdict)
    tally = ", ".join(f"{counts[s]} {s.value}" for s in Status if counts[s])
    rows = "".join(
        f'<tr><td><a href="#{e.name}">{escape(e.figure or "finding")}</a></td><td>{escape(e.title)}</td>'
        f"<td>{escape(e.claim)}</td><td>{_badge(r)}</td></tr>" for e, r in parts)
    return ("<h1>“A Globally Exponentially Stable Position Observer for IPMSMs”, run again</h1>"
            '<p class="lead">Every simulation and experiment of the paper by Ortega, Yi, Vukosavic, Nam and Choi '
            'through a '
            "simulated drive and a CAN bus: frames encoded, quantised, decoded, observed. Each verdict is computed "
            "from the run; angles are electrical, currents and voltages peak. M1 is the paper’s simulation motor, "
            "M2 its experiment motor; motor data, gains and injection are the paper’s unless said otherwise.</p>"
            f"<p><b>{escape(tally or 'nothing was run')}.</b></p>"
            '<div class="scroll"><table class="overview"><thead><tr><th></th><th>what</th><th>the '
            'claim</th><th>verdict</th>'
            f"</tr></thead><tbody>{rows}</tbody></table></div>")


def _badge(r: Result) -> str:
    if r.verdict is None:
        return '<span class="badge bad">could not be judged</span>'
    s = r.verdict.status
    return f'<span class="badge {_CLASSES[s]}">{_MARKS[s]} {s.value}</span>'


def _experiment(e: Experiment, r: Result) -> str:
    why = escape(_typeset(r.verdict.why if r.verdict else r.trouble))
    colour = _CLASSES[r.verdict.status] if r.verdict else "bad"
    plots = "".join(f"<figure><h4>{escape(d.title)}</h4>{d.key}{d.svg}</figure>" for d in r.drawings)
    rows = "".join(_figure_row(f) for f in r.figures)
    margins = any(f.margin is not None for f in r.figures)
    head = ('<thead><tr><th>measured</th><th class="n"></th><th></th>'
            f'<th class="n">{"margin" if margins else ""}</th></tr></thead>')
    number = f"<span>{escape(e.figure)}</span> " if e.figure else ""
    return (f'<section id="{e.name}"><h3>{number}{escape(e.title)}</h3>'
            f"<p><b>{'Claim' if e.figure else 'The paper'}:</b> {escape(e.claim)}</p>"
            f'<p>{_badge(r)}</p><p class="why {colour}">{why}</p><div class="plots">{plots}</div>'
            f'<details><summary>What was measured, and the setting</summary><p class="note">{escape(e.setting)}</p>'
            f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div></details></section>')


def _figure_row(f: Figure) -> str:
    margin = "" if f.margin is None else f"{_number(f.margin)}"
    return (f'<tr><td>{escape(f.name)}</td><td class="n">{_number(f.value)}</td><td>{escape(f.unit)}</td>'
            f'<td class="n">{margin}</td></tr>')


def _number(value: float) -> str:
    if math.isinf(value):
        return "never"
    return _typeset(f"{value:.3g}")


def _typeset(text: str) -> str:
    """Powers of ten and minus signs as they are printed."""
    raised = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    text = re.sub(r"(\d)e([+-]\d+)\b", lambda m: f"{m[1]}·10{str(int(m[2])).translate(raised)}", text)
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)


def _comparison(rows: Sequence[Row], costs: Mapping[str, float]) -> str:
    cells = {(r.kind, r.published, r.scene): r for r in rows}
    shown = [(kind, published) for kind, published in variants() if (kind, published, SCENES[0].name) in cells]

    def table(title: str, note: str, value: str, digits: int, far: float) -> str:
        head = "".join(f'<th class="n">{escape(s.short)}</th>' for s in SCENES)
        column = {s.name: f"{min(getattr(cells[k, p, s.name], value) for k, p in shown):.{digits}f}"
                  for s in SCENES}
        body = []
        for kind, published in shown:
            tds = []
            for s in SCENES:
                x = getattr(cells[kind, published, s.name], value)
                text = f"{x:.{digits}f}"
                role = " best" if text == column[s.name] and math.isfinite(x) else " far" if x > far else ""
                tds.append(f'<td class="n{role}">{"–" if math.isinf(x) else text}</td>')
            body.append(f"<tr><th>{escape(_variant(kind, published))}</th>{''.join(tds)}</tr>")
        return (f'<h4>{escape(title)}</h4><p class="note">{escape(note)}</p><div '
                'class="scroll"><table><thead><tr><th></th>'
                f"{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>")

    scenes = "; ".join(f"{s.short}: {s.title}" for s in SCENES)
    return ('<section id="comparison"><h3>All observers on all experiments</h3>'
            f'<p>The comparison that the authors leave as future work. {escape(_ges_against_chonam(cells))}</p>'
            '<p class="note">Every observer gets the same frames and starts 30° off. “Published gains”: α and γ '
            'of the '
            f"experiment; else the defaults of this program (α = 10, γ fitted to the motor). The best in a column "
            f"is bold. {escape(scenes)}.</p>"
            + table("Lock time [s]", "Time from which the error stays below 5°, at ±20 rpm and standstill below "
                    "10°, to the end; – if it never does for a fifth of the run.", "lock", 3, math.inf)
            + table("Error, rms [°]", "Over the second half of the run.", "rms", 2, 45.0)
            + table("Largest error [°]", "Over the second half of the run.", "largest", 1, 45.0)
            + table("Start at 180°: error at the end [°]", "Median of the last 0.1 s after a start at the opposite "
                    "pole; 180 means that it stays there.", "opposite", 1, 45.0)
            + _cost_table(costs) + "</section>")


def _variant(kind: str, published: bool) -> str:
    return TITLES.get(kind, kind) + (", published gains" if published else "")


def _ges_against_chonam(cells: Mapping[tuple[str, bool, str], Row]) -> str:
    if ("chonam", True, SCENES[0].name) not in cells:
        return ""
    words = []
    for published, gains in ((True, "the published gains"), (False, "the defaults")):
        ratios = {s: cells["chonam", published, s.name].rms / cells["ges", published, s.name].rms for s in SCENES}
        low, high = min(ratios, key=lambda s: ratios[s]), max(ratios, key=lambda s: ratios[s])
        words.append(f"at {gains} {ratios[low]:.2f} ({low.short}) to {ratios[high]:.2f} ({high.short}) times")
    return ("The proposed observer against the one with Λ: with Λ the rms error is "
            f"{' and '.join(words)} that without.")


def _cost_table(costs: Mapping[str, float]) -> str:
    if not costs:
        return ""
    rows = "".join(f'<tr><th>{escape(TITLES.get(kind, kind))}</th><td class="n">{1e9 * cost:.0f}</td></tr>'
                   for kind, cost in costs.items())
    return ('<h4>Cost [ns a sample]</h4><p class="note">Whole estimator (regression, observer, speed, excitation, '
            'trust) in '
            'a block, on the machine that made this page.</p><div '
            f'class="scroll"><table><tbody>{rows}</tbody></table></div>')


def _errata() -> str:
    rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in ERRATA)
    return ('<section id="errata"><h3>Slips in the text</h3><p class="note">None of them touches Lemma 1 or the '
            'observer; none '
            'is copied into the code.</p><div class="scroll"><table><thead><tr><th>where</th><th>as printed</th>'
            f"<th>should be</th><th>why</th></tr></thead><tbody>{rows}</tbody></table></div></section>")
