"""Reports that come in separate frames, brought to the time of the current's sample.

Every frame that holds the lead channel makes a row.  A channel of the same frame has its value there at once.
One that comes in other frames is interpolated between the reports before and after the row: on a straight line,
or for an angle on the circle, the number of whole turns in between taken from the speed.  A set point is held.
A row is handed on when every channel is known, or after `wait`: then the last report is held.

All this hangs on the frames and their time stamps alone, not on how they are cut into blocks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.mapping.plan import (
    AC_CHANNELS,
    ANGLE,
    CHANNELS,
    CIRCLE,
    CONSTANT,
    COUNTER,
    ENCODER,
    HOLD,
    INTERPOLATE,
    OMEGA,
    RATE,
)
from ipmsm_can.wire.sequence_kernel import RESTARTED

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Records = NDArray[np.void]

PENDING_MAX = 1 << 16
"""Rows that wait at most: a log whose time stands still must not fill the memory."""
BACKWARDS_NS = 1_000_000_000
"""Time stamps that run back by more than this begin a new recording; by less, they are taken for as late."""
_GAP_FROM = 1.75
"""Without a counter: sample periods between two samples from which on one counts as missing."""
TWO_PI = 2.0 * np.pi

STATE = np.dtype([
    ("t", "i8"), ("started", "i8"), ("sample", "i8"), ("has_sample", "i8"), ("sample_t", "i8"), ("counter", "i8"),
    ("rate", "f8"), ("dropped", "i8"), ("jumps", "i8"), ("has", "i8", (CHANNELS,)), ("last_t", "i8", (CHANNELS,)),
    ("last", "f8", (CHANNELS,)), ("next", "i8", (CHANNELS,)),
])


def new_state(rate: float | None, constants: dict[int, float]) -> Records:
    """State before the first frame.  rate: samples per second or None; constants: values by channel."""
    state = np.zeros(1, STATE)
    for channel, value in constants.items():
        state["last"][0, channel] = value
    state["rate"] = np.nan if rate is None else rate
    return state


@kernel
def on_circle(angle: float) -> float:
    """The same angle from -pi to pi [rad]."""
    return float(angle - TWO_PI * np.floor(angle / TWO_PI + 0.5))


@kernel
def _between(how: int, before: float, after: float, span: float, share: float, omega: float) -> float:
    """The value at `share` (0..1) of the time `span` [s] from one report to the next."""
    if how != CIRCLE:
        return before + (after - before) * share
    turned = omega * span
    return float(on_circle(before + (turned + on_circle(after - before - turned)) * share))


@kernel
def _resolve(st: Any, c: int, how: int, t: int, value: float, omega: float, count: int, row_t: Ints, values: Floats,
             apart: Floats, cross: Floats) -> None:
    """A report of channel c at t: every row that waits for it, none of them younger, gets its value."""
    for r in range(st.next[c], count):
        after = t - row_t[r]
        if not st.has[c] or after == 0:
            values[c, r] = value
            apart[c, r] = after
            continue
        before = row_t[r] - st.last_t[c]
        span = before + after
        values[c, r] = _between(how, st.last[c], value, 1e-9 * span, before / span, omega)
        apart[c, r] = min(before, after)
        if c < AC_CHANNELS:
            cross[c, r] = 1e-18 * before * after
    st.next[c] = count


@kernel
def _hold(st: Any, c: int, r: int, row_t: Ints, values: Floats, apart: Floats) -> None:
    """Row r takes the last report of channel c, NaN where there is none."""
    values[c, r] = st.last[c] if st.has[c] else np.nan
    apart[c, r] = abs(row_t[r] - st.last_t[c]) if st.has[c] else np.nan


@kernel
def _number(st: Any, t: int, counter: float, wrap: int) -> int:
    """Samples from the last one to this: 1 the next, 0 or less a repeated or late one."""
    if not st.has_sample:
        return 1
    expected = max(1e-9 * (t - st.sample_t) * st.rate, 0.0) if st.rate > 0.0 else 0.0
    if wrap == 0:
        # Jitter of arrival alone must not make a gap.
        return 1 if expected < _GAP_FROM else int(np.floor(min(expected, 1e12) + 0.5))
    delta = (int(counter) - st.counter) % wrap
    if not st.rate > 0.0:
        return int(delta)
    return int(delta + wrap * int(np.floor((min(expected, 1e12) - delta) / wrap + 0.5)))


@kernel
def _finish_all(st: Any, how: Ints, count: int, row_t: Ints, values: Floats, apart: Floats) -> None:
    for c in range(CHANNELS):
        if how[c] == INTERPOLATE or how[c] == CIRCLE:
            for r in range(st.next[c], count):
                _hold(st, c, r, row_t, values, apart)
            st.next[c] = count


@kernel
def align_block(t_ns: Ints, frames: Floats, how: Ints, lead: int, wrap: int, wait: int, at_end: bool,
                state: Records, row_t: Ints, sample: Ints, gap: Ints, values: Floats, apart: Floats, cross: Floats,
                waiting: int) -> tuple[int, int]:
    """Take in M frames; returns (rows in all, how many of them from the front are complete).

    t_ns (M,), frames (CHANNELS, M): reports, NaN where a frame holds none.  The other arrays hold `waiting` rows
    from before and have room for one more per frame: times, sample numbers, samples missing before, values,
    distance in time to the nearest report [ns], and for currents and voltages before * after [s^2].
    at_end: no more frames will come.
    """
    st = state[0]
    count = waiting
    head = 0
    for k in range(t_ns.shape[0]):
        t = t_ns[k]
        if st.started and t < st.t:
            if st.t - t < BACKWARDS_NS:
                t = st.t
            else:
                _finish_all(st, how, count, row_t, values, apart)
                st.has[:] = 0
                st.has_sample = 0
                st.jumps += 1
        st.t = t
        st.started = 1
        if np.isfinite(frames[RATE, k]) and frames[RATE, k] > 0.0:
            st.rate = frames[RATE, k]
        for c in range(CHANNELS):
            if how[c] == HOLD and not np.isnan(frames[c, k]):
                st.last[c] = frames[c, k]
                st.last_t[c] = t
                st.has[c] = 1
        if not np.isnan(frames[lead, k]) and not (wrap and np.isnan(frames[COUNTER, k])):
            steps = _number(st, t, frames[COUNTER, k], wrap)
            if steps <= 0:
                st.dropped += 1
                continue
            row_t[count] = t
            gap[count] = steps - 1 if st.has_sample or not st.jumps else RESTARTED
            st.sample = st.sample + steps if st.has_sample else (int(frames[COUNTER, k]) if wrap else 0)
            sample[count] = st.sample
            st.has_sample = 1
            st.sample_t = t
            if wrap:
                st.counter = int(frames[COUNTER, k])
            for c in range(CHANNELS):
                values[c, count] = np.nan
                apart[c, count] = np.nan
                if c < AC_CHANNELS:
                    cross[c, count] = 0.0
                if how[c] == HOLD:
                    _hold(st, c, count, row_t, values, apart)
                elif (how[c] == INTERPOLATE or how[c] == CIRCLE) and st.has[c] and st.last_t[c] == t:
                    values[c, count] = st.last[c]
                    apart[c, count] = 0.0
                    st.next[c] = count + 1
                elif how[c] == CONSTANT:
                    values[c, count] = st.last[c]
                    apart[c, count] = 0.0
            count += 1
        omega = frames[OMEGA, k]
        if not np.isfinite(omega):
            omega = st.last[OMEGA] if st.has[OMEGA] and np.isfinite(st.last[OMEGA]) else 0.0
        for c in range(CHANNELS):
            if (how[c] == INTERPOLATE or how[c] == CIRCLE) and not np.isnan(frames[c, k]):
                value = on_circle(frames[c, k]) if c in (ANGLE, ENCODER) else frames[c, k]
                _resolve(st, c, how[c], t, value, omega, count, row_t, values, apart, cross)
                st.last[c] = value
                st.last_t[c] = t
                st.has[c] = 1
        while head < count:
            late = row_t[head] < t - wait or count - head > PENDING_MAX
            complete = True
            for c in range(CHANNELS):
                if (how[c] == INTERPOLATE or how[c] == CIRCLE) and st.next[c] <= head:
                    if late:
                        _hold(st, c, head, row_t, values, apart)
                        st.next[c] = head + 1
                    else:
                        complete = False
            if not complete:
                break
            head += 1
    if at_end:
        _finish_all(st, how, count, row_t, values, apart)
        head = count
    for c in range(CHANNELS):
        st.next[c] = max(st.next[c] - head, 0)
    return count, head
