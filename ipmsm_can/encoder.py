"""The drive's encoder beside the estimate: DriveReference against the angle estimated for the same sample.

Neither is taken for the truth.  The encoder's zero may lie anywhere, so the difference of the two over the first
SETTLE of valid estimates is its offset: constant, told as such, and no fault.  What departs from that by more than
LIMIT and FACTOR sigma for PERSIST is a disagreement: one of the two has slipped.

Which one?  While the rotor turns fast enough for its back-EMF to stand clear of what the voltage may be wrong by,
the estimate rests on rotation: the observer's own tests would notice a slip of it within 20 ms, so its word stands
and the encoder is reported.  At standstill nothing of that kind speaks for the estimate; nobody knows, and an angle
that is not known is not called valid.  Then the estimate has to be found anew from the samples alone, by the
start-up or by rotation, before it is valid again.  After either the difference is settled anew, and if it is
another one, the encoder has slipped.

The angle is carried to the reference's sample with the estimate's speed, over REACH at most.  Wire input never
raises: what is not finite, or names a sample out of reach, is left out.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

SETTLE = 0.05
"""Time over which the encoder's zero is found [s]."""
LIMIT = math.radians(10.0)
FACTOR = 3.0
PERSIST = 0.004
REACH = 0.005
"""[s]"""
LEAST = 3
"""References in a row that make a disagreement, however rare they are."""
NOTABLE = math.radians(5.0)
"""Offset [rad electrical] worth telling."""
_SPEED_ERROR = 0.1

STATE = np.dtype([
    ("settled", "i8"), ("references", "i8"), ("since", "i8"), ("sum_re", "f8"), ("sum_im", "f8"), ("offset", "f8"),
    ("apart_since", "i8"), ("apart", "i8"), ("disagrees", "i8"), ("difference", "f8"), ("disagreements", "i8"),
])

Records = NDArray[np.void]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Agreement(IntEnum):
    """What the encoder says of the estimate."""

    NONE = 0
    SETTLING = 1
    AGREES = 2
    DISAGREES = 3


@kernel
def _wrapped(angle: float) -> float:
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def compare_block(counter: Ints, theta: Floats, omega: Floats, sigma: Floats, valid: NDArray[np.bool_], rate: float,
                  ref_counter: Ints, ref_theta: Floats, state: Records) -> bool:
    """Compare references (R,) with estimates (N,) that rise in counter; returns whether a disagreement begins.

    theta, sigma, ref_theta [rad electrical], omega [rad/s electrical]; rate: samples per second; the counters not
    wrapped, or wrapped alike.
    """
    st = state[0]
    begins = False
    n = counter.shape[0]
    at = 0
    for r in range(ref_counter.shape[0]):
        c = ref_counter[r]
        if c < counter[at]:
            at = 0
        while at + 1 < n and counter[at + 1] <= c:
            at += 1
        elapsed = (c - counter[at]) / rate
        if not (valid[at] and abs(elapsed) <= REACH and math.isfinite(ref_theta[r])):
            continue
        st.references += 1
        turned = omega[at] * elapsed
        off = _wrapped(theta[at] + turned - ref_theta[r])
        if not st.settled:
            if st.since < 0 or c < st.since:
                st.since = c
                st.sum_re = 0.0
                st.sum_im = 0.0
            st.sum_re += math.cos(off)
            st.sum_im += math.sin(off)
            if (c - st.since) / rate >= SETTLE:
                st.settled = 1
                st.offset = math.atan2(st.sum_im, st.sum_re)
                st.apart = 0
                st.disagrees = 0
            continue
        st.difference = _wrapped(off - st.offset)
        spread = sigma[at] + _SPEED_ERROR * abs(turned)
        if abs(st.difference) > max(LIMIT, FACTOR * spread):
            if st.apart == 0:
                st.apart_since = c
            st.apart += 1
            if not st.disagrees and st.apart >= LEAST and (c - st.apart_since) / rate >= PERSIST:
                st.disagrees = 1
                st.disagreements += 1
                begins = True
        else:
            st.apart = 0
            st.disagrees = 0
    return begins


class EncoderCheck:
    """Encoder against estimate, of one drive.

    disagreements: how often they parted.  slips: how often the encoder turned out to have another zero than before.
    """

    def __init__(self) -> None:
        self.slips = 0
        self._state = np.zeros(1, STATE)
        self._state["since"] = -1
        self._before = math.nan

    @property
    def disagreements(self) -> int:
        """How often the two parted."""
        return int(self._state["disagreements"][0])

    @property
    def offset(self) -> float:
        """Estimate minus encoder [rad electrical], where the encoder's zero was found; NaN before."""
        return float(self._state["offset"][0]) if self._state["settled"][0] else math.nan

    @property
    def difference(self) -> float:
        """By how much the two differ beyond the offset [rad electrical]."""
        return float(self._state["difference"][0])

    @property
    def agreement(self) -> Agreement:
        """What the encoder says now."""
        st = self._state[0]
        if st["disagrees"]:
            return Agreement.DISAGREES
        if st["settled"]:
            return Agreement.AGREES
        return Agreement.SETTLING if st["references"] else Agreement.NONE

    def settle(self) -> None:
        """Find the encoder's zero anew from the next valid estimates on."""
        if self._state["settled"][0]:
            self._before = float(self._state["offset"][0])
        self._state["settled"], self._state["since"] = 0, -1

    def compare(self, counter: Ints, theta: Floats, omega: Floats, sigma: Floats, valid: NDArray[np.bool_],
                rate: float, ref_counter: Ints, ref_theta: Floats) -> bool:
        """As `compare_block`."""
        if not counter.size or not ref_counter.size:
            return False
        settled = bool(self._state["settled"][0])
        begins = bool(compare_block(counter, theta, omega, sigma, valid, rate, ref_counter, ref_theta, self._state))
        if not settled and self._state["settled"][0] and math.isfinite(self._before):
            moved = math.remainder(self.offset - self._before, 2.0 * math.pi)
            self.slips += abs(moved) > LIMIT
            self._before = math.nan
        return begins
