"""The picture of a status: what it says, and that it fits."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from dataclasses import replace

import pytest

from ipmsm_can.cli import plain
from ipmsm_can.cli.monitor import INJECTION_WORDS, REASON_WORDS, STATE_WORDS, Rates, injection_words
from ipmsm_can.cli.render import render
from ipmsm_can.cli.status import DriveNodeStatus, DriveStatus, RunStatus
from ipmsm_can.wire.protocol import CompanionState, InjectionReason, InjectionState
from tests import live_view_status
from tests.live_view_status import BUS

NODE = replace(live_view_status.NODE, sample_rate=5000.0, samples_per_s=4999.0)
STATUS = RunStatus("ipmsm-can run", 83.0, False, BUS, (NODE,))
DRIVE = DriveStatus("ipmsm-can drive", 3.0, 16.0, "vcan0", 1000, 5560.0, 2, 1, (
    DriveNodeStatus(0, "m2", "demo", 3.0, 19.9, 20.0, 3.1, 3.0, 1.2, "rotating", 6.0, 4),))


def picture(status: RunStatus | DriveStatus, width: int = 80, height: int = 24) -> list[str]:
    return str(render(status, width, height)).split("\n")


def test_everything_is_on_the_picture() -> None:
    text = "\n".join(picture(STATUS))
    for words in ("SILENT (listening only)", "0:01:23", "drive 3", "m2", "[x] valid", "[x] locked", "[x] polarity",
                  "330.0 deg +/- 0.6", "VALID", "+1000.1 rpm mechanical", "+314.2 rad/s electrical",
                  "on, 6.0 V: low speed", "drive injects, 0.35 A", "4999/s of 5000 Hz", "estimates 1000/s",
                  "lost 7", "filled 5", "gaps 1", "duplicates 2", "reordered 3", "resyncs 4", "restarts 6",
                  "bad frames 8",
                  "57.3 %", "5560 frames/s", "received 1234567", "unknown ids 12", "wrong length 14",
                  "kernel drops 15", "bus-off"):
        assert words in text, words
    assert "TRANSMITTING" not in text
    loud = "\n".join(picture(replace(STATUS, transmit=True)))
    assert "TRANSMITTING" in loud
    assert "SILENT" not in loud
    assert "p50 120 us  p99 240 us  unsent 11" in loud


def test_ascii_only_so_that_every_terminal_shows_it() -> None:
    assert "\n".join(picture(STATUS) + picture(DRIVE)).isascii()
    assert (plain.line(STATUS) + plain.summary(STATUS) + plain.line(DRIVE) + plain.summary(DRIVE)).isascii()


@pytest.mark.parametrize("nodes", [1, 2, 3, 16])
@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40), (40, 10), (20, 5)])
def test_the_picture_fits_its_window(nodes: int, width: int, height: int) -> None:
    many = replace(STATUS, transmit=True, nodes=tuple(replace(NODE, node=k) for k in range(nodes)))
    lines = picture(many, width, height)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width


def test_nothing_of_one_drive_is_cut_off_at_80_columns() -> None:
    wide = picture(replace(STATUS, transmit=True), 200, 60)
    narrow = picture(replace(STATUS, transmit=True), 80, 24)
    assert [line.split() for line in narrow] == [line.split() for line in wide]


def test_many_drives_get_a_line_each_and_the_bus_stays() -> None:
    many = replace(STATUS, nodes=tuple(replace(NODE, node=k) for k in range(16)))
    lines = picture(many, 80, 20)
    assert any("more; the window is too low" in line for line in lines)
    assert lines[-1].endswith("bus-off (silent)")
    whole = picture(many, 80, 40)
    assert sum("330.0 +/- 0.6" in line for line in whole) == 16


@pytest.mark.parametrize(("change", "trust"), [
    ({"live": False, "state": "no samples any more"}, "no estimate"),
    ({"sigma": math.pi, "valid": False, "locked": False, "polarity_known": False}, "NOT VALID: angle unknown"),
    ({"theta": math.nan, "valid": False, "locked": False, "polarity_known": False}, "NOT VALID: angle unknown"),
    ({"valid": False, "polarity_known": False}, "NOT VALID: may be half a turn off"),
    ({"valid": False, "locked": False}, "NOT VALID: not locked"),
    ({"valid": False}, "NOT VALID: too uncertain"),
    ({"valid": False, "late": True}, "NOT VALID: samples too late"),
])
def test_an_angle_is_never_shown_as_more_than_it_is(change: dict[str, object], trust: str) -> None:
    node = replace(NODE, **change)  # type: ignore[arg-type]
    text = "\n".join(picture(replace(STATUS, nodes=(node,))))
    assert trust in text
    assert (" VALID" in text.replace("NOT VALID", "")) is False
    if trust in ("no estimate", "NOT VALID: angle unknown"):
        assert "330" not in text
        assert "330" not in plain.line(replace(STATUS, nodes=(node,)))


def test_plain_line_and_summary() -> None:
    assert plain.line(STATUS) == (
        "0:01:23 SILENT (listening only) load 57.3 % 5560 frames/s drops 15 error frames 2 | drive 3 locked, "
        "VALID, 330.0 deg +/- 0.6, +1000.1 rpm, probing on, 6.0 V: low speed, lost 7 bad 8")
    text = plain.summary(STATUS)
    assert text.startswith("SILENT (listening only) for 83.0 s on can0 (SocketCAN, kernel time stamps): 1234567 ")
    assert "turnaround" not in text
    assert "answers: turnaround p50 120 us" in plain.summary(replace(STATUS, transmit=True))
    assert "drive 3 (m2): no samples came" in plain.summary(replace(STATUS, nodes=(replace(NODE, received=0),)))
    assert text.endswith("  last: locked, VALID, 330.0 deg +/- 0.6, +1000.1 rpm")
    silent = replace(STATUS, nodes=(replace(NODE, live=False, state="no samples any more"),))
    assert plain.summary(silent).endswith("  last: no samples any more")
    assert plain.summary(DRIVE) == ("1000 frames sent in 3.0 s, 2 unsent; this machine was too slow for real time "
                                    "1 times; drive 0 refused 4 commands")


def test_every_state_and_reason_has_its_words() -> None:
    assert set(STATE_WORDS) == set(CompanionState)
    assert set(REASON_WORDS) == set(InjectionReason)
    assert set(INJECTION_WORDS) == set(InjectionState)
    assert injection_words(InjectionState.LIMITED, InjectionReason.CURRENT_LIMIT, 4.94) == (
        "limited, 4.9 V: current limit")
    assert injection_words(InjectionState.OFF, InjectionReason.NONE, 0.0) == "off"


def test_rates_are_those_of_the_last_second() -> None:
    rates = Rates(10.0)
    assert rates.update(10.5, {"n": 100}) == {"n": 200.0}
    for k in range(11, 31):
        told = rates.update(0.5 * k + 5.0, {"n": 100 + 50 * (k - 11)})
    assert told == {"n": 100.0}


def test_the_drawing_process_loads_next_to_nothing() -> None:
    code = ("import sys, ipmsm_can.cli.screen, ipmsm_can.cli.render, ipmsm_can.cli.status\n"
            "print([m for m in ('numpy', 'numba', 'can', 'cantools', 'pydantic') if m in sys.modules])")
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_the_drawing_process_ends_with_its_pipe_and_survives_half_a_message() -> None:
    message = pickle.dumps(STATUS)
    for sent in (b"", message, message + message[:20]):
        told = subprocess.run([sys.executable, "-m", "ipmsm_can.cli.screen"], input=sent, capture_output=True,
                              timeout=60, check=False)
        assert (told.returncode, told.stderr) == (0, b"")
