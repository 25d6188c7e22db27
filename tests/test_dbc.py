"""The project's DBC and its protocol: the file against hand-made bits, the enumerations, the checks."""

from __future__ import annotations

import math
import subprocess
import sys
from enum import IntEnum
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from cantools.autosar import end_to_end

from ipmsm_can.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FrameBlock
from ipmsm_can.wire.dbc import Database, DbcError, default_dbc_path
from ipmsm_can.wire.protocol import (
    BLOCK_SAMPLES,
    PROTOCOL_VERSION,
    CompanionState,
    DriveMode,
    InjectionReason,
    InjectionState,
    MessageKind,
    ObserverKind,
    Protocol,
    Waveform,
)

TEXT = default_dbc_path().read_text("utf-8")

# name: (identifier, bytes, {signal: (start, bits, signed, factor)}), from the specification
_TWO_PI = 2 * math.pi
_AXES = (("i_alpha", 0.005), ("i_beta", 0.005), ("v_alpha", 0.025), ("v_beta", 0.025))
LAYOUT: dict[str, tuple[int, int, dict[str, tuple[int, int, bool, float]]]] = {
    "DriveSample": (0x100, 8, {
        **{name: (15 * j, 15, True, factor) for j, (name, factor) in enumerate(_AXES)},
        "sample_counter": (60, 4, False, 1)}),
    "DriveSampleBlock": (0x120, 64, {
        "e2e_crc": (0, 16, False, 1), "e2e_counter": (16, 8, False, 1), "first_sample": (24, 32, False, 1),
        "sample_count": (56, 8, False, 1),
        **{f"{name}_{j}": (64 + 64 * j + 16 * k, 16, True, factor)
           for j in range(7) for k, (name, factor) in enumerate(_AXES)}}),
    "DriveTiming": (0x140, 8, {"sample_counter": (0, 32, False, 1), "sample_rate": (32, 32, False, 0.001)}),
    "DriveStatus": (0x160, 8, {
        "mode": (0, 4, False, 1), "active_waveform": (4, 3, False, 1), "encoder_available": (7, 1, False, 1),
        "faults": (8, 8, False, 1), "v_dc": (16, 16, False, 0.1), "temperature": (32, 8, True, 1),
        "protocol_version": (40, 8, False, 1), "rejected_commands": (48, 8, False, 1)}),
    "DriveReference": (0x180, 8, {
        "theta_e": (0, 16, False, _TWO_PI / 65536), "omega_e": (16, 16, True, 0.25),
        "sample_counter": (32, 32, False, 1)}),
    "PositionEstimate": (0x200, 8, {
        "e2e_crc": (0, 8, False, 1), "e2e_counter": (8, 4, False, 1),
        "theta_e": (12, 14, False, _TWO_PI / 16384), "omega_e": (26, 16, True, 0.25),
        "sigma_theta": (42, 8, False, 0.5), "sample_counter": (50, 10, False, 1),
        "valid": (60, 1, False, 1), "locked": (61, 1, False, 1), "polarity_known": (62, 1, False, 1),
        "injecting": (63, 1, False, 1)}),
    "InjectionCommand": (0x220, 8, {
        "e2e_crc": (0, 8, False, 1), "e2e_counter": (8, 4, False, 1), "waveform": (12, 3, False, 1),
        "amplitude": (15, 12, False, 0.05), "frequency": (27, 12, False, 1),
        "axis_angle": (39, 12, False, _TWO_PI / 4096), "time_to_live": (51, 8, False, 2)}),
    "ActiveFluxEstimate": (0x240, 8, {
        "x_alpha": (0, 16, True, 1e-4), "x_beta": (16, 16, True, 1e-4),
        "excitation_level": (32, 16, True, 0.01), "innovation": (48, 16, True, 1e-4)}),
    "CompanionStatus": (0x260, 8, {
        "state": (0, 3, False, 1), "observer": (3, 4, False, 1), "injection_state": (7, 3, False, 1),
        "injection_reason": (10, 4, False, 1), "bus_load": (14, 7, False, 1),
        "lost_samples": (21, 12, False, 1), "bad_frames": (33, 10, False, 1),
        "turnaround": (43, 10, False, 5), "version": (53, 8, False, 1)}),
}


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return Protocol()


@pytest.fixture(scope="module")
def reference() -> cantools.database.can.Database:
    loaded = cantools.database.load_string(TEXT, database_format="dbc", strict=True)
    assert isinstance(loaded, cantools.database.can.Database)
    return loaded


def attribute(reference: cantools.database.can.Database, message: str, name: str) -> int | float | str:
    dbc = reference.get_message_by_name(message).dbc
    assert dbc is not None
    value = dbc.attributes[name].value
    assert isinstance(value, (int, float, str))
    return value


def test_the_file_is_the_specification(protocol: Protocol) -> None:
    database = protocol.database
    assert list(database.messages) == list(LAYOUT) == [kind.message for kind in MessageKind]
    for name, (identifier, length, signals) in LAYOUT.items():
        codec = database.messages[name]
        assert (codec.frame_id, codec.length, codec.is_extended) == (identifier, length, False)
        assert codec.is_fd == (length == 64)
        found = {x.name: (x.start, x.length, x.kind == "signed", x.scale) for x in codec.layouts}
        assert found == signals
        assert not any(x.motorola or x.kind == "float" or x.offset for x in codec.layouts)
    assert database.attributes["ProtocolVersion"] == PROTOCOL_VERSION == 1


def test_limits_of_the_file_are_those_of_the_bits(protocol: Protocol) -> None:
    narrower = {("DriveSampleBlock", "sample_count"): (1, 7), ("CompanionStatus", "bus_load"): (0, 100)}
    for codec in protocol.database.codecs:
        for x in codec.layouts:
            low = -(2 ** (x.length - 1)) if x.kind == "signed" else 0
            expected = narrower.get((codec.name, x.name), (low * x.scale, (low + 2**x.length - 1) * x.scale))
            assert (x.minimum, x.maximum) == pytest.approx(expected, rel=1e-12), x.name


def test_everything_is_commented_and_has_the_nodes(reference: cantools.database.can.Database) -> None:
    assert [node.name for node in reference.nodes] == ["Drive", "Companion"]
    for message in reference.messages:
        assert message.comment and f"0x{message.frame_id:X}" in message.comment
        for signal in message.signals:
            assert signal.comment, signal.name
            if signal.unit and signal.unit not in ("%", "us", "ms"):
                assert f"[{signal.unit}" in signal.comment, signal.name
    assert TEXT.isascii()


def test_every_bit_of_a_sample_by_hand(protocol: Protocol) -> None:
    raw = protocol.encode(MessageKind.DRIVE_SAMPLE, 2, {
        "i_alpha": 1.0, "i_beta": -1.0, "v_alpha": 100.0, "v_beta": -0.025, "sample_counter": 11})
    bits = 200 | ((-200) % 2**15) << 15 | 4000 << 30 | ((-1) % 2**15) << 45 | 11 << 60
    block = FrameBlock(raw, np.zeros(1, np.int64))
    assert block.can_id[0] == 0x102 and block.length[0] == 8 and block.flags[0] == 0
    assert bytes(block.data[0, :8]) == bits.to_bytes(8, "little")


@pytest.mark.parametrize(("enumeration", "places"), [
    (Waveform, (("InjectionCommand", "waveform"), ("DriveStatus", "active_waveform"))),
    (DriveMode, (("DriveStatus", "mode"),)),
    (CompanionState, (("CompanionStatus", "state"),)),
    (ObserverKind, (("CompanionStatus", "observer"),)),
    (InjectionState, (("CompanionStatus", "injection_state"),)),
    (InjectionReason, (("CompanionStatus", "injection_reason"),)),
])
def test_enumerations_are_the_value_tables(protocol: Protocol, enumeration: type[IntEnum],
                                           places: tuple[tuple[str, str], ...]) -> None:
    for message, signal in places:
        table = protocol.database.messages[message].choices[signal]
        assert dict(table) == {int(member): member.name.lower() for member in enumeration}


def test_units_and_named_values_are_at_hand(protocol: Protocol) -> None:
    codec = protocol.codecs[MessageKind.POSITION_ESTIMATE]
    assert codec.units["theta_e"] == "rad" and "deviation" in codec.comments["sigma_theta"]
    assert codec.choices["sigma_theta"] == {255: "unknown"} and codec.choices["valid"] == {}


def test_data_identifiers_never_meet(protocol: Protocol) -> None:
    protections = [[protocol.protection(kind, node) for node in range(16)]
                   for kind in (MessageKind.POSITION_ESTIMATE, MessageKind.INJECTION_COMMAND)]
    for counter in range(16):
        at_counter = [p.data_ids[counter] for nodes in protections for p in nodes if p is not None]
        assert len(set(at_counter)) == 32
    for nodes in protections:
        assert nodes[0] is not None and len(set(nodes[0].data_ids.tolist())) == 16


def test_protected_messages_pass_cantools(protocol: Protocol,
                                          reference: cantools.database.can.Database) -> None:
    node = 9
    for kind in (MessageKind.POSITION_ESTIMATE, MessageKind.INJECTION_COMMAND):
        listed = bytes.fromhex(str(attribute(reference, kind.message, "E2EDataIDList")))
        threes = np.full((len(protocol.codecs[kind].signals), 40), 3.0)
        raw = protocol.encode(kind, node, threes, np.arange(40))
        for counter, row in enumerate(raw):
            sent = bytes(row[8:16])
            assert end_to_end.check_profile2_crc(sent, (listed[counter % 16] + node) % 256)
        _, intact, counters = protocol.decode(kind, node, raw)
        assert intact.all() and (counters == np.arange(40) % 16).all()
        assert not protocol.decode(kind, node + 1, raw)[1].any()
    kind = MessageKind.DRIVE_SAMPLE_BLOCK
    data_id = int(attribute(reference, kind.message, "E2EDataID"))
    raw = protocol.encode(kind, node, {"first_sample": 2.0**32 - 3, "sample_count": 7, "v_beta_6": -5.0}, 300)
    assert end_to_end.check_profile5_crc(bytes(raw[0, 8:72]), data_id + node)
    values, intact, counters = protocol.decode(kind, node, raw)
    assert intact[0] and counters[0] == 300 % 256
    index = protocol.codecs[kind].index
    assert values[index["first_sample"], 0] == 2.0**32 - 3 and values[index["v_beta_6"], 0] == -5.0
    assert BLOCK_SAMPLES == 7


def test_decode_of_our_messages_equals_cantools(protocol: Protocol,
                                                reference: cantools.database.can.Database) -> None:
    rng = np.random.default_rng(11)
    for kind in MessageKind:
        codec = protocol.codecs[kind]
        block = FrameBlock.zeros(300)
        block.length[:] = codec.length
        block.data[:, :codec.length] = rng.integers(0, 256, (300, codec.length))
        values = codec.decode(block.words)
        for k in range(300):
            expected = reference.decode_message(codec.frame_id, bytes(block.data[k, :codec.length]),
                                                decode_choices=False)
            assert isinstance(expected, dict)
            assert values[:, k].tolist() == [expected[name] for name in codec.signals]
        raw = protocol.encode(kind, 0, values, np.zeros(300))
        fixed = {"sample_count": (1, 7), "bus_load": (0, 100)}
        again = codec.decode(raw.view(np.uint64))
        for s, name in enumerate(codec.signals):
            if not name.startswith("e2e_"):
                low, high = fixed.get(name, (-math.inf, math.inf))
                assert again[s].tolist() == np.clip(values[s], low, high).tolist(), name


def test_every_identifier_is_classified(protocol: Protocol) -> None:
    block = FrameBlock.zeros(2048)
    block.can_id[:] = np.arange(2048)
    block.length[:] = 8
    block.length[0x120:0x130] = 64
    labels = protocol.classify(block.raw)
    for identifier in range(2048):
        kinds = [k for k, (base, _, _) in enumerate(LAYOUT.values()) if base <= identifier < base + 16]
        assert labels[identifier] == (kinds[0] * 16 + identifier % 16 if kinds else -1)
    assert (protocol.id_lut == labels).all() and protocol.id_lut.dtype == np.int16


def test_frames_that_are_not_ours(protocol: Protocol) -> None:
    cases = [
        (0x105, 8, 5), (0x105, 7, -4), (0x105, 0, -4), (0x125, 8, -4), (0x125, 64, 21), (0x105, 12, -4),
        (0x105 | CAN_EFF_FLAG, 8, -1), (0x105 | CAN_RTR_FLAG, 8, -3), (0x7FF | CAN_RTR_FLAG, 8, -1),
        (0x105 | CAN_ERR_FLAG, 8, -2), (0x20000004, 8, -2), (0x105 | CAN_EFF_FLAG | CAN_RTR_FLAG, 8, -1),
        (0x1FFFF105 | CAN_EFF_FLAG, 8, -1),
    ]
    block = FrameBlock.zeros(len(cases))
    block.can_id[:] = [case[0] for case in cases]
    block.length[:] = [case[1] for case in cases]
    assert protocol.classify(block.raw).tolist() == [case[2] for case in cases]
    assert protocol.classify(FrameBlock.zeros(0).raw).shape == (0,)


def test_a_scaled_copy_is_accepted_and_used() -> None:
    scaled = TEXT.replace("(0.005,0) [-81.92|81.915]", "(0.05,0) [-819.2|819.15]")
    protocol = Protocol(Database.loads(scaled))
    raw = protocol.encode(MessageKind.DRIVE_SAMPLE, 0, {"i_alpha": 600.0})
    assert int.from_bytes(raw[0, 8:10], "little") == 12000
    assert protocol.decode(MessageKind.DRIVE_SAMPLE, 0, raw)[0][0, 0] == 600.0


@pytest.mark.parametrize(("old", "new", "text"), [
    ("BO_ 320 DriveTiming:", "BO_ 320 Other:", "message DriveTiming is missing"),
    (" SG_ v_beta : 45", " SG_ v_gamma : 45", "message DriveSample lacks the signals v_beta"),
    (" SG_ sample_counter : 60|4@1+ (1,0) [0|15]", " SG_ sample_counter : 60|3@1+ (1,0) [0|7]",
     "signal sample_counter of DriveSample has 3 bits; it must have 4"),
    ('BA_ "E2EProfile" BO_ 512 "P02";', "",
     "attribute E2EProfile of PositionEstimate is ''; it must be 'P02'"),
    ('BA_ "E2EDataID" BO_ 288 7456;', 'BA_ "E2EDataID" BO_ 288 65530;',
     "E2EDataID is 65536; allowed is 0 to 65535"),
    (" 320 ", " 264 ", "the identifiers of DriveTiming and DriveSample overlap"),
    (" 320 ", " 2040 ", "message DriveTiming has identifier 0x7F8; allowed is an 11-bit one up to 0x7F0"),
    (" SG_ e2e_crc : 0|8@1+ (1,0) [0|255]", " SG_ e2e_crc : 0|8@1+ (2,0) [0|510]",
     "e2e_crc of PositionEstimate must"),
])
def test_a_database_that_does_not_fit_is_refused(old: str, new: str, text: str) -> None:
    changed = TEXT.replace(old, new)
    assert changed != TEXT
    with pytest.raises(DbcError) as caught:
        Protocol(Database.loads(changed, source="mine.dbc", strict=False))
    assert text in str(caught.value) and "mine.dbc does not fit the protocol" in str(caught.value)


def test_bad_calls_are_named(protocol: Protocol) -> None:
    with pytest.raises(ValueError, match="node is 16; allowed is 0 to 15"):
        protocol.encode(MessageKind.DRIVE_SAMPLE, 16, {})
    with pytest.raises(ValueError, match="PositionEstimate is protected; encode needs its counters"):
        protocol.encode(MessageKind.POSITION_ESTIMATE, 0, {})


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(DbcError, match=r"nowhere\.dbc cannot be read: No such file"):
        Database.load(tmp_path / "nowhere.dbc")
    broken = tmp_path / "broken.dbc"
    broken.write_text("this is not a database")
    with pytest.raises(DbcError, match=r"broken\.dbc is no usable DBC: ") as caught:
        Database.load(broken)
    assert "\n" not in str(caught.value)
    overlap = TEXT.replace(" SG_ i_beta : 15|15", " SG_ i_beta : 14|15")
    with pytest.raises(DbcError, match="signals i_beta and i_alpha are overlapping in message DriveSample"):
        Database.loads(overlap)
    assert Database.loads(overlap, strict=False).messages["DriveSample"].layouts[1].start == 14
    outside = TEXT.replace("BO_ 320 DriveTiming: 8", "BO_ 320 DriveTiming: 4")
    for strict in (True, False):
        with pytest.raises(DbcError, match="sample_rate"):
            Database.loads(outside, strict=strict)
    zero = TEXT.replace("(0.1,0)", "(0,0)")
    with pytest.raises(DbcError, match="signal v_dc has factor 0"):
        Database.loads(zero)


def test_windows_1252_and_utf_8(tmp_path: Path) -> None:
    degrees = TEXT.replace('"degC"', '"°C"')
    for encoding in ("cp1252", "utf-8", "utf-8-sig"):
        path = tmp_path / f"{encoding}.dbc"
        path.write_bytes(degrees.encode(encoding))
        assert Database.load(path).messages["DriveStatus"].units["temperature"] == "°C"


def test_lookup_by_identifier() -> None:
    text = TEXT.replace("BO_ 608 CompanionStatus", f"BO_ {608 | CAN_EFF_FLAG} CompanionStatus")
    text = "\n".join(line for line in text.splitlines() if " 608 " not in line) + "\n"
    database = Database.loads(text)
    assert database.by_id(0x100) is database.messages["DriveSample"]
    assert database.by_id(0x260) is None
    assert database.by_id(0x260, is_extended=True) is database.messages["CompanionStatus"]


def test_importing_the_wire_does_not_import_cantools() -> None:
    code = "import sys, ipmsm_can.wire.protocol; sys.exit('cantools' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
