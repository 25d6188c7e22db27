"""The compiled part of `sequence`: events of one drive in order of arrival to samples in order of time.

What can happen, and what is done, stands there; here are the state, the constants and the arithmetic of counters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

NIBBLE, TIMING, FULL = range(3)
"""Kinds of event: sample with a 4-bit counter, DriveTiming, sample with a 32-bit counter."""
CLIPPED = 4
"""Added to the kind of a sample that was cut off at the end of its range; also the bit in `SampleRun.doubt`."""
KIND_BITS = 3
"""Bits of an event's kind that say which it is."""

RATE_MIN, RATE_MAX = 100.0, 100_000.0
"""Sample rates [Hz] that are believed."""
RATE_TOLERANCE = 1e-3
"""Statements of the sample rate this close to each other, relatively, are one.  Quartz is 1e-4 off at most, and
counting a period's worth of ticks adds as much; a converter that is switched to another rate makes a larger step.
The estimator can stand it: speed and flux come out wrong by as much, less than psi_m is ever known to."""
RESTARTED = 1 << 40
"""Value of `gap` at the first sample after the drive restarted: nothing before it counts."""
LONGEST_SILENCE = 60.0
"""A counter further ahead than this [s] is a restarted drive, not a gap."""
LATE_AT_MOST = 0.5
"""Longest silence [s] after which the next counter value is taken for a late sample: so long may a busy
computer hold up a sender; it costs no more than waiting for the next DriveTiming when samples were lost."""
SETTLED_AFTER_NS = 1_000_000_000
"""Without DriveTiming: samples that still come late so long [ns] after a silence were lost, not held up."""
TIMING_LATE_AT_MOST = 3
"""Samples that may overtake a DriveTiming on their way."""
HALF_WRAP = 8.0
"""Half a wrap of the 4-bit counter [samples]: how far the arrival time can be off and still tell wraps apart."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STATE = np.dtype([
    ("has_last", "i8"), ("last", "i8"), ("last_t", "i8"), ("has_floor", "i8"), ("floor", "i8"),
    ("rate", "f8"), ("pace", "f8"), ("synced", "i8"), ("guess", "i8"), ("offset", "i8"), ("restarted", "i8"),
    ("correction", "i8"), ("doubt", "i8"), ("doubted_t", "i8"), ("seen", "u8"), ("values", "f8", (4,)),
])

(RECEIVED, FILLED, LOST, DUPLICATES, REORDERED, GAPS, RESYNCS, RESTARTS, BAD_RATE, OVERFLOW,
 CLIPPED_SAMPLES) = range(11)
FILLED_S = 1.7e-3
"""Longest loss [s] that is filled, whatever max_gap: a straight line is no path of a vector that turns meanwhile,
and at 600 rad/s electrical it does by a radian."""
COUNTERS = ("received", "filled", "lost", "duplicates", "reordered", "gaps", "resyncs", "restarts",
            "bad_rate", "overflow", "clipped")

SEQUENCED, RATE_CHANGED = range(2)
"""Why `sequence` stopped: at the end, or for another sample rate."""

WRAP = 1 << 32


@kernel
def _steps_since_last(nibble: int, t_ns: int, st: Any) -> int:
    """How many samples lie between the last one and this 4-bit counter; 0 duplicate, negative late."""
    delta = (nibble - st.last) & 15
    # DriveTiming said that `floor` had been sent before this frame: so many steps at least.
    least = st.floor - st.last if st.has_floor else 0
    proven = delta + 16 * max((least - delta + 15) // 16, 0)
    if st.rate <= 0.0:
        return int(delta if delta <= 8 else delta - 16)
    # A clock that was set back says nothing; believed, it would make every sample that follows "late".
    expected = min(max((t_ns - st.last_t) * 1e-9 * st.pace, 0.0), 1e9)
    if delta == 1 and least <= 1 and expected <= LATE_AT_MOST * st.rate:
        # Exactly the next one: late rather than exactly 16, 32, ... lost.
        if expected - delta > HALF_WRAP:
            st.doubt = 1
            st.doubted_t = t_ns
        return 1
    steps = delta + 16 * int(np.floor((expected - delta) / 16.0 + 0.5))
    if steps < proven and (steps > 0 or least >= 16):
        steps = proven
    if steps >= proven + 16 and steps > 16:
        st.guess += (steps - max(proven, 1)) // 16
        st.doubt = 1
        st.doubted_t = t_ns
    return int(steps)


@kernel
def settled(last: int, sent: int) -> int:
    """The counter that ends in the low four bits of `last`, given that sample `sent` had just been sent.

    The samples may lag behind through loss; and DriveTiming, of lower priority, may lag a little itself.
    """
    ahead = (last - sent) & 15
    return sent + (ahead if ahead <= TIMING_LATE_AT_MOST else ahead - 16)


@kernel
def _timing(counter: int, rate: float, st: Any, counts: Ints) -> bool:
    """Take in a DriveTiming; True where the sample rate changed, by more than RATE_TOLERANCE."""
    changed = abs(rate - st.rate) > RATE_TOLERANCE * st.rate
    if changed:
        st.rate = rate
    elif st.has_last:
        # The earliest arrival is kept as of sample 0; as of the last one it stays what it was.
        st.offset += int(st.last * (1e9 / st.pace) - st.last * (1e9 / rate))
    st.pace = rate
    synced = st.synced
    st.synced = 1
    st.guess = 0
    doubted = st.doubt
    st.doubt = 0
    if not st.has_last:
        st.has_floor = 1
        st.floor = counter
        return bool(changed)
    if not synced and not changed:
        # Counters were relative until now; the samples themselves are unbroken.
        st.last = settled(st.last, counter)
        st.has_floor = 1
        st.floor = counter
        return bool(changed)
    ahead = (counter - st.last) & (WRAP - 1)
    if ahead >= WRAP // 2:
        ahead -= WRAP
    if changed or ahead > LONGEST_SILENCE * rate or ahead < -2.0 * rate - 16.0:
        counts[RESTARTS] += 1
        st.has_last = 0
        st.restarted = 1
        st.has_floor = 1
        st.floor = counter
    elif (doubted and settled(st.last, counter) != st.last) or (ahead < 0 and (ahead & 15) == 0):
        wrong_by = settled(st.last, counter) - st.last
        counts[RESYNCS] += 1
        counts[LOST] += wrong_by
        st.last += wrong_by
        st.correction += wrong_by
        st.has_floor = 1
        st.floor = st.last
    elif ahead >= 0:
        st.has_floor = 1
        st.floor = st.last + ahead
    return bool(changed)


@kernel
def _before_it_was_taken(t_ns: int, st: Any, counts: Ints) -> None:
    """Put right a guess after which samples arrive earlier than any before them, by half a wrap or more; without
    DriveTiming, also one after which they stay late.
    """
    period = 1e9 / st.pace
    offset = t_ns - int(st.last * period)
    early = (st.offset - offset) / period
    if st.guess > 0 and early > HALF_WRAP:
        wraps = min(int(early / 16.0 + 0.5), st.guess)
        st.last -= 16 * wraps
        st.guess -= wraps
        st.correction -= 16 * wraps
        counts[LOST] -= 16 * wraps
        counts[RESYNCS] += 1
    elif st.doubt and not st.synced and t_ns - st.doubted_t > SETTLED_AFTER_NS:
        # There may never be a DriveTiming to settle it.
        wraps = max(int(-early / 16.0 + 0.5), 0)
        st.last += 16 * wraps
        st.correction += 16 * wraps
        counts[LOST] += 16 * wraps
        counts[RESYNCS] += 1 if wraps else 0
        st.guess = 0
        st.doubt = 0
        st.offset = t_ns - int(st.last * period)
    elif st.guess == 0:
        if early > -HALF_WRAP:
            st.doubt = 0  # as prompt as ever: it was late, and nothing is missing
        # A drive's clock may be slower than ours: let the earliest arrival fade.
        st.offset = min(offset, st.offset + int((t_ns - st.last_t) * 1e-4))


@kernel
def sequence(begin: int, kind: Ints, counter: Ints, rate: Floats, t_ns: Ints, values: Floats,
             max_gap: int, st_array: NDArray[np.void], counts: Ints, out_counter: Ints, out_values: Floats,
             out_filled: NDArray[np.uint8], out_doubt: NDArray[np.uint8], out_gap: Ints,
             out_t: Ints) -> tuple[int, int, int]:
    """Sequence events from `begin` on; stops after a change of sample rate.

    Returns (number of samples put out, next event, SEQUENCED or RATE_CHANGED).  The outputs need room for
    (max_gap + 1) samples per event.
    """
    st = st_array[0]
    m = 0
    k = begin
    n = kind.shape[0]
    while k < n:
        if kind[k] == TIMING:
            if not (rate[k] >= RATE_MIN and rate[k] <= RATE_MAX):
                counts[BAD_RATE] += 1
            elif _timing(counter[k], rate[k], st, counts):
                return m, k + 1, RATE_CHANGED
            k += 1
            continue
        whole = kind[k] & KIND_BITS == FULL
        clipped = kind[k] & CLIPPED
        if st.has_last:
            if not whole:
                steps = _steps_since_last(counter[k], t_ns[k], st)
            else:
                st.doubt = 0
                steps = (counter[k] - st.last) & (WRAP - 1)
                if steps >= WRAP // 2:
                    steps -= WRAP
                far = LONGEST_SILENCE * st.rate if st.rate > 0.0 else 1e6
                if steps > far or steps < -1024:
                    counts[RESTARTS] += 1
                    st.restarted = 1
                    st.has_last = 0
            if st.has_last and steps <= 0:
                if steps > -64 and (st.seen >> np.uint64(-steps)) & np.uint64(1):
                    counts[DUPLICATES] += 1
                else:
                    counts[REORDERED] += 1
                k += 1
                continue
        missing = 0
        if st.has_last:
            missing = steps - 1
            st.last += steps
            st.seen = (st.seen << np.uint64(steps)) | np.uint64(1) if steps < 64 else np.uint64(1)
            counts[LOST] += missing
            if not whole and st.rate > 0.0:
                _before_it_was_taken(t_ns[k], st, counts)
        else:
            st.seen = np.uint64(1)
            if whole:
                st.last = counter[k]
                st.synced = 1
            else:
                floor = st.floor if st.has_floor else 0
                st.last = floor + ((counter[k] - floor) & 15)
            st.guess = 0
            st.doubt = 0
            st.offset = t_ns[k] - int(st.last * (1e9 / st.pace)) if st.rate > 0.0 else 0
        gap = 0
        if st.restarted or not st.has_last:
            gap = RESTARTED if st.restarted else 0
        elif st.correction != 0 or missing > min(max_gap, st.rate * FILLED_S):
            gap = missing
            if st.correction != 0:
                gap = -max(abs(st.correction), missing)
            counts[GAPS] += 1
        else:
            for j in range(1, missing + 1):
                weight = j / (missing + 1)
                for r in range(4):
                    out_values[r, m] = st.values[r] + weight * (values[r, k] - st.values[r])
                out_counter[m] = (st.last - missing - 1 + j) & (WRAP - 1)
                out_filled[m] = 1
                out_doubt[m] = st.doubt | clipped
                out_gap[m] = 0
                out_t[m] = t_ns[k]
                m += 1
            counts[FILLED] += missing
        for r in range(4):
            out_values[r, m] = values[r, k]
            st.values[r] = values[r, k]
        out_counter[m] = st.last & (WRAP - 1)
        out_filled[m] = 0
        out_doubt[m] = st.doubt | clipped
        out_gap[m] = gap
        out_t[m] = t_ns[k]
        m += 1
        counts[RECEIVED] += 1
        counts[CLIPPED_SAMPLES] += 1 if clipped else 0
        st.has_last = 1
        st.restarted = 0
        st.correction = 0
        st.last_t = t_ns[k]
        k += 1
    return m, n, SEQUENCED
