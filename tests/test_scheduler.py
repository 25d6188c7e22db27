"""The injection scheduler's states, reasons and ramps, one command period after another."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.injection.scheduler import OFF_REPEATS, Command, InjectionScheduler, InjectionSettings
from ipmsm_can.wire.protocol import InjectionReason, InjectionState, Waveform

PERIOD = 0.02
SETTINGS = InjectionSettings(enabled=True, waveform=Waveform.ROTATING, amplitude=6.0, frequency=400.0,
                             speed_on=40.0, speed_off=60.0, excitation_on=0.0, excitation_off=0.0, ramp=60.0,
                             current_limit=0.35, time_to_live=0.1, period=PERIOD)


class Stand:
    """A scheduler with the inputs of the moment."""

    def __init__(self, settings: InjectionSettings = SETTINGS, transmit: bool = True) -> None:
        self.scheduler = InjectionScheduler(settings, transmit)
        self.omega, self.excitation, self.theta, self.current, self.fresh = 0.0, 1.0, 0.0, 0.0, True

    def go(self, periods: int = 1) -> Command | None:
        command = None
        for _ in range(periods):
            command = self.scheduler.update(PERIOD, self.omega, self.excitation, self.theta, self.current,
                                            self.fresh)
        return command

    @property
    def told(self) -> tuple[str, str]:
        return self.scheduler.state.name, self.scheduler.reason.name


def test_ramps_up_at_low_speed_and_says_so() -> None:
    s = Stand()
    amplitudes = []
    for k in range(7):
        command = s.go()
        assert command is not None
        amplitudes.append(command.amplitude)
        assert s.told == (("RAMP_UP" if k < 4 else "ON"), "LOW_SPEED")
    assert amplitudes == pytest.approx([1.2, 2.4, 3.6, 4.8, 6.0, 6.0, 6.0])
    assert command == Command(Waveform.ROTATING, 6.0, 400.0, 0.0, 0.1)


@pytest.mark.parametrize("current", [float("nan"), float("inf")])
def test_a_current_that_cannot_be_measured_ends_injection(current: float) -> None:
    s = Stand()
    s.go(10)
    s.current = current
    s.go(5)
    assert s.scheduler.amplitude == 0.0
    assert s.told == ("LIMITED", "CURRENT_LIMIT")
    s.current = 0.0
    s.go(600)
    assert s.scheduler.amplitude == pytest.approx(6.0)


def test_ramps_down_at_speed_with_hysteresis() -> None:
    s = Stand()
    s.go(10)
    for omega in (50.0, -59.9, 60.0):  # either direction; not before speed_off is exceeded
        s.omega = omega
        s.go()
        assert s.told == ("ON", "LOW_SPEED")
    s.omega = -60.1
    assert [c.amplitude for c in (s.go(), s.go()) if c] == pytest.approx([4.8, 3.6])
    assert s.told == ("RAMP_DOWN", "SPEED_HIGH_ENOUGH")
    s.omega = 40.0  # not below speed_on: stays off
    s.go(20)
    assert s.told == ("OFF", "SPEED_HIGH_ENOUGH")
    s.omega = -39.9
    s.go()
    assert s.told == ("RAMP_UP", "LOW_SPEED")


def test_off_is_said_a_few_times_and_then_no_more() -> None:
    s = Stand()
    s.go(10)
    s.omega = 100.0
    commands = [s.go() for _ in range(12)]
    off = [c for c in commands if c is not None and c.waveform is Waveform.OFF]
    assert len(off) == OFF_REPEATS
    assert all(c.amplitude == 0.0 for c in off)
    assert [c is None for c in commands[-5:]] == [True] * 5


def test_nothing_is_said_before_anything_was_on() -> None:
    s = Stand()
    s.omega = 100.0
    assert s.go(5) is None
    assert s.told == ("OFF", "NONE")


def test_poor_excitation_starts_it_at_any_speed() -> None:
    s = Stand(replace(SETTINGS, excitation_on=0.1, excitation_off=0.2))
    s.omega, s.excitation = 500.0, 0.15
    assert s.go() is None
    s.excitation = 0.09
    s.go()
    assert s.told == ("RAMP_UP", "POOR_EXCITATION")
    s.excitation = 0.15
    s.go(10)
    assert s.told == ("ON", "POOR_EXCITATION")
    s.excitation = 0.25
    s.go()
    assert s.told == ("RAMP_DOWN", "SPEED_HIGH_ENOUGH")


def test_good_excitation_does_not_stop_it_at_low_speed() -> None:
    s = Stand(replace(SETTINGS, excitation_on=0.1, excitation_off=0.2))
    s.excitation = 10.0
    s.go(10)
    assert s.told == ("ON", "LOW_SPEED")


def test_without_thresholds_excitation_is_not_looked_at() -> None:
    s = Stand()
    s.omega, s.excitation = 500.0, 0.0
    assert s.go(5) is None


def test_no_samples_stop_it_at_once() -> None:
    s = Stand()
    s.go(10)
    s.fresh = False
    command = s.go()
    assert command is not None and command.waveform is Waveform.OFF
    assert s.told == ("OFF", "NO_SAMPLES")
    assert [s.go() is None for _ in range(4)] == [False, False, True, True]
    s.fresh = True
    command = s.go()
    assert command is not None and command.amplitude == pytest.approx(1.2)  # from the bottom of the ramp
    assert s.told == ("RAMP_UP", "LOW_SPEED")


def test_current_limit_in_proportion_and_slowly_back() -> None:
    s = Stand()
    s.go(10)
    s.current = 0.7
    command = s.go()
    assert command is not None and command.amplitude == pytest.approx(4.8)  # target 3, reached along the ramp
    for _ in range(3):
        s.current = 0.7 * s.scheduler.amplitude / 6.0  # the machine is linear in the small
        s.go()
    assert s.scheduler.amplitude == pytest.approx(3.0)
    s.current = 0.34
    s.go(5)
    assert s.told == ("LIMITED", "CURRENT_LIMIT")
    assert s.scheduler.amplitude == pytest.approx(3.0)
    s.current = 0.1  # room again: a tenth of the amplitude per second
    s.go(50)
    assert s.scheduler.amplitude == pytest.approx(3.0 + 0.6, abs=0.02)
    s.go(500)
    assert s.told == ("ON", "LOW_SPEED")
    assert s.scheduler.amplitude == 6.0


def test_operator_stands_above_speed_but_not_above_silence() -> None:
    s = Stand()
    s.omega = 500.0
    s.scheduler.operator(True)
    s.go(10)
    assert s.told == ("ON", "OPERATOR")
    s.omega = 0.0
    s.scheduler.operator(False)
    s.go(10)
    assert s.told == ("OFF", "OPERATOR")
    s.scheduler.operator(True)
    s.fresh = False
    s.go()
    assert s.told == ("OFF", "NO_SAMPLES")
    s.fresh = True
    s.scheduler.operator(None)
    s.go()
    assert s.told == ("RAMP_UP", "LOW_SPEED")


@pytest.mark.parametrize(("settings", "transmit", "reason"), [
    (replace(SETTINGS, enabled=False), True, "DISABLED_BY_CONFIGURATION"),
    (replace(SETTINGS, enabled=False), False, "DISABLED_BY_CONFIGURATION"),
    (SETTINGS, False, "TRANSMIT_NOT_ENABLED")])
def test_disabled(settings: InjectionSettings, transmit: bool, reason: str) -> None:
    s = Stand(settings, transmit)
    s.scheduler.operator(True)
    assert s.go(20) is None
    assert s.told == ("DISABLED", reason)


def test_axis_follows_the_estimate() -> None:
    s = Stand(replace(SETTINGS, waveform=Waveform.PULSATING))
    s.theta = -2.0
    command = s.go()
    assert command is not None and (command.waveform, command.axis_angle) == (Waveform.PULSATING, -2.0)


@pytest.mark.parametrize("axis", [0.0, 0.5])
def test_an_axis_of_the_stationary_frame_stays_where_it_is(axis: float) -> None:
    s = Stand(replace(SETTINGS, waveform=Waveform.PULSATING, axis=axis))
    for s.theta in (-2.0, 3.0):
        command = s.go()
        assert command is not None and command.axis_angle == axis


@given(st.lists(st.tuples(st.floats(-1000, 1000), st.floats(0, 10), st.floats(0, 100), st.booleans(),
                          st.sampled_from([True, False, None])), max_size=60))
def test_whatever_comes_the_amplitude_stays_in_bounds(
        inputs: list[tuple[float, float, float, bool, bool | None]]) -> None:
    s = Stand(replace(SETTINGS, excitation_on=0.5, excitation_off=1.0))
    before = 0.0
    for omega, excitation, current, fresh, wanted in inputs:
        s.omega, s.excitation, s.current, s.fresh = omega, excitation, current, fresh
        s.scheduler.operator(wanted)
        command = s.go()
        now = s.scheduler.amplitude
        assert 0.0 <= now <= 6.0
        assert abs(now - before) <= 1.2 + 1e-9 or (not fresh and now == 0.0)
        assert command is None or command.amplitude == now
        assert (s.scheduler.state is InjectionState.OFF) == (now == 0.0 and not s.scheduler._wanted)
        if s.scheduler.reason is InjectionReason.CURRENT_LIMIT:
            assert s.scheduler.state is InjectionState.LIMITED
        before = now
