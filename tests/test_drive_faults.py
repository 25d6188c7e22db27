"""What a simulated drive reports wrongly, against phases and angles worked out by hand."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.drive.faults import DriveFaults, FaultyEncoder
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.parameters import DriveParameters
from ipmsm_can.drive.profile import RPM, Profile
from ipmsm_can.drive.simulation import DriveSimulation
from ipmsm_can.motor import M2
from ipmsm_can.wire.protocol import MessageKind, Protocol

PHASES = np.array([[1.0, 0.0], [-0.5, math.sqrt(0.75)], [-0.5, -math.sqrt(0.75)]])
"""Phases a, b, c of (alpha, beta): projections on axes 120 deg apart."""
BACK = PHASES.T * 2.0 / 3.0
ANGLES = np.linspace(-4.0, 9.0, 40)


@pytest.mark.parametrize("order", ["abc", "acb", "bac", "cba", "cab", "bca"])
def test_phases_are_reported_in_the_order_asked_for(order: str) -> None:
    true = np.stack([3.0 * np.cos(ANGLES), 3.0 * np.sin(ANGLES)])
    phases = dict(zip("abc", PHASES @ true, strict=True))
    expected = BACK @ np.stack([phases[name] for name in order])
    values = np.concatenate([true, 2.0 * true])
    out = DriveFaults(current_phases=order, voltage_phases=order, voltage_sign=-1).samples(values)
    np.testing.assert_allclose(out[:2], expected, atol=1e-12)
    np.testing.assert_allclose(out[2:], -2.0 * expected, atol=1e-12)


def test_an_encoder_with_every_fault_at_once_whatever_the_blocks() -> None:
    faults = DriveFaults(encoder_zero=0.3, encoder_direction=-1, encoder_pole_pairs=4, eccentricity=0.1, slip=0.5,
                         slip_at=0.02)
    shaft = np.linspace(0.0, 3.0 * 2.0 * math.pi, 200)
    theta, omega = 3.0 * shaft, np.full(200, 60.0)
    sample = np.arange(200)
    expected = -4.0 * shaft + 0.3 + 0.1 * np.sin(shaft) + 0.5 * (sample >= 20)
    for cuts in ([0, 200], [0, 1, 50, 50, 200]):
        encoder = FaultyEncoder(faults, 3, 1000.0)
        wrapped = np.angle(np.exp(1j * theta))
        got = [encoder.read(sample[a:b], wrapped[a:b], omega[a:b])
               for a, b in pairwise(cuts)]
        angle = np.concatenate([g[0] for g in got])
        np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * expected), atol=1e-9)
        np.testing.assert_allclose(np.concatenate([g[1] for g in got]),
                                   -80.0 + 0.1 * np.cos(shaft) * 20.0, atol=1e-9)


def test_a_sensor_of_another_gain_shows_in_its_phase_only_and_in_the_control() -> None:
    """The control regulates what it sees: the seen current stays balanced, the real one does not."""
    profile = Profile(((0.0, 300.0 * RPM),), ((0.0, 4.0),), 0.6)
    gains = (1.0, 1.25, 1.0)
    drive = DriveSimulation(M2, DriveParameters(sample_rate=5000.0, current_noise=0.0, current_gain=gains), profile)
    s = drive.run(3000)
    real = np.stack([np.cos(s.theta_e) * s.i_d - np.sin(s.theta_e) * s.i_q,
                     np.sin(s.theta_e) * s.i_d + np.cos(s.theta_e) * s.i_q])
    phases = np.asarray(gains)[:, None] * (PHASES @ real)
    # Three sensors of different gains no longer add up to zero; alpha and beta do not see that part.
    np.testing.assert_allclose(np.stack([s.i_alpha, s.i_beta]), BACK @ phases, atol=1e-9)
    size = [float(np.abs(part[2000:]).max()) for part in PHASES @ real]
    assert size[1] < 0.9 * size[0]


def reported(faults: DriveFaults | None) -> dict[MessageKind, NDArray[np.float64]]:
    protocol = Protocol()
    simulation = DriveSimulation(M2, DriveParameters(sample_rate=5000.0),
                                 Profile(((0.0, 500.0 * RPM),), ((0.0, 2.0),), 0.2))
    frames = DriveNode(protocol, 2, simulation, DriveNodeSettings(), faults).step(500).frames
    labels = protocol.classify(frames.raw)
    return {kind: protocol.decode(kind, 2, frames.raw, np.flatnonzero(labels == kind * 16 + 2))[0]
            for kind in (MessageKind.DRIVE_SAMPLE, MessageKind.DRIVE_REFERENCE)}


def test_the_wire_carries_the_faults_and_the_control_does_not_suffer() -> None:
    right = reported(None)
    wrong = reported(DriveFaults(current_sign=-1, encoder_zero=0.5))
    assert np.array_equal(right[MessageKind.DRIVE_SAMPLE], reported(DriveFaults())[MessageKind.DRIVE_SAMPLE])
    np.testing.assert_allclose(wrong[MessageKind.DRIVE_SAMPLE][:2], -right[MessageKind.DRIVE_SAMPLE][:2], atol=1e-9)
    np.testing.assert_array_equal(wrong[MessageKind.DRIVE_SAMPLE][2:], right[MessageKind.DRIVE_SAMPLE][2:])
    theta = Protocol().codecs[MessageKind.DRIVE_REFERENCE].index["theta_e"]
    step = wrong[MessageKind.DRIVE_REFERENCE][theta] - right[MessageKind.DRIVE_REFERENCE][theta]
    np.testing.assert_allclose(np.exp(1j * step), np.exp(0.5j), atol=1e-3)


@pytest.mark.parametrize(("given", "words"), [
    ({"current_phases": "aab"}, "current_phases is 'aab'; allowed is abc"),
    ({"voltage_sign": 0}, "voltage_sign is 0; allowed is 1 or -1"),
    ({"slip": math.nan}, "slip is nan; allowed is a finite number"),
    ({"encoder_pole_pairs": 0}, "encoder_pole_pairs is 0; allowed is 1 or more"),
])
def test_settings_that_cannot_be(given: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        DriveFaults(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize("gains", [(1.0, 1.0), (1.0, 0.0, 1.0), (1.0, math.inf, 1.0)])
def test_gains_that_cannot_be(gains: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"current_gain is .*; allowed are three finite numbers above 0"):
        DriveParameters(current_gain=gains)  # type: ignore[arg-type]
