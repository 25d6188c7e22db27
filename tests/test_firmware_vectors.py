"""The vectors shared with the C library: what the file says is what the package and cantools say."""

from __future__ import annotations

import json
import math
from typing import Any

import cantools
import numpy as np
import pytest
from cantools.autosar import end_to_end

from ipmsm_can.wire.dbc import default_dbc_path
from tools.firmware_tables import tables
from tools.firmware_vectors import TABLES, VECTORS, build, to_text

TEXT = VECTORS.read_text("utf-8")
DOCUMENT: dict[str, Any] = json.loads(TEXT)
DATABASE: Any = cantools.database.load_file(default_dbc_path())
AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")


def differences(here: Any, there: Any, path: str = "") -> list[str]:
    """Where two documents differ; floats may do so by what another processor's sine may differ by."""
    if isinstance(here, dict) and isinstance(there, dict) and here.keys() == there.keys():
        return [d for key in here for d in differences(here[key], there[key], f"{path}.{key}")]
    if isinstance(here, list) and isinstance(there, list) and len(here) == len(there):
        return [d for n, (one, other) in enumerate(zip(here, there, strict=True))
                for d in differences(one, other, f"{path}[{n}]")]
    if isinstance(here, float) and isinstance(there, float):
        return [] if abs(here - there) <= 2e-7 + 1e-12 * abs(here) else [f"{path}: {here} and {there}"]
    return [] if here == there and type(here) is type(there) else [f"{path}: {here} and {there}"]


def test_the_file_is_what_the_package_gives() -> None:
    assert differences(json.loads(to_text(build())), DOCUMENT) == []


def test_differences_are_found() -> None:
    other = json.loads(TEXT)
    other["probing"][2]["v_beta"][17] += 1e-6
    other["blocks"][1]["frame"] = other["blocks"][1]["frame"][:-1] + "0"
    assert len(differences(DOCUMENT, other)) == 2


def test_the_c_tables_are_what_the_file_gives() -> None:
    assert TABLES.read_text("utf-8") == tables(DOCUMENT), "run python -m tools.firmware_vectors --tables"


def decoded(name: str, row: dict[str, Any]) -> dict[str, Any]:
    message = DATABASE.get_message_by_name(name)
    found: dict[str, Any] = message.decode(bytes.fromhex(row["frame"]), decode_choices=False, scaling=True)
    return found


def held(signal: Any, value: float | str) -> float:
    number = float(value)
    return 0.0 if math.isnan(number) else min(max(number, float(signal.minimum)), float(signal.maximum))


def test_samples_as_cantools_reads_them() -> None:
    message = DATABASE.get_message_by_name("DriveSample")
    for row in DOCUMENT["samples"]:
        found = decoded("DriveSample", row)
        assert found["sample_counter"] == row["counter"] % 16
        for axis, value in zip(AXES, row["values"], strict=True):
            signal = message.get_signal_by_name(axis)
            assert abs(found[axis] - held(signal, value)) <= 0.5 * signal.scale


def test_blocks_as_cantools_reads_them() -> None:
    message = DATABASE.get_message_by_name("DriveSampleBlock")
    base = message.dbc.attributes["E2EDataID"].value
    for row in DOCUMENT["blocks"]:
        found = decoded("DriveSampleBlock", row)
        assert (found["first_sample"], found["sample_count"]) == (row["first"], 7)
        assert end_to_end.check_profile5_crc(bytes.fromhex(row["frame"]), base + row["node"])
        for j, values in enumerate(row["values"]):
            for axis, value in zip(AXES, values, strict=True):
                signal = message.get_signal_by_name(f"{axis}_{j}")
                assert abs(found[f"{axis}_{j}"] - held(signal, value)) <= 0.5 * signal.scale


def test_background_messages_as_cantools_reads_them() -> None:
    for row in DOCUMENT["timing"]:
        found = decoded("DriveTiming", row)
        assert (found["sample_counter"], found["sample_rate"]) == (row["counter"], pytest.approx(row["rate"]))
    status = DATABASE.get_message_by_name("DriveStatus")
    for row in DOCUMENT["status"]:
        found = decoded("DriveStatus", row)
        assert (found["mode"], found["active_waveform"], found["encoder_available"]) == (
            row["mode"], row["waveform"], row["encoder"])
        assert (found["faults"], found["rejected_commands"], found["protocol_version"]) == (
            row["faults"], row["rejected"], 1)
        for name in ("v_dc", "temperature"):
            signal = status.get_signal_by_name(name)
            assert abs(found[name] - held(signal, row[name])) <= 0.5 * signal.scale
    reference = DATABASE.get_message_by_name("DriveReference")
    for row in DOCUMENT["reference"]:
        found = decoded("DriveReference", row)
        theta = float(row["theta"])
        turned = theta if math.isfinite(theta) and abs(theta) < 1e6 else 0.0
        half_step = 0.5001 * reference.get_signal_by_name("theta_e").scale
        assert abs(math.remainder(found["theta_e"] - turned, math.tau)) <= half_step
        assert found["sample_counter"] == row["sample"]
        assert abs(found["omega_e"] - held(reference.get_signal_by_name("omega_e"), row["omega"])) <= 0.125


def test_crcs_as_cantools_computes_them() -> None:
    for row in DOCUMENT["crc8"]:
        assert end_to_end.check_profile2_crc(bytes.fromhex(row["payload"]), row["data_id"])
    for row in DOCUMENT["crc16"]:
        assert end_to_end.check_profile5_crc(bytes.fromhex(row["payload"]), row["data_id"])


def test_estimates_as_cantools_checks_them() -> None:
    message = DATABASE.get_message_by_name("PositionEstimate")
    listed = bytes.fromhex(message.dbc.attributes["E2EDataIDList"].value)
    seen = set()
    for row in DOCUMENT["estimates"]:
        payload = bytes.fromhex(row["frame"])
        data_id = (listed[payload[1] & 15] + row["node"]) % 256
        assert end_to_end.check_profile2_crc(payload, data_id) == (row["status"] != 4)
        seen.add(row["status"])
        found = decoded("PositionEstimate", row)
        assert all(found[name] == pytest.approx(row[name], abs=1e-12) for name in
                   ("theta_e", "omega_e", "sigma_theta", "valid", "locked", "polarity_known", "injecting"))
        if row["status"] != 4:
            assert found["sample_counter"] == row["named"] % 1024
    assert seen == {0, 1, 2, 3, 4}


def test_the_scripts_reach_what_they_are_for() -> None:
    """Every waveform, the drive's limit, an end by time to live, and every way to be refused."""
    scripts = DOCUMENT["probing"]
    assert {w for s in scripts for w in s["waveform"]} == {0, 1, 2, 3}
    assert max(scripts[2]["amplitude"]) == scripts[2]["limit"] == 12.0
    on = np.flatnonzero(scripts[0]["amplitude"])
    assert on[on < 130].max() == 99  # 20 ms at 5 kHz
    assert scripts[2]["rejected"] == 6
    assert {len(e["frame"]) for e in scripts[2]["events"]} == {14, 16}
    for script in scripts:
        size = np.hypot(script["v_alpha"], script["v_beta"])
        assert (size <= np.array(script["amplitude"]) + 1e-6).all()
