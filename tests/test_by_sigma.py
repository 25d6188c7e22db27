"""Injection by the estimate's own sigma: the rule alone, the keys it comes from, and from standstill to speed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.config import config_from
from ipmsm_can.config.build import estimator_settings, injection_settings, probing_frequency
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.estimation import confidence
from ipmsm_can.injection.by_sigma import AGAIN, FALL_TIME, OUT_OF_REACH, RISE_TIME, SigmaRule
from ipmsm_can.injection.scheduler import Command, InjectionScheduler
from ipmsm_can.motor import M2, PRESETS
from ipmsm_can.wire.protocol import Waveform
from tools import probing

PERIOD = 0.02
STEP = 0.2  # longer than DWELL: what a single call says holds
TARGET = math.radians(3.0)
EMF = 10.0


def rule(floor: float = 0.2) -> SigmaRule:
    return SigmaRule(TARGET, EMF, floor)


def go(r: SigmaRule, sigma: float, seconds: float, limited: bool = False) -> float:
    for _ in range(round(seconds / PERIOD)):
        level = r.share(sigma, PERIOD, limited)
    return level


# ---- the rule -----------------------------------------------------------------------------------------

def test_the_share_falls_slowly_rises_fast_and_rests_in_between() -> None:
    r = rule()
    go(r, 0.5 * TARGET, 0.4)  # what is smoothed has arrived
    begin = r.level
    assert begin - go(r, 0.5 * TARGET, 0.2) == pytest.approx(0.2 / FALL_TIME)
    go(r, 0.5 * TARGET, 1.2)
    go(r, 0.8 * TARGET, 0.4)
    rest = r.level
    assert go(r, 0.8 * TARGET, 2.0) == rest
    go(r, 0.95 * TARGET, 0.2)
    begin = r.level
    assert go(r, 0.95 * TARGET, 0.1) - begin == pytest.approx(0.1 / RISE_TIME)


def test_the_share_stays_between_floor_and_whole_and_is_whole_when_in_doubt() -> None:
    r = rule(0.3)
    assert go(r, 0.1 * TARGET, 10.0) == pytest.approx(0.3)
    assert r.share(2.1 * TARGET, PERIOD, False) == 1.0
    go(r, 0.1 * TARGET, 10.0)
    assert r.share(math.pi, PERIOD, False) == 1.0
    assert SigmaRule(0.0, EMF, 0.3).share(0.0, PERIOD, False) == 1.0


def test_it_ends_where_the_back_emf_suffices_and_begins_as_sigma_rises() -> None:
    r = rule()
    assert r.is_wanted(False, 0.0, math.pi, STEP)
    assert r.is_wanted(True, 0.9 * EMF, 0.5 * TARGET, STEP)
    assert not r.is_wanted(True, 1.1 * EMF, 0.5 * TARGET, STEP)
    assert not r.is_wanted(False, 0.0, 0.8 * TARGET, STEP)  # standing still, but still known: no need yet
    assert r.is_wanted(False, 0.0, 0.95 * TARGET, STEP)


def test_a_moment_of_speed_does_not_end_it() -> None:
    """What a correction of the angle at standstill looks like to the speed loop."""
    r = rule()
    for _ in range(20):
        for speed in (0.0, 3.0 * EMF, 2.0 * EMF, 0.0):
            assert r.is_wanted(True, speed, 0.5 * TARGET, PERIOD)


def test_at_speed_it_is_never_wanted() -> None:
    r = rule()
    assert not r.is_wanted(False, OUT_OF_REACH * EMF, math.pi, STEP)
    assert not r.is_wanted(True, OUT_OF_REACH * EMF, math.pi, STEP)
    assert r.is_wanted(True, 0.9 * OUT_OF_REACH * EMF, math.pi, STEP)


def test_it_does_not_go_on_and_off_for_ever_where_the_back_emf_does_not_suffice_after_all() -> None:
    """A machine on which sigma without injection is just above the target at any of these speeds."""
    r = rule()
    wanted, changes = True, 0
    speeds = np.linspace(0.5 * EMF, 2.0 * EMF, 4000)
    for speed in speeds:
        before, wanted = wanted, r.is_wanted(wanted, float(speed), (0.7 if wanted else 1.1) * TARGET, STEP)
        changes += wanted != before
        r.share(0.7 * TARGET, PERIOD, False)
    assert 2 <= changes <= 2 * (1 + math.log(2.0) / math.log(AGAIN))


def test_where_the_whole_amplitude_does_no_good_ending_is_tried_once() -> None:
    r = rule()
    r.is_wanted(False, 0.7 * EMF, math.pi, STEP)
    assert r.is_wanted(True, 0.7 * EMF, 1.2 * TARGET, STEP)
    go(r, 1.2 * TARGET, 1.5)
    assert not r.is_wanted(True, 0.7 * EMF, 1.2 * TARGET, STEP)
    assert r.is_wanted(False, 0.7 * EMF, 1.2 * TARGET, STEP)  # it was no better without
    go(r, 1.2 * TARGET, 5.0)
    assert r.is_wanted(True, 0.7 * EMF, 1.2 * TARGET, STEP)


@given(st.lists(st.tuples(st.floats(0.0, 200.0), st.floats(0.0, math.pi), st.booleans()), max_size=80))
def test_whatever_comes_the_share_stays_in_bounds(inputs: list[tuple[float, float, bool]]) -> None:
    r, wanted = rule(), False
    for speed, sigma, limited in inputs:
        wanted = r.is_wanted(wanted, speed, sigma, STEP)
        assert 0.2 <= r.share(sigma, PERIOD, limited) <= 1.0


# ---- the keys -----------------------------------------------------------------------------------------

def settings(kind: str = "riccati", **injection: Any) -> Any:
    return config_from({"motor": {"preset": "m2"}, "observer": {"kind": kind}, "injection": injection})


def test_sigma_decides_for_riccati_unless_a_key_says_otherwise() -> None:
    s = injection_settings(settings())
    assert s.sigma_target == pytest.approx(TARGET) and s.along_d
    assert s.emf_speed == pytest.approx(0.19 * 0.5 / (0.59 * TARGET))
    assert InjectionScheduler(s, True).calm[0] == pytest.approx(OUT_OF_REACH * s.emf_speed)
    for chosen in (settings("ges"), settings(speed_on=20.0), settings(speed_off=50.0),
                   settings(excitation_on=0.1, excitation_off=0.2), settings(sigma_target=0)):
        s = injection_settings(chosen)
        assert s.sigma_target == 0.0 and s.emf_speed == 0.0
    assert injection_settings(settings("ges", sigma_target=3)).sigma_target == 0.0
    both = injection_settings(settings(speed_on=20.0, sigma_target="4 deg"))
    assert both.sigma_target == pytest.approx(math.radians(4.0)) and both.emf_speed == 0.0
    assert (both.speed_on, both.speed_off) == (20.0, 60.0)
    assert settings(speed_off=30.0).injection.speeds == (20.0, 30.0)
    assert settings(speed_on=50.0).injection.speeds == (50.0, 75.0)


def test_the_operator_gets_the_whole_amplitude_and_the_waveform_configured() -> None:
    s = InjectionScheduler(injection_settings(settings(amplitude=6.0)), True)
    s.operator(True)
    for _ in range(400):
        command = s.update(PERIOD, 100.0, 1.0, 0.0, 0.1, True, sigma=0.01, valid=True)
    assert command is not None and (command.amplitude, command.waveform) == (6.0, Waveform.ROTATING)
    s.operator(None)
    assert s.update(PERIOD, 100.0, 1.0, 0.0, 0.1, True, sigma=0.01, valid=True) != command


def test_frequency_of_its_own_is_a_sixth_of_the_sample_rate() -> None:
    assert probing_frequency(settings(), 0.0) == 400.0
    assert probing_frequency(settings("injection_demodulation"), 5000.0) == 400.0
    assert estimator_settings(settings(), 5000.0).injection_frequency == 833.0
    assert probing_frequency(settings(frequency="auto"), 5000.0) == 833.0
    assert probing_frequency(settings(frequency="auto"), 100e3) == 4000.0
    assert probing_frequency(settings(frequency="500 Hz"), 5000.0) == 500.0


def test_amplitude_of_its_own_is_what_the_current_limit_leaves() -> None:
    limit = 0.15 * M2.rated_current
    for rate in (2500.0, 5000.0):
        s = injection_settings(settings(), rate)
        assert s.amplitude == pytest.approx(0.65 * limit * 2.0 * math.pi * round(rate / 6.0) * M2.L_d)
        assert s.ramp == pytest.approx(10.0 * s.amplitude)
    assert injection_settings(settings(), 40e3).amplitude == 30.0
    assert injection_settings(settings(polarity_amplitude=50.0), 40e3).amplitude > 30.0
    assert injection_settings(settings(current_limit="1 A"), 5000.0).amplitude == pytest.approx(25.855, abs=0.001)
    given = injection_settings(settings(amplitude=4.0, ramp=20.0), 5000.0)
    assert (given.amplitude, given.ramp) == (4.0, 20.0)


def test_the_scheduler_takes_what_the_sample_rate_makes_of_the_settings() -> None:
    scheduler = InjectionScheduler(injection_settings(settings()), True)
    scheduler.use(injection_settings(settings(), 5000.0))
    assert scheduler.settings.amplitude > 2.0 * injection_settings(settings()).amplitude
    assert scheduler._rule.floor == pytest.approx(2.0 / scheduler.settings.amplitude)


# ---- over the wire ------------------------------------------------------------------------------------

@pytest.mark.parametrize("motor", ["m1", "m2"])
def test_hand_over_from_standstill_to_speed_and_back(motor: str) -> None:
    """Injection ends once and begins once; the angle never jumps, and stays within twice the target.

    M1's magnet is weak: probing leaves 3 to 4 deg of sigma at standstill, so there the bound is 2 sigma.
    """
    track = Profile(((0.0, 0.0), (0.4, 0.0), (2.4, 300 * RPM), (2.6, 300 * RPM), (4.6, 0.0), (5.2, 0.0)),
                    ((0.0, 0.0),), 5.2)
    cosim = probing.start(motor, {}, track)
    scheduler = cosim.companion.nodes[0].scheduler
    told: list[bool] = []
    for _ in range(520):
        cosim.run(0.01)
        on = scheduler.amplitude > 0.0
        if not told or told[-1] != on:
            told.append(on)
    assert told in ([True, False, True], [True, False])
    t, off, sigma, flags = probing.errors(cosim)
    valid = flags & confidence.VALID != 0
    known = t > 0.3
    assert valid[known].mean() > 0.9
    limit = 6.0 if motor == "m2" else np.maximum(6.0, 2.0 * sigma[valid])
    assert (np.abs(off[valid]) < limit).all()
    # The start-up may still put it right by as much as it was in doubt; the hand-over, which begins at 0.4 s, not.
    assert (np.abs(np.diff(off)) < np.maximum(2.0, sigma[:-1]))[known[:-1] & (t[:-1] < 4.4)].all()
    assert np.abs(np.diff(off[(t > 0.5) & (t < 4.4)])).max() < 2.0
    amplitude = np.concatenate([s.injection_amplitude for s in cosim.recording.truth[0]])
    assert amplitude[round(2.0 * 5000):round(3.0 * 5000)].max() == 0.0


def test_a_valid_angle_is_probed_along_d_and_that_makes_next_to_no_torque() -> None:
    scheduled = probing.cost("m1", 0.0, {}, 2.0)
    fixed = probing.cost("m1", 0.0, {"waveform": "rotating", "speed_on": 1e4}, 2.0)
    assert scheduled.valid > 0.5 and fixed.valid > 0.5
    assert scheduled.ripple < 0.2 * fixed.ripple
    assert scheduled.loss < fixed.loss
    assert fixed.ripple > 0.01 * PRESETS["m1"].rated_torque


def test_a_moment_without_valid_does_not_change_the_waveform() -> None:
    """Another waveform begins from nothing, which makes sigma larger still: it would go to and fro."""
    scheduler = InjectionScheduler(injection_settings(settings(), 5000.0), transmit=True)

    def ask(valid: bool, times: int, sigma: float = 0.1) -> Waveform:
        for _ in range(times):
            command = scheduler.update(PERIOD, 0.0, 0.0, 0.3, 0.0, True, sigma=sigma, valid=valid)
        assert command is not None
        return command.waveform

    assert ask(False, 30) is Waveform.ROTATING
    assert ask(True, 3) is Waveform.PULSATING
    assert ask(False, round(0.08 / PERIOD)) is Waveform.PULSATING
    assert ask(True, 3) is Waveform.PULSATING
    assert ask(False, round(0.14 / PERIOD)) is Waveform.ROTATING
    assert ask(True, 3) is Waveform.ROTATING, "rotating showed the axis no worse: there it stays"
    assert ask(True, 3, 0.05) is Waveform.PULSATING


def test_pulses_that_showed_the_pole_are_followed_by_probing_along_d() -> None:
    """What they have shown is known, though not valid for some milliseconds yet; what they have not is not."""
    pulses = Command(Waveform.POLARITY_PULSES, 20.0, 400.0, 0.3, 0.1)
    for sigma, then in ((0.05, Waveform.PULSATING), (math.pi, Waveform.ROTATING)):
        scheduler = InjectionScheduler(injection_settings(settings(), 5000.0), transmit=True)
        for _ in range(3):
            scheduler.update(PERIOD, 0.0, 0.0, 0.3, 0.0, True, pulses=pulses)
        for _ in range(3):  # the amplitude is kept from before the pulses, and may have to come back
            command = scheduler.update(PERIOD, 0.0, 0.0, 0.3, 0.0, True, sigma=sigma)
        assert command is not None and command.waveform is then


def test_the_amplitude_settles_where_sigma_meets_the_target() -> None:
    """Less than the whole amplitude does, and it stays there."""
    track = Profile(((0.0, 0.0),), duration=8.0)
    cosim = probing.start("m2", {"amplitude": 25.0, "current_limit": 2.0, "sigma_target": 5.0}, track)
    asked = []
    for _ in range(400):
        cosim.run(0.02)
        asked.append(cosim.companion.nodes[0].scheduler.amplitude)
    waveform = np.concatenate([s.injection_waveform for s in cosim.recording.truth[0]])
    _, off, sigma, _ = probing.errors(cosim)
    late = slice(-10_000, None)
    assert 4.0 < np.median(asked[-100:]) < 20.0
    assert np.ptp(asked[-100:]) < 5.0
    assert np.median(sigma[late]) < 5.0
    assert np.abs(off[late]).max() < 14.0
    assert (waveform[late] == Waveform.PULSATING).all()
