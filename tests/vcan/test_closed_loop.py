"""The loop closed over a real interface, in real time: from rest at an unknown angle, to speed and through zero."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.vcan.test_end_to_end import companion, drive, ended, needs_can_utils

pytestmark = needs_can_utils

DRIVE = """
[motor]
preset = "m2"
[injection]
current_limit = 0.6
[simulation]
sample_rate = "2 kHz"
current_bandwidth = 60
angle_source = "companion"
saturation = 0.2
torque_limit = 6.2
# on one slow processor either side may be held up for tenths of a second; a drive lives on 10 ms by default
estimate_time_to_live = "500 ms"
"""
PROFILE = """
duration = 7.5
speed_rpm = [[0, 0], [1.5, 0], [2.3, 400], [4.2, 400], [5.3, -400], [7.5, -400]]
load_torque = [[0, 0], [3.2, 0], [3.2, 1.5]]
"""


def held_up(drives: str, companions: str) -> str:
    """What says that this computer was too slow for a loop in real time, "" where nothing does: a drive has to stop
    where the angle stays away."""
    slips = re.search(r"too slow for real time (\d+) times", drives)
    slowest = re.search(r"p99 (\d+) us", companions)
    assert slowest, companions
    if slips:  # a silence longer than the four bits of the counter leaves open how many samples are missing
        return slips[0]
    if int(slowest[1]) > 5000:
        return f"turnaround {slowest[0]}"
    return "samples too late" if "samples too late" in companions else ""


def test_from_rest_to_speed_and_through_zero(tmp_path: Path) -> None:
    config, profile = tmp_path / "drive.toml", tmp_path / "profile.toml"
    config.write_text(DRIVE)
    profile.write_text(PROFILE)
    for _ in range(3):
        with companion(config, "--transmit") as process:
            said = drive(str(config), "--profile", str(profile), "--theta0", "100")
            answered = ended(process)
        print(said, answered)
        why = held_up(said, answered)
        # a line a second: speed, and what was asked for
        found = re.findall(r"drive 0 ([+-][\d.]+) rpm \(asked ([+-][\d.]+)\)", said)
        held = [(float(rpm), float(asked)) for rpm, asked in found if abs(float(asked)) > 399.0]
        if {rpm > 0.0 for rpm, _ in held} == {True, False} and all(abs(rpm - asked) < 40.0 for rpm, asked in held):
            return
        assert why, found
    pytest.skip(f"this computer was held up each time: {why}")
