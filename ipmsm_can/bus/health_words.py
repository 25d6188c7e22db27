"""What a field engineer should know of a bus first: a `HealthReport` judged, and put into words."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

from ipmsm_can.bus.health_report import DriveHealth, Finding, HealthReport, IdHealth

HIGH_LOAD, FULL_LOAD = 0.7, 0.9
"""Bus loads from which on frames of low priority wait noticeably, and may not get through."""
PAUSE = 5.0
"""A frame sent by the clock has paused where it stayed away for so many of its usual gaps ..."""
PAUSE_LEAST_S = 0.02
"""... and for so long, for no operating system sends to the millisecond."""
WANDERING = 0.2
"""Relative difference between the most and the least frames in a whole second that is told."""
SILENCE_S = 1.0
DRIFT_PPM, DRIFT_LIMIT_PPM = 150.0, 1000.0
"""Two crystals differ by less than the first; beyond the second the companion takes it for another sample rate."""
_SURE = 5.0
_NAMED = 4
_ORDER = {"error": 0, "warning": 1, "notice": 2}
_OR_ANOTHER = "Where other devices send these identifiers: --dbc FILE names them, and nothing is said about drives."


def judge(report: HealthReport) -> HealthReport:
    """The report with its findings, the gravest first."""
    found = [*_about_the_bus(report), *_about_errors(report), *_about_losses(report), *_about_ids(report),
             *_about_clocks(report)]
    return dataclasses.replace(report, findings=tuple(sorted(found, key=lambda f: _ORDER[f.severity])))


def _about_the_bus(r: HealthReport) -> Iterator[Finding]:
    if r.no_bus:
        yield Finding("error", f"There is {r.no_bus}.")
    elif not r.frames and not r.errors.frames:
        yield Finding("error", "Not one frame came.",
                      "Check that something is sending, the bit rate, and the wiring (CAN_H and CAN_L, 60 ohm).")
    if r.outages:
        yield Finding("error", f"The bus went away {_times(r.outages)}, for {seconds(r.outage_time)} in all.",
                      "What was sent meanwhile is missing. Check plug, supply and interface.")
    load = max(r.peak_load, r.mean_load if r.duration >= 1.0 else 0.0)  # a few frames in a row are no load
    if load > 1.0:
        yield Finding("warning", f"The frames take {100 * load:.0f} % of the time, more than a bus of "
                                 f"{_rate(r.bitrate)} can carry.",
                      "The bit rate is another one: give it with -b (and --data-bitrate).")
    elif load > HIGH_LOAD:
        mean = f"{100 * r.mean_load:.0f} % on average"
        guess = f", if the bit rate is {_rate(r.bitrate)}" if r.assumed_rates else ""
        yield Finding("error" if load > FULL_LOAD else "warning",
                      f"The bus load reaches {100 * load:.0f} % within a second ({mean}){guess}.",
                      "Frames with high identifiers have to wait and may come late: send less often, or faster.")
    if r.silence > SILENCE_S:
        yield Finding("warning", f"The whole bus was silent for {seconds(r.silence)}, {_at(r.silence_at)}.")
    if r.back:
        yield Finding("warning", f"Time stamps run backwards {_times(r.back)}.",
                      "The clock was set, logs were joined, or one log holds several buses (-c takes one of them); "
                      "gaps and rates there mean nothing.")


def _about_errors(r: HealthReport) -> Iterator[Finding]:
    e = r.errors
    if not e.frames:
        return
    many = f"{e.frames} error frame{'s' if e.frames > 1 else ''}"
    if not e.decoded:
        yield Finding("warning", f"{many}; what they mean is not told by a recording or adapter of this kind.",
                      "Record with candump on SocketCAN to see classes and error counters.")
        return
    if e.bus_offs:
        now = " and is so still" if e.state.startswith("bus-off") else ""
        yield Finding("error", f"This computer's controller went bus-off {_times(e.bus_offs)}{now}: nothing it "
                               "sends gets through.",
                      "Usually a wrong bit rate, a short circuit or a missing termination. `ip link set can0 type "
                      "can restart` restarts it; `restart-ms 100`, set while it is down, does so every time.")
    elif e.passive:
        counters = f" (counters tx {e.tx_errors} rx {e.rx_errors})" if e.tx_errors >= 0 else ""
        yield Finding("error", f"This computer's controller was error passive{counters}: it sees many faulty "
                               "frames.", "Check bit rate, sample point, termination and wiring.")
    told = [f"{n} x {words}" for words, n in {**e.kinds, **e.violations}.items()]
    where = [f"{words} ({n})" for words, n in list(e.places.items())[:3]]
    yield Finding("warning", f"{many}: " + (", ".join(told) or "unknown class")
                  + (f"; most often in {', '.join(where)}" if where else "") + ".")


def _about_losses(r: HealthReport) -> Iterator[Finding]:
    if r.kernel_drops > 0:
        yield Finding("error", f"The kernel of this computer dropped {r.kernel_drops} frames: they were on the "
                               "bus, but were not read in time.",
                      "Give the program more processor, or a larger buffer.")
    if r.errors.overflows:
        yield Finding("error", f"The CAN controller's own buffer overflowed {_times(r.errors.overflows)}.",
                      "The computer answers its interrupts too late.")
    for d in r.drives:
        if not d.sequenced:
            yield Finding("warning", f"Drive {d.node} sends samples but no DriveTiming: losses cannot be counted.",
                          _OR_ANOTHER)
        if d.lost:
            share = d.lost / max(1, d.lost + d.received)
            yield Finding("error" if share > 0.01 else "warning",
                          f"{d.lost} samples of drive {d.node} never came ({100 * share:.2g} %): "
                          f"{loss_place(r, d)}.")
        if d.restarts:
            yield Finding("warning", f"The sample counter of drive {d.node} began anew {_times(d.restarts)}: it "
                                     "restarted.")
        if d.bad_frames:
            yield Finding("warning", f"{d.bad_frames} frames of drive {d.node} had a wrong checksum or impossible "
                                     "content.", "" if d.received else _OR_ANOTHER)
    if r.uncounted:
        yield Finding("notice", f"There are more identifiers than are told apart; {r.uncounted} frames are not in "
                                "the table.")


def loss_place(r: HealthReport, d: DriveHealth) -> str:
    """Where the samples of a drive were lost, as far as can be known."""
    if r.kernel_drops < 0:
        return "in the drive, on the bus or in the computer that listened, which did not tell"
    elsewhere = d.lost - r.kernel_drops
    if r.kernel_drops == 0:
        return "not in this computer's kernel or in this program, so in the drive, on the bus or in the controller"
    if elsewhere > 0:
        return f"at most {r.kernel_drops} in this computer's kernel, at least {elsewhere} before it"
    return "possibly all in this computer's kernel"


def _about_ids(r: HealthReport) -> Iterator[Finding]:
    paused = [i for i in r.ids if i.steady and i.max_gap > max(PAUSE * i.period, PAUSE_LEAST_S)]
    shared = [i for i in paused if r.silence > SILENCE_S and i.max_gap < r.silence + 3.0 * i.period
              and i.max_gap_at <= r.silence_at < i.max_gap_at + i.max_gap]
    alone = [i for i in paused if i not in shared]
    if alone:
        yield Finding("warning", "Sent by the clock, but with pauses: " + _named(
            alone, lambda i: f"{i.label} every {seconds(i.period)}, once not for {seconds(i.max_gap)} "
                             f"{_at(i.max_gap_at)}") + ".")
    wandering = [i for i in r.ids if i.steady and i not in paused and i.least >= 0 and i.most >= 10
                 and i.most - i.least > max(2, WANDERING * i.most)]
    if wandering:
        yield Finding("warning", "The rate is not steady: " + _named(
            wandering, lambda i: f"{i.label} {i.least} to {i.most} in a second") + ".")
    changing = [i for i in r.ids if i.length_changes]
    if changing:
        yield Finding("notice", "The length of the payload changes: " + _named(
            changing, lambda i: f"{i.label} {i.min_length} to {i.max_length} bytes") + ".")
    unknown = r.unknown
    if unknown and len(unknown) == len(r.ids):
        yield Finding("notice", f"None of the {len(r.ids)} identifiers is in {r.database}.",
                      "Another database may be given with --dbc.")
    elif unknown:
        yield Finding("notice", f"Not in {r.database}: " + _named(unknown, lambda i: i.label) + ".")


def _named(ids: list[IdHealth], words: object) -> str:
    assert callable(words)
    more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
    return ", ".join(words(i) for i in ids[:_NAMED]) + more


def _about_clocks(r: HealthReport) -> Iterator[Finding]:
    for d in r.drives:
        sure = math.isfinite(d.drift_ppm) and abs(d.drift_ppm) > DRIFT_PPM + _SURE * d.drift_sigma_ppm
        if sure:
            way = "faster" if d.drift_ppm > 0 else "slower"
            yield Finding("warning" if abs(d.drift_ppm) > DRIFT_LIMIT_PPM else "notice",
                          f"The clock of drive {d.node} runs {abs(d.drift_ppm):.0f} ppm {way} than this "
                          f"computer's, against the sample rate of {d.sample_rate:g} Hz that it states.",
                          "Speed and flux are wrong by the same share, unless the drive states the rate it has.")


def seconds(value: float) -> str:
    """A time to three digits, in a fitting unit."""
    if not math.isfinite(value):
        return "-"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if value >= size:
            return f"{value / size:.3g} {unit}" if value < 1000 * size else f"{value / size:.0f} {unit}"
    return f"{1e6 * value:.2g} us"


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"


def _at(value: float) -> str:
    return f"at {value:.3f} s" if math.isfinite(value) else ""


def _rate(bits: float) -> str:
    return f"{bits / 1e6:g} Mbit/s" if bits >= 1e6 else f"{bits / 1e3:g} kbit/s"


def rates(r: HealthReport) -> str:
    """The bit rates, and whether anybody said them."""
    text = _rate(r.bitrate)
    if r.data_bitrate != r.bitrate and any(i.fd for i in r.ids):
        text += f", data {_rate(r.data_bitrate)}"
    return text + (" assumed, -b says" if r.assumed_rates else "")


def headline(r: HealthReport) -> str:
    """Load and numbers in one line."""
    return (f"load {100 * r.load:.1f} % now, {100 * r.mean_load:.1f} % on average, {100 * r.peak_load:.1f} % in "
            f"the busiest second ({rates(r)})")


def losses(r: HealthReport) -> list[str]:
    """Sample loss by place, a line each."""
    drops = "not known" if r.kernel_drops < 0 else str(r.kernel_drops)
    lines = [f"lost in this computer: kernel {drops}, controller's buffer {r.errors.overflows}, this program 0"]
    for d in r.drives:
        if not d.sequenced:
            lines.append(f"drive {d.node}: waiting for DriveTiming")
            continue
        text = (f"drive {d.node}: {d.received} samples, {d.lost} missing by its counter, {d.restarts} restarts, "
                f"{d.duplicates} duplicates, {d.bad_frames} bad frames")
        if math.isfinite(d.drift_ppm):
            text += f"; clock {d.drift_ppm:+.2f} +/- {d.drift_sigma_ppm:.2g} ppm"
        lines.append(text)
    return lines


def errors(r: HealthReport) -> str:
    """Error frames in one line."""
    e = r.errors
    if not e.frames:
        return "no error frames"
    told = ", ".join(f"{n} x {words}" for words, n in e.kinds.items())
    text = f"{e.frames} error frames" + (f": {told}" if told else "")
    if e.state:
        text += f"; now {e.state}" + (f", worst {e.worst}" if e.worst != e.state else "")
    return text + (f"; counters tx {e.tx_errors} rx {e.rx_errors}" if e.tx_errors >= 0 else "")


TABLE_HEAD = (f"{'identifier':24}{'frames':>9}{'per s':>8}{'usual gap':>10}{'jitter':>8}{'longest':>8}"
              f"{'bytes':>6}{'share':>6}")


def table_row(i: IdHealth) -> str:
    """One identifier, in the columns of TABLE_HEAD."""
    rate = f"{i.rate:.1f}" if math.isfinite(i.rate) else "-"
    span = f"{i.min_length}" if i.min_length == i.max_length else f"{i.min_length}-{i.max_length}"
    longest = seconds(i.max_gap) if i.count > 1 else "-"
    return (f"{i.label[:23]:24}{i.count:>9}{rate:>8}{seconds(i.period):>10}{seconds(i.jitter):>8}{longest:>8}"
            f"{span:>6}{100 * i.share:>5.1f}%")


def text(r: HealthReport) -> str:
    """The whole report for people, the findings first."""
    lines = [f"{r.source}: {r.frames} frames of {len(r.ids)} identifiers in {r.duration:.1f} s", headline(r)]
    lines += ["", "Findings:"] if r.findings else ["", "Nothing remarkable."]
    for f in r.findings:
        lines.append(f"  {f.severity:8}{f.sentence}")
        if f.advice:
            lines.append(f"          {f.advice}")
    lines += ["", *losses(r), errors(r)]
    if r.ids:
        lines += ["", TABLE_HEAD, *(table_row(i) for i in r.ids)]
    return "\n".join(lines)
