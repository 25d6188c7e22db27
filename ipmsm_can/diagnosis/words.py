"""A report in words, for a terminal: short, the cause first."""

from __future__ import annotations

from ipmsm_can.diagnosis.finding import Checked, Finding, Report

_MARK = {"error": "ERROR", "warning": "WARNING", "info": "INFO"}


def lines(report: Report) -> list[tuple[str, int, str]]:
    """(text, indentation, style) of each paragraph; styles: head, error, warning, info, plain, advice, muted."""
    facts = ", ".join(f"{name} {value}" for name, value in report.facts.items() if name not in ("log", "encoder"))
    out = [(report.source, 0, "head"), (facts, 0, "muted"), ("", 0, "plain")]
    for finding in report.findings:
        out += _finding(finding)
    if not report.findings:
        out += [("Nothing found.", 0, "head"), ("", 0, "plain")]
    for state, label in (("fine", "looked at, and fine"), ("untold", "could not be told")):
        part = [c for c in report.checked if c.state == state]
        if part:
            out.append((f"{label}:", 0, "muted"))
            out += [(_checked(c), 2, "muted") for c in part]
    return out


def _finding(f: Finding) -> list[tuple[str, int, str]]:
    out = [(f"{_MARK[f.severity]}: {f.title}", 0, f.severity), (f.sentence, 2, "plain")]
    out += [(f"{e.label}: {e.words}", 4, "muted") for e in f.evidence]
    return [*out, (f"What to do: {f.advice}", 2, "advice"), ("", 0, "plain")]


def _checked(c: Checked) -> str:
    return f"{c.name}: {c.words}"
