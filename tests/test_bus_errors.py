"""Error frames as drivers build them (linux/can/error.h), written down by hand here."""

from __future__ import annotations

import numpy as np

from ipmsm_can.bus.errors import BusState, ErrorClass, ErrorCounters, decode_errors
from ipmsm_can.frames import FrameBlock


def block_of(*frames: str) -> FrameBlock:
    """Rows from "id#data" in hexadecimal, as in a candump log."""
    block = FrameBlock.zeros(len(frames))
    for row, text in enumerate(frames):
        can_id, data = text.split("#")
        payload = bytes.fromhex(data)
        block.can_id[row] = int(can_id, 16)
        block.raw[row, 4] = len(payload)
        block.raw[row, 8:8 + len(payload)] = np.frombuffer(payload, np.uint8)
        block.t_ns[row] = 1000 + row
    return block


def test_what_drivers_send() -> None:
    block = block_of(
        "00000123#1122334455667788",   # no error frame
        "20000204#0008000000006000",   # controller: tx warning, counters 96 / 0
        "20000204#0030000000008085",   # rx and tx passive, counters 128 / 133
        "20000040#0000000000000000",   # bus-off
        "20000100#0000000000000000",   # restarted
        "20000204#0040000000000100",   # back to error active
        "20000004#0003000000000000",   # rx and tx overflow, no state
        "2000008C#0010810A00000000",   # bus error, rx passive, protocol: single bit in data
        "20000020#",                   # no acknowledgement
    )
    errors = decode_errors(block)
    assert errors.row.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert errors.t_ns.tolist() == [1001 + k for k in range(8)]
    assert errors.state.tolist() == [
        BusState.WARNING, BusState.PASSIVE, BusState.BUS_OFF, BusState.ACTIVE, BusState.ACTIVE,
        BusState.UNKNOWN, BusState.PASSIVE, BusState.UNKNOWN]
    assert errors.tx_errors.tolist() == [96, 128, -1, -1, 1, -1, -1, -1]
    assert errors.rx_errors.tolist() == [0, 133, -1, -1, 0, -1, -1, -1]
    assert errors.rx_overflow.tolist() == [False] * 5 + [True] + [False] * 2
    assert errors.tx_overflow.tolist() == [False] * 5 + [True] + [False] * 2
    assert errors.protocol.tolist() == [0] * 6 + [0x81, 0]
    assert errors.location.tolist() == [0] * 6 + [0x0A, 0]
    assert errors.sentence(0) == "controller: error warning (a counter above 96); error counters tx 96 rx 0"
    assert errors.sentence(2) == "bus-off"
    assert "receive buffer overflow, transmit buffer overflow" in errors.sentence(5)
    assert "single bit error while transmitting in data" in errors.sentence(6)
    assert errors.sentence(7).startswith("no acknowledgement")


def test_counters_add_up_over_blocks() -> None:
    counters = ErrorCounters()
    assert counters.summary() == "no error frames"
    counters.update(block_of("00000123#11", "20000204#0008000000006000"))
    assert (counters.frames, counters.state, counters.tx_errors) == (1, BusState.WARNING, 96)
    counters.update(block_of("20000040#0000000000000000", "20000040#0000000000000000"))
    assert (counters.bus_offs, counters.restarts, counters.state) == (2, 0, BusState.BUS_OFF)
    counters.update(block_of("20000100#0000000000000000"))
    assert (counters.restarts, counters.state, counters.worst) == (1, BusState.ACTIVE, BusState.BUS_OFF)
    counters.update(block_of("20000004#0001000000000000", "00000001#"))
    assert counters.counts[ErrorClass.CONTROLLER] == 2
    assert counters.overflows == 1
    assert counters.state == BusState.ACTIVE
    text = counters.summary()
    assert text.startswith("5 error frames: 2 x controller problem, 2 x bus-off, 1 x controller restarted")
    assert "now error active (normal), worst bus-off (silent)" in text
    assert text.endswith("overflowed 1 x; error counters tx 96 rx 0")
    assert counters.last == "controller: receive buffer overflow"


def test_every_state_bit_on_its_own() -> None:
    expected = {0x04: BusState.WARNING, 0x08: BusState.WARNING, 0x10: BusState.PASSIVE,
                0x20: BusState.PASSIVE, 0x40: BusState.ACTIVE, 0x01: BusState.UNKNOWN, 0x24: BusState.PASSIVE}
    errors = decode_errors(block_of(*(f"20000004#00{bit:02X}000000000000" for bit in expected)))
    assert errors.state.tolist() == list(expected.values())
    # without the controller class the byte means nothing
    assert decode_errors(block_of("20000008#0020000000000000")).state[0] == BusState.UNKNOWN


def test_last_state_of_a_block_holds() -> None:
    counters = ErrorCounters()
    counters.update(block_of("20000204#0008000000006000", "20000204#0020000000008800", "20000001#",
                             "20000204#0040000000000500"))
    assert (counters.state, counters.worst, counters.tx_errors) == (BusState.ACTIVE, BusState.PASSIVE, 5)


def test_bytes_beyond_the_length_tell_nothing() -> None:
    block = block_of("20000204#00FF00000000FFFF")
    block.raw[0, 4] = 1
    errors = decode_errors(block)
    assert errors.state[0] == BusState.UNKNOWN
    assert errors.tx_errors[0] == -1


def test_any_rubbish_is_decoded() -> None:
    rng = np.random.default_rng(0)
    block = FrameBlock(rng.integers(0, 256, (3000, 72)).astype(np.uint8), np.zeros(3000, np.int64))
    counters = ErrorCounters()
    errors = counters.update(block)
    assert len(errors) == np.count_nonzero(block.raw[:, 3] & 0x20) > 1000
    assert all(errors.sentence(k) for k in range(len(errors)))
    assert counters.summary()
