"""The live view as a person sees it: the command on a terminal, with a terminal emulator as the witness."""

from __future__ import annotations

import fcntl
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from ipmsm_can.logs import read_log
from ipmsm_can.logs.writer import write_log
from ipmsm_can.wire.protocol import Protocol
from tests.live_view_status import STATUS
from tests.replaying import drive_frames
from tests.terminal import Terminal

MONITOR = [sys.executable, "-m", "ipmsm_can", "monitor"]
ENTER, LEAVE = b"\x1b[?1049h", b"\x1b[?1049l"
COLOUR = re.compile(rb"\x1b\[[\d;]*(?:3[0-7]|4[0-7]|9[0-7])[;m]")


def test_a_session_with_every_key(tmp_path: Path) -> None:
    """Record, mark, inject, stop, hold, turn pages, resize, and leave the terminal as it was."""
    log = tmp_path / "first.log"
    with Terminal([*MONITOR, "--demo", "--transmit", "--record", str(log)]) as t:
        t.wait("r stop rec  m mark  i o a injection  p pause")
        assert t.text.startswith(" TRANSMITTING  ● REC")
        t.press("m")
        t.wait("mark 1")
        assert "(not recorded)" not in t.text
        t.press("i")
        t.wait("into drive 0?  y: yes")
        t.press("n")
        t.wait("nothing done")
        t.press("iy")
        t.wait("injection ordered on")
        t.wait("ordered on  the drive injects")
        t.press("o")
        t.wait("off: asked for by the operator  ordered off")
        t.press("r")
        t.wait("not recording")
        t.wait(f"recorded {log}"[:60])
        t.press("p")
        t.wait(" PAUSED ")
        t.look(0.3)
        speeds = [line for line in t.lines if line.startswith(("speed", "samples", "bus load"))]
        t.look(0.6)
        assert [line for line in t.lines if line.startswith(("speed", "samples", "bus load"))] == speeds
        assert len(speeds) == 3
        t.press("p\x1b[A\x1bOP")  # arrows and function keys mean nothing
        t.press("h")
        t.wait("leave the injection to the companion again")
        t.press("h")
        t.wait("1 sigma of the angle")
        t.press("f")
        t.wait("drive 0: injection ordered off")
        t.press("f")
        t.resize(120, 40)
        t.wait("phase current [A rms]")
        t.wait("f findings  h help  q quit")
        assert len(t.lines[0]) == 120 and t.lines[-1].startswith("r record")
        assert not t.mode[3] & 2  # canonical input is off: keys come at once
        t.press("q")
        assert t.finish() == 0
        assert t.mode == t.before
        assert t.sent.count(ENTER) == t.sent.count(LEAVE) == 1
        told = t.sent[t.sent.index(LEAVE):].decode()
        assert "TRANSMITTING for" in told and "mark 1" in told and "recorded" in told
    reader = read_log(log)
    ids = {int(i) for block in reader for i in block.can_id}
    assert {0x100, 0x140, 0x160, 0x200, 0x220} <= ids
    assert [mark.text for mark in reader.marks] == ["mark 1"]


def test_a_recording_without_colours_and_without_unicode(tmp_path: Path) -> None:
    log, config = tmp_path / "run.blf", tmp_path / "drive.toml"
    config.write_text('[motor]\npreset = "m2"\n')
    write_log(log, [drive_frames(Protocol(), 9.0)])
    with Terminal([*MONITOR, str(config), "--log", str(log), "--speed", "3", "--no-findings"],
                  env={"NO_COLOR": "1", "LANG": "C"}) as t:
        text = t.wait("[x] valid")
        assert text.startswith(" SILENT (listening only)  not recording")
        assert "played 3 times as fast" in text
        t.press("i")
        t.wait("SILENT: nothing is transmitted")
        t.press("r")
        t.wait("this is a recording already")
        t.press("m")
        t.wait("mark 1 (not recorded)")
        t.look(0.5)
        assert t.text.isascii() and "*" in t.text and "#" in t.text
        t.wait("played 3 times as fast, over: q ends")
        t.look(0.5)
        assert "[x] valid" in t.text and " PAUSED " in t.text, "the last picture, not the silence after it"
        t.press("q")
        assert t.finish() == 0
    assert not COLOUR.search(t.sent)
    assert b"0 sent" in t.sent and b"last: locked, VALID" in t.sent
    assert re.search(rb"\r\n\d:\d\d\.\d{3} mark 1", t.sent), "the time of a recording's mark is the recording's"


def test_a_program_that_is_killed_leaves_the_terminal_as_it_was() -> None:
    with Terminal([*MONITOR, "--demo", "--no-findings"]) as t:
        t.wait("drive 0  m2")
        os.kill(t.pid, signal.SIGKILL)
        t.finish()
        end = time.monotonic() + 10.0
        while LEAVE not in t.sent and time.monotonic() < end:
            t.look(0.1)
        t.look(0.2)
        assert LEAVE in t.sent
        assert t.mode == t.before


def test_a_connection_that_hangs_up_ends_in_order(tmp_path: Path) -> None:
    """Without a keyboard, too; the record is finished."""
    log = tmp_path / "run.blf"
    with Path(os.devnull).open() as nothing, Terminal(
            [*MONITOR, "--demo", "--no-findings", "--record", str(log)], stdin=nothing.fileno()) as t:
        t.wait("no keys: standard input is not a terminal")
        t.wait("[x] locked")
        assert "nobody looks for any" in t.text
        os.kill(t.pid, signal.SIGHUP)
        assert t.finish() == 0
    reader = read_log(log)
    assert sum(map(len, reader)) > 1000 and not reader.problem


def test_without_a_terminal_there_are_lines() -> None:
    told = subprocess.run([*MONITOR, "--demo", "--no-findings", "--duration", "1.3"], capture_output=True,
                          text=True, timeout=120, stdin=subprocess.DEVNULL, check=False)
    assert told.returncode == 0
    assert re.match(r"0:00:01 SILENT \(listening only\) load .* frames/s", told.stdout)
    assert "\x1b" not in told.stdout


# The drawing process alone


def drawing(columns: int = 80, rows: int = 24) -> tuple[Terminal, int]:
    """The drawing process on a terminal, and where to write statuses for it."""
    read, write = os.pipe()
    t = Terminal([sys.executable, "-m", "ipmsm_can.live_view.drawing"], columns, rows, stdin=read)
    os.close(read)
    return t, write


def test_only_what_changes_is_written() -> None:
    t, write = drawing()
    with t:
        os.write(write, pickle.dumps(STATUS))
        t.wait("drive 3  m2")
        t.look(0.3)
        assert "drive 3" not in t.sent[-10:].decode()
        whole = len(t.sent)
        os.write(write, pickle.dumps(STATUS))
        t.look(0.5)
        assert len(t.sent) == whole
        os.write(write, pickle.dumps(replace(STATUS, notice="something new")))
        t.wait("something new")
        assert len(t.sent) - whole < 60
        os.close(write)
        assert t.finish() == 0
        assert t.sent.endswith(LEAVE)


def test_a_terminal_that_is_slow_gets_the_newest() -> None:
    """Held up for a while, it shows the present, not the history."""
    t, write = drawing()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 1 << 20)  # room for all: the writer must not wait for who is held
    with t:
        os.write(write, pickle.dumps(STATUS))
        t.wait("drive 3  m2")
        os.kill(t.pid, signal.SIGSTOP)
        for k in range(100):
            run = replace(STATUS.run, elapsed=1000.0 + k)
            os.write(write, pickle.dumps(replace(STATUS, run=run, notice=f"status {k}")))
        before = len(t.sent)
        os.kill(t.pid, signal.SIGCONT)
        t.wait("status 99", 10.0)
        assert t.sent[before:].count(b"status ") < 50
        os.close(write)
        assert t.finish() == 0
