"""A map held against its DBC: every value it names as a channel, with the message that carries it.

What cannot work is said here in one sentence, with the names that are near.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.config.load import nearest_word
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_SFF_MASK
from ipmsm_can.mapping.load import MapError
from ipmsm_can.mapping.model import AngleMap, InverterMap
from ipmsm_can.mapping.signals import SignalRef
from ipmsm_can.wire.codec import MessageCodec
from ipmsm_can.wire.dbc import Database

(I_0, I_1, I_2, V_0, V_1, V_2, ANGLE, ENCODER, OMEGA, V_DC, TORQUE, TEMPERATURE, COUNTER, RATE) = range(14)
"""Channels: rows of every array of values inside the mapping."""
CHANNELS = 14
AC_CHANNELS = 6
"""The first ones are currents and voltages."""

ABSENT, INTERPOLATE, HOLD, CIRCLE, CONSTANT = range(5)
"""How a channel is brought to the time of a sample."""

_TURN = {"deg": math.pi / 180.0, "rad": 1.0, "turns": 2.0 * math.pi}
_SPEED = {"rad/s": 1.0, "Hz": 2.0 * math.pi, "rpm": 2.0 * math.pi / 60.0, "turns/s": 2.0 * math.pi}

_SHOWN = {ANGLE: 180.0 / math.pi, ENCODER: 180.0 / math.pi, OMEGA: 0.5 / math.pi}


@dataclass(frozen=True, slots=True)
class Channel:
    """One value of the map.  key: where it stands in the map, "current.a".  value = gain * DBC value + offset, in
    A, V, rad electrical, rad/s electrical, N m, degC; how: INTERPOLATE, HOLD, CIRCLE or CONSTANT.

    unit, scale: what to show it in, and the factor into that.
    """

    number: int
    key: str
    ref: SignalRef
    how: int
    gain: float
    offset: float
    unit: str = ""
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """One message of the map.  can_id: with the node and CAN_EFF_FLAG; rows: of the codec, one per channel."""

    codec: MessageCodec
    can_id: int
    channels: tuple[Channel, ...]
    rows: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be decoded, and which frame makes a sample.

    lead: the channel whose report is the instant of a sample.  counter_wrap: values of the counter, 0 without one.
    """

    map: InverterMap
    channels: tuple[Channel, ...]
    sources: tuple[Source, ...]
    lead: int
    counter_wrap: int

    @property
    def how(self) -> NDArray[np.int64]:
        """int64 (CHANNELS,): how each channel is brought to the time of a sample."""
        out = np.zeros(CHANNELS, np.int64)
        for channel in self.channels:
            out[channel.number] = channel.how
        return out

    def source_of(self, channel: Channel) -> Source | None:
        """The message that carries a channel; None for a constant."""
        return next((s for s in self.sources if channel in s.channels), None)


def make_plan(inverter: InverterMap, *, node: int | None = None, pole_pairs: int | None = None) -> Plan:
    """Hold a map against its DBC.

    node: instead of the map's.  pole_pairs: of the motor, where angles or speeds of the shaft need them; what the
    map says comes first.
    Raises MapError, or DbcError for a DBC that cannot be read.
    """
    database = Database.load(inverter.map.dbc, strict=inverter.map.strict)
    pairs = inverter.map.pole_pairs or pole_pairs
    if inverter.needs_pole_pairs and pairs is None:
        raise MapError(f"{inverter.needs_pole_pairs} counts turns of the shaft, and the pole pairs of the motor "
                       "are not known; give them with --pole-pairs, map.pole_pairs or a drive.toml")
    channels = _channels(inverter, pairs or 1)
    named = {c.ref.message for c in channels if not c.ref.is_constant}
    sources = tuple(_source(inverter, database, message, [c for c in channels if c.ref.message == message], node)
                    for message in sorted(named))
    if inverter.map.identifiers == "either length":
        plain = [s.can_id & CAN_EFF_MASK for s in sources]
        twice = [i for i in plain if plain.count(i) > 1]
        if twice:
            raise MapError('map.identifiers is "either length", and two messages of the map have the identifier '
                           f'0x{twice[0]:X} in both lengths; allowed is "as in the DBC"')
    lead = next((c for c in channels if not c.ref.is_constant), None)
    if lead is None:
        raise MapError(f"the map {inverter.map.title!r} names no signal, only constants")
    wrap = 0
    counter = inverter.timing.counter
    if counter is not None:
        if counter.message != lead.ref.message:
            raise MapError(f"timing.counter is {counter}; allowed is a signal of the message of {lead.key}, "
                           f"{lead.ref.message}")
        source = next(s for s in sources if s.codec.name == counter.message)
        layout = source.codec.layouts[source.codec.index[counter.signal]]
        wrap = 1 << (inverter.timing.bits or min(32, layout.length))
    return Plan(inverter, tuple(channels), sources, lead.number, wrap)


def _channels(inverter: InverterMap, pole_pairs: int) -> list[Channel]:
    found: list[Channel] = []
    duty = inverter.voltage is not None and inverter.voltage.form == "duty"
    units = {**dict.fromkeys((I_0, I_1, I_2), "A"), **dict.fromkeys((V_0, V_1, V_2), "" if duty else "V"),
             ANGLE: "deg", ENCODER: "deg", OMEGA: "Hz electrical", V_DC: "V", TORQUE: "N m", TEMPERATURE: "degC",
             COUNTER: "", RATE: "Hz"}

    def add(number: int, key: str, ref: SignalRef | None, factor: float = 1.0, offset: float = 0.0,
            how: int = INTERPOLATE) -> None:
        if ref is None:
            return
        if ref.is_constant:
            found.append(Channel(number, key, ref, CONSTANT, 0.0, ref.constant * factor + offset, units[number],
                                 _SHOWN.get(number, 1.0)))
            return
        how = HOLD if ref.method == "hold" else how
        found.append(Channel(number, key, ref, how, ref.sign * ref.gain * factor,
                             ref.sign * ref.offset * factor + offset, units[number], _SHOWN.get(number, 1.0)))

    def add_angle(number: int, name: str, part: AngleMap | None) -> None:
        if part is not None:
            turns = part.direction * (pole_pairs if part.of == "shaft" else 1)
            add(number, f"{name}.signal", part.signal, turns * _TURN[part.unit],
                -part.direction * math.radians(part.zero), CIRCLE)

    for first, name in ((I_0, "current"), (V_0, "voltage")):
        section = inverter.current if name == "current" else inverter.voltage
        if section is not None:
            keys = {id(getattr(section, k)): k for k in type(section).model_fields}
            for j, ref in enumerate(section.components):
                add(first + j, f"{name}.{keys.get(id(ref), '')}", ref)
    add_angle(ANGLE, "angle", inverter.angle)
    add_angle(ENCODER, "encoder", inverter.encoder)
    if inverter.speed is not None:
        unit, of = inverter.speed.unit.split()
        add(OMEGA, "speed.signal", inverter.speed.signal, _SPEED[unit] * (pole_pairs if of == "shaft" else 1))
    for number, name in ((V_DC, "dc_voltage"), (TORQUE, "torque"), (TEMPERATURE, "temperature")):
        part = getattr(inverter, name)
        if part is not None:
            add(number, f"{name}.signal", part.signal)
    add(COUNTER, "timing.counter", inverter.timing.counter, how=HOLD)
    add(RATE, "timing.rate_signal", inverter.timing.rate_signal, how=HOLD)
    return found


def _source(inverter: InverterMap, database: Database, message: str, channels: list[Channel],
            node: int | None) -> Source:
    codec = database.messages.get(message)
    if codec is None:
        raise MapError(f"{channels[0].key} is {str(channels[0].ref)!r}, and {database.source} has no message "
                       f"{message!r}{_near(message, list(database.messages), 'it has')}")
    for channel in channels:
        if channel.ref.signal not in codec.index:
            near = _near(channel.ref.signal, list(codec.signals), "it has")
            raise MapError(f"{channel.key} is {str(channel.ref)!r}, and message {message} of {database.source} has "
                           f"no signal {channel.ref.signal!r}{near}")
    number = inverter.map.node if node is None else node
    can_id = codec.frame_id + (number << inverter.map.node_shift)
    most = CAN_EFF_MASK if codec.is_extended else CAN_SFF_MASK
    if number < 0 or can_id > most:
        raise MapError(f"node {number} gives message {message} the identifier 0x{can_id:X}; allowed is "
                       f"0x{most:X} at most")
    rows = np.array([codec.index[c.ref.signal] for c in channels], np.intp)
    return Source(codec, can_id | (CAN_EFF_FLAG if codec.is_extended else 0), tuple(channels), rows)


def _near(word: str, known: list[str], has: str) -> str:
    guess = nearest_word(word, known)
    shown = ", ".join(known[:12]) + (f" and {len(known) - 12} more" if len(known) > 12 else "")
    return (f"; did you mean {guess}?" if guess else ";") + f" ({has} {shown or 'none'})"
