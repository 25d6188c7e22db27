"""Our SocketCAN port against can-utils as third parties, on a real kernel interface."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.bus.port import BusError, Port, open_port
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FrameBlock,
)
from ipmsm_can.logs import read_log

SENT = ["123#0102030405060708", "7FF#", "1ABCDEF0#DEADBEEF", "00000001#11", "321#R", "321#R5",
        "100##1" + "A5" * 64, "101##0" + "00112233445566778899AABB", "12345678##3" + "FF" * 20, "000#00"]


class Candump:
    """candump -L into a file; ready when it has seen a frame sent for that purpose."""

    PROBE = "7A5#C0FFEE"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("wb")
        # -L: log format; -r: receive buffer in bytes; #FFFFFFFF: error frames, too
        self._process = subprocess.Popen(
            ["candump", "-L", "-r", "33554432", "vcan0,0:0,#FFFFFFFF"], stdout=self._file)
        deadline = time.monotonic() + 10
        while not path.stat().st_size:
            assert time.monotonic() < deadline, "candump shows nothing"
            cansend(self.PROBE)
            time.sleep(0.05)
        time.sleep(0.1)

    def frames(self, at_least: int) -> FrameBlock:
        """What it wrote, without the probes, once there are so many."""
        deadline = time.monotonic() + 20
        while True:
            block = FrameBlock.concat(read_log(self.path))
            block = block.take(block.can_id != 0x7A5)
            if len(block) >= at_least or time.monotonic() > deadline:
                return block
            time.sleep(0.1)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()
        self._file.close()


def cansend(frame: str) -> None:
    subprocess.run(["cansend", "vcan0", frame], check=True)


@pytest.fixture
def candump(tmp_path: Path) -> Iterator[Candump]:
    dump = Candump(tmp_path / "candump.log")
    yield dump
    dump.close()


@pytest.fixture
def port() -> Iterator[SocketCanPort]:
    with SocketCanPort("vcan0") as opened:
        yield opened


def collect(port: Port, n: int, timeout_s: float = 2.0) -> FrameBlock:
    """At least n frames, or what came before a silence."""
    parts: list[FrameBlock] = []
    while sum(map(len, parts)) < n:
        parts.append(port.receive(timeout_s))
        if not len(parts[-1]):
            break
    return FrameBlock.concat(parts)


def numbered(n: int) -> FrameBlock:
    block = FrameBlock.zeros(n)
    block.can_id[:] = 0x100 + np.arange(n) % 16
    block.raw[:, 4] = 8
    block.words[:, 1] = np.arange(n, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return block


def mixed() -> FrameBlock:
    block = FrameBlock.zeros(7)
    block.can_id[:] = [0x100, 0x1ABCDEF0 | CAN_EFF_FLAG, 0x200 | CAN_RTR_FLAG, 0x120, 0x121,
                       0x5 | CAN_EFF_FLAG, CAN_ERR_FLAG | 4]
    block.raw[:, 4] = [8, 3, 0, 64, 12, 20, 8]
    block.raw[3:6, 5] = [CANFD_FDF | CANFD_BRS, CANFD_FDF, CANFD_FDF | CANFD_BRS | CANFD_ESI]
    for row in (0, 1, 3, 4, 5):
        length = int(block.raw[row, 4])
        block.raw[row, 8:8 + length] = 17 * row + 1 + np.arange(length)
    block.raw[6, 8:16] = [0, 0x20, 0, 0, 0, 0, 0x80, 0x10]
    return block


def test_we_see_what_cansend_sends_as_candump_does(candump: Candump, port: SocketCanPort) -> None:
    before = time.time_ns()
    for frame in SENT:
        cansend(frame)
    ours = collect(port, len(SENT))
    theirs = candump.frames(len(SENT))
    assert len(ours) == len(theirs) == len(SENT)
    remote = (ours.can_id & CAN_RTR_FLAG) != 0
    ours.raw[remote, 4] = theirs.raw[remote, 4]  # this candump writes no length for remote frames
    assert np.array_equal(ours.raw, theirs.raw)
    # the kernel stamps a frame once; candump cuts the stamp to microseconds
    assert np.array_equal(ours.t_ns // 1000, theirs.t_ns // 1000)
    assert (np.diff(ours.t_ns) > 0).all()
    assert before < ours.t_ns[0] < ours.t_ns[-1] <= time.time_ns()


def test_rows_are_what_cansend_was_told(port: SocketCanPort) -> None:
    """Read by hand, so that a mistake our log reader shared would show."""
    for frame in SENT:
        cansend(frame)
    found = collect(port, len(SENT))
    assert found.can_id.tolist() == [
        0x123, 0x7FF, 0x1ABCDEF0 | CAN_EFF_FLAG, 1 | CAN_EFF_FLAG, 0x321 | CAN_RTR_FLAG, 0x321 | CAN_RTR_FLAG,
        0x100, 0x101, 0x12345678 | CAN_EFF_FLAG, 0]
    assert found.length.tolist() == [8, 0, 4, 1, 0, 5, 64, 12, 20, 1]
    assert found.flags.tolist() == [0, 0, 0, 0, 0, 0, CANFD_FDF | CANFD_BRS, CANFD_FDF, 7, 0]
    assert found.data[2].tobytes() == bytes.fromhex("DEADBEEF") + bytes(60)
    assert found.data[6].tobytes() == b"\xa5" * 64
    assert found.data[9].tobytes() == bytes(64)


def test_candump_sees_what_we_send_byte_for_byte(candump: Candump, port: SocketCanPort) -> None:
    assert port.send(mixed()) == len(mixed())
    theirs = candump.frames(len(mixed()))
    assert np.array_equal(theirs.raw, mixed().raw)
    assert port.unsent == 0


def test_another_port_gets_the_same_rows_and_we_do_not_hear_ourselves(port: SocketCanPort) -> None:
    with SocketCanPort("vcan0") as other, SocketCanPort("vcan0", receive_own=True) as echo:
        echo.send(mixed())
        assert np.array_equal(collect(other, 7).raw, mixed().raw)
        assert np.array_equal(collect(echo, 7).raw, mixed().raw)
        collect(port, 7)
        port.send(mixed())
        assert len(port.receive(0.0)) == 0
        assert len(collect(other, 7)) == 7


def test_without_loopback_nobody_here_hears(port: SocketCanPort) -> None:
    with SocketCanPort("vcan0", loopback=False) as quiet:
        assert quiet.send(mixed()) == 7
        assert len(port.receive(0.1)) == 0


def test_burst_of_20000_frames_without_loss(candump: Candump, port: SocketCanPort) -> None:
    burst = numbered(20_000)
    with SocketCanPort("vcan0") as sender:
        assert sender.send(burst) == 20_000
    ours = collect(port, 20_000)
    assert port.drops == 0
    assert np.array_equal(ours.raw, burst.raw)
    assert (np.diff(ours.t_ns) >= 0).all()
    theirs = candump.frames(20_000)
    if len(theirs) == 20_000:  # candump itself may drop; it is not what is tested here
        assert np.array_equal(ours.t_ns // 1000, theirs.t_ns // 1000)
    kept = np.isin(ours.words[:, 1], theirs.words[:, 1])
    assert np.array_equal(ours.raw[kept], theirs.raw)


def test_lost_frames_are_counted() -> None:
    with SocketCanPort("vcan0", receive_buffer=2048) as small, SocketCanPort("vcan0") as sender:
        sender.send(numbered(500))
        kept = collect(small, 500, 0.05)
        assert 0 < len(kept) < 500
        # the kernel tells with the next frame that gets through
        sender.send(numbered(1))
        assert len(collect(small, 1)) == 1
        assert small.drops == 500 - len(kept)
        sender.send(numbered(300))
        again = collect(small, 300, 0.05)
        sender.send(numbered(1))
        small.receive(1.0)
        assert small.drops == 800 - len(kept) - len(again)


def test_blocks_stay_valid_and_are_bounded() -> None:
    with SocketCanPort("vcan0", max_frames=64) as port, SocketCanPort("vcan0") as sender:
        sender.send(numbered(100))
        first = port.receive(1.0)
        copy = first.raw.copy(), first.t_ns.copy()
        # the kernel may hand a burst on in several goes, so only the sum is certain
        rest = collect(port, 100 - len(first))
        assert 1 <= len(first) <= 64
        assert np.array_equal(first.raw, copy[0])
        assert np.array_equal(first.t_ns, copy[1])
        assert np.array_equal(FrameBlock.concat([first, rest]).raw, numbered(100).raw)


def test_a_long_frame_leaves_nothing_behind_in_a_short_one(port: SocketCanPort) -> None:
    with SocketCanPort("vcan0") as sender:
        for _ in range(2):
            sender.send(mixed())
            sender.send(numbered(3))
            found = collect(port, 10)
            assert np.array_equal(found.raw, np.concatenate([mixed().raw, numbered(3).raw]))


def test_filters(port: SocketCanPort) -> None:
    filters = [{"can_id": 0x100, "can_mask": 0x7FE, "extended": False},
               {"can_id": 0x5, "can_mask": 0x1FFFFFFF, "extended": True}]
    with open_port({"interface": "socketcan", "channel": "vcan0", "can_filters": filters}) as picky:
        port.send(mixed())
        port.send(numbered(16))
        found = collect(picky, 5, 0.5)
        # error frames pass whatever the filters
        assert found.can_id.tolist() == [0x100, 0x5 | CAN_EFF_FLAG, CAN_ERR_FLAG | 4, 0x100, 0x101]


def test_classical_only_port_neither_gets_nor_sends_fd(port: SocketCanPort) -> None:
    with SocketCanPort("vcan0", fd=False) as classical:
        port.send(mixed())
        assert len(collect(classical, 4, 0.1)) == 4
        with pytest.raises(BusError, match="refused the frame with identifier 0x120: the interface takes"):
            classical.send(mixed())
        assert classical.unsent == 4
    assert port.fd


def test_time_out_is_kept(port: SocketCanPort) -> None:
    for timeout in (0.05, 0.3, 0.05):
        begin = time.monotonic()
        assert len(port.receive(timeout)) == 0
        assert time.monotonic() - begin >= timeout * 0.99
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="timeout_s is"):
            port.receive(wrong)


def test_interface_down_up_and_missing(port: SocketCanPort) -> None:
    """Only where we may: needs root, as inside tools/vcan/run's machine."""
    if subprocess.run(["ip", "link", "add", "dev", "vcan7", "type", "vcan"], check=False).returncode:
        pytest.skip("not allowed to make an interface")
    try:
        with pytest.raises(BusError, match="vcan7 is down; bring it up with"):
            SocketCanPort("vcan7")
        subprocess.run(["ip", "link", "set", "vcan7", "up"], check=True)
        with pytest.raises(BusError, match="vcan7 is not set up for CAN FD"):
            subprocess.run(["ip", "link", "set", "vcan7", "down"], check=True)
            subprocess.run(["ip", "link", "set", "vcan7", "mtu", "16", "up"], check=True)
            SocketCanPort("vcan7", fd=True)
        with SocketCanPort("vcan7") as shaky, SocketCanPort("vcan7") as other:
            assert not shaky.fd
            subprocess.run(["ip", "link", "set", "vcan7", "down"], check=True)
            with pytest.raises(BusError, match="vcan7 is down"):
                shaky.receive(0.1)
            with pytest.raises(BusError, match="vcan7 is down"):
                shaky.send(numbered(1))
            subprocess.run(["ip", "link", "set", "vcan7", "up"], check=True)
            with pytest.raises(BusError):
                other.receive(0.1)  # told once, whenever it looks
            assert other.send(numbered(3)) == 3
            assert len(collect(shaky, 3)) == 3
            subprocess.run(["ip", "link", "del", "vcan7"], check=True)
            with pytest.raises(BusError, match="vcan7"):
                shaky.receive(0.1)
    finally:
        subprocess.run(["ip", "link", "del", "vcan7"], check=False, stderr=subprocess.DEVNULL)
    with pytest.raises(BusError, match="there is no CAN interface 'vcan7'"):
        SocketCanPort("vcan7")
    with pytest.raises(BusError, match="lo is a network interface, but not a CAN one"):
        SocketCanPort("lo")


def test_environment_opens_our_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "vcan0")
    with open_port({}) as port:
        assert isinstance(port, SocketCanPort)
        assert port.description == "vcan0 (SocketCAN, kernel time stamps)"


def test_default_buffer_is_granted_in_full(port: SocketCanPort) -> None:
    if Path("/proc/self/status").read_text().find("CapEff:\t000001ffffffffff") < 0:
        pytest.skip("without CAP_NET_ADMIN the kernel may grant less")
    assert port.buffer_bytes >= 2 * (8 << 20)
