"""What the companion is measured against on the bus: the same duty in the ways people write it today.

    echo   a bare Python loop on a raw socket: recv_into, and a frame back for every n-th sample
    loop   python-can and cantools: recv, decode each sample, encode and send an answer for every n-th
    recv   python-can's recv alone, nothing else

Run as a process: `python -m tools.bench.rivals echo vcan0 5`, to answer every fifth sample.
  Ends on SIGTERM and prints the frames received.
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
from typing import Any

SAMPLE, ANSWER = 0x100, 0x200


class _Stop(Exception):
    pass


def _stop(*_: Any) -> None:
    raise _Stop


def echo(channel: str, every: int) -> int:
    """Bare raw-socket echo."""
    s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    s.setsockopt(socket.SOL_SOCKET, 33, 1 << 22)
    s.bind((channel,))
    buffer = bytearray(16)
    answer = bytearray(struct.pack("<IB3x8x", ANSWER, 8))
    received = 0
    print("ready", flush=True)
    try:
        while True:
            s.recv_into(buffer)
            received += 1
            if buffer[0] == 0 and buffer[1] == 1 and (buffer[15] >> 4) % every == 0:
                answer[8:16] = buffer[8:16]
                s.send(answer)
    except _Stop:
        return received


def loop(channel: str, every: int) -> int:
    """python-can and cantools."""
    import can
    import cantools

    from ipmsm_can.wire.dbc import default_dbc_path

    database: Any = cantools.database.load_file(str(default_dbc_path()))
    sample = database.get_message_by_name("DriveSample")
    answer = database.get_message_by_name("PositionEstimate")
    bus = can.Bus(interface="socketcan", channel=channel)
    values = dict.fromkeys((s.name for s in answer.signals), 0)
    received = 0
    print("ready", flush=True)
    try:
        while True:
            message = bus.recv()
            received += 1
            if message is not None and message.arbitration_id == SAMPLE:
                decoded: Any = sample.decode(message.data)
                if int(decoded["sample_counter"]) % every == 0:
                    values["sample_counter"] = int(decoded["sample_counter"])
                    bus.send(can.Message(arbitration_id=ANSWER, data=answer.encode(values), is_extended_id=False))
    except _Stop:
        return received


def recv(channel: str, _every: int) -> int:
    """python-can's recv alone."""
    import can

    bus = can.Bus(interface="socketcan", channel=channel)
    received = 0
    print("ready", flush=True)
    try:
        while True:
            if bus.recv() is not None:
                received += 1
    except _Stop:
        return received


def main() -> None:
    """Command line."""
    signal.signal(signal.SIGTERM, _stop)
    duty = {"echo": echo, "loop": loop, "recv": recv}[sys.argv[1]]
    print(duty(sys.argv[2], int(sys.argv[3])), flush=True)


if __name__ == "__main__":
    main()
