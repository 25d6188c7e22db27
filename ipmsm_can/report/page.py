"""The page: one HTML file with figures and panels, nothing loaded from anywhere, light and dark, any width."""

from __future__ import annotations

import math
from html import escape

from ipmsm_can.report import svg
from ipmsm_can.report.figure import STATE_WORDS, STATES, Panel
from ipmsm_can.report.palette import DARK, LIGHT, css_variables
from ipmsm_can.report.summary import Summary, number, per_second, rows

_STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;-webkit-text-size-adjust:100%}
main{max-width:1120px;margin:0 auto;padding:28px 20px 48px}
h1{font-size:clamp(1.5rem,1.1rem + 1.8vw,2.2rem);line-height:1.2;margin:0 0 6px;letter-spacing:-.01em}
h2{font-size:1.13rem;line-height:1.3;margin:0}
p{margin:.2em 0 .5em}
.lead{color:var(--muted);max-width:70ch;margin:0 0 20px}
.verdict{display:inline-block;border-radius:4px;padding:1px 10px;font-weight:600;margin:0 0 10px;
border:1.5px solid var(--valid);color:var(--ink)}
.verdict.bad{border-color:var(--error)}
ul.faults{margin:0 0 16px;padding-left:1.2em}
.cards{display:grid;grid-template-columns:repeat(4,1fr);gap:12px;margin:0 0 14px;padding:0}
.card{background:var(--card);border:1px solid var(--grid);border-radius:8px;padding:12px 14px}
.card b{display:block;font-size:1.55rem;line-height:1.15;font-weight:650;font-variant-numeric:tabular-nums;
white-space:nowrap}
.card span{color:var(--muted);font-size:.86rem;line-height:1.35;display:block;margin-top:3px}
figure{margin:26px 0 0}
.note{color:var(--muted);font-size:.92rem;max-width:84ch}
.key{display:flex;flex-wrap:wrap;gap:2px 18px;font-size:.84rem;color:var(--muted);margin:0 0 2px;padding:0;
list-style:none}
.key svg{width:26px;height:10px;margin-right:6px;vertical-align:baseline}
svg{display:block;width:100%;height:auto;overflow:visible}
svg.narrow{display:none}.key svg{display:inline-block}
text{font:12px system-ui,-apple-system,"Segoe UI",Roboto,Arial,sans-serif;fill:var(--muted);
font-variant-numeric:tabular-nums}
text.phase{fill:var(--ink);font-weight:600}text.state-word{fill:var(--ink)}text.unit{fill:var(--ink)}
path{fill:none;stroke-linejoin:round}
.grid{stroke:var(--grid)}.zero,.axis{stroke:var(--line)}
.step{stroke:var(--load);stroke-dasharray:2 3;opacity:.65}
.load{fill:var(--load);opacity:.45}
.encoder{stroke:var(--encoder);stroke-width:4.5;stroke-linecap:round}
.estimate{stroke:var(--estimate);stroke-width:1.6}
.estimate-unknown{stroke:var(--estimate);stroke-width:2;stroke-linecap:round;opacity:.5}
.error{stroke:var(--error);stroke-width:1.5}
.error-unknown{stroke:var(--error);stroke-width:2;stroke-linecap:round;opacity:.4}
.sigma-band{fill:var(--sigma);opacity:.24}
.probe{stroke:var(--probe);stroke-width:1.8}.probe-band{fill:var(--probe);opacity:.2}
.obeyed{stroke:var(--ink);stroke-width:5}
.current{stroke:var(--current);stroke-width:1.1}
.excitation{stroke:var(--excitation);stroke-width:1.6}
.state.unknown{fill:var(--unknown);opacity:.16}.state.locked{fill:var(--locked);opacity:.10}
.state.valid{fill:none}
.strip.unknown{fill:var(--unknown)}.strip.locked{fill:var(--locked)}.strip.valid{fill:var(--valid)}
table{border-collapse:collapse;font-size:.92rem;margin:6px 0 0;width:100%}
th,td{text-align:left;vertical-align:top;padding:6px 14px 6px 0;border-top:1px solid var(--grid);font-weight:400}
th{color:var(--muted);width:15em}td.n{text-align:right;font-variant-numeric:tabular-nums;width:7em}
.tables{display:grid;grid-template-columns:3fr 2fr;gap:0 40px;margin-top:34px}
footer{color:var(--muted);font-size:.84rem;margin-top:30px}
@media (max-width:820px){.cards{grid-template-columns:1fr 1fr}.tables{grid-template-columns:1fr;gap:30px}}
@media (max-width:640px){main{padding:18px 8px 36px}h1,.lead,.note,.key,h2,.verdict,.faults,footer,.tables
{margin-left:4px;margin-right:4px}svg.wide{display:none}svg.narrow{display:block}.card{padding:10px}
.card b{font-size:1.25rem}th{width:9em}.key svg{display:inline-block}figure{margin-top:30px}}
@media print{main{max-width:none}figure{break-inside:avoid}}
"""


def build(parts: list[Panel], summary: Summary, faults: list[str], headline: str, footer: str) -> str:
    """The page as text.  faults: what was wrong; headline: what ran, in a sentence; footer: how to get it again."""
    body = [f"<h1>Where is the rotor?</h1><p class=lead>{escape(headline)}</p>", _verdict(faults), _cards(summary)]
    body += [_figure(panel) for panel in parts]
    body.append(_tables(summary))
    body.append(f"<footer>{escape(footer)}</footer>")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><title>Where is the rotor? – ipmsm-can demo</title>'
        f"<style>:root{{color-scheme:light dark;{css_variables(LIGHT)}}}"
        f"@media (prefers-color-scheme:dark){{:root{{{css_variables(DARK)}}}}}{_STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n")


def _verdict(faults: list[str]) -> str:
    if not faults:
        return '<p class="verdict">Locked, and no frame was lost.</p>'
    items = "".join(f"<li>{escape(fault)}</li>" for fault in faults)
    return f'<p class="verdict bad">Something was wrong</p><ul class="faults">{items}</ul>'


def _cards(s: Summary) -> str:
    turnaround = s.bus.turnaround
    fast = math.isfinite(turnaround[0])
    cards = [
        (number(s.lock_after_motion, ".2f", "s"), "from the rotor's first motion to the first valid angle"),
        (number(s.rms_valid, ".2f", "°"), f"rms error once valid, {number(s.worst_valid, '.2f', '°')} at worst "
                                          "(electrical)"),
        (f"{s.lost}", f"of {s.samples:,} samples lost; the bus was {number(100 * s.load_mean, '.0f', '%')} full"),
        (number(1e3 * turnaround[0], ".2f", "ms") if fast else "virtual",
         f"from sample to answer, half of the time; 99 % within {1e3 * turnaround[1]:.2f} ms" if fast
         else "time: as fast as the machine goes, so nothing to say about turnaround"),
    ]
    inner = "".join(f'<div class="card"><b>{escape(big)}</b><span>{escape(small)}</span></div>'
                    for big, small in cards)
    return f'<div class="cards">{inner}</div>'


def _figure(panel: Panel) -> str:
    keys = [_swatch(line.role, line.label) for line in panel.lines if line.label]
    keys += [_swatch(f"{band.role}-band", band.label) for band in panel.bands if band.label]
    if panel.spans:
        keys += [_swatch(f"strip {role}", STATE_WORDS[role]) for role in STATES
                 if any(s.role == role for s in panel.spans)]
    if panel.loads and panel.name == "speed":
        keys.append(_swatch("load", "load torque in N m"))
    elif panel.loads:
        keys.append(_swatch("step", "load steps"))
    return (f'<figure id="{panel.name}"><figcaption><h2>{escape(panel.title)}</h2>'
            f'<p class="note">{escape(panel.note)}</p><ul class="key">{"".join(keys)}</ul></figcaption>'
            f"{svg.draw(panel, svg.WIDE)}{svg.draw(panel, svg.NARROW)}</figure>")


def _swatch(role: str, label: str) -> str:
    if role.endswith("-band") or role.startswith(("strip", "load")):
        mark = f'<rect class="{role}" width="26" height="10"/>'
        mark = mark.replace("rect", "path").replace('width="26" height="10"', 'd="M0 0H26V10H0Z"')
    elif role.endswith("unknown"):
        mark = f'<path class="{role}" d="M3 6h0M10 3h0M16 7h0M23 4h0"/>'
    else:
        mark = f'<path class="{role}" d="M1 5H25"/>'
    return f'<li><svg viewBox="0 0 26 10" aria-hidden="true">{mark}</svg>{escape(label)}</li>'


def _tables(s: Summary) -> str:
    figures = "".join(f"<tr><th>{escape(what)}</th><td>{escape(value)}</td></tr>" for what, value in rows(s))
    frames = "".join(
        f'<tr><th>{kind.message}</th><td class="n">{n:,}</td><td class="n">'
        f'{per_second(n, s.duration)}</td></tr>'
        for kind, n in s.frames.items() if n)
    return (f'<div class="tables"><section><h2>The figures</h2><table>{figures}</table></section>'
            f"<section><h2>Frames on the bus</h2><table>{frames}</table></section></div>")
