"""Recording, summing up and drawing a run, against data made by hand."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.profile import RPM, Profile, demo
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.report import figure, page, png, summary, svg
from ipmsm_can.report.recorder import Record, Recorder
from ipmsm_can.report.reduce import envelope
from ipmsm_can.wire.protocol import MessageKind, Protocol

RATE = 1000.0
N = 4000
LOCKED, VALID = confidence.LOCKED, confidence.LOCKED | confidence.POLARITY_KNOWN | confidence.VALID


def made_up(error_deg: float = 0.5, first_counter: int = 0) -> Record:
    """4 s at 1 kHz: still for 1 s, then 20 rad/s; unknown, locked from 2 s, valid from 2.5 s; encoder at 100 Hz.

    The estimate is `error_deg` ahead from 2 s on and 90 deg off before.
    """
    counter = first_counter + np.arange(N, dtype=np.int64)
    time = counter / RATE
    theta = 1.0 + 20.0 * np.maximum(time - 1.0, 0.0)
    off = np.where(time < 2.0, 90.0, error_deg)
    flags = np.where(time < 2.0, 0, np.where(time < 2.5, LOCKED, VALID)).astype(np.uint8)
    encoder = counter[::10]
    wrapped = np.angle(np.exp(1j * (theta + np.radians(off))))
    return Record(
        sample_rate=RATE, counter=counter, time=time, theta=wrapped, omega=np.where(time > 1.0, 20.0, 0.0),
        sigma=np.where(time < 2.0, math.pi, 0.05), excitation=np.full(N, 0.1), current=np.full(N, 1.0), flags=flags,
        injecting=time < 1.5, filled=np.zeros(N, np.bool_), reference_counter=encoder,
        reference_theta=theta[::10] % (2.0 * np.pi), reference_omega=np.where(time > 1.0, 20.0, 0.0)[::10],
        command_time=np.arange(0.0, 1.5, 0.02), command_amplitude=np.full(75, 6.0),
        load=np.concatenate([np.linspace(0.01, 0.5, 10), np.full(30, 0.6)]),
        frames=dict.fromkeys(MessageKind, 0) | {MessageKind.DRIVE_SAMPLE: N})


def summed(record: Record) -> summary.Summary:
    config = config_from({"motor": {"preset": "m2"}})
    node = Companion([config], Protocol(), True).nodes[0]
    return summary.summarise(record, node, summary.BusFigures("a bus"))


def test_errors_lock_and_motion_of_known_data() -> None:
    s = summed(made_up(0.5))
    assert s.lock_time == 2.5
    # 1 deg at 20 rad/s takes 0.87 ms; the encoder speaks every 10 ms
    assert s.motion_time == pytest.approx(1.01)
    assert s.lock_after_motion == pytest.approx(1.49)
    assert s.rms_valid == pytest.approx(0.5) and s.worst_valid == pytest.approx(0.5)
    assert s.compared == 400
    assert s.valid_share == 1.0
    assert s.load_mean == pytest.approx(0.6)


def test_error_is_signed_and_wraps() -> None:
    c = summary.compare(made_up(-0.5))
    assert np.allclose(c.error[c.time >= 2.0], -0.5)
    assert np.allclose(c.error[c.time < 2.0], 90.0)
    assert c.valid.sum() == 150


def test_encoder_frames_without_an_estimate_are_left_out() -> None:
    record = made_up()
    keep = np.ones(N, np.bool_)
    keep[1000:1501] = False  # lost: encoder frames of 1000, 1010, ... 1500 have no partner
    gone = replace(record, **{name: getattr(record, name)[keep] for name in (
        "counter", "time", "theta", "omega", "sigma", "excitation", "current", "flags", "injecting", "filled")})
    late = replace(gone, reference_counter=np.append(gone.reference_counter, 10**6),
                   reference_theta=np.append(gone.reference_theta, 0.0),
                   reference_omega=np.append(gone.reference_omega, 0.0))
    c = summary.compare(late)
    assert c.error.size == 400 - 51
    assert np.allclose(c.error[c.time >= 2.0], 0.5)


def test_an_angle_lost_again_counts_after_lock_but_not_as_valid() -> None:
    record = made_up(0.5)
    flags = record.flags.copy()
    flags[3000:] = 0
    theta = record.theta.copy()
    theta[3000:] += math.radians(30.0)
    s = summed(replace(record, flags=flags, theta=theta))
    assert s.worst_valid == pytest.approx(0.5)
    assert s.worst_after_lock == pytest.approx(30.5)
    assert s.valid_share == pytest.approx(1.0 / 3.0)


def test_faults_name_what_was_wrong() -> None:
    good = replace(summed(made_up()), samples=N)
    assert good.faults() == []
    for change, words in (
        ({"lost": 3}, "3 samples were lost"), ({"gaps": 2}, "broke 2 times"), ({"bad_frames": 4}, "4 frames were"),
        ({"samples": 0}, "no sample"), ({"lock_time": math.nan}, "never became valid"),
        ({"worst_valid": 20.0}, "off by 20.0 deg"), ({"rms_valid": 3.0}, "3.00 deg rms"), ({"restarts": 1}, "anew"),
        ({"compared": 0}, "no encoder frame"),
    ):
        faults = replace(good, **change).faults()
        assert len(faults) == 1 and words in faults[0], change
    for bus, words in ((summary.BusFigures("a bus", drops=5), "dropped 5"),
                       (summary.BusFigures("a bus", unsent=6), "6 frames could not be sent"),
                       (summary.BusFigures("a bus", rejected_commands=7), "refused 7")):
        faults = replace(good, bus=bus).faults()
        assert len(faults) == 1 and words in faults[0]


def test_nothing_recorded_is_told_not_raised() -> None:
    companion = Companion([config_from({"motor": {"preset": "m2"}})], Protocol(), True)
    record = Recorder(companion, 0).record()
    s = summary.summarise(record, companion.nodes[0], summary.BusFigures("a bus"))
    assert s.faults() == ["no sample of the drive arrived"]
    assert "–" in summary.text(s)
    assert "never" not in page.build(figure.panels(record, s, M2, demo()), s, s.faults(), "x", "y")


def test_recorder_grows_and_keeps_only_its_node() -> None:
    protocol = Protocol()
    configs = [config_from({"motor": {"preset": "m2"}, "wire": {"node": n, "sample_rate": 5000}}) for n in (0, 1)]
    companion = Companion(configs, protocol, True)
    recorder = Recorder(companion, 1)
    total = 70_000
    rng = np.random.default_rng(5)
    current = rng.uniform(-20.0, 20.0, (2, total))
    for begin in range(0, total, 7000):
        k = np.arange(begin, begin + 7000)
        raws = []
        for node in (0, 1):
            raws.append(protocol.encode(MessageKind.DRIVE_SAMPLE, node, {
                "i_alpha": current[0, k], "i_beta": current[1, k], "v_alpha": 0.0 * k, "v_beta": 0.0 * k,
                "sample_counter": k & 15}))
        raws.append(protocol.encode(MessageKind.DRIVE_REFERENCE, 1, {
            "theta_e": np.array([1.0]), "omega_e": np.array([2.0]), "sample_counter": np.array([begin])}))
        t = np.concatenate([k * 200_000, k * 200_000, [k[-1] * 200_000]])
        block = FrameBlock(np.concatenate(raws), t)
        answers = companion.respond(companion.feed(FrameBlock.zeros(0)), int(t[-1]))
        recorder.observe(block, companion.feed(block), answers, int(t[-1]))
    r = recorder.record()
    assert r.counter.tolist() == list(range(total))
    assert r.frames[MessageKind.DRIVE_SAMPLE] == total
    assert r.frames[MessageKind.COMPANION_STATUS] > 0
    assert np.allclose(r.current, np.hypot(*current), atol=0.0051)
    assert r.reference_counter.tolist() == list(range(0, total, 7000))
    assert recorder.seconds == pytest.approx((total - 1) / 5000.0)


def test_envelope_keeps_extremes_and_breaks() -> None:
    x = np.arange(100_000) / 1000.0
    y = np.sin(x)
    y[54_321] = 9.0
    y[70_000:75_000] = np.nan
    a, b = envelope(x, y, 0.0, 100.0, 200)
    assert a.size <= 400 and np.all(np.diff(a) >= 0.0)
    assert np.nanmax(b) == 9.0 and np.nanmin(b) == np.nanmin(y)
    inside = (a > 70.5) & (a < 74.5)
    assert inside.any() and np.isnan(b[inside]).all()
    assert np.isfinite(b[(a > 76.0)]).all()
    few = envelope(x[:50], y[:50], 0.0, 100.0, 200)
    assert np.array_equal(few[1], y[:50])


def test_scales_place_known_values() -> None:
    log = figure.Scale(1e-4, 1.0, (), "log")
    assert log.place(1e-2) == pytest.approx(0.5)
    even = figure.Scale(-180.0, 180.0, (), "asinh", 0.5)
    assert even.place(0.0) == pytest.approx(0.5)
    assert even.place(np.array([-500.0, 500.0])).tolist() == [0.0, 1.0]
    assert even.place(5.0) - 0.5 == pytest.approx(0.5 * math.asinh(10.0) / math.asinh(360.0))


def test_states_loads_and_phases() -> None:
    spans = figure.states(made_up())
    assert [(s.begin, s.end, s.role) for s in spans] == [
        (0.0, 2.0, "unknown"), (2.0, 2.5, "locked"), (2.5, pytest.approx(3.999), "valid")]
    profile = Profile(((0.0, 0.0), (1.0, 0.0), (2.0, 100.0 * RPM), (3.0, 100.0 * RPM), (4.0, -100.0 * RPM)),
                      ((0.0, 0.0), (1.0, 0.0), (1.0, -2.0), (1.5, -2.0), (1.5, 0.0)))
    assert [(m.begin, m.end, m.label) for m in figure.speed_phases(profile, 5.0)] == [
        (0.0, 1.0, "standstill"), (2.0, 3.0, "100 rpm"), (3.0, 4.0, "reversal"), (4.0, 5.0, "−100 rpm")]
    assert [(m.begin, m.end, m.label) for m in figure.load_steps(profile, 5.0)] == [(1.0, 1.5, "−2 N m")]
    assert figure.load_steps(profile, 0.5) == ()


def test_a_line_is_drawn_where_it_belongs() -> None:
    """A constant 5 on a scale 0..10 is a horizontal line half-way up, from edge to edge."""
    scale = figure.Scale(0.0, 10.0, ((0.0, "0"), (10.0, "10")))
    x = np.linspace(0.0, 2.0, 50)
    panel = figure.Panel("p", "Title & more", "", "V", scale, 0.0, 2.0, 1.0,
                         (figure.Line(x, np.full(50, 5.0), "probe", "a"),))
    drawing = svg.draw(panel, svg.WIDE)
    d = re.search(r'<path class="probe"[^>]* d="([^"]*)"', drawing)
    assert d is not None
    points = [tuple(map(float, p.split())) for p in re.split("[ML]", d[1])[1:]]
    assert {y for _, y in points} == {24.0 + svg.WIDE.unit_height / 2}
    assert points[0][0] == svg.WIDE.left and points[-1][0] == svg.WIDE.width - svg.WIDE.right
    assert "Title &amp; more" in drawing


def test_page_stands_alone_in_both_themes_and_widths(tmp_path: object) -> None:
    record = made_up()
    s = replace(summed(record), samples=N)
    parts = figure.panels(record, s, M2, demo())
    text = page.build(parts, s, [], "What <ran>", "how")
    assert [p.name for p in parts] == ["speed", "error", "lock", "probing", "current", "excitation"]
    assert "prefers-color-scheme:dark" in text and 'name="viewport"' in text
    assert text.count('<svg class="wide"') == text.count('<svg class="narrow"') == len(parts)
    for outside in ("http", "src=", "href=", "@import", "<script", "url(//"):
        assert outside not in text, outside
    assert re.findall(r"url\((?!#)", text) == []
    assert "What &lt;ran&gt;" in text
    assert "nan" not in text.lower().replace("nano", "")
    for figure_text in ("1.49 s", "0.50°"):
        assert figure_text in text
    for panel in parts:
        assert panel.unit in text and panel.title in text
    assert "Something was wrong" in page.build(parts, s, ["it broke"], "", "")


def test_every_colour_of_the_page_is_in_both_palettes() -> None:
    from ipmsm_can.report.palette import DARK, LIGHT

    assert DARK.keys() == LIGHT.keys()
    used = set(re.findall(r"var\(--([a-z]+)\)", page._STYLE))
    assert used <= LIGHT.keys()


def test_picture_is_a_png_of_some_size(tmp_path) -> None:  # type: ignore[no-untyped-def]
    record = made_up()
    s = summed(record)
    png.save(figure.panels(record, s, M2, None), tmp_path / "a.png", "x")
    data = (tmp_path / "a.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = (int.from_bytes(data[k:k + 4], "big") for k in (16, 20))
    assert width > 1000 and height > 1000
