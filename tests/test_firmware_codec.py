"""The C codec in firmware_stub/codec: it is what the DBC gives, and it says no to a DBC it cannot serve."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ipmsm_can.wire.dbc import default_dbc_path
from tools.firmware_codec import CODEC, generate, main

DBC = default_dbc_path()
TEXT = DBC.read_text("utf-8")


def test_the_committed_codec_is_what_the_dbc_gives() -> None:
    files = generate(DBC)
    assert sorted(files) == ["ipmsm_can.c", "ipmsm_can.h", "ipmsm_can_parameters.h"]
    for name, text in files.items():
        assert (CODEC / name).read_bytes() == text.encode("utf-8"), f"{name}: run make firmware-codec"


def test_it_has_neither_date_nor_double() -> None:
    for name in generate(DBC):
        text = (CODEC / name).read_text("utf-8")
        assert not re.search(r"\bdouble\b", text)
        assert not re.search(r"20\d\d \*|\d\d:\d\d:\d\d|cantools version", text)


def changed(tmp_path: Path, old: str, new: str) -> Path:
    assert TEXT.count(old) == 1
    path = tmp_path / "other.dbc"
    path.write_text(TEXT.replace(old, new), "utf-8")
    return path


def test_another_scaling_and_limit_reach_the_c(tmp_path: Path) -> None:
    dbc = changed(tmp_path, "SG_ i_alpha : 0|15@1- (0.005,0) [-81.92|81.915]",
                  "SG_ i_alpha : 0|15@1- (0.05,0) [-819.2|819.15]")
    assert main(["--dbc", str(dbc), "--output", str(tmp_path / "out")]) == 0
    source = (tmp_path / "out" / "ipmsm_can.c").read_text("utf-8")
    body = source.split("int16_t ipmsm_can_drive_sample_i_alpha_encode(float value)")[1]
    assert body.split("}")[0].strip().endswith("return (int16_t)(roundf(value * 20.0f));")
    parameters = (tmp_path / "out" / "ipmsm_can_parameters.h").read_text("utf-8")
    assert "#define IPMSM_CAN_DRIVE_SAMPLE_I_ALPHA_MAX (819.15f)\n" in parameters


def test_data_ids_and_version_reach_the_c(tmp_path: Path) -> None:
    dbc = changed(tmp_path, '"E2EDataID" BO_ 288 7456', '"E2EDataID" BO_ 288 4660')
    assert "#define IPMSM_CAN_DRIVE_SAMPLE_BLOCK_DATA_ID (4660u)\n" in generate(dbc)["ipmsm_can_parameters.h"]
    dbc = changed(tmp_path, "F8 58 90 23 C6", "01 02 03 04 05")
    text = generate(dbc)["ipmsm_can_parameters.h"]
    assert "{ 0x01u, 0x02u, 0x03u, 0x04u, 0x05u, 0x1bu," in text


@pytest.mark.parametrize(("old", "new", "names"), [
    ("SG_ v_beta_3 : 304|16@1- (0.025,0)", "SG_ v_beta_3 : 304|16@1- (0.5,0)", ("v_beta_3", "v_beta_0")),
    ("SG_ v_beta_6 : 496|16", "SG_ v_beta_6 : 496|15", ("v_beta_6", "15 bits", "16 bits")),
    ("SG_ i_alpha : 0|15@1- (0.005,0) [-81.92|81.915]", "SG_ i_alpha : 0|15@1- (0.005,0) [0|0]",
     ("i_alpha", "limits")),
])
def test_a_dbc_the_firmware_cannot_serve_is_refused_in_one_sentence(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, names: tuple[str, ...]) -> None:
    dbc = changed(tmp_path, old, new)
    assert main(["--dbc", str(dbc), "--output", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(name in said for name in names)
    assert not (tmp_path / "out").exists()
