"""What the simulated drive is asked to do: speed and load torque over time."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

RPM = 2.0 * math.pi / 60.0
"""One revolution per minute in rad/s."""

Track = tuple[tuple[float, float], ...]
"""Breakpoints (time [s], value): straight lines between, the end values held outside."""

_KEYS = ("name", "duration", "speed_rad_s", "speed_rpm", "load_torque")
_SNAP = 1e-6


@dataclass(frozen=True)
class Profile:
    """Speed and load torque over time, each on breakpoints of its own.

    speed: (time [s], speed [rad/s mechanical]) breakpoints.
    load: (time [s], load torque [N m] against positive speed) breakpoints.
    duration: length [s]; 0, the default, stands for the time of the last breakpoint (1 s if that is at 0).
    Times are >= 0 and never fall; two points at the same time are a step.

    Raises ValueError naming the track and point, what was found and what is allowed.
    """

    speed: Track
    load: Track = ((0.0, 0.0),)
    duration: float = 0.0
    name: str = "custom"

    def __post_init__(self) -> None:
        object.__setattr__(self, "speed", _checked_track("speed", self.speed))
        object.__setattr__(self, "load", _checked_track("load", self.load))
        if not _is_number(self.duration) or self.duration < 0.0:
            raise ValueError(f"duration is {self.duration!r}; allowed is a finite number above 0, in s, "
                             "or 0 to end with the last breakpoint")
        if self.duration == 0.0:
            last = max(self.speed[-1][0], self.load[-1][0])
            object.__setattr__(self, "duration", last if last > 0.0 else 1.0)

    @classmethod
    def from_toml(cls, path: str | Path) -> Profile:
        """Read a profile from a TOML file.

            name = "crane"                                  # optional
            duration = 8.0                                  # s, optional
            speed_rpm = [[0, 0], [1, 20], [2, 1000]]        # mechanical; or speed_rad_s, mechanical
            load_torque = [[0, 0], [4, 0], [4, 6.2]]        # N m, optional

        Raises ValueError with one sentence naming file, key, what was found and what is allowed; OSError
        if the file cannot be read.
        """
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not a TOML file: {error}") from None
        try:
            return _from_table(table, path.stem)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def tracks(self, sample_rate: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Speed and load tracks as `value_at` takes them: float64 (2, points), time in samples, value."""
        return _in_samples(self.speed, sample_rate), _in_samples(self.load, sample_rate)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


def _checked_track(name: str, points: Sequence[Sequence[float]]) -> Track:
    allowed = "allowed is a list of [time, value] pairs of finite numbers"
    if not isinstance(points, list | tuple) or not points:
        raise ValueError(f"{name} is {points!r}; {allowed}, at least one")
    track: list[tuple[float, float]] = []
    for number, point in enumerate(points):
        if not (isinstance(point, list | tuple) and len(point) == 2 and all(map(_is_number, point))):
            raise ValueError(f"{name} point {number} is {point!r}; {allowed}")
        t, value = float(point[0]), float(point[1])
        if t < 0.0 or (track and t < track[-1][0]):
            earliest = track[-1][0] if track else 0.0
            raise ValueError(f"{name} point {number} is at {t:g} s; allowed is {earliest:g} s or later")
        if len(track) > 1 and t == track[-2][0]:
            raise ValueError(f"{name} point {number} is the third at {t:g} s; allowed are two (a step)")
        track.append((t, value))
    return tuple(track)


def _from_table(table: dict[str, Any], stem: str) -> Profile:
    for key in table:
        if key not in _KEYS:
            raise ValueError(f"unknown key {key!r}; allowed are {', '.join(_KEYS)}")
    given = [key for key in ("speed_rad_s", "speed_rpm") if key in table]
    if len(given) != 1:
        found = "both" if given else "neither"
        raise ValueError(f"{found} of speed_rad_s and speed_rpm found; allowed is exactly one")
    speed = _checked_track(given[0], table[given[0]])
    if given[0] == "speed_rpm":
        speed = tuple((t, value * RPM) for t, value in speed)
    name = table.get("name", stem)
    if not isinstance(name, str):
        raise ValueError(f"name is {name!r}; allowed is a text")
    load = _checked_track("load_torque", table.get("load_torque", ((0.0, 0.0),)))
    duration = table.get("duration", 0.0)
    if "duration" in table and not (_is_number(duration) and duration > 0.0):
        raise ValueError(f"duration is {duration!r}; allowed is a finite number above 0, in s")
    return Profile(speed, load, duration, name)


def _in_samples(track: Track, sample_rate: float) -> NDArray[np.float64]:
    points = np.array(track, dtype=np.float64).T.copy()
    points[0] *= sample_rate
    # A breakpoint meant to lie on a sample must not fall one rounding error beside it.
    nearest = np.round(points[0])
    points[0] = np.where(np.abs(points[0] - nearest) < _SNAP, nearest, points[0])
    return points


@kernel
def value_at(track: NDArray[np.float64], sample: float, before: bool) -> float:
    """Value of a track (2, points) at a time in samples; at a step, the value before it or after it."""
    low = 0
    high = track.shape[1]
    while low < high:
        middle = (low + high) // 2
        t = track[0, middle]
        if t < sample or (t == sample and not before):
            low = middle + 1
        else:
            high = middle
    if low == 0:
        return float(track[1, 0])
    if low == track.shape[1]:
        return float(track[1, low - 1])
    t_0 = track[0, low - 1]
    share = (sample - t_0) / (track[0, low] - t_0)
    return float(track[1, low - 1] + share * (track[1, low] - track[1, low - 1]))


def constant(speed: float, load: float = 0.0, duration: float = 1.0) -> Profile:
    """Constant speed [rad/s mechanical] and load torque [N m] for a duration [s]."""
    return Profile(((0.0, speed),), ((0.0, load),), duration, "constant")


def paper_ramp() -> Profile:
    """M1 from 10 to 100 rad/s (mechanical) at 0.5 N m (paper, Section 5.1); the ramp's times are ours."""
    return Profile(((0.0, 10.0), (0.5, 10.0), (1.5, 100.0)), ((0.0, 0.5),), 2.5, "paper_ramp")


def torque_pulses() -> Profile:
    """M2 at 1000 rpm, load pulses from 0 to the rated 6.2 N m (paper, Section 5.2); the times are ours."""
    pulses = ((0.0, 0.0), (0.5, 0.0), (0.5, 6.2), (1.0, 6.2), (1.0, 0.0), (1.5, 0.0), (1.5, 6.2),
              (2.0, 6.2), (2.0, 0.0))
    return Profile(((0.0, 1000.0 * RPM),), pulses, 2.5, "torque_pulses")


def demo() -> Profile:
    """M2 in 16 s: standstill, 20, 100 and 1000 rpm, reversal to -1000 rpm, standstill, with load steps.

    20 rpm is held long enough (2.9 s) for the observer to make sure of the angle before the speed rises.
    """
    speed_rpm = ((0.0, 0.0), (1.5, 0.0), (1.7, 20.0), (4.6, 20.0), (4.8, 100.0), (6.0, 100.0),
                 (7.0, 1000.0), (9.2, 1000.0), (11.2, -1000.0), (12.8, -1000.0), (13.8, 0.0))
    load = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (4.4, 3.0), (4.4, 0.0), (5.2, 0.0), (5.2, 4.0), (5.6, 4.0),
            (5.6, 0.0), (7.6, 0.0), (7.6, 6.2), (8.4, 6.2), (8.4, 0.0), (11.7, 0.0), (11.7, -4.0),
            (12.3, -4.0), (12.3, 0.0), (14.8, 0.0), (14.8, 2.0), (15.3, 2.0), (15.3, 0.0))
    return Profile(tuple((t, value * RPM) for t, value in speed_rpm), load, 16.0, "demo")


PRESETS: dict[str, Callable[[], Profile]] = {
    "paper_ramp": paper_ramp, "torque_pulses": torque_pulses, "demo": demo,
}
"""Profiles by name; `constant` takes arguments and stands apart."""
