"""How long frames occupy the bus: exact bits on the wire, stuff bits included, and the bus load.

Counted from start of frame to the end of the interframe space (ISO 11898-1:2015, 10.4 and 10.5;
Bosch CAN 2.0).  Acknowledge and intermission are taken at their nominal length, so the figures are those
of a bus without errors.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.frames import FrameBlock


@kernel
def _byte(raw: NDArray[np.uint8], row: int, column: int) -> int:
    """One byte as a signed machine word: shifting or adding uint8 would not do what the field means."""
    value: int = 0 + raw[row, column]
    return value


@kernel
def _stuff(bit: int, run: int, last: int) -> tuple[int, int, int]:
    """Send one bit: (bits on the wire 1 or 2, length of the run of equal bits, last bit sent).

    After five equal bits the complement follows at once; the caller drops it where the rule has ended.
    """
    run = run + 1 if bit == last else 1
    if run == 5:
        return 2, 1, 1 - bit
    return 1, run, bit


@kernel
def _header(can_id: int, is_fd: bool, flags: int, dlc: int) -> tuple[int, int, int]:
    """Bits from start of frame to the DLC as a number, how many, and how many of them end with BRS."""
    extended = can_id & 0x80000000
    remote = 1 if can_id & 0x40000000 and not is_fd else 0
    if extended:
        ident = can_id & 0x1FFFFFFF
        # SOF, 11 bits, SRR, IDE, 18 bits
        word = (((ident >> 18) << 2 | 3) << 18) | (ident & 0x3FFFF)
        n = 1 + 11 + 2 + 18
    else:
        word = can_id & 0x7FF
        n = 1 + 11
    if is_fd:
        brs = flags & 0x01
        esi = (flags >> 1) & 1
        word <<= 1  # RRS
        n += 1
        if not extended:
            word <<= 1  # IDE
            n += 1
        word = (((word << 1 | 1) << 1) << 1 | brs) << 1 | esi  # FDF, res, BRS, ESI
        n += 4
        arbitration = n - 1
    else:
        word = (word << 1 | remote) << 2  # RTR, then IDE and r0, or r1 and r0
        n += 3
        arbitration = n
    return word << 4 | dlc, n + 4, arbitration


@kernel
def _classical(raw: NDArray[np.uint8], row: int, can_id: int) -> int:
    length = min(_byte(raw, row, 4), 8)
    word, n, _ = _header(can_id, False, 0, length)
    crc = 0
    total = 0
    run = 0
    last = -1
    for j in range(n):
        bit = (word >> (n - 1 - j)) & 1
        wire, run, last = _stuff(bit, run, last)
        total += wire
        crc = ((crc << 1) & 0x7FFF) ^ (0x4599 if bit != crc >> 14 else 0)
    if not can_id & 0x40000000:
        for k in range(length):
            byte = _byte(raw, row, 8 + k)
            for j in range(8):
                bit = (byte >> (7 - j)) & 1
                wire, run, last = _stuff(bit, run, last)
                total += wire
                crc = ((crc << 1) & 0x7FFF) ^ (0x4599 if bit != crc >> 14 else 0)
    for j in range(15):
        wire, run, last = _stuff((crc >> (14 - j)) & 1, run, last)
        total += wire
    # CRC delimiter 1, ACK slot 1, ACK delimiter 1, end of frame 7, intermission 3
    return total + 13


@kernel
def _flexible(raw: NDArray[np.uint8], row: int, can_id: int) -> tuple[int, int]:
    given = min(_byte(raw, row, 4), 64)
    length, dlc = given, given
    if given > 8:  # the wire knows 12, 16, 20, 24, 32, 48, 64
        if given <= 24:
            length = (given + 3) // 4 * 4
            dlc = 6 + length // 4
        else:
            length = 32 if given <= 32 else (48 if given <= 48 else 64)
            dlc = 11 + length // 16
    flags = _byte(raw, row, 5)
    word, n, arbitration = _header(can_id, True, flags, dlc)
    nominal = 0
    data = 0
    run = 0
    last = -1
    wire = 1
    for j in range(n):
        wire, run, last = _stuff((word >> (n - 1 - j)) & 1, run, last)
        if j < arbitration:
            nominal += wire
        else:
            data += wire
    for k in range(length):
        byte = _byte(raw, row, 8 + k) if k < given else 0
        for j in range(8):
            wire, run, last = _stuff((byte >> (7 - j)) & 1, run, last)
            data += wire
    # a stuff bit due after the last data bit is not sent: the first fixed stuff bit stands in for it
    data -= wire - 1
    # stuff count 4, CRC, a fixed stuff bit before every 4 of those bits; CRC delimiter
    crc = 17 if length <= 16 else 21
    data += 4 + crc + (4 + crc + 3) // 4 + 1
    nominal += 12  # ACK slot 1, ACK delimiter 1, end of frame 7, intermission 3
    if flags & 0x01:
        return nominal, data
    return nominal + data, 0


@kernel
def _frame_bits(raw: NDArray[np.uint8], nominal: NDArray[np.int64], data: NDArray[np.int64]) -> None:
    for row in range(raw.shape[0]):
        can_id = 0
        for k in range(4):
            can_id |= _byte(raw, row, k) << (8 * k)
        data[row] = 0
        if can_id & 0x20000000:
            nominal[row] = 0
        elif raw[row, 5] & 0x04:
            nominal[row], data[row] = _flexible(raw, row, can_id)
        else:
            nominal[row] = _classical(raw, row, can_id)


def frame_bits(block: FrameBlock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bits each frame takes on the wire, interframe space included: (nominal, data), int64 (N,) each.

    nominal: sent at the nominal (arbitration) bit rate; data: sent at the data bit rate, which is 0 for
    classical frames and for CAN FD without bit rate switch.  The switch falls inside two bits, at their
    sample points; BRS is counted as nominal and the CRC delimiter as data, which is exact when both
    phases sample at the same fraction of a bit.  A CAN FD payload of a length the wire does not know is
    counted as the next one, padded with 0.  Rows with CAN_ERR_FLAG are no frames on the wire and count 0.
    """
    nominal, data = np.empty(len(block), np.int64), np.empty(len(block), np.int64)
    _frame_bits(np.ascontiguousarray(block.raw), nominal, data)
    return nominal, data


def _check_rates(bitrate: float, data_bitrate: float | None) -> tuple[float, float]:
    for name, rate in (("bitrate", bitrate), ("data_bitrate", data_bitrate)):
        if rate is not None and not (math.isfinite(rate) and rate > 0):
            raise ValueError(f"{name} is {rate!r}; allowed is a finite number above 0, in bit/s")
    return bitrate, bitrate if data_bitrate is None else data_bitrate


def frame_seconds(block: FrameBlock, bitrate: float, data_bitrate: float | None = None
                  ) -> NDArray[np.float64]:
    """Time each frame occupies the bus [s], float64 (N,).

    bitrate, data_bitrate: bit/s, > 0; None means that the data phase is not faster.
    Raises ValueError for a bit rate that is not above 0.
    """
    bitrate, data_bitrate = _check_rates(bitrate, data_bitrate)
    nominal, data = frame_bits(block)
    return nominal / bitrate + data / data_bitrate


# state of the load kernel
_HEAD, _FIRST, _LAST = 0, 1, 2


@kernel
def _advance(t_ns: int, bin_ns: int, bins: NDArray[np.int64], state: NDArray[np.int64]) -> None:
    """Move the window so that it ends with the bin of t_ns; start afresh after a jump back in time."""
    n = bins.shape[0]
    at = t_ns // bin_ns
    if state[0] < 0 or at <= state[0] - n:
        bins[:, :] = 0
        state[0] = at
        state[1] = t_ns
        state[2] = t_ns
        return
    if at > state[0]:
        for k in range(min(at - state[0], n)):
            bins[(at - k) % n, :] = 0
        state[0] = at
    state[2] = max(state[2], t_ns)


@kernel
def _load(t_ns: NDArray[np.int64], nominal: NDArray[np.int64], data: NDArray[np.int64], bin_ns: int,
          bins: NDArray[np.int64], state: NDArray[np.int64]) -> None:
    n = bins.shape[0]
    for row in range(t_ns.shape[0]):
        if t_ns[row] < 0:
            continue
        _advance(t_ns[row], bin_ns, bins, state)
        at = (t_ns[row] // bin_ns) % n
        bins[at, 0] += nominal[row]
        bins[at, 1] += data[row]


class BusLoad:
    """Share of time the bus is busy, over a sliding window; fed with blocks, has no clock.

    bitrate, data_bitrate: bit/s, > 0.  window_s: length of the window, > 0; it moves in steps of 1/20.
    The figure is the same however the frames are cut into blocks.  A jump back in time by more than the
    window (a log started again) starts the window afresh.
    Raises ValueError for a bit rate or window that is not above 0.
    """

    _BINS = 20

    def __init__(self, bitrate: float, data_bitrate: float | None = None, window_s: float = 1.0) -> None:
        self._bitrate, self._data_bitrate = _check_rates(bitrate, data_bitrate)
        if not (math.isfinite(window_s) and window_s > 0):
            raise ValueError(f"window_s is {window_s!r}; allowed is a finite number of seconds above 0")
        self._bin_ns = max(1, round(window_s * 1e9 / self._BINS))
        self._bins = np.zeros((self._BINS, 2), np.int64)
        self._state = np.array([-1, 0, 0], np.int64)
        self.update(FrameBlock.zeros(0))

    def update(self, block: FrameBlock, bits: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None) -> None:
        """Count the frames of a block at their t_ns.  bits: what `frame_bits` says of it, where that is known."""
        nominal, data = frame_bits(block) if bits is None else bits
        _load(np.ascontiguousarray(block.t_ns), nominal, data, self._bin_ns, self._bins, self._state)

    def load(self, now_ns: int | None = None) -> float:
        """Busy share, 0..1, of the window that ends at now_ns (default: at the last frame); 0 before any.

        Before a whole window has passed, of the time since the first frame, but at least one step.
        Moves the window: frames before it are forgotten.  More than 1 means wrong bit rates or times.
        """
        if self._state[_HEAD] < 0:
            return 0.0
        if now_ns is not None and now_ns > self._state[_LAST]:
            _advance(now_ns, self._bin_ns, self._bins, self._state)
        nominal, data = self._bins.sum(axis=0)
        begin = max((int(self._state[_HEAD]) - self._BINS + 1) * self._bin_ns, int(self._state[_FIRST]))
        span_ns = max(int(self._state[_LAST]) - begin, self._bin_ns)
        return float((nominal / self._bitrate + data / self._data_bitrate) * 1e9 / span_ns)
