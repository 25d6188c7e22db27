"""Ports over python-can (its virtual bus), message conversion both ways, and how a port is chosen."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import can.cli
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.bus.port import BusError, Port, open_port
from ipmsm_can.bus.pythoncan import PythonCanPort, block_from_messages, messages_from_block
from ipmsm_can.frames import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    FrameBlock,
)


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    kind = draw(st.sampled_from(["data", "remote", "fd", "error"]))
    extended = draw(st.booleans())
    can_id = draw(st.integers(0, (1 << 29) - 1 if extended else (1 << 11) - 1))
    t_ns = draw(st.integers(0, 2_000_000_000_000_000))
    fields: dict[str, Any] = {"timestamp": t_ns * 1e-6, "arbitration_id": can_id, "is_extended_id": extended}
    if kind == "remote":
        return can.Message(**fields, is_remote_frame=True, dlc=draw(st.integers(0, 8)))
    if kind == "fd":
        size = draw(st.sampled_from([0, 5, 8, 12, 20, 48, 64]))
        return can.Message(**fields, is_fd=True, data=draw(st.binary(min_size=size, max_size=size)),
                           bitrate_switch=draw(st.booleans()), error_state_indicator=draw(st.booleans()))
    if kind == "error":
        fields["is_extended_id"] = False
        return can.Message(**fields, is_error_frame=True, data=draw(st.binary(min_size=8, max_size=8)))
    return can.Message(**fields, data=draw(st.binary(max_size=8)))


@given(st.lists(messages(), max_size=10))
def test_messages_survive_the_way_there_and_back(sent: list[can.Message]) -> None:
    block = block_from_messages(sent)
    assert block.raw.shape == (len(sent), 72)
    back = messages_from_block(block)
    for a, b in zip(sent, back, strict=True):
        assert a.equals(b, timestamp_delta=1e-6, check_channel=False)
    assert np.array_equal(block_from_messages(back).raw, block.raw)


def test_rows_byte_by_byte() -> None:
    block = block_from_messages([
        can.Message(timestamp=1.5, arbitration_id=0x123, is_extended_id=False, data=[1, 2, 3]),
        can.Message(arbitration_id=0x12345678, is_extended_id=True, is_remote_frame=True, dlc=5),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, is_fd=True, bitrate_switch=True,
                    data=bytes(64)),
        can.Message(arbitration_id=0x44, is_error_frame=True, is_extended_id=False, data=bytes(range(8))),
    ])
    assert block.raw[0].tobytes() == bytes.fromhex("2301000003000000010203") + bytes(61)
    assert block.raw[1].tobytes() == bytes.fromhex("785634d205000000") + bytes(64)
    assert block.raw[2].tobytes() == bytes.fromhex("ff07000040050000") + bytes(64)
    assert block.raw[3].tobytes() == bytes.fromhex("44000020080000000001020304050607") + bytes(56)
    assert block.t_ns.tolist() == [1_500_000_000, 0, 0, 0]


def test_oversized_payload_is_cut() -> None:
    block = block_from_messages([can.Message(arbitration_id=1, is_extended_id=False, data=bytes([7] * 20))])
    assert block.length[0] == 8
    assert not block.data[0, 8:].any()


@pytest.fixture
def pair() -> Iterator[tuple[Port, Port]]:
    options = {"interface": "virtual", "channel": "ipmsm-test", "fd": True}
    with open_port(options) as one, open_port(options) as other:
        yield one, other


def mixed() -> FrameBlock:
    block = FrameBlock.zeros(4)
    block.can_id[:] = [0x100, 0x1ABCDEF0 | CAN_EFF_FLAG, 0x200 | CAN_RTR_FLAG, 0x120]
    block.raw[:, 4] = [8, 3, 2, 64]
    block.raw[3, 5] = CANFD_FDF | CANFD_BRS | CANFD_ESI
    block.raw[0, 8:16] = np.arange(8)
    block.raw[1, 8:11] = 9
    block.raw[3, 8:] = np.arange(64)
    return block


def test_frames_pass_between_two_ports(pair: tuple[Port, Port]) -> None:
    one, other = pair
    before = time.time_ns()
    assert one.send(mixed()) == 4
    found = other.receive(1.0)
    assert np.array_equal(found.raw, mixed().raw)
    assert ((found.t_ns >= before - 1000) & (found.t_ns <= time.time_ns() + 1000)).all()
    assert len(one.receive(0.0)) == 0
    assert len(other.receive(0.0)) == 0
    assert (one.drops, one.unsent, one.fd) == (0, 0, True)
    assert one.description == "ipmsm-test (virtual through python-can)"


def test_blocks_are_bounded_and_nothing_is_lost() -> None:
    options = {"interface": "virtual", "channel": "ipmsm-many"}
    with open_port(options) as sender, PythonCanPort(
            can.Bus(interface="virtual", channel="ipmsm-many"), max_frames=100) as port:
        sender.send(FrameBlock.zeros(250))
        assert [len(port.receive(0.1)) for _ in range(4)] == [100, 100, 50, 0]


def test_closing_twice_and_using_a_closed_bus() -> None:
    port = open_port({"interface": "virtual", "channel": "ipmsm-closed"})
    port.close()
    port.close()
    with pytest.raises(BusError, match="receiving from ipmsm-closed"):
        port.receive(0.0)
    with pytest.raises(BusError, match="sending on ipmsm-closed"):
        port.send(mixed())
    assert port.unsent == 4


def test_negative_timeout(pair: tuple[Port, Port]) -> None:
    with pytest.raises(ValueError, match=r"timeout_s is -1\.0; allowed is 0 or more"):
        pair[0].receive(-1.0)


def test_full_adapter_counts_as_unsent(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = can.Bus(interface="virtual", channel="ipmsm-full")
    taken: list[can.Message] = []

    def send(message: can.Message, timeout: float | None = None) -> None:
        if len(taken) == 3:
            raise can.CanOperationError("Transmit buffer full")
        taken.append(message)

    monkeypatch.setattr(bus, "send", send)
    with PythonCanPort(bus) as port:
        assert port.send(FrameBlock.zeros(10)) == 3
        assert port.unsent == 7


# ---- the choice of a port -----------------------------------------------------------------------------

def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    can.cli.add_bus_arguments(parser, filter_arg=True)
    return parser.parse_args(list(words))


def test_options_of_python_can_users(capsys: pytest.CaptureFixture[str]) -> None:
    with open_port(arguments("-i", "virtual", "-c", "ipmsm-cli", "--filter", "100:7F0",
                             "--bus-kwargs", "preserve_timestamps=True")) as port:
        assert isinstance(port, PythonCanPort)
        assert port._bus.filters == [{"can_id": 0x100, "can_mask": 0x7F0}]
        with can.Bus(interface="virtual", channel="ipmsm-cli", preserve_timestamps=True) as bus:
            bus.send(can.Message(arbitration_id=0x105, is_extended_id=False, timestamp=5.0))
            bus.send(can.Message(arbitration_id=0x115, is_extended_id=False))
            found = port.receive(0.5)
        assert found.can_id.tolist() == [0x105]
        assert found.t_ns.tolist() == [5_000_000_000]


def test_environment_and_file_name_the_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", "ipmsm-env")
    with open_port(arguments()) as port:
        assert port.description.startswith("ipmsm-env (virtual")
    with open_port(arguments("-c", "ipmsm-other")) as port:
        assert port.description.startswith("ipmsm-other (virtual")
    monkeypatch.delenv("CAN_INTERFACE")
    monkeypatch.delenv("CAN_CHANNEL")
    (tmp_path / "can.conf").write_text("[default]\ninterface = virtual\nchannel = ipmsm-file\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(tmp_path / "can.conf")])
    with open_port({}) as port:
        assert port.description.startswith("ipmsm-file (virtual")


def test_sentences_for_options_that_name_no_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    for key in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(key, raising=False)
    with pytest.raises(ValueError, match="no CAN interface was given; name it with --interface"):
        open_port({})
    with pytest.raises(ValueError, match="no CAN channel was given; name it with --channel"):
        open_port({"interface": "virtual"})
    with pytest.raises(ValueError, match=r"CAN interface is 'nonsense'; allowed is one of .*socketcan"):
        open_port({"interface": "nonsense", "channel": "x"})
    with pytest.raises(BusError, match="CAN bus 'serial /dev/none' cannot be opened"):
        open_port({"interface": "serial", "channel": "/dev/none"})


@pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux")
def test_socketcan_needs_no_python_can() -> None:
    """Opening (here: failing to open) SocketCAN with explicit options saves the second `import can` takes."""
    code = ("import sys\nfrom ipmsm_can.bus.port import open_port, BusError\n"
            "try: open_port({'interface': 'socketcan', 'channel': 'nosuchcan0'})\n"
            "except BusError as error: print(error)\n"
            "assert 'can' not in sys.modules and 'cantools' not in sys.modules")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "SocketCAN socket" in done.stdout or "no CAN interface 'nosuchcan0'" in done.stdout


def test_bus_kwargs_reach_the_adapter() -> None:
    seen = {}

    def bus(**options: Any) -> Any:
        seen.update(options)
        raise OSError("enough")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(can, "Bus", bus)
        with pytest.raises(BusError, match="CAN bus 'pcan USB1' cannot be opened: enough"):
            open_port({"a_interface": "pcan", "a_channel": "USB1", "a_bitrate": 250000, "channel": "other",
                       "a_bus_kwargs": {"auto_reset": True}}, prefix="a")
    assert seen == {"interface": "pcan", "channel": "USB1", "bitrate": 250000, "auto_reset": True}


@pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux")
def test_unknown_socketcan_keyword_is_named() -> None:
    with pytest.raises(ValueError, match=r"bus keyword 'colour' is unknown to SocketCAN; allowed are can_"):
        open_port({"interface": "socketcan", "channel": "can0", "bus_kwargs": {"colour": 1}})


def test_flags_are_linux_flags() -> None:
    assert (CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG) == (1 << 31, 1 << 30, 1 << 29)
