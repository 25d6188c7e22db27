"""The diagnosis of drives whose maps allow the steady-state checks only, of a simulated drive's traffic."""

from __future__ import annotations

import json
import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.analysis import steady as analysis
from ipmsm_can.analysis.measurement import Measurement
from ipmsm_can.analysis.steady import SteadyBuilder, SteadySamples, read_mapped
from ipmsm_can.cli import main
from ipmsm_can.diagnosis import Report, diagnose, limits
from ipmsm_can.diagnosis import steady_points as pointing
from ipmsm_can.diagnosis.checks import motor as motors
from ipmsm_can.diagnosis.live_mapped import MappedDiagnosis
from ipmsm_can.diagnosis.steady import SteadyCase
from ipmsm_can.diagnosis.steady_fit import NAMES, Equation
from ipmsm_can.diagnosis.steady_points import Points
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.frames import FrameBlock
from ipmsm_can.live_view.judging import Batch, MappedSource, Plan
from ipmsm_can.logs.writer import write_log
from ipmsm_can.mapping import load_map, make_plan
from ipmsm_can.motor import Motor
from tests.steady_traffic import CAR, M2, Wrong, cascadia, own, scaled, simulated, told, toml
from tests.test_mapping_live import run_live

DEG = math.radians(1.0)
RIGHT = Wrong()
MAPS = ("cascadia_pm", "cascadia_pm_dq", "own")
MOTORS = pytest.mark.parametrize("plate", [M2, CAR], ids=["m2", "car"])


def tolerant(plate: Motor, more: bool = True) -> Motor:
    """A healthy motor as far off its name plate as drive.toml allows for."""
    side = 1.0 if more else -1.0
    return scaled(plate, R=1.0 + 0.2 * side, L_d=1.0 - 0.1 * side, L_q=1.0 + 0.1 * side)


def collected(frames: FrameBlock, plate: Motor, name: str = "cascadia_pm", cuts: list[int] | None = None,
              window_s: float | None = None) -> SteadySamples:
    rate = 500.0 if name.endswith("own.toml") else 100.0
    builder = SteadyBuilder(make_plan(load_map(name), pole_pairs=plate.pole_pairs), rate, window_s=window_s)
    for a, b in pairwise([0, *(cuts or []), len(frames)]):
        builder.feed(frames.take(slice(a, b)))
    builder.finish()
    return builder.measurement()


def case(folder: Path, plate: Motor, true: Motor, name: str, wrong: Wrong = RIGHT) -> SteadyCase:
    samples = simulated(true, top_rpm=1000.0 if plate is M2 else 1500.0)
    if name == "own":
        frames, path = own(folder, samples, plate.pole_pairs, wrong)
        name = str(path)
    else:
        frames = cascadia(samples, plate.pole_pairs, wrong)
    return SteadyCase(collected(frames, plate, name), told(plate))


def report(c: SteadyCase) -> Report:
    return diagnose(c.s, c.config)


@MOTORS
@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("more", [True, False])
def test_a_healthy_drive_has_no_finding_and_its_values_within_their_intervals(
        tmp_path: Path, plate: Motor, name: str, more: bool) -> None:
    true = tolerant(plate, more)
    c = case(tmp_path, plate, true, name)
    found = report(c)
    assert found.exit_code == 0, found.findings
    assert {f.code for f in found.findings} <= {"samples.apart"}
    fit = c.fit
    for value in ("R", "L_d", "L_q", "psi_m"):
        assert abs(fit[value] - getattr(true, value)) < 2.5 * fit.sigma(value), value
    assert abs(fit["psi_m"] - true.psi_m) < 1.96 * fit.sigma("psi_m") < 0.03 * true.psi_m
    assert abs(fit["dead_time"] - 0.5) < 2.5 * fit.sigma("dead_time") < 2.5 * 0.25
    assert abs(c.zero) < 2.5 * fit.sigma("delta") < 1.5 * DEG
    states = {k.name: k.state for k in found.checked}
    zero = "zero of the reported angle" if name == "cascadia_pm" else "zero of the drive's own d and q"
    for fine in ("signs of current, voltage and speed", zero, "psi_m", "L_q"):
        assert states[fine] == "fine", fine
    assert "no fast observer: the voltage is a momentary value" in found.checked[-1].words


FAULTS = [
    ("motor.psi_m", RIGHT, 0.8), ("motor.psi_m", RIGHT, 0.88), ("motor.psi_m", Wrong(voltage=math.sqrt(3)), 1.0),
    ("encoder.zero", Wrong(zero=12 * DEG), 1.0), ("encoder.zero", Wrong(zero=-25 * DEG), 1.0),
    ("wiring.current_sign", Wrong(current=-1), 1.0), ("wiring.voltage_sign", Wrong(voltage=-1), 1.0),
    ("speed.direction", Wrong(speed=-1), 1.0), ("encoder.direction", Wrong(angle=-1), 1.0),
    ("speed.pole_pairs", Wrong(speed=0.75), 1.0), ("speed.pole_pairs", Wrong(speed=2.0), 1.0),
    ("encoder.pole_pairs", Wrong(angle=0.75), 1.0), ("encoder.pole_pairs", Wrong(angle=2.0), 1.0),
    ("torque.scale", Wrong(torque=1.3), 1.0), ("torque.scale", Wrong(torque=-1), 1.0)]


def _seen_by(name: str, code: str, wrong: Wrong) -> bool:
    # the map that has neither angle nor torque cannot tell what is wrong with those
    return name != "own" or not (wrong.angle != 1 or wrong.torque != 1 or code == "speed.pole_pairs")


@MOTORS
@pytest.mark.parametrize(("name", "code", "wrong", "psi"), [
    (name, *fault) for name in MAPS for fault in FAULTS if _seen_by(name, *fault[:2])])
def test_each_fault_is_the_first_finding(tmp_path: Path, plate: Motor, name: str, code: str, wrong: Wrong,
                                         psi: float) -> None:
    # 2/3 and 4/3 of the pole pairs where the motor has three
    if plate is M2:
        wrong = Wrong(**{**wrong.__dict__, **{k: 2.0 / 3.0 for k in ("speed", "angle")
                                              if getattr(wrong, k) == 0.75}})
    c = case(tmp_path, plate, scaled(tolerant(plate), psi_m=psi), name, wrong)
    found = report(c)
    assert found.exit_code == 1 and found.findings[0].code == code, [f.code for f in found.findings]
    assert found.findings[0].evidence
    if code == "motor.psi_m":
        share = psi * wrong.voltage
        assert abs(c.fit["psi_m"] / plate.psi_m - share) < 0.03
        sentence = found.findings[0].sentence
        assert ("line voltage" in sentence) == (wrong.voltage != 1)
        assert name == "cascadia_pm" or ("L_q is off by as much" in sentence) == (wrong.voltage != 1)
        # 0.8 is near 0.816; the L_q that is right tells that it is no scale
        assert ("But L_q is not off by as much" in sentence) == (psi == 0.8)
    if code == "encoder.zero":
        assert abs(c.zero - wrong.zero) < 1.0 * DEG
        assert found.findings[0].severity == ("error" if abs(wrong.zero) > 15 * DEG else "warning")
    if wrong.angle == -1:
        assert c.fit.cost < 20.0, "where that angle begins is known to nobody, and is not held against it"
    if wrong.speed != 1 or wrong.angle != 1:
        others = [f.code for f in found.findings[1:] if f.severity == "error"]
        assert not others, "the one cause must not show as several"


@MOTORS
def test_an_angle_that_is_not_the_frame_of_d_and_q(tmp_path: Path, plate: Motor) -> None:
    for turned in (12 * DEG, -8 * DEG):
        c = case(tmp_path, plate, tolerant(plate), "cascadia_pm", Wrong(shown_zero=turned))
        found = report(c).findings[0]
        assert found.code == "encoder.frame" and abs(found.evidence[0].value * DEG - turned) < 2.0 * DEG
        assert abs(c.zero) < 2.0 * DEG
    c = case(tmp_path, plate, tolerant(plate), "cascadia_pm_dq", Wrong(shown_zero=12 * DEG))
    assert report(c).exit_code == 0  # nothing was turned by that angle


def test_pole_pairs_that_make_the_speed_are_named_with_psi_m(tmp_path: Path) -> None:
    found = report(case(tmp_path, CAR, tolerant(CAR), "own", Wrong(speed=0.8))).findings[0]
    assert found.code == "motor.psi_m" and "A motor of 5 pole pairs, not 4" in found.sentence
    weak = report(case(tmp_path, CAR, scaled(CAR, psi_m=0.75), "cascadia_pm_dq")).findings[0]
    assert weak.code == "motor.psi_m" and "pole pairs" not in weak.sentence  # its speed is electrical as it comes


def test_the_equation_is_that_of_the_simulated_machine_in_any_frame() -> None:
    s = simulated(CAR, dead_time=0.0, noise=0.0, top_rpm=1500.0)
    k = np.arange(9000, 79_000, 500)
    k = k[np.abs(s.omega_e[k] - s.omega_e[k - 200]) < 1e-6]
    assert k.size > 60
    for delta in (0.0, 0.7, -2.5):
        frame = np.exp(-1j * (s.theta_e + delta))
        i = (s.i_alpha + 1j * s.i_beta) * frame
        v = (s.v_alpha + 1j * s.v_beta) * frame * np.exp(0.5j * s.omega_e / 10_000.0)
        held = k[np.abs(i[k] - i[k - 200]) < 1e-2]
        assert held.size > 60
        points = Points(i[held], v[held], np.zeros(held.size, complex), s.omega_e[held], s.torque[held],
                        np.zeros(held.size), np.ones(held.size, np.int64))
        equation = Equation(points, CAR, told(CAR), False)
        x = equation.centre.copy()
        x[NAMES.index("delta")] = delta
        assert np.abs(equation.voltage(x) - points.v).max() < 0.1
        assert np.abs(points.v).max() > 60.0


def _course(speed_rpm: float, torque: float, seconds: float = 4.0) -> Profile:
    return Profile(((0.0, speed_rpm * RPM),), ((0.0, torque),), seconds)


def test_what_cannot_be_told_says_why() -> None:
    def of(course: Profile, name: str = "cascadia_pm_dq") -> Report:
        s = simulated(tolerant(M2), profile=course)
        return diagnose(collected(cascadia(s, 3), M2, name), told(M2))

    one = of(_course(600.0, 4.0))
    assert [f.code for f in one.findings] == ["signals.doubtful"]  # a speed that never changes
    words = {c.name: (c.state, c.words) for c in one.checked}
    assert words["signs of current, voltage and speed"] == ("untold", "there was only one operating point")
    assert words["R"][0] == words["L_q"][0] == "untold" and "only one operating point" in words["R"][1]
    assert words["psi_m"][0] == "fine"
    slow = of(_course(5.0, 4.0))
    assert slow.exit_code == 0
    assert any(c.state == "untold" and "the rotor was never fast enough" in c.words for c in slow.checked)
    restless = Profile(tuple((0.1 * k, (900.0 if k % 2 else -900.0) * RPM) for k in range(40)))
    never = of(restless)
    assert never.exit_code == 0
    assert any(c.state == "untold" and "at no time did currents" in c.words for c in never.checked)


def test_an_inverter_that_is_off_is_left_out() -> None:
    frames = cascadia(simulated(tolerant(CAR), top_rpm=1500.0), CAR.pole_pairs)
    s = collected(frames, CAR, "cascadia_pm_dq")
    off = s.time > 4.0
    for v in (np.zeros(len(s), complex), 90.0 * np.exp(1j * np.arange(len(s)))):  # nothing, or line voltages
        s.v[off], s.i[off] = v[off], 0.0
        found = diagnose(s, told(CAR))
        assert found.exit_code == 0 and {c.name: c.state for c in found.checked}["psi_m"] == "fine"


def test_any_partition_gives_the_same_and_the_window_is_kept() -> None:
    frames = cascadia(simulated(tolerant(CAR), top_rpm=1500.0), CAR.pole_pairs)
    whole = collected(frames, CAR)
    for cuts in ([1, 2, 3, 700, 701], list(range(13, len(frames), 13))):
        part = collected(frames, CAR, cuts=cuts)
        for name in SteadySamples.__dataclass_fields__:
            assert np.array_equal(getattr(part, name), getattr(whole, name)) or (
                np.array_equal(getattr(part, name), getattr(whole, name), equal_nan=True)), name
        last = collected(frames, CAR, cuts=cuts, window_s=2.0)
        assert np.array_equal(last.i, whole.i[whole.t_ns >= whole.t_ns[-1] - 2_000_000_000])
    assert diagnose(part, told(CAR)).to_dict() == diagnose(whole, told(CAR)).to_dict()


def test_memory_is_bounded_while_a_clock_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(analysis, "MOST_SAMPLES", 300)
    frames = cascadia(simulated(CAR, top_rpm=1500.0), CAR.pole_pairs)
    builder = SteadyBuilder(make_plan(load_map("cascadia_pm_dq"), pole_pairs=4), 100.0, window_s=1e6)
    most = 0
    for k in range(0, len(frames), 50):
        builder.feed(frames.take(slice(k, k + 50)))
        most = max(most, builder.samples)
    assert 250 < most <= 310


def test_values_too_far_apart_lost_and_never_changing_are_said() -> None:
    frames = cascadia(simulated(CAR, top_rpm=1500.0), CAR.pole_pairs)
    found = diagnose(collected(frames, CAR), told(CAR)).findings
    assert [f.code for f in found] == ["samples.apart"] and "% of the samples" in found[0].sentence
    current = np.flatnonzero(frames.can_id == 0xA6)
    lost = np.zeros(len(frames), bool)
    lost[current[5::9]] = True
    found = diagnose(collected(frames.take(~lost), CAR, "cascadia_pm"), told(CAR)).findings
    assert "samples.lost" in [f.code for f in found]
    still = diagnose(collected(cascadia(simulated(CAR, profile=_course(1500.0, 0.0)), 4), CAR, "cascadia_pm_dq"),
                     told(CAR))
    assert [f.code for f in still.findings] == ["signals.doubtful"] and still.exit_code == 0
    assert "speed.signal (PM_A5_Position.electrical_frequency) never changes" in still.findings[0].sentence


def test_a_speed_that_is_filtered_is_not_one_of_other_pole_pairs() -> None:
    frames = cascadia(simulated(CAR, top_rpm=1500.0), CAR.pole_pairs)
    s = collected(frames, CAR, "cascadia_pm_dq")
    late = np.empty(len(s))
    held = s.omega[0]
    for k, w in enumerate(s.omega):
        held += 0.25 * (w - held)  # 40 ms
        late[k] = held
    s.omega[:] = late
    assert pointing.turning(s, CAR).ratio == 1.0


@pytest.mark.parametrize("wrong", [RIGHT, Wrong(speed=-1), Wrong(angle=0.5)])
def test_at_one_fast_speed_whole_turns_between_samples_leave_the_ratio_untold(wrong: Wrong) -> None:
    course = _course(1500.0, 40.0)  # 100 Hz electrical, and as many samples a second
    frames = cascadia(simulated(CAR, profile=course), 4, wrong)
    s = collected(frames, CAR, "cascadia_pm_dq")
    s.theta[:] += np.random.default_rng(3).normal(0.0, 0.01, len(s))
    found = diagnose(s, told(CAR))
    state = next(c for c in found.checked if "direction and pole pairs" in c.name)
    if wrong.angle != 1.0:
        assert found.findings[0].code == "speed.angle" and "cannot be told which" in found.findings[0].sentence
    else:
        assert state.state == "untold" and "fit as well" in state.words
    zero = [f for f in found.findings if f.code == "encoder.zero"]
    assert len(zero) == (wrong.speed < 0) and all("one of them reversed may" in f.sentence for f in zero)


@pytest.mark.parametrize(("wrong", "ratio"), [(RIGHT, 1.0), (Wrong(speed=-1), -1.0), (Wrong(angle=0.5), 0.5)])
def test_a_second_speed_tells_though_it_was_held_for_less_long(wrong: Wrong, ratio: float) -> None:
    course = Profile(((0.0, 1500.0 * RPM), (3.0, 1500.0 * RPM), (3.2, 830.0 * RPM), (4.2, 830.0 * RPM)),
                     ((0.0, 40.0),))
    s = collected(cascadia(simulated(CAR, profile=course), 4, wrong), CAR, "cascadia_pm_dq")
    assert pointing.turning(s, CAR).ratio == ratio


def test_a_slow_speed_with_its_coarse_steps_and_jitter_are_not_other_pole_pairs() -> None:
    slow = collected(cascadia(simulated(CAR, profile=_course(3.7, 0.0)), 4), CAR, "cascadia_pm_dq")
    assert set(np.round(slow.omega / (2 * math.pi), 3)) == {0.2}  # it is 0.247 Hz, and 5/4 of 0.2 are 0.25
    t = pointing.turning(slow, CAR)
    assert math.isnan(t.ratio) and not t.differ
    for seed in range(6):
        s = collected(cascadia(simulated(CAR, top_rpm=1500.0), 4), CAR, "cascadia_pm_dq")
        s.theta[:] += np.random.default_rng(seed).normal(0.0, 0.5 if seed < 3 else 5.0, len(s))
        t = pointing.turning(s, CAR)
        assert math.isnan(t.ratio) and not t.differ


@pytest.fixture(scope="module")
def reversed_current() -> FrameBlock:
    return cascadia(simulated(tolerant(CAR), top_rpm=1500.0), CAR.pole_pairs, Wrong(current=-1))


def test_the_command_gives_a_page_the_words_and_exit_1(tmp_path: Path, reversed_current: FrameBlock,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    log, page = tmp_path / "car.blf", tmp_path / "d.html"
    write_log(log, [reversed_current])
    given = str(toml(tmp_path, CAR))
    assert main(["diagnose", str(log), "--drive", given, "--map", "cascadia_pm_dq", "--out", str(page)]) == 1
    said = capsys.readouterr().out
    assert "ERROR: the current is reversed" in said and "operating points" in said
    assert "no fast observer: the voltage is a momentary value" in re.sub(r"\s+", " ", said)
    data = json.loads((tmp_path / "d.json").read_text())
    assert data["findings"][0]["code"] == "wiring.current_sign" and data["worst"] == "error"
    assert page.read_text().count("<svg") == 4 and "Voltage by the equation" in page.read_text()
    last = tmp_path / "last.json"
    assert main(["diagnose", str(log), "--drive", given, "--map", "cascadia_pm_dq", "--last", "3", "--json",
                 str(last)]) in (0, 1)
    assert json.loads(last.read_text())["facts"]["length"] == "3.00 s"


def test_live_it_says_what_it_says_of_the_log_and_sends_nothing(tmp_path: Path, reversed_current: FrameBlock,
                                                                capsys: pytest.CaptureFixture[str]) -> None:
    log, given = tmp_path / "run.log", toml(tmp_path, CAR)
    write_log(log, [reversed_current])
    assert main(["diagnose", str(log), "--drive", str(given), "--map", "cascadia_pm"]) == 1
    recorded = capsys.readouterr().out.splitlines()
    code, said, heard = run_live(given, "cascadia_pm", reversed_current, capsys, command="diagnose")
    assert code == 1 and not heard
    figure = re.compile(r"[\d.]+")  # python-can's time stamps are floats: the last digit of a figure may differ
    begin = next(k for k, line in enumerate(recorded) if line.startswith("length"))
    report_ = said.splitlines()[1:]
    assert [figure.sub("#", line) for line in report_] == [figure.sub("#", line) for line in recorded[begin:]]
    assert "ERROR: the current is reversed" in report_


def test_the_live_view_judges_too_and_repeats_no_note(reversed_current: FrameBlock) -> None:
    live = MappedDiagnosis(told(CAR), make_plan(load_map("cascadia_pm_dq"), pole_pairs=4))
    for k in range(0, len(reversed_current), 200):
        live.feed(reversed_current.take(slice(k, k + 200)))
    assert live.diagnosis is not None
    assert [f.code for f in live.diagnosis.findings()] == ["wiring.current_sign"]
    still = cascadia(simulated(CAR, profile=_course(1500.0, 0.0)), 4)
    source = MappedSource(Plan((told(CAR),), (500_000, 500_000), False, "cascadia_pm_dq"))
    source.feed(Batch(still))
    never = [f.sentence for f in source.findings() if "never changes" in f.sentence]
    assert len(never) == 2 and all(sentence.startswith("Of the map: ") for sentence in never)


@pytest.mark.filterwarnings("error")
def test_nothing_at_all_and_noise_never_raise() -> None:
    nothing = diagnose(collected(FrameBlock.zeros(0), CAR), told(CAR))
    assert nothing.exit_code == 0 and nothing.facts["length"] == "nothing"
    rng = np.random.default_rng(5)
    frames = cascadia(simulated(CAR, top_rpm=1500.0), 4)
    for count in (1, 5, 40, 3000):
        some = frames.take(np.arange(count))
        some.data[:] = rng.integers(0, 256, some.data.shape, dtype=np.uint8)
        for name in ("cascadia_pm", "cascadia_pm_dq"):
            json.dumps(diagnose(collected(some, CAR, name), told(CAR)).to_dict(), allow_nan=False)
    s = collected(frames, CAR)
    for name in ("i", "v", "omega", "theta"):
        getattr(s, name)[::3] = np.nan
    assert diagnose(s, told(CAR)).exit_code == 0


def test_a_log_that_allows_neither_says_both_reasons_in_one_sentence(tmp_path: Path) -> None:
    frames = cascadia(simulated(CAR, top_rpm=1500.0), CAR.pole_pairs)
    write_log(tmp_path / "a.log", [frames.take(~np.isin(frames.can_id, [0xA7]))])
    why = r"neither those of the fast observer .*momentary.* nor of the steady-state checks .*none of the samples"
    with pytest.raises(ValueError, match=why) as error:
        read_mapped(tmp_path / "a.log", told(CAR), "cascadia_pm")
    assert "\n" not in str(error.value)


def test_a_map_that_allows_the_fast_observer_gets_it(tmp_path: Path) -> None:
    from ipmsm_can.wire.protocol import Protocol
    from tests.replaying import drive_frames

    write_log(tmp_path / "a.log", [drive_frames(Protocol(), 0.5, reference_rate=500.0)])
    assert isinstance(read_mapped(tmp_path / "a.log", told(M2), "ipmsm_can"), Measurement)


def test_magnets_of_another_motor_altogether_are_not_too_far_off_to_be_told() -> None:
    """Their uncertainty is small beside them, though not beside the name plate's."""
    found = motors.Parameter("psi_m", 0.644, 0.0113, 0.11, limits.PSI_M)
    assert found.known and found.off
    assert not motors.Parameter("psi_m", 0.12, 0.0113, 0.11, limits.PSI_M).known
    unsure = motors.Parameter("psi_m", 0.12, 0.004, 0.11, limits.PSI_M)
    findings, checked = motors.judge([unsure], told(M2), lambda name: "")
    assert unsure.known and not findings and checked[0].state == "untold" and "not surely" in checked[0].words


def test_an_angle_that_nothing_goes_through_is_not_called_fine(tmp_path: Path) -> None:
    """Currents and voltages in the drive's own d and q say nothing of an angle that is reported beside them."""
    for shown in (0.0, 15 * DEG):
        found = report(case(tmp_path, CAR, CAR, "cascadia_pm_dq", Wrong(shown_zero=shown)))
        states = {k.name: k.state for k in found.checked}
        assert states["zero of the reported angle"] == "untold"
        assert states["zero of the drive's own d and q"] == "fine"


def test_a_torque_that_the_drive_makes_of_the_name_plate_is_no_finding_of_its_own(tmp_path: Path) -> None:
    """Magnets a fifth weak, and a drive that does not know it."""
    found = report(case(tmp_path, M2, scaled(M2, psi_m=0.8), "cascadia_pm_dq", Wrong(torque=1.25)))
    assert [f.code for f in found.findings if f.severity != "info"] == ["motor.psi_m"]
    words = next(k.words for k in found.checked if k.name == "reported torque")
    assert "drive.toml's motor" in words


def test_a_rotor_that_is_mostly_too_fast_for_the_map_is_judged_where_it_is_not(tmp_path: Path) -> None:
    """Far less than half of the samples have an angle near enough to the current; there are enough of them."""
    samples = simulated(CAR, top_rpm=3200.0, seconds=16.0)
    write_log(tmp_path / "run.log", [cascadia(samples, CAR.pole_pairs)])
    drive = told(CAR)
    measured = read_mapped(tmp_path / "run.log", drive, "cascadia_pm")
    assert isinstance(measured, SteadySamples) and 100 < np.count_nonzero(measured.good) < 0.5 * len(measured)
    found = diagnose(measured, drive)
    assert "samples.apart" in {f.code for f in found.findings} and found.exit_code == 0
