"""observer.kind of a drive.toml in co-simulation and in replay: with quantisation, with losses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ipmsm_can.bus import lane, lane_kernel
from ipmsm_can.bus.cosim import BusFaults, CoSimulation
from ipmsm_can.companion import Companion
from ipmsm_can.config import OBSERVER_KINDS, parse_config
from ipmsm_can.drive import profile
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import confidence
from ipmsm_can.frames import FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import MessageKind, ObserverKind, Protocol
from tests.replaying import column, rows_of
from tests.test_observers import MODULO_PI, SURFACE

PROTOCOL = Protocol()
SURFACE_TOML = '[motor]\npreset = "m2"\nL_d = "10.25 mH"\nL_q = "10.25 mH"\n'
SALIENT_TOML = '[motor]\npreset = "m2"\n'


def toml(kind: str) -> str:
    motor = SURFACE_TOML if kind.startswith("spmsm") else SALIENT_TOML
    return f'{motor}[observer]\nkind = "{kind}"\n[injection]\nwaveform = "rotating"\n'


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
def test_in_co_simulation_and_again_in_replay(kind: str) -> None:
    """A loaded drive, at 1000 rpm or, to be probed by the companion itself, at 20; one frame in fifty lost."""
    axis_only = kind in MODULO_PI
    track = profile.constant((20.0 if axis_only else 1000.0) * profile.RPM, 1.0, 1.5)
    motor = SURFACE if kind.startswith("spmsm") else M2
    simulation = DriveSimulation(motor, DriveParameters(sample_rate=5000.0), track, theta_0=0.3)
    drive = DriveNode(PROTOCOL, 0, simulation, DriveNodeSettings())
    config = parse_config(toml(kind))
    companion = Companion([config], PROTOCOL, transmit=True)
    cosim = CoSimulation([drive], companion, BusFaults(loss=0.02, seed=3), keep_frames=True)
    recording = cosim.run(1.5)
    truth = np.concatenate([s.theta_e for s in recording.truth[0]])
    tracked = recording.tracked[0]
    counter = np.concatenate([t.run.counter for t in tracked])
    theta = np.concatenate([t.estimate.angle[0] for t in tracked])
    flags = np.concatenate([t.estimate.flags for t in tracked])
    turn = 180.0 if axis_only else 360.0
    off = (np.degrees(theta - truth[counter]) + turn / 2) % turn - turn / 2
    late = counter > 0.7 * counter[-1]
    assert np.sqrt(np.mean(off[late] ** 2)) < (8.0 if axis_only else 0.3)
    if axis_only:
        assert not (flags & confidence.VALID).any()
        assert np.mean(flags[late] & confidence.LOCKED != 0) > 0.8
    else:
        assert (flags[late] & confidence.VALID != 0).all()

    frames = FrameBlock.concat(recording.frames)
    status = np.flatnonzero(frames.can_id == PROTOCOL.base_ids[MessageKind.COMPANION_STATUS])
    values, _, _ = PROTOCOL.decode(MessageKind.COMPANION_STATUS, 0, frames.raw, status)
    index = PROTOCOL.codecs[MessageKind.COMPANION_STATUS].index
    assert set(values[index["observer"]]) == {float(ObserverKind[kind.upper()])}

    blocks = rows_of(frames, [config], PROTOCOL)[0]
    again, rows = column(blocks, "theta_rad"), column(blocks, "sample").astype(np.int64)
    # The log has no losses, so the filters' past differs a little; the angle must not.
    apart = (np.degrees(again - truth[rows]) + turn / 2) % turn - turn / 2
    assert np.sqrt(np.mean(apart[rows > 0.7 * rows[-1]] ** 2)) < (8.0 if axis_only else 0.3)


@pytest.mark.parametrize("kind", OBSERVER_KINDS)
def test_the_compiled_loop_serves_it(kind: str) -> None:
    """One machine code for all kinds: the records have the same types whatever the observer is."""
    companion = Companion([parse_config(toml(kind))], PROTOCOL, transmit=True)
    values: dict[str, Any] = dict.fromkeys(("i_alpha", "i_beta", "v_alpha", "v_beta"), np.zeros(4))
    samples = PROTOCOL.encode(MessageKind.DRIVE_SAMPLE, 0, {**values, "sample_counter": np.arange(4)})
    timing = PROTOCOL.encode(MessageKind.DRIVE_TIMING, 0, {"sample_counter": np.array([3]),
                                                           "sample_rate": np.array([5000.0])})
    raw = np.concatenate([samples, timing])
    companion.feed(FrameBlock(raw, np.arange(5) * 200_000))
    node = companion.nodes[0]
    assert node.estimator is not None
    lane.warm_up(companion)
    signatures = lane_kernel.lap.signatures  # type: ignore[attr-defined]
    assert len(signatures) == 1
