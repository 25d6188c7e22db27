"""The live display's picture of a status: ASCII only, made for 80 columns, words before colours."""

from __future__ import annotations

import textwrap

from rich.text import Text

from ipmsm_can.cli import plain
from ipmsm_can.cli.health_view import health_lines
from ipmsm_can.cli.status import DriveStatus, HealthStatus, NodeStatus, RunStatus, Status
from ipmsm_can.record.status import RecordStatus

_BLOCK_LINES = 8
_LABEL = 9
_ERROR_LINES = 3


def render(status: Status, width: int, height: int) -> Text:
    """A status as at most `height` lines of at most `width` columns."""
    if isinstance(status, HealthStatus):
        badge = Text(f" {plain.SILENT} ", style="reverse")
        lines = _header(status.title, badge, status.elapsed, status.report.source, width)
        lines[2:2] = _records(status.records, width)
        lines += health_lines(status.report, width, height - len(lines))
    else:
        lines = _run(status, width, height) if isinstance(status, RunStatus) else _drive(status, width)
    if len(lines) > height:
        lines = [*lines[:height - 1], Text("... the window is too low for the rest", style="yellow")]
    for one in lines:
        one.truncate(width)
    return Text("\n").join(lines)


def _run(status: RunStatus, width: int, height: int) -> list[Text]:
    badge = Text(f" {plain.voice(status)} ", style="bold black on yellow" if status.transmit else "reverse")
    lines = _header(status.title, badge, status.elapsed, status.bus.description, width)
    lines[2:2] = _records(status.records, width)
    if status.bus.no_bus:
        told = textwrap.wrap(status.bus.no_bus, max(20, width - 2))
        lines[-1:] = [*(Text(f"  {part}", style="bold red") for part in told[:_ERROR_LINES]), Text()]
    tail = _bus(status, width)
    room = height - len(lines) - len(tail)
    if _BLOCK_LINES * len(status.nodes) + sum(bool(n.encoder) for n in status.nodes) <= room:
        for node in status.nodes:
            lines += [*_node(node, width), Text()]
    else:
        lines += [*_table(status.nodes, room - 1), Text()]
    return lines + tail


def _table(nodes: tuple[NodeStatus, ...], room: int) -> list[Text]:
    """One line for each drive, as many as there is room for."""
    lines = [Text(f"{'':3}{'state':10}{'angle el.':16}{'rpm mech.':>9}{'samples/s':>10}{'lost':>6}"
                  f"{'bad':>4}  probing", style="dim")]
    lines += [_row(node) for node in nodes]
    if len(lines) > room > 2:
        hidden = len(lines) - room + 1
        lines = [*lines[:room - 1], Text(f"   ... and {hidden} more; the window is too low", style="yellow")]
    return lines


def _header(title: str, badge: Text, elapsed: float, description: str, width: int) -> list[Text]:
    first = Text.assemble((title, "bold"), "  ", badge)
    time = plain.clock(elapsed)
    first.append(time.rjust(max(len(time) + 1, width - first.cell_len)))
    end = "Ctrl-C ends"
    second = Text(description, style="dim")
    second.append(end.rjust(max(len(end) + 2, width - second.cell_len)))
    return [first, second, Text()]


def _records(records: tuple[RecordStatus, ...], width: int) -> list[Text]:
    return [Text(part, style="bold green" if one.whole else "bold red")
            for one in records for part in textwrap.wrap(one.words, width)]


def _labelled(label: str, *parts: str | tuple[str, str] | Text) -> Text:
    return Text.assemble((f"  {label:{_LABEL}}", "dim"), *parts)


def _flag(name: str, is_set: bool) -> tuple[str, str]:
    return (f"  [{'x' if is_set else ' '}] {name}", "green" if is_set else "dim")


def _trust_style(node: NodeStatus) -> str:
    return "bold green" if node.valid else "bold yellow" if node.live else "bold red"


def _counts(pairs: list[tuple[str, int]]) -> Text:
    text = Text()
    for k, (name, n) in enumerate(pairs):
        text.append(f"{'  ' if k else ''}{name} ", style="red" if n else "dim")
        text.append(str(n), style="bold red" if n else "")
    return text


def _node(node: NodeStatus, width: int) -> list[Text]:
    head = Text.assemble((f"drive {node.node}", "bold"), f"  {node.motor}  ",
                         (node.state, "green" if node.locked else "yellow" if node.live else "red"))
    flags = Text.assemble(_flag("valid", node.valid), _flag("locked", node.locked),
                          _flag("polarity", node.polarity_known))
    head.append(" " * max(0, width - head.cell_len - flags.cell_len))
    head.append(flags)
    speed = (f"{node.rpm:+8.1f} rpm mechanical  {node.omega:+8.1f} rad/s electrical"
             if node.live else "unknown")
    probing = Text(node.injection)
    if node.injecting:
        probing.append(f"  (drive injects, {node.hf_current:.2f} A)", style="cyan")
    if node.rejected_commands:
        probing.append(f"  {node.rejected_commands} commands refused", style="red")
    losses = plain.losses(node)
    encoder = [_labelled("encoder", (node.encoder, "yellow"))] if node.encoder else []
    lines = [
        head,
        _labelled("angle", f"{plain.angle(node) + ' electrical' if node.known else 'unknown':35}",
                  (node.trust, _trust_style(node))),
        _labelled("speed", speed),
        _labelled("probing", probing),
        *encoder,
        _labelled("samples", f"{node.samples_per_s:.0f}/s of {node.sample_rate:.0f} Hz   estimates "
                  f"{node.estimates_per_s:.0f}/s   excitation {node.excitation:.3g} V^2 s"),
        _labelled("", _counts(losses[:4])),
        _labelled("", _counts(losses[4:])),
    ]
    return [*lines, _labelled("timing", (node.timing, "yellow"))] if node.timing else lines


def _row(node: NodeStatus) -> Text:
    state = "VALID" if node.valid else "not valid" if node.live else "silent"
    angle = plain.angle(node).replace("deg ", "") if node.known else "unknown"
    speed = f"{node.rpm:+.1f}" if node.live else "-"
    return Text.assemble(
        (f"{node.node:2} ", "bold"), (f"{state:10}", _trust_style(node)), f"{angle:16}{speed:>9}"
        f"{node.samples_per_s:>10.0f}", (f"{node.lost:>6}", "red" if node.lost else ""),
        (f"{node.bad_frames:>4}", "red" if node.bad_frames else ""), f"  {node.injection}")


def _bus(status: RunStatus, width: int) -> list[Text]:
    bus = status.bus
    load = (f"load {100 * bus.load:5.1f} %   {bus.frames_per_s:.0f} frames/s   received {bus.frames}   "
            f"sent {bus.sent}")
    if bus.load > 1.0:
        load = load.replace("%", "% (more than the bit rate carries)", 1)
    lines = [Text.assemble(("bus", "bold"), " " * (_LABEL - 1), load),
             _labelled("", _counts(plain.bus_troubles(bus) + [("outages", bus.outages)] * (bus.outages > 0)))]
    if status.transmit:
        unsent = _counts([("unsent", bus.unsent), ("too late", bus.late)])
        lines.append(_labelled("answers", f"turnaround {plain.turnaround(bus)}  ", unsent))
    style = "red" if bus.error_frames else ""
    told = textwrap.wrap(bus.errors, max(20, width - _LABEL - 2)) or [""]
    return lines + [_labelled("" if k else "errors", (part, style)) for k, part in enumerate(told[:_ERROR_LINES])]


def _drive(status: DriveStatus, width: int) -> list[Text]:
    badge = Text(" simulated, TRANSMITTING ", style="bold black on yellow")
    lines = _header(status.title, badge, status.elapsed, status.description, width)
    for n in status.nodes:
        on = n.amplitude > 0.0
        lines += [
            Text.assemble((f"drive {n.node}", "bold"), f"  {n.motor}  profile {n.profile}, at {n.time:.1f} s"),
            _labelled("speed", f"{n.rpm:+8.1f} rpm mechanical   asked {n.reference_rpm:+8.1f}"),
            _labelled("torque", f"{n.torque:+8.2f} N m              load  {n.load_torque:+8.2f}"),
            _labelled("current", f"{n.current:8.2f} A peak"),
            _labelled("probing", (f"{n.waveform}, {n.amplitude:.1f} V" if on else "off", "cyan" if on else ""),
                      (f"  {n.rejected} commands refused" if n.rejected else "", "red")),
            Text(),
        ]
    sent = f"{status.sent_per_s:.0f} frames/s   sent {status.sent}   "
    lines.append(Text.assemble(("bus", "bold"), " " * (_LABEL - 1), sent,
                               _counts([("unsent", status.unsent), ("too slow", status.slips)])))
    left = max(0.0, status.duration - status.elapsed)
    lines.append(_labelled("ends in", f"{left:.0f} s"))
    return lines
