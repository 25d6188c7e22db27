"""The command line: what it says, how it ends, and what it does not load."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ipmsm_can.cli import COMMANDS, build_parser, bus, main
from ipmsm_can.config import parse_config

M2 = '[motor]\npreset = "m2"\n'


def rejected(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one sentence on stderr that comes with exit code 2."""
    try:
        code = main(argv)
    except SystemExit as leaving:  # argparse leaves by itself
        code = int(leaving.code or 0)
    out, err = capsys.readouterr()
    err = err.removeprefix("compiling kernels (first time only) ...\n")
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("ipmsm-can")
    return err


def test_help_loads_nothing_heavy() -> None:
    code = ("import sys\nfrom ipmsm_can.cli import main\n"
            "try:\n    main(['--help'])\nexcept SystemExit as leaving:\n    assert leaving.code == 0\n"
            "heavy = ('numpy', 'numba', 'scipy', 'can', 'cantools', 'pydantic', 'rich', 'matplotlib', 'shtab')\n"
            "print('loaded:', [m for m in heavy if m in sys.modules])")
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.splitlines()[-1] == "loaded: []"
    assert "ipmsm-can run drive.toml" in told.stdout


@pytest.mark.parametrize("command", [*COMMANDS, ""])
def test_every_help_has_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        main([command, "--help"] if command else ["--help"])
    assert leaving.value.code == 0
    text = capsys.readouterr().out
    examples = text[text.index("examples:"):]
    assert f"ipmsm-can {command}" in examples


@pytest.mark.parametrize("command", ["run", "drive", "monitor"])
def test_examples_of_the_bus_commands_are_accepted(command: str) -> None:
    parser = build_parser([command])
    module = {"monitor": "live_view"}.get(command, command)
    text = sys.modules[f"ipmsm_can.cli.{module}"].EPILOG
    lines = [line.split("  ")[0].split("|")[0] for line in map(str.strip, text.splitlines())
             if line.startswith(("ipmsm-can ", "CAN_"))]
    assert len(lines) >= 3
    for line in lines:
        words = line.split()
        args = parser.parse_args(words[words.index("ipmsm-can") + 1:])
        assert args.command == command


def test_bus_options_are_those_of_python_can() -> None:
    args = build_parser(["run"]).parse_args([
        "run", "a.toml", "-i", "pcan", "-c", "PCAN_USBBUS1", "-b", "500000", "--fd", "--data-bitrate", "2000000",
        "--bus-kwargs", "state=PASSIVE", "--filter", "100:70F"])
    assert (args.interface, args.channel, args.bitrate, args.fd) == ("pcan", "PCAN_USBBUS1", 500_000, True)
    assert (args.data_bitrate, args.bus_kwargs) == (2_000_000, {"state": "PASSIVE"})
    assert args.can_filters == [{"can_id": 0x100, "can_mask": 0x70F}]


@pytest.mark.parametrize(("argv", "words"), [
    ([], "required: COMMAND"),
    (["frob"], "'frob'"),
    (["run"], "required: drive.toml"),
    (["run", "a.toml", "--bogus"], "--bogus"),
    (["run", "a.toml", "--duration", "0"], "it is '0'; allowed is a number of seconds above 0"),
    (["run", "a.toml", "--duration", "nan"], "it is 'nan'; allowed is a number of seconds above 0"),
    (["run", "a.toml", "-i", "carrier-pigeon"], "'carrier-pigeon'"),
    (["drive", "--tick", "0"], "it is '0'; allowed is a number of ms from 0.1 to 100"),
    (["drive", "--seed", "1.5"], "it is '1.5'; allowed is a whole number of 0 or more"),
    (["drive", "--seed", "-1"], "it is '-1'; allowed is a whole number of 0 or more"),
    (["drive", "--theta0", "inf"], "it is 'inf'; allowed is an angle in degrees"),
    (["drive", "--profile", "nix", "-i", "virtual", "-c", "wrong"], "--profile is 'nix'; allowed is paper_ramp, "),
    (["completion", "fish"], "'fish'"),
])
def test_wrong_arguments(argv: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert words in rejected(capsys, *argv)


@pytest.mark.parametrize(("text", "words"), [
    (None, "there is no such file"),
    ("[motor\n", "not valid TOML"),
    ('[motor]\npreset = "m3"\n', 'motor.preset is "m3"; allowed is "m1" or "m2"'),
    (M2 + "[observer]\ngama = 3\n", "did you mean observer.gamma?"),
])
@pytest.mark.parametrize("command", ["run", "drive"])
def test_wrong_configuration(command: str, text: str | None, words: str, tmp_path: Path,
                             capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.toml"
    if text is not None:
        path.write_text(text)
    message = rejected(capsys, command, str(path), "-i", "virtual", "-c", "wrong")
    assert message.startswith(f"ipmsm-can {command}: {path}: ")
    assert words in message


def test_drives_that_do_not_fit_on_one_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = tmp_path / "one.toml", tmp_path / "other.toml"
    one.write_text(M2)
    other.write_text(M2)
    bus_options = ["-i", "virtual", "-c", "wrong"]
    assert "wire.node is 0, which" in rejected(capsys, "run", str(one), str(other), *bus_options)
    other.write_text(M2 + "[wire]\nnode = 1\nbitrate = 500000\n")
    assert "wire.bitrate/wire.data_bitrate are 500000/5000000 and 1000000/5000000 bit/s" in rejected(
        capsys, "run", str(one), str(other), *bus_options)
    (tmp_path / "big.dbc").write_bytes((Path(__file__).parents[1] / "dbc" / "ipmsm_can.dbc").read_bytes())
    other.write_text(M2 + "[wire]\nnode = 1\ndbc = 'big.dbc'\n")
    message = rejected(capsys, "run", str(one), str(other), *bus_options)
    assert "wire.dbc is none and " in message
    assert "big.dbc; allowed is the same file for all drives on a bus" in message


@pytest.mark.parametrize("command", ["run", "drive"])
def test_no_bus_named(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                      capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "drive.toml"
    path.write_text(M2)
    message = rejected(capsys, command, str(path))
    assert message.startswith(f"ipmsm-can {command}: no CAN interface was given; name it with --interface")
    assert "--channel" in rejected(capsys, command, str(path), "-i", "kvaser")


def test_an_interface_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.toml"
    path.write_text(M2)
    message = rejected(capsys, "run", str(path), "-i", "socketcan", "-c", "can77")
    assert "can77" in message or "SocketCAN" in message


def test_bit_rates_come_from_the_options_else_from_the_configuration() -> None:
    configs = [parse_config(M2 + "[wire]\nbitrate = '500 kbit/s'\ndata_bitrate = '2 Mbit/s'\n")]
    assert bus.bit_rates(argparse.Namespace(), configs) == (500_000, 2_000_000)
    given = argparse.Namespace(bitrate=250_000, data_bitrate=4_000_000)
    assert bus.bit_rates(given, configs) == (250_000, 4_000_000)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_scripts_parse_and_know_the_commands(shell: str, tmp_path: Path,
                                                        capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    for word in (*COMMANDS, "--transmit", "--profile", "--interface"):
        assert word in text, word
    program = shutil.which(shell)
    if program is None:
        assert shell != "bash", "bash is needed to check what it is given"
        return
    script = tmp_path / "completion"
    script.write_text(text)
    told = subprocess.run([program, "-n", str(script)], capture_output=True, text=True, check=False)
    assert (told.returncode, told.stderr) == (0, "")


def test_what_takes_long_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with bus.patience():
        pass
    assert capsys.readouterr().err == ""
    said: list[str] = []

    class Now:
        daemon = False

        def __init__(self, seconds: float, call: object) -> None:
            self.call = call

        def start(self) -> None:
            self.call()  # type: ignore[operator]
            said.append("started")

        def cancel(self) -> None:
            said.append("cancelled")

    monkeypatch.setattr(threading, "Timer", Now)
    with bus.patience():
        assert said == ["started"]
    assert said == ["started", "cancelled"]
    assert capsys.readouterr().err == "compiling kernels (first time only) ...\n"
