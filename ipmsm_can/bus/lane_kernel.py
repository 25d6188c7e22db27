"""The compiled loop of the fast lane: from recvmmsg to sendmmsg without Python in between.

What it does per batch of frames is what SampleReceiver, Node and Companion do, with the same kernels on the same
state; whatever it is not sure of it leaves alone and hands back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.bus.message_table import unpack
from ipmsm_can.estimation import regression, speed
from ipmsm_can.estimation.confidence import VALID, WITHHELD
from ipmsm_can.estimation.estimator import estimate_block
from ipmsm_can.estimation.observers import common
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_SFF_MASK
from ipmsm_can.injection.meter import meter_block
from ipmsm_can.wire.answers import due_among, flux_values, position_values, tracking_state
from ipmsm_can.wire.e2e import crc_p02
from ipmsm_can.wire.kernels import decode_block, encode_block
from ipmsm_can.wire.protocol import PROTOCOL_VERSION, DriveMode
from ipmsm_can.wire.receive import is_clipped
from ipmsm_can.wire.sequence_kernel import NIBBLE, SEQUENCED, TIMING, sequence

MOST = 64
"""Frames that one receive takes at most."""

DONE, SILENCE, STRANGE, UNSENT = range(4)
"""Why the loop came back: it was time; no frame in time, or no bus; a batch for the ordinary path; answers that the
port would not take."""

_recvmmsg = types.ExternalFunction(
    "recvmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32, types.intp))
_sendmmsg = types.ExternalFunction("sendmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32))
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Rows = NDArray[np.intp]
Records = NDArray[np.void]
Words = NDArray[np.uint64]

FLUX_AT = regression.ROWS
ANGLE_AT = FLUX_AT + common.ROWS
EXCITATION_AT = ANGLE_AT + speed.ROWS
SIGMA_AT = EXCITATION_AT + 1
ESTIMATES = SIGMA_AT + 1
"""Rows of the estimates of a lap: regression, flux, angle, excitation, sigma."""

_RUNNING, _VERSION = int(DriveMode.RUNNING), PROTOCOL_VERSION
_CLOCK_REALTIME = 0
_LONG_NS = 10**12


class Decoder(NamedTuple):
    """Tables of a message that comes in, and the rows of the signals that are read."""

    frame: np.uint64
    table: Ints
    scaling: Floats
    ranges: Ints
    rows: Rows


class Encoder(NamedTuple):
    """Tables of a message that goes out, and the rows of the signals that are written."""

    header: np.uint64
    order: Rows
    table: Ints
    scaling: Floats
    ranges: Ints
    rows: Rows


class Wire(NamedTuple):
    """The messages; reference: header word of DriveReference, which is only counted; known: `Protocol.id_lut`;
    ends: `range_ends` of a DriveSample."""

    sample: Decoder
    timing: Decoder
    status: Decoder
    reference: np.uint64
    known: NDArray[np.int16]
    position: Encoder
    flux: Encoder
    companion: Encoder
    data_ids: Bytes
    ends: Floats


class Incoming(NamedTuple):
    """The port's receiving table, and the frames of one batch."""

    handle: int
    headers: Ints
    address: int
    control: Ints
    frames: Bytes
    state: Ints
    raw: Bytes
    words: Words
    t_ns: Ints


class Outgoing(NamedTuple):
    """The port's sending table; moment (2,): struct timespec."""

    frames: Bytes
    words: Words
    iov: Ints
    address: int
    moment: Ints
    moment_address: int


class LaneRecords(NamedTuple):
    """Parameters and states of sequencer, estimator and meter."""

    sequencer: Records
    counts: Ints
    regression_parameters: Records
    regression: Records
    observer_parameters: Records
    observer: Records
    speed: Records
    excitation: Records
    confidence: Records
    meter: Records


class Plan(NamedTuple):
    """What holds for a lap.

    lap_ns: how long at most; end_ns: when Python has to give the next command [ns].
    max_gap: longest loss, in samples, that is filled.
    every, flux_every: samples per PositionEstimate and ActiveFluxEstimate; oldest: age in samples beyond which
    none is sent.  injecting, rejected: what DriveStatus said last.  step: resolution of theta_e [rad].
    calm_speed [rad/s electrical], calm_excitation [V^2 s]: below them Python is to be asked at once; by the
    speed only where sigma is above calm_sigma [rad electrical].
    status_period [ns]; status (n_signals, 1): CompanionStatus as of the lap's beginning, but for its state, which
    goes into row state_row.
    time_every: of so many answers, one is timed; clock_every: for so many, the clock is read once to see whether
    they come too late, beyond oldest_s.
    """

    lap_ns: int
    end_ns: int
    max_gap: int
    every: int
    flux_every: int
    oldest: int
    injecting: int
    rejected: int
    step: float
    calm_speed: float
    calm_excitation: float
    calm_sigma: float
    status_period: int
    status: Floats
    state_row: int
    time_every: int
    clock_every: int
    oldest_s: float


class Kept(NamedTuple):
    """What a lap leaves: frames with their times; samples (counter and arrival; filled and doubt; values) with
    their estimates; turnarounds; answers sent, with the time of the frame that each answers.
    """

    raw: Bytes
    t_ns: Ints
    counter: Ints
    marks: Bytes
    values: Floats
    estimates: Floats
    flags: Bytes
    took: Floats
    hf_current: Floats
    sent_words: Words
    sent_t_ns: Ints


(TAKEN, SAMPLES, LEFT, SENT, UNSENT_FRAMES, FIRST_UNSENT, COUNTER, SAMPLE_FRAMES, TIMINGS, STATUSES, NEXT_STATUS,
 TIMED, LATE, FOREIGN, RESULTS) = range(15)
"""What `lap` says in its array: frames taken in, samples estimated, frames of the last batch left alone, answers
sent and not sent, row of the first of those, PositionEstimates sent so far; DriveSamples, DriveTimings and
DriveStatuses taken in; when CompanionStatus is due next, turnarounds measured, PositionEstimates withheld for
being late; frames with identifiers that are nobody's here."""


@kernel
def _is_foreign(word: np.uint64, known: NDArray[np.int16]) -> bool:
    """Whether a frame with this header has an identifier that is nobody's here, as `Protocol.classify` has it."""
    header = np.int64(word)
    return bool(header & CAN_ERR_FLAG == 0 and (header & CAN_EFF_FLAG != 0 or known[header & CAN_SFF_MASK] < 0))


@kernel
def _is_plain(m: int, gap: Ints, at: int, n: int, why: int) -> bool:
    """Whether all events were taken in and the estimator can go on through the m samples they gave."""
    plain = at == n and why == SEQUENCED
    for k in range(m):
        plain &= gap[k] == 0
    return plain


@kernel
def _says_the_same(heard: Floats, rows: Rows, plan: Plan) -> bool:
    """Whether a DriveStatus only repeats what is known of a running drive."""
    return bool(heard[rows[0], 0] == _RUNNING and (heard[rows[1], 0] != 0.0) == (plan.injecting != 0)
                and heard[rows[2], 0] == _VERSION and heard[rows[3], 0] == plan.rejected)


@kernel
def _clock(outgoing: Outgoing) -> int:
    """Unix time [ns], the clock of the kernel's time stamps."""
    _clock_gettime(_CLOCK_REALTIME, outgoing.moment_address)
    return int(outgoing.moment[0] * 1_000_000_000 + outgoing.moment[1])


@kernel
def time_clock(outgoing: Outgoing, times: int) -> int:
    """Read the clock so many times; returns how long that took [ns]."""
    begin = _clock(outgoing)
    for _ in range(times):
        end = _clock(outgoing)
    return end - begin


@kernel
def _encode(values: Floats, to: Encoder, words: Words) -> None:
    encode_block(values, 1, to.order, to.table, to.scaling, to.ranges, to.header, words)


@kernel
def lap(plan: Plan, wire: Wire, incoming: Incoming, outgoing: Outgoing, records: LaneRecords, kept: Kept,
        result: Ints) -> int:
    """Serve for a while; returns why it stopped, and in `result` what it did."""
    st = records.sequencer[0]
    raw = incoming.raw
    words = incoming.words
    t_ns = incoming.t_ns
    capacity = kept.t_ns.shape[0]
    rows = outgoing.frames.shape[0]
    most_samples = (plan.max_gap + 1) * MOST
    before = records.sequencer.copy()
    counts_before = records.counts.copy()
    begin = -1
    late = False
    unchecked = True
    while True:
        taken = result[TAKEN]
        done = result[SAMPLES]
        if taken + MOST > capacity or done + most_samples > capacity or result[SENT] + rows > capacity:
            return DONE
        # Up to the next sample that is to be answered, or to the next moment at which something else is due.
        want = min(plan.every - (st.last & 0xFFFFFFFF) % plan.every, MOST)
        until = min(plan.end_ns, result[NEXT_STATUS]) - st.last_t
        want = min(want, max(1, int(min(until, _LONG_NS) * 1e-9 * st.rate) + 1))
        n = _recvmmsg(incoming.handle, incoming.address, want, 0, 0)
        if n <= 0:
            return SILENCE
        n = unpack(n, incoming.headers, incoming.control, incoming.frames, raw, t_ns, incoming.state)
        if n == 0:
            continue
        strange = not st.has_last or st.rate <= 0.0
        events = 0
        timings = 0
        statuses = 0
        foreign = 0
        kind = np.empty(n, np.int64)
        low = np.empty(n, np.int64)
        rate = np.zeros(n)
        arrived = np.empty(n, np.int64)
        part = np.zeros((4, n))
        row = np.empty(1, np.intp)
        one = np.empty((wire.sample.table.shape[0], 1))
        for k in range(n):
            row[0] = k
            arrived[events] = t_ns[k]
            if t_ns[k] < 0:
                strange = True
            elif words[k, 0] == wire.sample.frame:
                s = wire.sample
                decode_block(words, row, True, 1, s.table, s.scaling, s.ranges, one)
                for r in range(4):
                    part[r, events] = one[s.rows[r], 0]
                strange |= is_clipped(part, 0, events, wire.ends)
                kind[events] = NIBBLE
                low[events] = np.int64(one[s.rows[4], 0])
                events += 1
            elif words[k, 0] == wire.timing.frame:
                t = wire.timing
                timing = np.empty((t.table.shape[0], 1))
                decode_block(words, row, True, 1, t.table, t.scaling, t.ranges, timing)
                kind[events] = TIMING
                low[events] = np.int64(timing[t.rows[0], 0])
                rate[events] = timing[t.rows[1], 0]
                events += 1
                timings += 1
            elif words[k, 0] == wire.status.frame:
                h = wire.status
                heard = np.empty((h.table.shape[0], 1))
                decode_block(words, row, True, 1, h.table, h.scaling, h.ranges, heard)
                strange |= not _says_the_same(heard, h.rows, plan)
                statuses += 1
            elif _is_foreign(words[k, 0], wire.known):
                foreign += 1
            elif words[k, 0] != wire.reference:
                strange = True
        room = (plan.max_gap + 1) * events
        run_counter = np.empty(room, np.int64)
        run_values = np.empty((4, room))
        run_filled = np.empty(room, np.uint8)
        run_doubt = np.empty(room, np.uint8)
        run_gap = np.empty(room, np.int64)
        run_t = np.empty(room, np.int64)
        m = 0
        if not strange:
            before[0] = records.sequencer[0]
            counts_before[:] = records.counts
            m, at, why = sequence(
                0, kind[:events], low[:events], rate[:events], arrived[:events], part, plan.max_gap,
                records.sequencer, records.counts, run_counter, run_values, run_filled, run_doubt, run_gap, run_t)
            if not _is_plain(m, run_gap, at, events, why):
                records.sequencer[0] = before[0]
                records.counts[:] = counts_before
                strange = True
        if strange:
            result[LEFT] = n
            return STRANGE
        for k in range(n):
            for b in range(72):
                kept.raw[taken + k, b] = raw[k, b]
            kept.t_ns[taken + k] = t_ns[k]
        taken += n
        result[TAKEN] = taken
        result[SAMPLE_FRAMES] += events - timings
        result[TIMINGS] += timings
        result[STATUSES] += statuses
        result[FOREIGN] += foreign
        now = t_ns[n - 1]
        if begin < 0:
            begin = now
        over = now < begin or now - begin >= plan.lap_ns or now >= plan.end_ns
        if m == 0:
            if over:
                return DONE
            continue
        samples = np.empty((4, m))
        samples[:] = run_values[:, :m]
        regressed = np.empty((FLUX_AT, m))
        flux = np.empty((ANGLE_AT - FLUX_AT, m))
        angle = np.empty((EXCITATION_AT - ANGLE_AT, m))
        excited = np.empty(m)
        sigma = np.empty(m)
        run_flags = np.empty(m, np.uint8)
        estimate_block(samples, records.regression_parameters, records.regression, records.observer_parameters,
                       records.observer, records.speed, records.excitation, records.confidence, regressed, flux,
                       angle, excited, sigma, run_flags)
        kept.hf_current[0] = meter_block(samples, records.meter)
        for k in range(m):
            if run_doubt[k]:
                run_flags[k] = run_flags[k] & (0xFF ^ VALID) | WITHHELD
            kept.counter[0, done + k] = run_counter[k]
            kept.counter[1, done + k] = run_t[k]
            kept.marks[0, done + k] = run_filled[k]
            kept.marks[1, done + k] = run_doubt[k]
            kept.flags[done + k] = run_flags[k]
            for r in range(4):
                kept.values[r, done + k] = samples[r, k]
            for r in range(FLUX_AT):
                kept.estimates[r, done + k] = regressed[r, k]
            for r in range(ANGLE_AT - FLUX_AT):
                kept.estimates[FLUX_AT + r, done + k] = flux[r, k]
            for r in range(EXCITATION_AT - ANGLE_AT):
                kept.estimates[ANGLE_AT + r, done + k] = angle[r, k]
            kept.estimates[EXCITATION_AT, done + k] = excited[k]
            kept.estimates[SIGMA_AT, done + k] = sigma[k]
        result[SAMPLES] = done + m
        due = np.empty(m, np.intp)
        flux_due = np.empty(m, np.intp)
        counters = run_counter[:m]
        n_due = due_among(counters, plan.every, plan.oldest, due)
        n_flux = min(due_among(counters, plan.flux_every, plan.oldest, flux_due), rows - n_due - 1)
        answer = run_counter[m - 1] // plan.every
        if n_due + n_flux > 0 and (late or unchecked or answer % plan.clock_every == 0):
            late = _clock(outgoing) - run_t[m - 1] > 1e9 * plan.oldest_s
            unchecked = False
        if late:
            result[LATE] += n_due
            n_due = 0
            n_flux = 0
        out = n_due
        if n_due > 0:
            said = np.empty(m, np.uint8)
            said[:] = plan.injecting
            answers = np.zeros((wire.position.table.shape[0], n_due))
            position_values(counters, angle, sigma, run_flags, said, due[:n_due], plan.step, wire.position.rows,
                            answers)
            _encode(answers, wire.position, outgoing.words)
            for j in range(n_due):
                outgoing.frames[j, 9] = (outgoing.frames[j, 9] & 0xF0) | (result[COUNTER] & 0x0F)
                outgoing.frames[j, 8] = crc_p02(outgoing.frames, j, 8, wire.data_ids)
                result[COUNTER] += 1
        if n_flux > 0:
            fluxes = np.empty((wire.flux.table.shape[0], n_flux))
            fluxes[:] = np.nan
            flux_values(regressed, flux, excited, flux_due[:n_flux], wire.flux.rows, fluxes)
            _encode(fluxes, wire.flux, outgoing.words[out:])
            out += n_flux
        # The first time, or the clock was set back, or due.
        if not result[NEXT_STATUS] - plan.status_period < now < result[NEXT_STATUS]:
            result[NEXT_STATUS] = now + plan.status_period
            plan.status[plan.state_row, 0] = tracking_state(run_flags[m - 1], sigma[m - 1])
            _encode(plan.status, wire.companion, outgoing.words[out:])
            out += 1
        if out > 0:
            for j in range(out):
                outgoing.iov[j, 1] = 16
            sent = max(0, _sendmmsg(incoming.handle, outgoing.address, out, 0))
            for j in range(sent):
                kept.sent_words[result[SENT] + j, 0] = outgoing.words[j, 0]
                kept.sent_words[result[SENT] + j, 1] = outgoing.words[j, 1]
                kept.sent_t_ns[result[SENT] + j] = now
            result[SENT] += sent
            if sent < out:
                result[UNSENT_FRAMES] = out - sent
                result[FIRST_UNSENT] = sent
                return UNSENT
            if n_due > 0 and answer % plan.time_every == 0 and result[TIMED] < kept.took.shape[0]:
                kept.took[result[TIMED]] = 1e-9 * (_clock(outgoing) - run_t[due[n_due - 1]])
                result[TIMED] += 1
        slow = abs(angle[speed.OMEGA, m - 1]) < plan.calm_speed and sigma[m - 1] > plan.calm_sigma
        if over or slow or excited[m - 1] < plan.calm_excitation:
            return DONE
