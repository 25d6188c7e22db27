"""End-to-end protection of frames after AUTOSAR profiles 2 and 5, as kernels over blocks of frames.

Profile 2 (8-byte messages): byte 0 is a CRC-8 (polynomial 0x2F, start 0xFF, inverted) over bytes 1..7 and
one byte of a list of 16, chosen by the counter in the low nibble of byte 1.
Profile 5 (CAN FD): bytes 0..1 are a CRC-16 (polynomial 0x1021, start 0xFFFF), low byte first, over the
rest and the 16-bit data identifier, low byte first; byte 2 is the counter.

The identifiers are not sent: a frame that reaches the wrong place fails its check although it is intact.

Source: AUTOSAR Specification of SW-C End-to-End Communication Protection Library, chapters on
E2E profile 2 and profile 5.  The sequence check takes its idea from there, but has one state only: it
accepts the first intact frame, and after a jump it goes on from the frame that jumped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import DATA_OFFSET

_P02, _P05 = 2, 5
_STATE_SIZE = 3
_SEEN, _LAST, _LOST = range(_STATE_SIZE)


class E2EStatus(IntEnum):
    """Verdict on one frame; up to OK_SOME_LOST its content may be used."""

    OK = 0
    OK_SOME_LOST = 1
    REPEATED = 2
    WRONG_SEQUENCE = 3
    WRONG_CRC = 4


_OK, _SOME_LOST, _REPEATED, _WRONG_SEQUENCE, _WRONG_CRC = (int(status) for status in E2EStatus)


def _crc8_table() -> NDArray[np.uint8]:
    table = np.zeros(256, np.uint8)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return table


def _crc16_table() -> NDArray[np.uint16]:
    table = np.zeros(256, np.uint16)
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        table[byte] = crc
    return table


_CRC8 = _crc8_table()
_CRC16 = _crc16_table()


@kernel
def crc_p02(raw: NDArray[np.uint8], r: int, length: int, data_ids: NDArray[np.uint8]) -> int:
    """Profile 2 CRC of row r, whose payload has `length` bytes and already holds its counter."""
    crc = 0xFF
    for j in range(DATA_OFFSET + 1, DATA_OFFSET + length):
        crc = int(_CRC8[crc ^ raw[r, j]])
    crc = int(_CRC8[crc ^ data_ids[raw[r, DATA_OFFSET + 1] & 0x0F]])
    return crc ^ 0xFF


@kernel
def crc_p05(raw: NDArray[np.uint8], r: int, length: int, data_id: int) -> int:
    """Profile 5 CRC of row r, whose payload has `length` bytes and already holds its counter."""
    crc = 0xFFFF
    for j in range(DATA_OFFSET + 2, DATA_OFFSET + length):
        crc = ((crc << 8) & 0xFFFF) ^ int(_CRC16[(crc >> 8) ^ raw[r, j]])
    crc = ((crc << 8) & 0xFFFF) ^ int(_CRC16[(crc >> 8) ^ (data_id & 0xFF)])
    return ((crc << 8) & 0xFFFF) ^ int(_CRC16[(crc >> 8) ^ (data_id >> 8)])


@kernel
def _protect(raw: NDArray[np.uint8], profile: int, length: int, data_ids: NDArray[np.uint8], data_id: int,
             counters: NDArray[np.int64]) -> None:
    for r in range(raw.shape[0]):
        if profile == _P02:
            raw[r, DATA_OFFSET + 1] = (raw[r, DATA_OFFSET + 1] & 0xF0) | (counters[r] & 0x0F)
            raw[r, DATA_OFFSET] = crc_p02(raw, r, length, data_ids)
        else:
            raw[r, DATA_OFFSET + 2] = counters[r] & 0xFF
            crc = crc_p05(raw, r, length, data_id)
            raw[r, DATA_OFFSET] = crc & 0xFF
            raw[r, DATA_OFFSET + 1] = crc >> 8


@kernel
def _check(raw: NDArray[np.uint8], rows: NDArray[np.intp], profile: int, length: int,
           data_ids: NDArray[np.uint8], data_id: int, intact: NDArray[np.bool_],
           counters: NDArray[np.int64]) -> None:
    for k in range(rows.shape[0]):
        r = rows[k]
        if raw[r, 4] != length:
            intact[k] = False
            counters[k] = 0
        elif profile == _P02:
            intact[k] = raw[r, DATA_OFFSET] == crc_p02(raw, r, length, data_ids)
            counters[k] = raw[r, DATA_OFFSET + 1] & 0x0F
        else:
            found = raw[r, DATA_OFFSET] + (np.int64(raw[r, DATA_OFFSET + 1]) << 8)
            intact[k] = found == crc_p05(raw, r, length, data_id)
            counters[k] = raw[r, DATA_OFFSET + 2]


@kernel
def check_sequence(counters: NDArray[np.int64], intact: NDArray[np.bool_], modulus: int, max_delta: int,
                   state: NDArray[np.int64], status: NDArray[np.int64]) -> None:
    """status[k] = verdict on frame k, from its counter, whether its CRC is right, and the frames before it.

    modulus: 16 (profile 2) or 256 (profile 5).  max_delta: largest step of the counter still accepted.
    state: int64 (3,), zeros at the start: seen a frame, last counter, frames lost in accepted steps.
    A frame with a wrong CRC says nothing about the sequence and leaves the state alone.
    """
    for k in range(counters.shape[0]):
        if not intact[k]:
            status[k] = _WRONG_CRC
            continue
        delta = (counters[k] - state[_LAST]) % modulus
        if state[_SEEN] == 0 or delta == 1:
            status[k] = _OK
        elif delta == 0:
            status[k] = _REPEATED
        elif delta <= max_delta:
            status[k] = _SOME_LOST
            state[_LOST] += delta - 1
        else:
            status[k] = _WRONG_SEQUENCE
        state[_SEEN] = 1
        state[_LAST] = counters[k]


def sequence_state() -> NDArray[np.int64]:
    """A fresh state for `check_sequence`: no frame seen yet."""
    return np.zeros(_STATE_SIZE, np.int64)


@dataclass(frozen=True, slots=True)
class E2EProtection:
    """Parameters of one protected message of one node.

    profile: 2 or 5.  length: payload in bytes.
    data_ids: uint8 (16,), profile 2 only.  data_id: 0..65535, profile 5 only.
    Build it with `p02`, `p05` or `from_attributes`, which check.
    """

    profile: int
    length: int
    data_ids: NDArray[np.uint8]
    data_id: int = 0

    @classmethod
    def p02(cls, length: int, data_ids: bytes) -> E2EProtection:
        """Profile 2; ValueError unless there are 16 data_ids and a length of 2..64 bytes."""
        if len(data_ids) != 16:
            raise ValueError(f"E2EDataIDList has {len(data_ids)} bytes; profile P02 needs 16")
        if not 2 <= length <= 64:
            raise ValueError(f"the message has {length} bytes; profile P02 needs 2 to 64")
        return cls(_P02, length, np.frombuffer(data_ids, np.uint8).copy())

    @classmethod
    def p05(cls, length: int, data_id: int) -> E2EProtection:
        """Profile 5; ValueError unless data_id is 0..65535 and length 3..64 bytes."""
        if not 0 <= data_id <= 0xFFFF:
            raise ValueError(f"E2EDataID is {data_id}; allowed is 0 to 65535")
        if not 3 <= length <= 64:
            raise ValueError(f"the message has {length} bytes; profile P05 needs 3 to 64")
        return cls(_P05, length, np.zeros(16, np.uint8), data_id)

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, int | float | str], length: int,
                        node: int = 0) -> E2EProtection | None:
        """From a DBC's attributes E2EProfile, E2EDataID, E2EDataIDList of node 0; None if unprotected.

        node: 0..15; added to the data identifier, and modulo 256 to every byte of the list.
        Raises ValueError for a profile other than P02 and P05 or identifiers that do not fit it.
        """
        profile = attributes.get("E2EProfile", "")
        if profile == "":
            return None
        if profile == "P02":
            text = str(attributes.get("E2EDataIDList", ""))
            try:
                listed = bytes.fromhex(text)
            except ValueError as error:
                raise ValueError(f"E2EDataIDList is {text!r}; allowed are 16 bytes in hex") from error
            return cls.p02(length, bytes((b + node) % 256 for b in listed))
        if profile == "P05":
            return cls.p05(length, int(attributes.get("E2EDataID", -1)) + node)
        raise ValueError(f"E2EProfile is {profile!r}; allowed are P02 and P05")

    @property
    def modulus(self) -> int:
        """Number of counter values: 16 (profile 2) or 256 (profile 5)."""
        return 16 if self.profile == _P02 else 256

    def protect(self, raw: NDArray[np.uint8], counters: NDArray[np.int64]) -> None:
        """Write counter (taken modulo `modulus`) and CRC into the rows, in place.

        raw: uint8 (N, 72), C-contiguous, rows of this message.  counters: int64 (N,).
        """
        _protect(raw, self.profile, self.length, self.data_ids, self.data_id, counters)

    def check(self, raw: NDArray[np.uint8],
              rows: NDArray[np.intp] | None = None) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """(intact, counter) of the rows, bool and int64 (N,); a row of another length is never intact.

        raw: uint8 (M, 72), C-contiguous.  rows: the rows to look at, all of them if None.
        """
        chosen = np.arange(raw.shape[0]) if rows is None else rows
        intact = np.empty(chosen.shape[0], np.bool_)
        counters = np.empty(chosen.shape[0], np.int64)
        _check(raw, chosen, self.profile, self.length, self.data_ids, self.data_id, intact, counters)
        return intact, counters


class SequenceChecker:
    """Counter check of one protected message of one node, across blocks; see `check_sequence`.

    max_delta: largest counter step still accepted, 1..modulus - 1; ValueError otherwise.
    """

    def __init__(self, modulus: int, max_delta: int) -> None:
        if not 1 <= max_delta < modulus:
            raise ValueError(f"max_delta is {max_delta}; allowed is 1 to {modulus - 1}")
        self._modulus, self._max_delta = modulus, max_delta
        self._state = sequence_state()

    @property
    def lost(self) -> int:
        """Frames lost within accepted counter steps, since the start."""
        return int(self._state[_LOST])

    def update(self, intact: NDArray[np.bool_], counters: NDArray[np.int64]) -> NDArray[np.int64]:
        """E2EStatus of each frame, int64 (N,), from what `E2EProtection.check` gave."""
        status = np.empty(counters.shape[0], np.int64)
        check_sequence(counters, intact, self._modulus, self._max_delta, self._state, status)
        return status
