"""Frames of any inverter in, samples out, block by block: no clock, no thread, no file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FrameBlock
from ipmsm_can.mapping import align, convert
from ipmsm_can.mapping.model import InverterMap
from ipmsm_can.mapping.plan import (
    AC_CHANNELS,
    CHANNELS,
    CONSTANT,
    ENCODER,
    OMEGA,
    TEMPERATURE,
    TORQUE,
    V_DC,
    Plan,
    make_plan,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MappedBlock:
    """N samples, all arrays (N,) unless said otherwise; NaN where the map gives nothing or nothing came.

    t_ns: int64, arrival of the current's frame [ns].  sample: int64, its number: the drive's counter, carried on
    past its wraps, else a count.  gap: int64, samples missing right before this one; `wire.sequence.RESTARTED`
    where the time stamps ran back to a new beginning.
    i_alpha, i_beta [A], v_alpha, v_beta [V]: peak, per phase, amplitude-invariant, stationary frame.
    i_d, i_q, v_d, v_q: the same in the frame of theta_e.  theta_e: reported angle [rad electrical, -pi..pi];
    theta_encoder: a measured one (the same, unless the map has another).
    omega_e: reported speed [rad/s electrical]; turning: the same, else found from the angle or the current.
    v_dc [V], torque [N m], temperature [degC]: as reported.
    quality: uint8, bits of `mapping.convert`, 0 where all is well.
    apart: (CHANNELS, N), distance in time to the nearest report [ns], rows as in `mapping.plan`.
    """

    t_ns: Ints
    sample: Ints
    gap: Ints
    i_alpha: Floats
    i_beta: Floats
    v_alpha: Floats
    v_beta: Floats
    i_d: Floats
    i_q: Floats
    v_d: Floats
    v_q: Floats
    theta_e: Floats
    theta_encoder: Floats
    omega_e: Floats
    turning: Floats
    v_dc: Floats
    torque: Floats
    temperature: Floats
    quality: NDArray[np.uint8]
    apart: Floats

    def __len__(self) -> int:
        return len(self.t_ns)


class Mapper:
    """The mapping of one drive, with its state.  Any partition of the same frames gives the same bits.

    plan: what is decoded, from `make_plan`.  rate: samples per second where the caller knows better than the map.
    listener: is shown what every frame reports, t_ns (M,) and values (CHANNELS, M) with NaN where there is none.
    frames: how many frames of each message (in the order of plan.sources) came; foreign: of other identifiers.
    """

    def __init__(self, plan: Plan, rate: float | None = None,
                 listener: Callable[[Ints, Floats], None] | None = None) -> None:
        self.plan = plan
        self._listener = listener
        self.frames = np.zeros(len(plan.sources), np.int64)
        self.foreign = 0
        inverter = plan.map
        self._either = inverter.map.identifiers == "either length"
        keys = np.array([s.can_id for s in plan.sources], np.uint32)
        self._order = np.argsort(self._key(keys), kind="stable")
        self._keys = self._key(keys)[self._order]
        self._how = plan.how
        self._align = align.new_state(rate or inverter.timing.rate,
                                      {c.number: c.offset for c in plan.channels if c.how == CONSTANT})
        self._settings = convert.settings(inverter, self._how)
        self._convert = np.zeros(1, convert.STATE)
        self._wait = round(1e9 * inverter.timing.wait)
        self._measured = inverter.encoder is None and inverter.angle is not None and inverter.angle.measured
        self._ints = np.zeros((3, 0), np.int64)
        self._floats = np.zeros((2 * CHANNELS + AC_CHANNELS, 0))

    @property
    def rate(self) -> float:
        """Samples per second, as the map, the caller or the drive says; NaN where nobody does."""
        return float(self._align["rate"][0])

    @property
    def dropped(self) -> int:
        """Frames of samples that were repeated or late by their counter."""
        return int(self._align["dropped"][0])

    def _key(self, can_id: NDArray[np.uint32]) -> NDArray[np.uint32]:
        return can_id & np.uint32(~CAN_EFF_FLAG & 0xFFFFFFFF) if self._either else can_id

    def feed(self, block: FrameBlock) -> MappedBlock:
        """Take in frames in order of arrival; returns the samples that are complete by now."""
        ids = self._key(block.can_id)
        at = np.minimum(np.searchsorted(self._keys, ids), self._keys.size - 1)
        ours = self._keys[at] == ids
        # A remote or error frame has bits in its identifier that none of the keys has.
        picked = np.flatnonzero(ours)
        source = self._order[at[picked]]
        strange = (block.can_id & np.uint32(CAN_ERR_FLAG | CAN_RTR_FLAG)) != 0
        self.foreign += int(np.count_nonzero(~ours & ~strange))
        frames = np.full((CHANNELS, picked.size), np.nan)
        words = block.words
        for k, s in enumerate(self.plan.sources):
            here = np.flatnonzero(source == k)
            self.frames[k] += here.size
            if not here.size:
                continue
            values = s.codec.decode_rows(words, picked[here])
            for row, channel in zip(s.rows.tolist(), s.channels, strict=True):
                frames[channel.number, here] = channel.gain * values[row] + channel.offset
        t_ns = block.t_ns[picked]
        if self._listener is not None:
            self._listener(t_ns, frames)
        return self._rows(t_ns, frames, at_end=False)

    def flush(self) -> MappedBlock:
        """The rest, when no more frames will come: samples whose later reports are missing."""
        return self._rows(np.zeros(0, np.int64), np.zeros((CHANNELS, 0)), at_end=True)

    def _rows(self, t_ns: Ints, frames: Floats, at_end: bool) -> MappedBlock:
        waiting = self._ints.shape[1]
        room = int(np.count_nonzero(~np.isnan(frames[self.plan.lead])))
        ints = np.concatenate([self._ints, np.empty((3, room), np.int64)], axis=1)
        floats = np.concatenate([self._floats, np.empty((self._floats.shape[0], room))], axis=1)
        values, apart, cross = floats[:CHANNELS], floats[CHANNELS:2 * CHANNELS], floats[2 * CHANNELS:]
        count, done = align.align_block(
            np.ascontiguousarray(t_ns), frames, self._how, self.plan.lead, self.plan.counter_wrap, self._wait,
            at_end, self._align, ints[0], ints[1], ints[2], values, apart, cross, waiting)
        self._ints, self._floats = ints[:, done:count].copy(), floats[:, done:count].copy()
        v = np.ascontiguousarray(values[:, :done])
        distance = np.ascontiguousarray(apart[:, :done])
        out = np.empty((convert.OUTPUTS, done))
        quality = np.empty(done, np.uint8)
        convert.convert_block(ints[0, :done], v, distance, np.ascontiguousarray(cross[:, :done]), self._settings,
                              self._convert, out, quality)
        encoder = out[convert.THETA] if self._measured else v[ENCODER]
        return MappedBlock(
            ints[0, :done].copy(), ints[1, :done].copy(), ints[2, :done].copy(), out[convert.I_ALPHA],
            out[convert.I_BETA], out[convert.V_ALPHA], out[convert.V_BETA], out[convert.I_D], out[convert.I_Q],
            out[convert.V_D], out[convert.V_Q], out[convert.THETA], encoder, v[OMEGA], out[convert.TURNING],
            v[V_DC], v[TORQUE], v[TEMPERATURE], quality, distance)


def mapped(reader: Iterable[FrameBlock], inverter: InverterMap, *, node: int | None = None,
           pole_pairs: int | None = None, rate: float | None = None) -> Iterator[MappedBlock]:
    """The samples of a drive in the frames of a log, in blocks.

    reader: blocks of frames, such as `logs.read_log` gives.  node: instead of the map's.  pole_pairs: of the motor,
    where angles or speeds are those of the shaft.  rate: samples per second, where the map does not say.
    The mean voltage belongs to the interval that ended at the sample, but for `inverter.voltage.delay` samples.
    Raises MapError or DbcError at the first block asked for; frames never raise.
    """
    if rate is not None and not (math.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; allowed is a number above 0, in Hz")
    mapper = Mapper(make_plan(inverter, node=node, pole_pairs=pole_pairs), rate)
    for block in reader:
        part = mapper.feed(block)
        if len(part):
            yield part
    part = mapper.flush()
    if len(part):
        yield part
