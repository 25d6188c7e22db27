"""How large a thing must be to matter, in one place; docs/diagnose.md gives the same numbers.

What drive.toml says of the drive (`observer.voltage_uncertainty`, `resistance_uncertainty`, ...) is 1-sigma; twice
that is still a drive as told.
"""

from __future__ import annotations

import math

SURE = 4.0
"""A value is there when it is so many times its own 1-sigma."""
SIGMAS_95 = 1.96

OFFSET = 0.025
"""Offset of the current, as a share of rated current."""
IMBALANCE = 0.03
"""Difference between the largest and the smallest gain of the phases' current sensors."""
DELAY = 0.15
"""Delay of the voltage [samples]."""
VOLTAGE = 2.5
"""Dead time and offset of the voltage, in units of observer.voltage_uncertainty."""
PSI_M = 0.075
"""Flux of the magnets, as a share of the name plate's; drive.toml has no key for its uncertainty."""
TOLERANCE = 2.0
"""R, L_d, L_q in units of the uncertainty that drive.toml tells."""
ALONG_D = 0.05
"""Course of i_d from which on L_d can be told, as a share of rated current."""
ZERO, ZERO_ERROR = math.radians(5.0), math.radians(15.0)
"""Encoder's zero [rad electrical]: notable, and an error."""
ECCENTRICITY, ECCENTRICITY_ERROR = math.radians(1.5), math.radians(10.0)
"""Amplitude of what repeats with each turn of the shaft [rad electrical]."""
SLIP_ERROR = math.radians(4.0)
LOST, LOST_MUCH = 0.01, 0.05
"""Share of the samples lost: worth telling, and a warning."""
UNEXCITED = 0.2
"""Share of the time in which nothing shows the position."""
WINDOW_S = 0.1
"""Window of the paper's conditions [s]."""
VALID = 0.7
"""Share of the time in which the rotor turns that an estimate ought to be valid."""
WRONG, WRONG_SHARE = math.radians(15.0), 0.05
"""A valid angle further off [rad electrical], for more than this share of the valid time, is wrong."""
