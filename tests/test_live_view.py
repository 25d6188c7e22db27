"""What the live view shows: its picture, its curves, and the course of a drive."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.profile import RPM
from ipmsm_can.live_view import chart
from ipmsm_can.live_view.course import CourseRing
from ipmsm_can.live_view.picture import picture
from ipmsm_can.live_view.status import FINDINGS, HELP, MonitorStatus, Told
from ipmsm_can.motor import M2
from ipmsm_can.node import Tracked
from ipmsm_can.wire.protocol import Protocol
from tests.live_view_status import DRIVE, EVENTS, NODE, STATUS, samples

PROTOCOL = Protocol()
SIZES = [(80, 24), (120, 40), (40, 10), (200, 60), (20, 5), (1, 1)]


def shown(status: MonitorStatus, width: int = 80, height: int = 24) -> list[str]:
    return [str(line) for line in picture(status, width, height)]


# The picture


def test_everything_is_on_the_screen() -> None:
    text = "\n".join(shown(STATUS, 120, 40))
    for words in (
            " SILENT (listening only) ", "● REC", "run.blf 12.3 MB", "0:01:23", "can0 (SocketCAN", "drive 3  m2",
            "[x] valid  [x] locked  [x] polarity", "330.0° ± 0.60° electrical", "VALID",
            "+999.9 ± 0.41 rpm mechanical", "+314.2 rad/s electrical", "2.34 A rms, 3.61 A peak",
            "i_d -0.52  i_q +3.27 A peak", "87.6 V rms to neutral", "141 % of rated current",
            "on, 6.0 V: low speed", "the drive injects, 0.35 A peak", "9999/s of 10000 Hz", "excitation 5.83 V^2 s",
            "lost 7", "gaps 1", "bad frames 8", "speed [rpm mech.], last 25 s", "1 sigma of the angle [deg el.]",
            "phase current [A rms]", "57.3 %", "5560 frames/s", "kernel drops 15", "error frames 2",
            "unknown ids 12",
            "error       The frames take 97 %", "warning     Samples of drive 3", "14:03:11    mark 1",
            "r stop rec  m mark  p pause", "h help  q quit"):
        assert words in text, words
    assert "TRANSMITTING" not in text and "inject  " not in text and "answers" not in text
    loud = "\n".join(shown(replace(STATUS, injectable=True, run=replace(STATUS.run, transmit=True)), 120, 40))
    assert "TRANSMITTING" in loud and "SILENT" not in loud
    assert "99 sent  after p50 120 us  p99 240 us  unsent 11  too late 9" in loud
    assert "i o a injection" in loud


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("nodes", [1, 2, 16])
@pytest.mark.parametrize("page", ["main", FINDINGS, HELP])
@pytest.mark.parametrize("ascii_only", [False, True])
def test_it_fits_every_window(width: int, height: int, nodes: int, page: str, ascii_only: bool) -> None:
    many = replace(STATUS, page=page, ascii=ascii_only, selected=nodes - 1,
                   drives=tuple(replace(DRIVE, node=replace(NODE, node=k)) for k in range(nodes)))
    lines = shown(many, width, height)
    assert len(lines) == height
    assert max(map(len, lines)) <= width
    assert not ascii_only or "".join(lines).isascii()
    if width >= 40:
        assert "SILENT (listening only)" in lines[0]
    if width >= 40 and height >= 10 and page == "main":
        assert any("VALID" in line for line in lines), "the verdict on the angle is never cut off"
        assert "q quit" in lines[-1]


def test_nothing_of_the_numbers_is_cut_off_at_80_columns() -> None:
    narrow, wide = shown(STATUS), shown(STATUS, 200, 60)

    def numbers(lines: list[str]) -> list[str]:
        at = [next(k for k, line in enumerate(lines) if line.startswith(word))
              for word in ("drive", "        speed", "bus load", "error")]
        return " ".join(lines[at[0]:at[1]] + lines[at[2]:at[3]]).split()

    assert numbers(narrow) == numbers(wide) and len(numbers(narrow)) > 80


@pytest.mark.parametrize(("change", "words"), [
    ({"live": False, "state": "no samples any more"}, "no estimate"),
    ({"sigma": math.pi, "valid": False, "locked": False}, "NOT VALID: angle unknown"),
    ({"valid": False, "polarity_known": False}, "NOT VALID: may be half a turn off"),
])
def test_an_angle_is_never_shown_as_more_than_it_is(change: dict[str, object], words: str) -> None:
    status = replace(STATUS, drives=(replace(DRIVE, node=replace(NODE, **change)),))  # type: ignore[arg-type]
    for width in (40, 80, 120):
        text = "\n".join(shown(status, width, 40))
        assert (words if width >= 80 else words[:20]) in text
        assert " VALID" not in text.replace("NOT VALID", "")
        if not change.get("live", True) or change.get("sigma") == math.pi:
            assert "330" not in text and "i_d -0.52" not in text


def test_what_is_grave_is_told_in_words() -> None:
    gone = replace(STATUS.run, bus=replace(STATUS.run.bus, no_bus="no bus since 14:03:12: can0 is down"))
    assert any("no bus since 14:03:12: can0 is down" in line for line in shown(replace(STATUS, run=gone)))
    full = replace(STATUS, record_trouble="no space left on the disk of run.blf")
    assert " NOT RECORDING " in shown(full)[0] and "no space left" in shown(full)[1]
    assert " PAUSED " in shown(replace(STATUS, paused=True))[0]
    assert shown(replace(STATUS, keys=False))[-1].startswith("no keys: standard input is not a terminal")
    for checked, words in (("the bus, drive 3", "none so far  looked at: the bus, drive 3"),
                           ("starting", "the checks are starting"), ("", "nobody looks for any")):
        for page in ("main", FINDINGS):
            assert words in "\n".join(shown(replace(STATUS, findings=(), checked=checked, page=page)))


def test_what_others_say_is_put_into_ascii_where_there_is_no_more() -> None:
    told = (Told("error", "The coil has 3 Ω ± 1, at 20 °C, says Jürgen."),)
    text = "\n".join(shown(replace(STATUS, ascii=True, findings=told)))
    assert text.isascii() and "3 ohm +/- 1, at 20  degC, says J?rgen." in text


def test_lines_for_pipes_tell_the_gravest_finding() -> None:
    from ipmsm_can.cli.live_view_session import line

    assert line(STATUS).endswith("lost 7 bad 8 | error: The frames take 97 % of the bus time, so others wait.")
    assert line(replace(STATUS, findings=STATUS.findings[2:])).endswith("lost 7 bad 8")


def test_findings_have_a_page_with_advice() -> None:
    few = "\n".join(shown(STATUS))
    assert "(+" in few and "more: f)" in few and "Send less" not in few
    page = "\n".join(shown(replace(STATUS, page=FINDINGS)))
    assert "Send less. (since 14:03:12)" in " ".join(page.split()) and all(event.words in page for event in EVENTS)
    assert "The frames take" not in "\n".join(shown(replace(STATUS, page=HELP)))


def test_the_drawing_process_loads_next_to_nothing() -> None:
    code = ("import sys, ipmsm_can.live_view.drawing\n"
            "print([m for m in ('numpy', 'numba', 'can', 'cantools', 'pydantic') if m in sys.modules])")
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


# Curves


def dots(lines: list[str]) -> np.ndarray:
    """The dots of a braille chart without its axis, as rows of booleans, top first; an independent reading."""
    width = max(map(len, lines)) - 8
    cells = np.array([[ord(c) - 0x2800 if c != " " else 0 for c in line[8:].ljust(width)] for line in lines])
    bits = [[0, 3], [1, 4], [2, 5], [6, 7]]
    out = np.zeros((4 * cells.shape[0], 2 * cells.shape[1]), bool)
    for y in range(4):
        for x in range(2):
            out[y::4, x::2] = cells >> bits[y][x] & 1
    return out


def test_a_curve_is_where_its_values_are() -> None:
    values = np.linspace(0.0, 100.0, chart.points(48, False))
    lines = chart.chart(values.tolist(), values.tolist(), 48, 5, 1.0, False)
    assert lines[0].startswith("    100│") and lines[-1].startswith("      0│")
    drawn = dots(lines)
    expected = 19 - np.minimum((values / 100.0 * 20).astype(int), 19)
    assert np.array_equal(drawn.argmax(axis=0), expected)
    assert drawn.sum(axis=0).max() == 1


def test_a_curve_has_no_holes_but_where_nothing_was() -> None:
    values = [0.0, 100.0, math.nan, 100.0, 0.0]
    width = 8 + 3
    drawn = dots(chart.chart(values, values, width, 4, 1.0, False))
    assert drawn.sum(axis=0).tolist() == [0, 1, 15, 0, 1, 15]
    plain = chart.chart(values, values, 8 + 5, 4, 1.0, True)
    assert [line[8:] for line in plain] == [" * * ", " *  *", " *  *", "*   *"]


@pytest.mark.parametrize("low, high, least, expected", [
    (0.0, 0.0, 10.0, (0.0, 10.0)), (-990.0, 1005.0, 10.0, (-1000.0, 1500.0)), (19.9, 20.1, 10.0, (15.0, 25.0)),
    (math.nan, math.nan, 10.0, (0.0, 10.0)), (0.02, 0.03, 0.1, (0.0, 0.1))])
def test_axes_are_round_and_hold_the_data(low: float, high: float, least: float,
                                          expected: tuple[float, float]) -> None:
    assert chart.scale(low, high, least) == pytest.approx(expected)


# Course



@pytest.fixture(scope="module")
def tracked() -> list[Tracked]:
    companion = Companion([config_from({"motor": {"preset": "m2"}})], PROTOCOL, transmit=False)
    frames = samples(12_000)
    edges = [0, *np.sort(np.random.default_rng(1).choice(len(frames), 40, False)).tolist(), len(frames)]
    out = []
    for a, b in pairwise(edges):
        out += companion.feed(frames.take(slice(a, b)))
    return out


def columns(part: list[Tracked], name: str) -> np.ndarray:
    return np.concatenate([getattr(p.estimate, name) for p in part], axis=-1)


def test_the_course_is_that_of_the_samples(tracked: list[Tracked]) -> None:
    ring, whole = CourseRing(), CourseRing()
    for part in tracked:
        ring.add(part)
    values = np.concatenate([p.run.values for p in tracked], axis=1)
    t = np.concatenate([p.run.t_ns for p in tracked])
    last = tracked[-1]
    together = replace(last, run=replace(
        last.run, values=values, t_ns=t, counter=np.concatenate([p.run.counter for p in tracked])),
        estimate=replace(last.estimate, angle=columns(tracked, "angle"), sigma=columns(tracked, "sigma")))
    whole.add(together)
    assert ring._bins.tobytes() == whole._bins.tobytes(), "the cut into blocks must not matter"
    use = t // 10**8 > t[-1] // 10**8 - 3
    angle, sigma = columns(tracked, "angle"), columns(tracked, "sigma")
    i = values[0, use] + 1j * values[1, use]
    i_dq = i * np.exp(-1j * angle[0, use])
    p = ring.present()
    assert p.i_rms == pytest.approx(np.sqrt((np.abs(i) ** 2).mean() / 2.0), rel=1e-9)
    assert p.i_peak == pytest.approx(np.abs(i).max(), rel=1e-12)
    assert (p.i_d, p.i_q) == pytest.approx((i_dq.real.mean(), i_dq.imag.mean()), rel=1e-9, abs=1e-12)
    assert p.omega == pytest.approx(angle[2, use].mean(), rel=1e-9)
    assert p.omega == pytest.approx(600.0 * RPM * M2.pole_pairs, rel=1e-3)
    first = (t // 10**8 == t[-1] // 10**8 - 2)
    expected = math.hypot(sigma[first].max(), sigma[-1]) / (use.sum() / 10_000.0)
    assert p.omega_sigma == pytest.approx(expected, rel=1e-9)
    c = whole.columns(int(t[-1]), 8, 2, 2.0)
    for k in range(8):
        own = t // 2 // 10**8 == t[-1] // 2 // 10**8 - 7 + k
        known = own & (sigma < math.radians(90.0))
        if not own.any():
            assert math.isnan(c.current[k]) and math.isnan(c.speed_low[k])
            continue
        assert c.current[k] == pytest.approx(np.sqrt((values[:2, own] ** 2).sum(axis=0).mean() / 2.0), rel=1e-6)
        assert c.speed_high[k] == pytest.approx(2.0 * angle[2, known].max(), rel=1e-6)
        assert c.speed_low[k] == pytest.approx(2.0 * angle[2, known].min(), rel=1e-6)
    assert math.isnan(whole.columns(int(t[-1]) + 10**9, 8, 1, 1.0).current[-1]), "silence is a gap"


def test_a_clock_that_is_set_back_begins_a_new_course(tracked: list[Tracked]) -> None:
    ring = CourseRing()
    for part in tracked:
        ring.add(part)
    back = replace(tracked[-1], run=replace(tracked[-1].run, t_ns=tracked[-1].run.t_ns - 3600 * 10**9))
    ring.add(back)
    assert np.isfinite(ring.columns(int(back.run.t_ns[-1]), 100, 1, 1.0).current).sum() <= 2
    assert math.isfinite(ring.present().i_rms)
