"""The SocketCAN port of the C library, function by function, against a socket of Python's own."""

from __future__ import annotations

import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

cffi = pytest.importorskip("cffi")
if not shutil.which("cc"):
    pytest.skip("no C compiler", allow_module_level=True)

FOLDER = Path(__file__).resolve().parents[2] / "firmware_stub"
NODE = 3
FD, EXTENDED, REMOTE = 1, 2, 4
EFF, RTR = 0x80000000, 0x40000000

DECLARATIONS = """
struct ipmsm_frame { uint32_t id; uint8_t length; uint8_t flags; uint8_t data[64]; };
struct ipmsm_hal {
    void *context;
    bool (*transmit)(void *, const struct ipmsm_frame *);
    bool (*receive)(void *, struct ipmsm_frame *);
    uint32_t (*now_us)(void *);
    uint32_t (*lock)(void *);
    void (*unlock)(void *, uint32_t);
};
struct socketcan_port { int socket; bool fd; uint64_t mutex[WORDS]; uint32_t errors; };
int socketcan_port_open(struct socketcan_port *, struct ipmsm_hal *, const char *, uint8_t, bool);
void socketcan_port_close(struct socketcan_port *);
"""
SIZES = """
#include <stddef.h>
#include <stdio.h>
#include "socketcan_port.h"
int main(void)
{
    printf("%zu %zu %zu", sizeof(pthread_mutex_t), sizeof(struct socketcan_port),
           offsetof(struct socketcan_port, errors));
    return 0;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    """(ffi, lib) of the port, with traps for undefined behaviour."""
    folder = tmp_path_factory.mktemp("port")
    include = [f"-I{FOLDER / name}" for name in ("include", "codec", "ports/socketcan")]
    (folder / "sizes.c").write_text(SIZES)
    subprocess.run(["cc", "-std=c11", *include, str(folder / "sizes.c"), "-o", str(folder / "sizes")], check=True)
    told = subprocess.run([folder / "sizes"], check=True, capture_output=True)
    mutex, size, errors = map(int, told.stdout.split())
    subprocess.run(["cc", "-std=c11", "-O1", "-fPIC", "-shared", "-fsanitize=undefined",
                    "-fsanitize-undefined-trap-on-error", *include,
                    str(FOLDER / "ports" / "socketcan" / "socketcan_port.c"), "-o", str(folder / "port.so")],
                   check=True)
    ffi = cffi.FFI()
    ffi.cdef(DECLARATIONS.replace("WORDS", str(mutex // 8)))
    assert (ffi.sizeof("struct socketcan_port"), ffi.offsetof("struct socketcan_port", "errors")) == (size, errors)
    return ffi, ffi.dlopen(str(folder / "port.so"))


class Port:
    """An opened port."""

    def __init__(self, library: tuple[Any, Any], fd: bool) -> None:
        self.ffi, self.lib = library
        self.port = self.ffi.new("struct socketcan_port *")
        self.hal = self.ffi.new("struct ipmsm_hal *")
        assert self.lib.socketcan_port_open(self.port, self.hal, b"vcan0", NODE, fd) == 0

    def transmit(self, can_id: int, data: bytes, flags: int = 0) -> bool:
        frame = self.ffi.new("struct ipmsm_frame *", {"id": can_id, "length": len(data), "flags": flags,
                                                      "data": data})
        return bool(self.hal.transmit(self.hal.context, frame))

    def receive(self) -> tuple[int, bytes, int] | None:
        frame = self.ffi.new("struct ipmsm_frame *")
        if not self.hal.receive(self.hal.context, frame):
            return None
        return frame.id, bytes(frame.data)[:frame.length], frame.flags


@pytest.fixture(params=[False, True], ids=["classical", "fd"])
def port(library: tuple[Any, Any], request: pytest.FixtureRequest) -> Iterator[Port]:
    opened = Port(library, request.param)
    yield opened
    opened.lib.socketcan_port_close(opened.port)
    assert opened.port.socket == -1
    opened.lib.socketcan_port_close(opened.port)  # a second time does nothing


@pytest.fixture
def other() -> Iterator[socket.socket]:
    """Somebody else on the bus."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as end:
        end.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        end.settimeout(5.0)
        end.bind(("vcan0",))
        yield end


def classical(can_id: int, data: bytes) -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def test_frames_go_out_as_they_are(port: Port, other: socket.socket) -> None:
    assert port.transmit(0x103, bytes(range(8)))
    assert other.recv(100) == classical(0x103, bytes(range(8)))
    assert port.transmit(0x143, b"\x01\x02")
    assert other.recv(100) == classical(0x143, b"\x01\x02")
    taken = port.transmit(0x123, bytes(range(64)), FD)
    assert taken == port.port.fd
    if taken:
        found = other.recv(100)
        assert len(found) == 72
        assert struct.unpack_from("=IBB", found) in {(0x123, 64, 1), (0x123, 64, 5)}  # BRS; newer kernels add FDF
        assert found[8:] == bytes(range(64))
    assert port.port.errors == (0 if taken else 1)


def test_only_what_is_for_this_node_comes_in(port: Port, other: socket.socket) -> None:
    payload = bytes(range(8))
    for can_id in (0x202, 0x204, 0x222, 0x103, 0x263, 0x203 | EFF, 0x223 | EFF, 0x203 | RTR, 0x223 | RTR):
        other.send(classical(can_id, payload))
    other.send(classical(0x203, payload))
    other.send(classical(0x223, payload[:3]))
    time.sleep(0.05)
    assert port.receive() == (0x203, payload, 0)
    assert port.receive() == (0x223, payload[:3], 0)
    assert port.receive() is None
    assert port.port.errors == 0  # an empty queue is none


def test_can_fd_comes_in_only_where_it_was_asked_for(port: Port, other: socket.socket) -> None:
    other.send(struct.pack("=IBB2x64s", 0x203, 64, 1, bytes(range(64))))
    other.send(classical(0x203, b"\x07"))
    time.sleep(0.05)
    if port.port.fd:
        assert port.receive() == (0x203, bytes(range(64)), FD)
    assert port.receive() == (0x203, b"\x07", 0)
    assert port.receive() is None


def test_its_own_frames_do_not_come_back(port: Port) -> None:
    assert port.transmit(0x203, b"\x01")
    time.sleep(0.05)
    assert port.receive() is None


def test_the_clock_is_the_monotonic_one(port: Port) -> None:
    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    now = port.hal.now_us(port.hal.context)
    after = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    assert (now - before) % 2**32 <= after - before


def test_the_critical_section_can_be_entered_again_after_it_was_left(port: Port) -> None:
    for _ in range(3):
        port.hal.unlock(port.hal.context, port.hal.lock(port.hal.context))


@pytest.mark.parametrize("name", [b"can17", b"lo"])
def test_what_cannot_be_opened_leaves_nothing_open(library: tuple[Any, Any], name: bytes) -> None:
    ffi, lib = library
    port, hal = ffi.new("struct socketcan_port *"), ffi.new("struct ipmsm_hal *")
    assert lib.socketcan_port_open(port, hal, name, NODE, False) != 0
    assert port.socket == -1
    lib.socketcan_port_close(port)
