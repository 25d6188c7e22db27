"""The page: a report as one HTML file, nothing loaded from anywhere, light and dark, any width."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from ipmsm_can import __version__
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Report
from ipmsm_can.diagnosis.plot import draw
from ipmsm_can.report.palette import DARK, LIGHT, css_variables

_WORD = {"error": "Error", "warning": "Warning", "info": "Info"}
_SIGN = {"error": "✕", "warning": "!", "info": "i"}
_STATE = {"found": "found", "fine": "fine", "untold": "cannot be told"}
_STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;-webkit-text-size-adjust:100%;overflow-wrap:anywhere}
main{max-width:960px;margin:0 auto;padding:28px 20px 48px}
h1{font-size:clamp(1.4rem,1.1rem + 1.6vw,2rem);line-height:1.2;margin:0 0 6px}
h2{font-size:1.2rem;line-height:1.3;margin:0 0 6px}h3{font-size:1rem;margin:0}
p{margin:.2em 0 .6em}.muted,.note{color:var(--muted)}.note{font-size:.9rem;margin:0}
dl.facts{display:flex;flex-wrap:wrap;gap:4px 26px;margin:10px 0 24px;font-size:.92rem}
dl.facts div{display:flex;gap:.5em}dt{color:var(--muted)}dd{margin:0}
.finding,.panel{background:var(--card);border:1px solid var(--grid);border-radius:8px;padding:16px 18px;
margin:0 0 16px}
.finding{border-left:6px solid var(--line)}
.finding.error{border-left-color:var(--error)}.finding.warning{border-left-color:var(--sigma)}
.finding.info{border-left-color:var(--estimate)}
.badge{display:inline-flex;align-items:center;gap:.45em;font-size:.84rem;font-weight:600;margin:0 0 4px}
.badge b{display:inline-block;width:1.5em;height:1.5em;line-height:1.5em;text-align:center;border-radius:50%;
color:var(--card);background:var(--muted)}
.error .badge b{background:var(--error)}.warning .badge b{background:var(--sigma);color:#1b2127}
.info .badge b{background:var(--estimate)}
.badge i{font-style:normal;color:var(--muted);font-weight:400}
.do{border-left:3px solid var(--valid);padding-left:10px;margin:8px 0}
table{border-collapse:collapse;width:100%;font-size:.92rem;margin:8px 0 4px}
th,td{text-align:left;vertical-align:top;padding:5px 12px 5px 0;border-top:1px solid var(--grid);font-weight:400}
th{color:var(--muted);width:38%}td{font-variant-numeric:tabular-nums}
td.state{white-space:nowrap;width:9em}.none{font-size:1.15rem;font-weight:600}
figure.plot{margin:16px 0 4px}.key{display:flex;flex-wrap:wrap;gap:2px 18px;font-size:.84rem;color:var(--muted);
margin:2px 0 4px;padding:0;list-style:none}.key i{display:inline-block;width:24px;height:0;border-top:3px solid;
margin-right:6px;vertical-align:middle}.key i.dot{width:8px;height:8px;border:0;border-radius:50%;
background:currentColor}
i.error{color:var(--error)}i.estimate{color:var(--estimate)}i.encoder{color:var(--encoder)}
i.current{color:var(--current)}i.probe{color:var(--probe)}
.unit,.xlabel{font-size:.84rem}.xlabel{text-align:right}
.frame{display:grid;grid-template-columns:52px 1fr;height:230px}
.up,.across{position:relative;font-size:12px;color:var(--muted);font-variant-numeric:tabular-nums}
.up span{position:absolute;right:6px;transform:translateY(-50%)}
.across{height:18px;margin-left:52px}.across span{position:absolute;transform:translateX(-50%)}
.area{position:relative;overflow:hidden;border-left:1px solid var(--line);border-bottom:1px solid var(--line);
touch-action:pan-y;cursor:crosshair}
.area svg{position:absolute;inset:0;width:100%;height:100%}
.mark{position:absolute;top:0;bottom:0;background:var(--estimate);opacity:.18}
path{fill:none;vector-effect:non-scaling-stroke;stroke-linejoin:round;stroke-width:1.6px}
path.dots{stroke-width:4.5px;stroke-linecap:round;opacity:.75}
.grid{stroke:var(--grid);stroke-width:1px}.zero{stroke:var(--line);stroke-width:1px}
path.error{stroke:var(--error)}path.estimate{stroke:var(--estimate)}path.encoder{stroke:var(--encoder);stroke-width:4px}
path.current{stroke:var(--current)}path.probe{stroke:var(--probe)}
button{font:inherit;font-size:.84rem;color:var(--ink);background:var(--paper);border:1px solid var(--line);
border-radius:5px;padding:1px 10px;margin:2px 0}
footer{color:var(--muted);font-size:.84rem;margin-top:26px}
@media (max-width:640px){main{padding:18px 10px 36px}.finding,.panel{padding:12px}
th{width:44%}.frame{height:200px;grid-template-columns:44px 1fr}.across{margin-left:44px}
table.checked tr{display:block;border-top:1px solid var(--grid);padding:6px 0}
table.checked th,table.checked td{display:block;width:auto;border:0;padding:0}}
@media print{.finding,.panel{break-inside:avoid}button{display:none}}
"""


def build(report: Report) -> str:
    """The page as text."""
    numbers = iter(range(1, 1000))
    findings = "".join(_finding(f, numbers) for f in report.findings)
    if not report.findings:
        findings = ('<section class="panel"><p class="none">Nothing found.</p><p>What was looked at, and what '
                    "could not be told, stands below.</p></section>")
    plots = "".join(draw(p, next(numbers)) for p in report.plots)
    measured = f'<section class="panel"><h2>What was measured</h2>{plots}</section>' if plots else ""
    facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
                    for name, value in report.facts.items())
    script = (files("ipmsm_can.diagnosis") / "zoom.js").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><title>What is wrong with the drive? – ipmsm-can</title>'
        f"<style>:root{{color-scheme:light dark;{css_variables(LIGHT)}}}"
        f"@media (prefers-color-scheme:dark){{:root{{{css_variables(DARK)}}}}}{_STYLE}</style></head><body><main>"
        f'<h1>{escape(_headline(report))}</h1><p class="muted">{escape(report.source)}</p>'
        f'<dl class="facts">{facts}</dl>{findings}{_checked(report.checked)}{measured}'
        f"<footer>ipmsm-can {escape(__version__)} diagnose. Angles and speeds are electrical, voltages and "
        "currents peak per phase, unless said otherwise. Drag across a plot to look closer, double click to see "
        "all of it; with Ctrl or Shift the wheel zooms.</footer></main>"
        f"<script>{script}</script></body></html>\n")


def _headline(report: Report) -> str:
    first = report.findings[0].title if report.findings else "Nothing is wrong, as far as the samples tell"
    return first[0].upper() + first[1:]


def _finding(f: Finding, numbers: object) -> str:
    rows = "".join(f"<tr><th>{escape(e.label)}</th><td>{_value(e)}</td></tr>" for e in f.evidence)
    table = f"<table>{rows}</table>" if rows else ""
    plot = draw(f.plot, next(numbers)) if f.plot is not None else ""  # type: ignore[call-overload]
    title = escape(f.title[0].upper() + f.title[1:])
    return (f'<section class="finding {f.severity}" id="{escape(f.code)}"><div class="badge">'
            f"<b>{_SIGN[f.severity]}</b>{_WORD[f.severity]}<i>{escape(f.code)}</i></div><h2>{title}</h2>"
            f'<p>{escape(f.sentence)}</p><p class="do">{escape(f.advice)}</p>{table}{plot}</section>')


def _value(e: Evidence) -> str:
    return escape(e.words)


def _checked(checked: tuple[Checked, ...]) -> str:
    order = {"found": 0, "untold": 1, "fine": 2}
    rows = "".join(f'<tr><th>{escape(c.name)}</th><td class="state">{_STATE[c.state]}</td>'
                   f"<td>{escape(c.words)}</td></tr>" for c in sorted(checked, key=lambda c: order[c.state]))
    return f'<section class="panel"><h2>What was looked at</h2><table class="checked">{rows}</table></section>'
