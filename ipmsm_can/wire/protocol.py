"""The project's own nine messages, bound to a database: identifiers, enumerations, protection.

The names of messages and signals, the enumerations and the widths of the counters are fixed here; where a
signal lies and how it is scaled stands in the DBC only.  A user with a larger inverter edits factors in a
copy of ipmsm_can.dbc and loads that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK
from ipmsm_can.wire.codec import MessageCodec
from ipmsm_can.wire.dbc import Database, DbcError, default_dbc_path
from ipmsm_can.wire.e2e import E2EProtection

TWO_PI = 2.0 * math.pi
NODES = 16
BLOCK_SAMPLES = 7
PROTOCOL_VERSION = 1

UNKNOWN = -1
ERROR_FRAME = -2
REMOTE_FRAME = -3
WRONG_LENGTH = -4


class MessageKind(IntEnum):
    """The nine messages; kind * 16 + node names a message of a node in `id_lut` and `classify`."""

    DRIVE_SAMPLE = 0
    DRIVE_SAMPLE_BLOCK = 1
    DRIVE_TIMING = 2
    DRIVE_STATUS = 3
    DRIVE_REFERENCE = 4
    POSITION_ESTIMATE = 5
    INJECTION_COMMAND = 6
    ACTIVE_FLUX_ESTIMATE = 7
    COMPANION_STATUS = 8

    @property
    def message(self) -> str:
        """Name of the message in the DBC, e.g. DriveSample."""
        return self.name.title().replace("_", "")


class Waveform(IntEnum):
    """Probing signal of InjectionCommand.waveform and DriveStatus.active_waveform."""

    OFF = 0
    ROTATING = 1
    PULSATING = 2
    POLARITY_PULSES = 3


class DriveMode(IntEnum):
    """DriveStatus.mode."""

    OFF = 0
    READY = 1
    RUNNING = 2
    FAULT = 3
    SAFE_STOP = 4


class CompanionState(IntEnum):
    """CompanionStatus.state."""

    WAITING_FOR_SAMPLES = 0
    WAITING_FOR_TIMING = 1
    STARTING = 2
    TRACKING = 3
    LOCKED = 4
    STALE = 5
    FAULT = 6


class ObserverKind(IntEnum):
    """CompanionStatus.observer."""

    GES = 0
    RICCATI = 1
    SPMSM_GRADIENT = 2
    SPMSM_GRADIENT_MAX = 3
    SPMSM_REGRESSION = 4
    ACTIVE_FLUX_REGRESSION = 5
    CHONAM = 6
    INJECTION_EXTRACTION = 7
    INJECTION_DEMODULATION = 8


class InjectionState(IntEnum):
    """CompanionStatus.injection_state."""

    DISABLED = 0
    OFF = 1
    RAMP_UP = 2
    ON = 3
    RAMP_DOWN = 4
    LIMITED = 5
    POLARITY_PULSES = 6


class InjectionReason(IntEnum):
    """CompanionStatus.injection_reason."""

    NONE = 0
    DISABLED_BY_CONFIGURATION = 1
    TRANSMIT_NOT_ENABLED = 2
    LOW_SPEED = 3
    POOR_EXCITATION = 4
    SPEED_HIGH_ENOUGH = 5
    CURRENT_LIMIT = 6
    NO_SAMPLES = 7
    OPERATOR = 8
    DRIVE_NOT_RUNNING = 9
    POLARITY_UNKNOWN = 10
    POLARITY_UNKNOWABLE = 11


# Every signal the program reads or writes, with its width where a counter's modulus or a flag depends on it.
_AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")
_ANY = 0
_P02_HEADER = {"e2e_crc": 8, "e2e_counter": 4}
_REQUIRED: dict[MessageKind, dict[str, int]] = {
    MessageKind.DRIVE_SAMPLE: {**dict.fromkeys(_AXES, _ANY), "sample_counter": 4},
    MessageKind.DRIVE_SAMPLE_BLOCK: {
        "e2e_crc": 16, "e2e_counter": 8, "first_sample": 32, "sample_count": _ANY,
        **{f"{axis}_{j}": _ANY for j in range(BLOCK_SAMPLES) for axis in _AXES}},
    MessageKind.DRIVE_TIMING: {"sample_counter": 32, "sample_rate": _ANY},
    MessageKind.DRIVE_STATUS: {
        "mode": _ANY, "active_waveform": _ANY, "encoder_available": 1, "faults": 8, "v_dc": _ANY,
        "temperature": _ANY, "protocol_version": _ANY, "rejected_commands": 8},
    MessageKind.DRIVE_REFERENCE: {"theta_e": _ANY, "omega_e": _ANY, "sample_counter": 32},
    MessageKind.POSITION_ESTIMATE: {
        **_P02_HEADER, "theta_e": _ANY, "omega_e": _ANY, "sigma_theta": _ANY, "sample_counter": 10,
        "valid": 1, "locked": 1, "polarity_known": 1, "injecting": 1},
    MessageKind.INJECTION_COMMAND: {
        **_P02_HEADER, "waveform": _ANY, "amplitude": _ANY, "frequency": _ANY, "axis_angle": _ANY,
        "time_to_live": _ANY},
    MessageKind.ACTIVE_FLUX_ESTIMATE: {
        "x_alpha": _ANY, "x_beta": _ANY, "excitation_level": _ANY, "innovation": _ANY},
    MessageKind.COMPANION_STATUS: {
        "state": _ANY, "observer": _ANY, "injection_state": _ANY, "injection_reason": _ANY, "bus_load": _ANY,
        "lost_samples": 12, "bad_frames": 10, "turnaround": _ANY, "version": _ANY},
}
_PROFILES = {MessageKind.DRIVE_SAMPLE_BLOCK: "P05", MessageKind.POSITION_ESTIMATE: "P02",
             MessageKind.INJECTION_COMMAND: "P02"}


@kernel
def _classify(words: NDArray[np.uint64], id_lut: NDArray[np.int16], lengths: NDArray[np.int64],
              out: NDArray[np.int16]) -> None:
    for k in range(words.shape[0]):
        header = np.int64(words[k, 0])
        if header & CAN_ERR_FLAG:
            out[k] = ERROR_FRAME
            continue
        label = id_lut[header & CAN_SFF_MASK]
        if header & CAN_EFF_FLAG or label < 0:
            out[k] = UNKNOWN
        elif header & CAN_RTR_FLAG:
            out[k] = REMOTE_FRAME
        elif (header >> 32) & 0xFF != lengths[label >> 4]:
            out[k] = WRONG_LENGTH
        else:
            out[k] = label


class Protocol:
    """The nine messages as one database describes them.

    database: whose layouts and scalings hold; the project's own if None.
    codecs: MessageCodec by kind; base_ids: int64 (9,), identifier of node 0 by kind.
    id_lut: int16 (2048,), kind * 16 + node, or -1, for an 11-bit identifier.

    Raises DbcError naming the first message, signal or attribute that is missing or does not fit.
    """

    def __init__(self, database: Database | None = None) -> None:
        self.database = Database.load(default_dbc_path()) if database is None else database
        self.codecs: Mapping[MessageKind, MessageCodec] = {k: self._bind(k) for k in MessageKind}
        self.base_ids = np.array([self.codecs[kind].frame_id for kind in MessageKind], np.int64)
        self._lengths = np.array([self.codecs[kind].length for kind in MessageKind], np.int64)
        self.id_lut = self._build_lut()
        self._protection = {(kind, node): self._bind_protection(kind, node)
                            for kind in _PROFILES for node in range(NODES)}

    def _error(self, text: str) -> DbcError:
        return DbcError(f"{self.database.source} does not fit the protocol: {text}")

    def _bind(self, kind: MessageKind) -> MessageCodec:
        codec = self.database.messages.get(kind.message)
        if codec is None:
            raise self._error(f"message {kind.message} is missing")
        missing = [name for name in _REQUIRED[kind] if name not in codec.index]
        if missing:
            raise self._error(f"message {kind.message} lacks the signals {', '.join(missing)}")
        for name, bits in _REQUIRED[kind].items():
            found = codec.layouts[codec.index[name]].length
            if bits != _ANY and found != bits:
                raise self._error(f"signal {name} of {kind.message} has {found} bits; it must have {bits}")
        if codec.is_extended or codec.frame_id + NODES - 1 > CAN_SFF_MASK:
            raise self._error(f"message {kind.message} has identifier 0x{codec.frame_id:X}; allowed is an "
                              f"11-bit one up to 0x{CAN_SFF_MASK + 1 - NODES:X}, as node n adds n")
        return codec

    def _build_lut(self) -> NDArray[np.int16]:
        lut = np.full(CAN_SFF_MASK + 1, UNKNOWN, np.int16)
        for kind in MessageKind:
            base = self.codecs[kind].frame_id
            taken = lut[base:base + NODES]
            if (taken >= 0).any():
                other = MessageKind(int(taken.max()) // NODES).message
                raise self._error(f"the identifiers of {kind.message} and {other} overlap; "
                                  f"each message needs {NODES} of its own")
            lut[base:base + NODES] = kind * NODES + np.arange(NODES)
        return lut

    def _bind_protection(self, kind: MessageKind, node: int) -> E2EProtection:
        codec, profile = self.codecs[kind], _PROFILES[kind]
        if codec.attributes.get("E2EProfile") != profile:
            raise self._error(f"attribute E2EProfile of {kind.message} is "
                              f"{codec.attributes.get('E2EProfile', '')!r}; it must be {profile!r}")
        for name, start in (("e2e_crc", 0), ("e2e_counter", 16 if profile == "P05" else 8)):
            layout = codec.layouts[codec.index[name]]
            if layout.start != start or layout.motorola or layout.scale != 1.0 or layout.offset != 0.0:
                raise self._error(f"signal {name} of {kind.message} must start at bit {start}, "
                                  "little-endian, with factor 1 and offset 0")
        try:
            protection = E2EProtection.from_attributes(codec.attributes, codec.length, node)
        except ValueError as error:
            raise self._error(f"message {kind.message}: {error}") from error
        assert protection is not None
        return protection

    def angle(self, kind: MessageKind, signal: str, radians: ArrayLike) -> NDArray[np.float64]:
        """The angle as that signal can carry it, 0..2 pi: what would round up to a whole turn becomes 0.

        Encoding saturates; without this, angles within half a step below 2 pi would be a step and a half off.
        """
        codec = self.codecs[kind]
        step = codec.layouts[codec.index[signal]].scale
        turned = np.asarray(radians, np.float64) % TWO_PI
        return np.where(turned >= TWO_PI - 0.5 * step, 0.0, turned)

    def protection(self, kind: MessageKind, node: int) -> E2EProtection | None:
        """End-to-end parameters of a message of a node, None if it is not protected."""
        return self._protection.get((kind, node))

    def classify(self, raw: NDArray[np.uint8]) -> NDArray[np.int16]:
        """What each row is, int16 (N,): kind * 16 + node, or -1 not one of ours, -2 error frame,
        -3 remote frame and -4 wrong payload length under one of our identifiers.

        raw: uint8 (N, 72), C-contiguous.  Extended identifiers are never ours.
        """
        out = np.empty(raw.shape[0], np.int16)
        _classify(raw.view(np.uint64), self.id_lut, self._lengths, out)
        return out

    def encode(self, kind: MessageKind, node: int, values: NDArray[np.float64] | Mapping[str, ArrayLike],
               counters: ArrayLike | None = None) -> NDArray[np.uint8]:
        """Frames of a message of a node, uint8 (N, 72); a protected message gets its counter and CRC.

        values: as for MessageCodec.encode; e2e_crc and e2e_counter in it are overwritten.
        counters: integers, scalar or (N,), taken modulo the profile's range; needed for protected messages.
        Raises ValueError for a node outside 0..15 or if counters are missing.
        """
        if not 0 <= node < NODES:
            raise ValueError(f"node is {node}; allowed is 0 to {NODES - 1}")
        raw = self.codecs[kind].encode(values)
        raw.view(np.uint32)[:, 0] += np.uint32(node)
        protection = self.protection(kind, node)
        if protection is not None:
            if counters is None:
                raise ValueError(f"{kind.message} is protected; encode needs its counters")
            numbers = np.asarray(counters, np.int64)
            if numbers.shape != raw.shape[:1]:
                numbers = np.array(np.broadcast_to(numbers, raw.shape[:1]))
            protection.protect(raw, numbers)
        return raw

    def decode(self, kind: MessageKind, node: int, raw: NDArray[np.uint8],
               rows: NDArray[np.intp] | None = None,
               ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
        """(values, intact, counters) of rows known to be this message of this node.

        values: float64 (n_signals, N), rows as in `codecs[kind].signals`, decoded even where not intact.
        intact, counters: as E2EProtection.check; all True and 0 for an unprotected message.
        raw: uint8 (M, 72), C-contiguous.  rows: intp (N,), all rows if None.
        """
        words = raw.view(np.uint64)
        codec = self.codecs[kind]
        values = codec.decode(words) if rows is None else codec.decode_rows(words, rows)
        protection = self.protection(kind, node)
        if protection is None:
            return values, np.ones(values.shape[1], np.bool_), np.zeros(values.shape[1], np.int64)
        intact, counters = protection.check(raw, rows)
        return values, intact, counters
