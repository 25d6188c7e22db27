"""Another inverter, live: `run --map` looks, decides, follows; the same as a replay of the same frames gives."""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest

from ipmsm_can.bus.pythoncan import messages_from_block
from ipmsm_can.cli import bus, main
from ipmsm_can.config import load_configs
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping import load_map, make_plan
from ipmsm_can.mapping.follow import Follower
from ipmsm_can.mapping.mapper import Mapper
from ipmsm_can.mapping.track import MappedTracking
from ipmsm_can.wire.protocol import Protocol
from tests.replaying import drive_frames
from tests.test_mapping_drives import cascadia


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("toml") / "drive.toml"
    path.write_text('[motor]\npreset = "m2"\n')
    return path


def follow(config: Path, name: str, frames: FrameBlock, piece: int, look_s: float) -> Follower:
    drive = load_configs([str(config)])[0]
    follower = Follower(drive, make_plan(load_map(name), pole_pairs=drive.build_motor().pole_pairs), look_s)
    for k in range(0, len(frames), piece):
        follower.feed(frames.take(slice(k, k + piece)))
    return follower


def test_fast_observer_as_in_a_replay_whatever_the_blocks(config: Path) -> None:
    frames = drive_frames(Protocol(), 1.0, reference_rate=500.0)
    drive = load_configs([str(config)])[0]
    parts = [follow(config, "ipmsm_can", frames, piece, 0.3) for piece in (1, 137, 100_000)]
    plan = parts[0].plan
    assert parts[0].tracking is not None
    rate = parts[0].tracking.summary.sample_rate
    mapper, expected = Mapper(plan, rate), MappedTracking(drive, plan.map, rate)
    expected.feed(mapper.feed(frames))
    for one in parts:
        assert one.decided and one.verdict.startswith("fast observer: ") and one.tracking is not None
        assert one.tracking.latest == expected.latest
        assert one.tracking.summary.rows == expected.summary.rows == one.samples
        assert one.tracking.summary.encoder.rms < math.radians(2.0)
    assert expected.summary.rows > 0.9 * rate


def test_steady_state_only(config: Path) -> None:
    frames = cascadia(seconds=4.0)
    parts = [follow(config, "cascadia_pm", frames, piece, 2.0) for piece in (7, 100_000)]
    for one in parts:
        assert one.tracking is None and one.steady is not None
        assert one.verdict.startswith("steady-state quantities only: the voltage is a momentary value")
        assert one.steady.psi_m.mean == pytest.approx(0.59, rel=0.02)
    assert parts[0].steady is not None and parts[1].steady is not None
    assert parts[0].steady.words() == parts[1].steady.words()


def test_it_looks_until_there_is_something_and_again_where_that_was_not_enough(config: Path) -> None:
    frames = cascadia(seconds=6.0)
    foreign = FrameBlock.zeros(100)
    foreign.can_id[:] = 0x7AA
    foreign.t_ns[:] = frames.t_ns[0] - 10**9 + 10**6 * np.arange(100)
    voltages = np.isin(frames.can_id, [0xA7, 0xA8])
    late = frames.t_ns > frames.t_ns[0] + 2_500_000_000
    one = follow(config, "cascadia_pm", foreign, 10, 1.0)
    assert one.verdict == "no frame of the map has come yet" and not one.decided
    short = follow(config, "cascadia_pm", frames, 50, 60.0)
    assert not short.decided
    short.flush()
    assert short.steady is not None and short.samples == 600
    one = follow(config, "cascadia_pm", FrameBlock.concat([foreign, frames.take(late | ~voltages)]), 50, 1.0)
    assert one.steady is not None and one.samples < 400
    nothing = follow(config, "cascadia_pm", frames.take(~voltages), 50, 1.0)
    assert not nothing.decided and nothing.verdict.startswith("nothing can be made of the signals: ")


def run_live(config: Path, name: str, frames: FrameBlock, capsys: pytest.CaptureFixture[str],
             *options: str, command: str = "run", quiet: str = "--quiet") -> tuple[int, str, list[int]]:
    """The command on a virtual bus with this traffic; exit code, what it said, identifiers it sent."""
    begin = [command, "--drive", str(config)] if command == "diagnose" else [command, str(config), quiet]
    stops: list[bus.Stop] = []
    ordinary = bus.stop_on_signals
    codes: list[int] = []

    class Entered:
        def __init__(self, duration: float | None = None) -> None:
            self.context = ordinary(duration)

        def __enter__(self) -> bus.Stop:
            stops.append(self.context.__enter__())
            return stops[-1]

        def __exit__(self, *words: object) -> None:
            self.context.__exit__(None, None, None)

    with (can.Bus(interface="virtual", channel=name, preserve_timestamps=True) as sender,
          pytest.MonkeyPatch.context() as patch):
        patch.setattr(bus, "stop_on_signals", Entered)
        thread = threading.Thread(target=lambda: codes.append(main(
            [*begin, "-i", "virtual", "-c", name, "--map", name, *options])))
        thread.start()
        deadline = time.monotonic() + 240
        while not stops and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.2)
        for sent in messages_from_block(frames):  # with their times: the map goes by those
            sender.send(sent)
        time.sleep(0.5)
        stops[0].now()
        thread.join(60)
        heard = []
        while (message := sender.recv(0)) is not None:
            heard.append(message.arbitration_id)
    said = capsys.readouterr()
    return codes[0], said.out + said.err, heard


def test_the_command_listens_records_and_sends_nothing(config: Path, tmp_path: Path,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    frames = cascadia(seconds=3.0)
    log = tmp_path / "run.blf"
    code, said, heard = run_live(config, "cascadia_pm", frames, capsys, "--record", str(log))
    assert code == 0 and not heard, said
    assert f"recorded {len(frames)} frames in {log}" in said
    assert "SILENT (listening only)" in said


@pytest.mark.parametrize(("options", "told"), [
    (["--transmit"], "--transmit does not go with --map"),
    (["--measure", "x.mf4"], "--measure does not go with --map"),
    (["--map", "cascadia"], "did you mean cascadia_pm"),
])
def test_wrong_options(config: Path, options: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(config), "-i", "virtual", "-c", "x", "--map", "cascadia_pm", *options]) == 2
    assert told in capsys.readouterr().err


def test_no_sample_is_said(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(config), "-i", "virtual", "-c", "silence", "--map", "cascadia_pm", "--quiet",
                 "--duration", "0.3"]) == 1
    assert "no sample of the map cascadia_pm could be used: no frame of the map has come yet" in (
        capsys.readouterr().err)
