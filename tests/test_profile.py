"""Profiles: interpolation against numpy.interp, steps, TOML and what it refuses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.drive.profile import PRESETS, RPM, Profile, constant, value_at


@given(
    gaps=st.lists(st.floats(0.01, 3.0), min_size=1, max_size=6),
    values=st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6),
    sample=st.floats(0.0, 200.0),
)
def test_between_breakpoints_it_is_linear_and_outside_held(
    gaps: list[float], values: list[float], sample: float
) -> None:
    times = np.cumsum(gaps)
    profile = Profile(tuple(zip(times.tolist(), values, strict=False)))
    track, _ = profile.tracks(10.0)
    expected = np.interp(sample, times * 10.0, values[: len(gaps)])
    for before in (False, True):
        assert value_at(track, sample, before) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_two_points_at_one_time_are_a_step_on_exactly_one_sample() -> None:
    assert 0.035 * 10_000.0 > 350.0  # the product of the two doubles is not the whole number that is meant
    track, _ = Profile(((0.0, 1.0), (0.035, 1.0), (0.035, 5.0))).tracks(10_000.0)
    assert value_at(track, 349.0, False) == 1.0
    assert value_at(track, 350.0, True) == 1.0
    assert value_at(track, 350.0, False) == 5.0


def test_duration_comes_from_the_last_breakpoint() -> None:
    assert Profile(((0.0, 1.0), (2.0, 3.0)), ((4.0, 1.0),)).duration == 4.0
    assert Profile(((0.0, 1.0),)).duration == 1.0
    assert constant(10.0, 0.5, 3.0).duration == 3.0


def test_presets_are_what_the_paper_and_the_demo_need() -> None:
    ramp, pulses, demo = PRESETS["paper_ramp"](), PRESETS["torque_pulses"](), PRESETS["demo"]()
    assert (ramp.speed[0][1], ramp.speed[-1][1], ramp.load[0][1]) == (10.0, 100.0, 0.5)
    assert pulses.speed[0][1] == pytest.approx(104.7198, abs=1e-4)
    assert {value for _, value in pulses.load} == {0.0, 6.2}
    rpm = [round(value / RPM) for _, value in demo.speed]
    assert rpm[0] == rpm[-1] == 0
    assert {20, 100, 1000, -1000} <= set(rpm)
    assert demo.duration == 16.0
    for name, preset in PRESETS.items():
        assert preset().name == name


def write(folder: Path, text: str) -> Path:
    path = folder / "crane.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_toml_in_rpm_and_in_rad_s(tmp_path: Path) -> None:
    profile = Profile.from_toml(write(tmp_path, """
        duration = 8.0
        speed_rpm = [[0, 0], [1, 60], [1, 120.0]]
        load_torque = [[0, 0], [4, 6.2]]
    """))
    assert profile.name == "crane"
    assert profile.duration == 8.0
    assert profile.load == ((0.0, 0.0), (4.0, 6.2))
    assert [value for _, value in profile.speed] == pytest.approx([0.0, 2 * np.pi, 4 * np.pi])
    profile = Profile.from_toml(write(tmp_path, 'name = "a"\nspeed_rad_s = [[0, 5]]'))
    assert (profile.name, profile.speed, profile.load) == ("a", ((0.0, 5.0),), ((0.0, 0.0),))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("speed_rpm = [[0, 0]]\nspeed_rad_s = [[0, 0]]", ["both", "speed_rad_s", "speed_rpm"]),
        ("load_torque = [[0, 0]]", ["neither", "speed_rad_s", "speed_rpm"]),
        ("speed = [[0, 0]]", ["'speed'", "speed_rad_s", "load_torque"]),
        ("speed_rpm = 5", ["speed_rpm", "5", "pairs"]),
        ("speed_rpm = []", ["speed_rpm", "[]", "at least one"]),
        ("speed_rpm = [[0, 0], [1]]", ["speed_rpm", "point 1", "[1]"]),
        ("speed_rpm = [[0, nan]]", ["speed_rpm", "point 0", "nan", "finite"]),
        ("speed_rpm = [[0, true]]", ["speed_rpm", "point 0", "True"]),
        ("speed_rpm = [[-1, 0]]", ["speed_rpm", "point 0", "-1 s", "0 s"]),
        ("speed_rpm = [[0, 0]]\nload_torque = [[2, 0], [1, 0]]", ["load_torque", "point 1", "1 s", "2 s"]),
        ("speed_rpm = [[0, 0], [0, 1], [0, 2]]", ["speed_rpm", "third", "two"]),
        ("speed_rpm = [[0, 0]]\nduration = 0", ["duration", "0", "above 0"]),
        ("speed_rpm = [[0, 0]]\nduration = inf", ["duration", "inf"]),
        ("speed_rpm = [[0, 0]]\nname = 3", ["name", "3", "text"]),
        ("speed_rpm = [[0, 0]", ["not a TOML file"]),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ValueError) as caught:
        Profile.from_toml(write(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    for word in ["crane.toml", *words]:
        assert word in message


def test_a_negative_duration_is_refused() -> None:
    with pytest.raises(ValueError, match=r"duration is -1\.0; allowed"):
        Profile(((0.0, 1.0),), duration=-1.0)
