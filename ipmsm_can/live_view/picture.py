"""The screen of `ipmsm-can monitor`: a status as lines of text that fit the window; words before colours.

Nothing is told by colour alone; those used (cyan, yellow, reverse) differ for colour-blind readers too.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace

from rich.text import Text

from ipmsm_can.cli import plain
from ipmsm_can.live_view import chart
from ipmsm_can.live_view.status import FINDINGS, HELP, DriveView, MonitorStatus, Told

_GOOD, _WARN, _BAD, _DIM = "cyan", "yellow", "bold reverse", "dim"
_STYLES = {"error": _BAD, "warning": "bold yellow", "notice": "cyan"}
_LABEL = 12
_NARROW, _WIDE = 72, 110
_CHART_LEAST, _CHART_MOST = 3, 12
_PLAIN = str.maketrans({"°": " deg", "±": "+/-", "Ω": "ohm", "µ": "u", "²": "^2", "–": "-", "…": "..."})
_HELP = (
    ("r", "start or stop recording every frame (second line: the file)"),
    ("m", "mark this moment: in the record, and in the list of events"),
    ("i", "order the injection on (asks first); only with --transmit"),
    ("o", "order the injection off, at once"),
    ("a", "leave the injection to the companion again (automatic)"),
    ("p, space", "hold the picture still; receiving and recording go on"),
    ("t", "time that the curves show: 6, 12, 25 or 50 s at 80 columns"),
    ("f", "all findings, with what to do about them, and all events"),
    ("tab", "the next drive, where there are several"),
    ("h, ?", "this page"),
    ("q, Ctrl-C", "end, with a summary"),
)
_NOTES = (
    "angle: with its 1-sigma. NOT VALID: do not use it, whatever it says.",
    "speed: mean of the last 0.3 s; its 1-sigma is what the angle's allows.",
    "current, voltage: of one phase, rms of the last 0.3 s; peak: of its vector.",
    "curves: a gap means no samples, or no angle.",
    "excitation: of the observer's regression; near 0 the rotor cannot be seen.",
    "An order to inject ends where the samples pause, and must be given again.",
)


def picture(status: MonitorStatus, width: int, height: int) -> list[Text]:
    """Exactly `height` lines of at most `width` columns."""
    top = _header(status, width)
    bottom = _footer(status, width)
    room = max(0, height - len(top) - len(bottom))
    if status.page == HELP:
        body = _help(width)
    elif status.page == FINDINGS:
        body = _all_findings(status, width, room)
    else:
        body = _main(status, width, room)
    if len(body) > room:
        body = [*body[:max(0, room - 1)], Text("... the window is too low for the rest", style=_WARN)][:room]
    lines = [*top, *body, *(Text() for _ in range(room - len(body))), *bottom]
    # where not even header and footer fit, what must never be missing goes last
    lines = [*lines[:max(1, height - 1)], *lines[-1:]][:height]
    for line in lines:
        if status.ascii and not line.plain.isascii():  # a path, or a sentence of the diagnosis
            line.plain = line.plain.translate(_PLAIN).encode("ascii", "replace").decode()
        line.truncate(width)
    return lines


def _header(status: MonitorStatus, width: int) -> list[Text]:
    run = status.run
    badge = Text(f" {plain.voice(run)} ", style="bold black on yellow" if run.transmit else "reverse")
    first = Text.assemble(badge, " ")
    if status.record_trouble:
        first.append(" NOT RECORDING ", style=_BAD)
    elif status.recording:
        first.append(f"{'*' if status.ascii else '●'} REC ", style="bold")
    else:
        first.append("not recording ", style=_DIM)
    if status.paused:
        first.append(" PAUSED ", style=_BAD)
    right = f"{run.title}  {plain.clock(run.elapsed)}"
    if first.cell_len + len(right) >= width:
        right = plain.clock(run.elapsed)
    first.append(right.rjust(max(len(right) + 1, width - first.cell_len)))
    second = Text(status.source, style=_DIM)
    wanted = status.record_trouble or status.recording
    if wanted:
        room = width - second.cell_len - 3
        shown = wanted if len(wanted) <= room else "..." + wanted[3 - room:] if room > 10 else ""
        second.append(shown.rjust(max(0, width - second.cell_len)), style=_WARN if status.record_trouble else "")
    lines = [first, second]
    if run.bus.no_bus:
        told = textwrap.wrap(run.bus.no_bus, max(20, width - 2))[:3]
        lines += [Text(f" {part} ".ljust(width), style=_BAD) for part in told]
    return lines


def _footer(status: MonitorStatus, width: int) -> list[Text]:
    if not status.keys:
        keys = "no keys: standard input is not a terminal   Ctrl-C ends"
    else:
        parts = ["r stop rec" if status.recording else "r record", "m mark"]
        parts += ["i o a injection"] if status.injectable else []
        parts += ["p go on" if status.paused else "p pause", "t time", "f findings"]
        parts += ["tab drive"] if len(status.drives) > 1 else []
        parts += ["h help", "q quit"]
        for gap in ("  ", " "):
            keys = gap.join(parts)
            if len(keys) <= width:
                break
        else:
            keys = "h help  q quit"
    return [Text(status.notice, style="bold"), Text(keys, style="reverse dim" if width > 200 else "reverse")]


def _main(status: MonitorStatus, width: int, room: int) -> list[Text]:
    drive = status.drives[status.selected]
    numbers = _drive(drive, width, status.ascii)
    bus = _bus(status, width)
    table = _table(status, width, room - len(numbers) - len(bus) - 2) if len(status.drives) > 1 else []
    # Findings and events first, then the curves; what is still left parts the sections.
    left = room - len(table) - len(numbers) - len(bus)
    figures = [_labelled(name, words) for name, words in drive.figures]
    told = _findings(status, width, 2 if left < 12 else left // 3)
    events = _events(status, 1 if left < 12 else left // 5)
    left -= len(told) + len(events)
    # what is left beside the lowest curves, or all there is
    figures = figures[:max(left - _CHART_LEAST - 1 if left > _CHART_LEAST else left, 0)]
    left -= len(figures)
    curves = []
    if left > _CHART_LEAST:
        curves = _charts(drive, width, min(_CHART_MOST, left - 1), status.ascii)
        left -= len(curves)
    lines: list[Text] = []
    for section in (table, numbers + figures, curves, bus, told, events):
        if lines and section and left > 0:
            lines.append(Text())
            left -= 1
        lines += section
    return lines


def _labelled(label: str, *parts: str | tuple[str, str] | Text) -> Text:
    return Text.assemble((f"{label:{_LABEL}}", _DIM), *parts)


def _fine(sigma: float) -> str:
    """A 1-sigma with as many digits as say something: never 0.0 for what is not."""
    return f"{sigma:.1f}" if sigma >= 0.95 else f"{sigma:.2f}" if sigma >= 0.01 else "<0.01"


def _drive(drive: DriveView, width: int, ascii_only: bool) -> list[Text]:
    node = drive.node
    deg, pm = (" deg", "+/-") if ascii_only else ("°", "±")
    head = Text.assemble((f"drive {node.node}", "bold"), f"  {node.motor}  ",
                         (node.state, _GOOD if node.locked else _WARN))
    flags = Text("  ".join(f"[{'x' if on else ' '}] {name}" for name, on in (
        ("valid", node.valid), ("locked", node.locked), ("polarity", node.polarity_known))))
    if any((node.valid, node.locked, node.polarity_known)) or head.cell_len + 2 + flags.cell_len <= width:
        head.append(" " * max(2, width - head.cell_len - flags.cell_len))
        head.append(flags)
    trust = (node.trust, "bold cyan" if node.valid else "bold yellow" if node.live else _BAD)
    if node.known:
        sigma = _fine(math.degrees(node.sigma))
        angle = f"{math.degrees(node.theta) % 360.0:5.1f}{deg} {pm} {sigma}{deg} electrical"
    else:
        angle = "unknown"
    if node.live and math.isfinite(drive.rpm):
        sure = f" {pm} {_fine(drive.rpm_sigma)}" if math.isfinite(drive.rpm_sigma) and node.known else ""
        speed = f"{drive.rpm:+7.1f}{sure} rpm mechanical"
        speed = f"{speed:34}{node.omega:+.1f} rad/s electrical"
    elif drive.reported and math.isfinite(drive.rpm):
        speed = f"{f'{drive.rpm:+7.1f} rpm mechanical':34}as the drive reports it"
    else:
        speed = "unknown"
    # Whether it may be used must not be cut off.
    shown = (trust, f"  {angle}") if width < _NARROW else (f"{angle:34}", trust)
    lines = [head, _labelled("angle", *shown), _labelled("speed", speed)]
    if (node.live or drive.reported) and math.isfinite(drive.i_rms):
        axes = (f"i_d {drive.i_d:+.2f}  i_q {drive.i_q:+.2f} A peak"
                if math.isfinite(drive.i_d) and (node.known or drive.reported) else "i_d, i_q unknown")
        of = f"{100.0 * drive.i_rms / drive.rated:.0f} % of rated current" if drive.rated > 0.0 else ""
        current = f"{drive.i_rms:.2f} A rms, {drive.i_peak:.2f} A peak"
        lines.append(_labelled("current", f"{current:34}{axes}"))
        voltage = f"{drive.v_rms:.1f} V rms to neutral" if math.isfinite(drive.v_rms) else "unknown"
        lines.append(_labelled("voltage", f"{voltage:34}{of}"))
    else:
        lines.append(_labelled("current", "unknown"))
    lines.append(_probing(drive))
    rate = f"{node.samples_per_s:.0f}/s of {node.sample_rate:.0f} Hz" if node.sample_rate else (
        f"{node.samples_per_s:.0f}/s")
    excitation = "" if drive.reported else f"   excitation {node.excitation:.3g} V^2 s"
    lines.append(_labelled("samples", rate + excitation))
    always = {"lost", "gaps", "bad frames"}
    lines += _listed("losses", [(name, n) for name, n in plain.losses(node) if n or name in always], width)
    if node.encoder:
        lines.append(_labelled("encoder", (node.encoder, _WARN)))
    if node.timing:
        lines.append(_labelled("timing", (node.timing, _WARN)))
    return lines


def _probing(drive: DriveView) -> Text:
    node = drive.node
    text = _labelled("injection", node.injection)
    if drive.order:
        text.append(f"  ordered {drive.order}", style="bold")
    if node.injecting:
        text.append(f"  the drive injects, {node.hf_current:.2f} A peak", style=_WARN)
    if node.rejected_commands:
        text.append(f"  {node.rejected_commands} commands refused", style="bold yellow")
    return text


def _counts(pairs: Sequence[tuple[str, int]]) -> Text:
    text = Text()
    for k, (name, n) in enumerate(pairs):
        text.append(f"{'  ' if k else ''}{name} {n}", style="bold yellow" if n else "")
    return text


def _listed(label: str, pairs: Sequence[tuple[str, int]], width: int) -> list[Text]:
    """Counts on as many lines as they need."""
    lines: list[Text] = []
    rest = list(pairs)
    while rest:
        fits = next((n for n in range(len(rest), 1, -1) if _LABEL + _counts(rest[:n]).cell_len <= width), 1)
        lines.append(_labelled("" if lines else label, _counts(rest[:fits])))
        rest = rest[fits:]
    return lines


def _table(status: MonitorStatus, width: int, room: int) -> list[Text]:
    """One line for each drive, the selected one marked; as many around it as there is room for."""
    lines = [Text(f"  {'':15}{'angle el. deg':16}{'rpm mech.':>10}{'A rms':>8}{'lost':>7}  injection", style=_DIM)]
    fits = max(1, room - 1)
    begin = max(0, min(status.selected - fits // 2, len(status.drives) - fits))
    for k, drive in enumerate(status.drives[begin:begin + fits], begin):
        n = drive.node
        state = "VALID" if n.valid else "not valid" if n.live else "silent"
        angle = f"{math.degrees(n.theta) % 360.0:5.1f} +/- {math.degrees(n.sigma):.1f}" if n.known else "unknown"
        rpm = f"{drive.rpm:+.1f}" if n.live and math.isfinite(drive.rpm) else "-"
        amps = f"{drive.i_rms:.2f}" if n.live and math.isfinite(drive.i_rms) else "-"
        mark, style = (">", "bold") if k == status.selected else (" ", "")
        lines.append(Text(f"{mark} {n.node:<4}{state:11}{angle:16}{rpm:>10}{amps:>8}{n.lost:>7}  {n.injection}",
                          style=style))
    return lines


def _charts(drive: DriveView, width: int, rows: int, ascii_only: bool) -> list[Text]:
    """Title and curves, side by side: speed, sigma, and where there is room, or no sigma, the current."""
    course = drive.course
    curves = [("speed [rpm mech.]", course.speed_low, course.speed_high, 10.0, False)]
    if not drive.reported:
        curves.append(("1 sigma of the angle [deg el.]", course.sigma, course.sigma, 1.0, True))
    if drive.reported or width >= _WIDE:
        curves.append(("phase current [A rms]", course.current, course.current, 0.1, True))
    each = width // len(curves) - 1
    seconds = chart.points(each, ascii_only) * course.column_s
    titles, blocks = [], []
    for k, (title, low, high, least, zero) in enumerate(curves):
        last = f"{title}, last {seconds:.0f} s" if k == 0 else title
        titles.append(f"{'':8}{last}"[:each].ljust(each))
        blocks.append(chart.chart(low, high, each, rows, least, ascii_only, zero))
    lines = [Text(" ".join(titles), style=_DIM)]
    for parts in zip(*blocks, strict=True):
        lines.append(Text(" ".join(part.ljust(each) for part in parts)))
    return lines


def _bus(status: MonitorStatus, width: int) -> list[Text]:
    bus = status.run.bus
    full, empty = ("#", ".") if status.ascii else ("█", "░")
    filled = round(20 * min(1.0, max(0.0, bus.load)))
    load = _labelled("bus load", f"{100 * bus.load:5.1f} % ", full * filled + empty * (20 - filled),
                     f"  {bus.frames_per_s:.0f} frames/s, {bus.frames} so far")
    if bus.load > 1.0:
        load.append("  wrong bit rate?", style="bold yellow")
    troubles = [("kernel drops", bus.drops), ("error frames", bus.error_frames), ("unknown ids", bus.unknown)]
    troubles += [(name, n) for name, n in (("wrong length", bus.wrong_length), ("remote", bus.remote),
                                           ("outages", bus.outages)) if n]
    lines = [load, *_listed("bus", troubles, width)]
    if status.run.transmit:
        lines.append(_labelled("answers", f"{bus.sent} sent  after {plain.turnaround(bus)}  ",
                               _counts([("unsent", bus.unsent), ("too late", bus.late)])))
    return lines


def _finding(told: Told, width: int, advice: bool) -> list[Text]:
    indent = _LABEL
    words = told.sentence + (f" {told.advice}" if advice and told.advice else "")
    parts = textwrap.wrap(words, max(20, width - indent)) or [""]
    lines = [Text.assemble((f"{told.severity:{indent - 2}}", _STYLES.get(told.severity, "")), "  ", parts[0])]
    return lines + [Text(" " * indent + part) for part in parts[1:]]


def _none(status: MonitorStatus) -> tuple[str, tuple[str, str]]:
    """Where there is no finding: because nothing is wrong, or because nobody looks (yet)."""
    if status.checked in ("", "starting"):
        return "nobody looks for any" if not status.checked else "the checks are starting", ("", "")
    return "none so far", (f"  looked at: {status.checked}", _DIM)


def _findings(status: MonitorStatus, width: int, room: int) -> list[Text]:
    if not status.findings:
        return [_labelled("findings", *_none(status))]
    lines: list[Text] = []
    for k, told in enumerate(status.findings):
        parts = _finding(told, width, False)
        more = len(status.findings) - k
        if len(lines) + len(parts) + (more > 1) > room:
            if not lines:
                lines = parts[:room]
                more -= 1
            if more:
                tail = f"  (+{more} more: f)"
                lines[-1].truncate(width - len(tail))
                lines[-1].append(tail, style=_WARN)
            break
        lines += parts
    return lines


def _events(status: MonitorStatus, room: int) -> list[Text]:
    shown = status.events[-room:] if room > 0 else ()
    return [Text.assemble((f"{event.time:{_LABEL}}", _DIM), (event.words, _STYLES["error"] if
                          event.severity == "error" else "")) for event in shown]


def _all_findings(status: MonitorStatus, width: int, room: int) -> list[Text]:
    lines = [Text("findings", style="bold") if status.findings else _labelled("findings", *_none(status))]
    for told in status.findings:
        lines += _finding(replace(told, advice=f"{told.advice} (since {told.since})"), width, True)
    lines += [Text(), Text("events" if status.events else "no events", style="bold")]
    left = room - len(lines)
    return lines + _events(status, max(left, 3))


def _help(width: int) -> list[Text]:
    lines = [Text.assemble((f"{key:{_LABEL}}", "bold"), words) for key, words in _HELP]
    lines.append(Text())
    for note in _NOTES:
        parts = textwrap.wrap(note, max(20, width - 2), subsequent_indent="  ")
        lines += [Text(part) for part in parts]
    return lines
