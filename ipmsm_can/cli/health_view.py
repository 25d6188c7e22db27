"""The picture of a bus that is listened to: findings first, then numbers, then as many identifiers as fit."""

from __future__ import annotations

import textwrap

from rich.text import Text

from ipmsm_can.bus import health_words
from ipmsm_can.bus.health_report import HealthReport

_STYLES = {"error": "bold red", "warning": "bold yellow", "notice": "cyan"}
_INDENT = 10


def health_lines(report: HealthReport, width: int, room: int) -> list[Text]:
    """At most `room` lines of at most `width` columns, to which words are wrapped."""
    numbers = [Text(part) for line in (health_words.headline(report), *health_words.losses(report),
                                       health_words.errors(report))
               for part in textwrap.wrap(line, width, subsequent_indent="  ")]
    lines: list[Text] = []
    left = max(4, room - len(numbers) - 6)
    for finding in report.findings:
        parts = textwrap.wrap(finding.sentence, max(20, width - _INDENT))
        if len(lines) + len(parts) > left:
            lines.append(Text("  ... and more; the window is too low", style="yellow"))
            break
        lines.append(Text.assemble((f"{finding.severity:{_INDENT}}", _STYLES[finding.severity]), parts[0]))
        lines += [Text(" " * _INDENT + part) for part in parts[1:]]
    if not lines:
        lines = [Text("nothing remarkable", style="green")]
    lines += [Text(), *numbers, Text(), Text(health_words.TABLE_HEAD, style="dim")]
    rows = [Text(health_words.table_row(i)) for i in report.ids]
    fits = max(1, room - len(lines))
    if len(rows) > fits:
        rows = [*rows[:fits - 1], Text(f"... and {len(rows) - fits + 1} more identifiers", style="dim")]
    return lines + rows
