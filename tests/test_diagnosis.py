"""Findings on simulated drives whose fault is known; `python -m tools.faults` runs many more of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder
from ipmsm_can.config import DriveConfig
from ipmsm_can.diagnosis import Report, diagnose
from ipmsm_can.diagnosis.case import Case
from ipmsm_can.diagnosis.finding import Finding, ranked
from ipmsm_can.drive.node import DriveNode
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.wire.protocol import Protocol
from tools import faults as campaign
from tools.faults import FAULTS, MORE, healthy, judge, measure

PROTOCOL = Protocol()
SEED = 1
ALL = {what: (number, code, breaks) for number, (what, code, breaks) in enumerate(FAULTS + MORE)}


def report_on(what: str) -> Report:
    number, _, breaks = ALL[what]
    return judge(breaks, SEED, number, PROTOCOL, thorough=False)


def value(finding: Finding, label: str) -> float:
    return next(e.value for e in finding.evidence if e.label.startswith(label))


@pytest.mark.parametrize("what", [
    "current phases b, c swapped", "voltage reversed", "encoder counts backwards", "encoder with a pole pair more",
    "winding 100 K hotter", "magnets 12 % weaker", "voltage phases a, c swapped",
])
def test_a_fault_is_the_first_finding(what: str) -> None:
    report = report_on(what)
    assert report.findings[0].code == ALL[what][1]
    assert report.exit_code == 1


@pytest.mark.parametrize(("what", "label", "true", "within"), [
    ("current offset 13 %", "offset of i_beta", 0.12 * 2.336, 0.05),
    ("phase c reads 20 % low", "gain of phase c", -100.0 * 0.2 * 2.0 / 3.0, 1.5),
    ("voltage 0.8 samples late", "delay", 0.8, 0.05),
    ("dead time 4 V", "voltage lost by each phase", 4.0, 0.3),
    ("encoder's zero off by -50 deg", "encoder minus rotor", -50.0, 0.5),
    ("encoder eccentric, 3 deg", "amplitude", 3.0, 0.2),
    ("encoder slips by -60 deg", "step at 3.40 s", -60.0, 1.0),
])
def test_a_fault_is_the_first_finding_and_its_size_is_right(what: str, label: str, true: float,
                                                            within: float) -> None:
    first = report_on(what).findings[0]
    assert first.code == ALL[what][1]
    assert value(first, label) == pytest.approx(true, abs=within)


def test_sound_drives_give_no_error_and_say_what_was_looked_at() -> None:
    for number in range(100, 104):
        report = judge(None, SEED, number, PROTOCOL, thorough=number < 102)
        assert report.worst in (None, "info")
        assert report.exit_code == 0
        names = {c.name for c in report.checked}
        assert {"signs and order of phases", "encoder's zero", "current offset", "dead time", "psi_m",
                "position estimate", "excitation", "samples"} <= names


@pytest.fixture(scope="module")
def sound() -> tuple[Measurement, DriveConfig]:
    return measure(healthy(SEED, 101), PROTOCOL)


def without_encoder(m: Measurement) -> Measurement:
    return replace(m, encoder_sample=np.zeros(0, np.int64), encoder_theta=np.zeros(0), encoder_omega=np.zeros(0))


@pytest.mark.parametrize(("what", "code"), [
    ("current reversed", "wiring.current_sign"), ("current phases b, c swapped", "wiring.current_phases"),
    ("magnets 12 % weaker", "motor.psi_m")])
def test_without_an_encoder(what: str, code: str) -> None:
    number, _, breaks = ALL[what]
    report = judge(breaks, SEED, number, PROTOCOL, encoder=False, thorough=False)
    assert report.findings[0].code == code
    assert next(c for c in report.checked if c.name == "encoder").state == "untold"


def test_a_sound_drive_without_an_encoder(sound: tuple[Measurement, DriveConfig]) -> None:
    report = diagnose(without_encoder(sound[0]), sound[1], thorough=False)
    assert report.worst in (None, "info")
    untold = {c.name for c in report.checked if c.state == "untold"}
    assert {"encoder", "current offset", "gain of the current sensors", "delay of the voltage", "L_q"} <= untold


def test_the_report_is_the_same_whatever_the_blocks(sound: tuple[Measurement, DriveConfig]) -> None:
    drive = healthy(SEED, 101)
    block = campaign.frames(drive, PROTOCOL)
    builder = MeasurementBuilder(sound[1], PROTOCOL, source="simulated")
    for begin in range(0, len(block), 997):
        builder.feed(block.take(slice(begin, begin + 997)))
    builder.finish()
    assert diagnose(builder.measurement(), sound[1], thorough=False).to_dict() == diagnose(
        *sound, thorough=False).to_dict()


def test_the_report_is_plain_json(sound: tuple[Measurement, DriveConfig]) -> None:
    data = report_on("encoder eccentric, 3 deg").to_dict()
    assert json.loads(json.dumps(data, allow_nan=False)) == data


def test_a_rotor_at_rest_tells_little_and_that_is_said(sound: tuple[Measurement, DriveConfig]) -> None:
    drive = healthy(SEED, 101)
    drive = replace(drive, profile=Profile(((0.0, 0.0),), ((0.0, 0.0),), 2.0))
    report = diagnose(*measure(drive, PROTOCOL), thorough=False)
    assert [f.code for f in report.findings] == ["excitation.weak"]
    assert report.exit_code == 0
    untold = {c.name for c in report.checked if c.state == "untold"}
    assert {"signs and order of phases", "encoder", "motor's parameters", "current offset"} <= untold


@pytest.mark.parametrize(("share", "words"), [
    (1.5, ("C3 at standstill 9", "C3 at standstill 100")), (0.6, ("C3 at standstill 0",))])
def test_the_probing_that_a_report_asks_for_satisfies_c3_and_half_of_it_does_not(
        share: float, words: tuple[str, ...]) -> None:
    drive = healthy(SEED, 101)
    drive = replace(drive, profile=Profile(((0.0, 0.0),), ((0.0, 0.0),), 2.0),
                    parameters=replace(drive.parameters, current_noise=0.02, saturation=0.0,
                                       dead_time_voltage=0.0))
    told = campaign.config(drive)
    told = told.model_copy(update={"injection": told.injection.model_copy(update={"frequency": 400.0})})
    simulation = DriveSimulation(drive.true, drive.parameters, drive.profile, 0.3, 1)
    # 0.5 V for 0.1 s, and the noise of 20 mA through L_s/dt in 250 means of two samples; 3 sigma of its scatter.
    level = 0.5**2 * 0.1 + 2.0 * (drive.plate.L_s / 4e-4 * 0.02) ** 2 * 0.1 * (1.0 + 3.0 * (3.0 / 250.0) ** 0.5)
    volts = (2.0 * level / 0.1) ** 0.5 * 2.0 * drive.plate.L_s / abs(drive.plate.L_0)
    simulation.command_injection(1, share * volts, 400.0, 0.0, 100_000)
    builder = MeasurementBuilder(told, PROTOCOL)
    builder.feed(DriveNode(PROTOCOL, 0, simulation, drive.settings).step(simulation.samples_in_profile).frames)
    report = diagnose(builder.measurement(), told, thorough=False)
    said = next(c.words for c in report.checked if c.name == "excitation")
    assert any(w in said for w in words), said
    if share < 1.0:
        asked = next(f for f in report.findings if f.code == "excitation.weak")
        assert value(asked, "rotating probing needed") == pytest.approx(volts, rel=0.01)


def test_the_offset_of_the_current_shows_at_once_where_the_drive_is_off(
        sound: tuple[Measurement, DriveConfig]) -> None:
    m, config = sound
    n = 2000
    rng = np.random.default_rng(1)
    off = np.zeros(len(m), np.bool_)
    off[:n] = True
    i_alpha, i_beta = m.i_alpha.copy(), m.i_beta.copy()
    i_alpha[:n] = 0.3 + 0.02 * rng.standard_normal(n)
    i_beta[:n] = -0.1 + 0.02 * rng.standard_normal(n)
    first = diagnose(replace(m, i_alpha=i_alpha, i_beta=i_beta, running=~off), config, thorough=False).findings[0]
    assert first.code == "current.offset"
    assert value(first, "offset of i_alpha") == pytest.approx(0.3, abs=0.003)
    assert value(first, "offset of i_beta") == pytest.approx(-0.1, abs=0.003)


def test_hardly_any_samples() -> None:
    m, config = measure(replace(healthy(SEED, 101), profile=Profile(((0.0, 10.0),), ((0.0, 0.0),), 0.02)), PROTOCOL)
    report = diagnose(m, config, thorough=False)
    assert report.findings == ()
    assert report.checked[-1].state == "untold"


def test_losses_and_cut_off_samples_are_told(sound: tuple[Measurement, DriveConfig]) -> None:
    m, config = sound
    clipped = np.zeros(len(m), np.bool_)
    clipped[100:140] = True
    counts = {**m.counts, "lost": 4000, "received": 21000}
    worn = replace(m, clipped=clipped, usable=m.usable & ~clipped, counts=counts)
    report = diagnose(worn, config, thorough=False)
    codes = {f.code: f for f in report.findings}
    assert {"samples.lost", "samples.clipped"} <= set(codes)
    assert codes["samples.lost"].severity == "warning"


def test_numbers_that_are_none_and_angles_out_of_reach_do_no_harm(sound: tuple[Measurement, DriveConfig]) -> None:
    m, config = sound
    bad = m.i_alpha.copy()
    bad[50:60] = np.nan
    theta = m.encoder_theta.copy()
    theta[5] = np.nan
    worn = replace(m, i_alpha=bad, usable=m.usable & np.isfinite(bad), encoder_theta=theta)
    report = diagnose(worn, config, thorough=False)
    assert report.worst in (None, "info")


def test_causes_come_before_consequences() -> None:
    def one(code: str, severity: str, size: float, order: int) -> Finding:
        return Finding(code, severity, "", "", "", size=size, order=order)  # type: ignore[arg-type]

    found = ranked([one("consequence", "error", 9.0, 5), one("large warning", "warning", 6.0, 3),
                    one("small error", "error", 1.5, 3), one("large error", "error", 4.0, 3),
                    one("cause", "warning", 1.0, 0)])
    assert [f.code for f in found] == ["cause", "large error", "small error", "large warning", "consequence"]


def test_the_intervals_of_the_motor_hold_the_motor_that_was_simulated() -> None:
    """With a fault beside it that would spoil them: those of the identification, of the samples put right."""
    drive = healthy(SEED, 103)
    drive = replace(drive, parameters=replace(drive.parameters, saturation=0.0),
                    true=replace(drive.true, psi_m=0.8 * drive.plate.psi_m), faults=replace(
                        drive.faults, encoder_direction=-1, encoder_zero=0.7))
    report = diagnose(*measure(drive, PROTOCOL))
    found = next(f for f in report.findings if f.code == "motor.psi_m")
    assert report.findings[0].code == "encoder.direction"
    for name, unit in (("psi_m", 1.0), ("L_q", 1e3)):
        e = next(e for e in found.evidence if e.label == name)
        slack = 0.003 * e.value
        assert e.low - slack <= unit * getattr(drive.true, name) <= e.high + slack


def test_the_fit_finds_the_motor_that_was_simulated(sound: tuple[Measurement, DriveConfig]) -> None:
    drive = healthy(SEED, 103)
    drive = replace(drive, parameters=replace(drive.parameters, saturation=0.0, mtpa=True))
    fit = Case(*measure(drive, PROTOCOL)).fit
    assert fit is not None
    assert fit.solution["L_q"] == pytest.approx(drive.true.L_q, rel=0.01)
    assert abs(fit.solution.pair("psi")) == pytest.approx(drive.true.psi_m, rel=0.005)
    assert fit.solution["R"] == pytest.approx(drive.true.R, rel=0.05)
    assert abs(fit.zero) < math.radians(0.5)


def test_the_profile_of_the_campaign_is_ordinary() -> None:
    profile = campaign.ordinary_profile(np.random.default_rng(1), 5.0)
    assert max(abs(v) for _, v in profile.speed) <= campaign.TOP_RPM * RPM
    assert max(abs(v) for _, v in profile.load) <= 5.0
