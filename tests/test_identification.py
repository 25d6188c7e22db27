"""Identification against the simulated drives that made the samples."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ipmsm_can.analysis.measurement import Measurement, MeasurementBuilder
from ipmsm_can.config import config_from
from ipmsm_can.drive.node import DriveNode, DriveNodeSettings
from ipmsm_can.drive.profile import Profile, constant
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.identification import encoder_fit as fit
from ipmsm_can.identification import identify, sensorless_fit
from ipmsm_can.identification.samples import Stretch, encoder_angle, stretches
from ipmsm_can.identification.words import as_dict, sentences, table
from ipmsm_can.motor import PRESETS
from ipmsm_can.wire.protocol import Protocol
from tools.identification import LIMITS, Drawn, drawn, one, recorded, running, truth
from tools.identification import table as campaign_table


@cache
def protocol() -> Protocol:
    return Protocol()


@cache
def drive(name: str, seed: int) -> tuple[Drawn, Measurement]:
    d = drawn(name, seed)
    return d, recorded(d, protocol())


def record(d: Drawn, profile: Profile, keep: float = 1.0, encoder: bool = True) -> Measurement:
    simulation = DriveSimulation(d.motor, d.parameters, profile, d.theta_0, d.seed)
    node = DriveNode(protocol(), 0, simulation, DriveNodeSettings(reference_rate=500.0 if encoder else 0.0))
    frames = node.step(simulation.samples_in_profile, 10**18).frames
    frames = frames.take(np.random.default_rng(1).random(len(frames)) < keep)
    builder = MeasurementBuilder(config_from({"motor": {"preset": d.name}}), protocol())
    builder.feed(frames)
    return builder.measurement()


@pytest.mark.parametrize("name", ["m1", "m2"])
def test_a_motor_is_found_from_ordinary_running(name: str) -> None:
    d, m = drive(name, 5)
    found = identify(m, d.plate)
    assert found.method == "encoder" and found.fits and not found.notes
    for key, value in truth(d).items():
        p = found.parameters[key]
        assert p.told, key
        assert abs(p.value - value) < 4.0 * p.standard_error, key
        if key in LIMITS:
            assert 100.0 * abs(p.value / value - 1.0) < LIMITS[key], key
            assert p.high - p.low < 0.12 * value, key
    assert found.parameters["dead_time_zone"].value == pytest.approx(0.2, rel=0.05)
    # The sensors' noise, and nothing else, is left.
    assert found.residual == pytest.approx((0.02, 0.02), rel=0.05)


def test_the_name_plate_does_not_matter() -> None:
    d, m = drive("m2", 5)
    a, b = identify(m, d.plate), identify(m, PRESETS["m1"])
    for key in LIMITS:
        assert b.value(key) == pytest.approx(a.value(key), abs=0.2 * a.parameters[key].standard_error), key


def test_a_slice_of_the_campaign() -> None:
    runs = [one(("m2", seed, True)) for seed in range(3)]
    lines, _ = campaign_table("m2", runs, PRESETS["m2"], True)
    assert lines[0].startswith("m2, 3 runs") and len(lines) == 2 + len(runs[0])
    held = [row[2] for run in runs for row in run.values()]
    assert np.mean(held) >= 0.8
    assert all(math.isfinite(row[0]) for run in runs for row in run.values())


def test_the_encoders_zero_and_a_late_voltage_are_told_apart() -> None:
    d, m = drive("m2", 5)
    late = replace(m, v_alpha=np.roll(m.v_alpha, 1), v_beta=np.roll(m.v_beta, 1),
                   encoder_theta=(m.encoder_theta + 0.5) % (2.0 * math.pi))
    found, before = identify(late, d.plate), identify(m, d.plate)
    assert found.value("encoder_zero") == pytest.approx(0.5, abs=1e-3)
    assert found.value("voltage_delay") == pytest.approx(1.0, abs=5e-3)
    assert any("observer.voltage_delay = 1.00" in s for s in sentences(found))
    for key in LIMITS:
        assert found.value(key) == pytest.approx(before.value(key), rel=5e-3), key


def test_an_inductance_that_losses_hide_is_not_claimed() -> None:
    d, _ = drive("m2", 5)
    found = identify(record(d, running("m2"), keep=0.95), d.plate)
    assert found.fits and {"R", "L_q", "psi_m"} <= found.told
    assert "L_d" not in found.told
    assert any(note.startswith("L_d cannot be told") for note in found.notes)
    assert found.value("R") == pytest.approx(d.motor.R, rel=0.01)


def test_saturation_is_told() -> None:
    d = drawn("m2", 5, saturation=0.3)
    found = identify(recorded(d, protocol()), d.plate)
    assert any("change with the current" in note for note in found.notes)
    assert found.value("L_q") < 0.95 * d.motor.L_q
    assert "L_d" not in found.told


def test_a_rotor_that_stands_tells_no_flux() -> None:
    d, _ = drive("m2", 5)
    found = identify(record(d, constant(0.0, 0.0, 1.0)), d.plate)
    assert not found.told & {"psi_m", "R", "encoder_zero", "voltage_delay"}


@pytest.mark.parametrize("change", ["swapped", "direction", "pole_pairs"])
def test_samples_of_another_machine_give_no_number(change: str) -> None:
    d, m = drive("m2", 5)
    wrong = {"swapped": lambda: replace(m, i_beta=-m.i_beta, v_beta=-m.v_beta),
             "direction": lambda: replace(m, encoder_theta=-m.encoder_theta, encoder_omega=-m.encoder_omega),
             "pole_pairs": lambda: replace(m, encoder_theta=np.unwrap(m.encoder_theta) * 4.0 / 3.0,
                                           encoder_omega=m.encoder_omega * 4.0 / 3.0)}[change]()
    found = identify(wrong, d.plate)
    assert not found.fits and not found.told
    assert "not those of such a motor" in found.notes[0]


@pytest.mark.parametrize("name", ["m1", "m2"])
def test_without_an_encoder_the_resistance_and_the_magnet_are_told(name: str) -> None:
    d, m = drive(name, 5)
    blind = replace(m, encoder_sample=m.encoder_sample[:0], encoder_theta=m.encoder_theta[:0],
                    encoder_omega=m.encoder_omega[:0])
    found = identify(blind, d.plate)
    assert found.method == "sensorless" and found.fits
    assert found.told >= {"R", "psi_m"} and not found.told & {"L_d", "L_q"}
    assert found.value("R") == pytest.approx(d.motor.R, rel=0.1)
    assert found.value("psi_m") == pytest.approx(d.motor.psi_m, rel=0.01)
    for key in ("R", "psi_m"):
        p = found.parameters[key]
        assert abs(p.value - getattr(d.motor, key)) < 3.0 * p.standard_error
    assert any(note.startswith("L_d and L_q cannot be told without an encoder") for note in found.notes)


def test_nothing_to_go_by_gives_a_sentence() -> None:
    d, _ = drive("m2", 5)
    found = identify(record(d, constant(0.0, 0.0, 0.5), encoder=False), d.plate)
    assert not found.fits and not found.told
    assert "the log holds no encoder" in found.notes[0]
    empty = MeasurementBuilder(config_from({"motor": {"preset": "m2"}}), protocol()).measurement()
    assert not identify(empty, d.plate).told


def test_derivatives_with_encoder_are_those_of_the_residual() -> None:
    """Without noise columns made of the model's own currents are the derivatives."""
    d = drawn("m2", 1, current_noise=0.0, current_offset=(0.0, 0.0), dead_time_voltage=0.5)
    m = recorded(d, protocol())
    whole = stretches(m, encoder_angle(m))[0]
    piece = [whole.part(3000, 6000)]
    p, sigma = fit.start(d.motor)
    p[fit.DEAD_TIME], p[fit.ZONE] = 0.5, math.log(0.2)
    base, columns, _ = fit.rows(piece, m.sample_rate, p)
    for k, name in enumerate(fit.NAMES):
        q = p.copy()
        q[k] += 1e-5 * sigma[k]
        change = (fit.rows(piece, m.sample_rate, q)[0] - base).ravel() / (1e-5 * sigma[k])
        c = columns[k].ravel()
        # The columns leave out what dead time does beyond first order within a sample.
        assert change @ c / (c @ c) == pytest.approx(1.0, abs=0.05), name


def test_derivatives_without_encoder_are_those_of_the_residual() -> None:
    rng = np.random.default_rng(2)
    n, rate = 2500, 5000.0
    theta = 150.0 * np.arange(n) / rate
    d = PRESETS["m2"]
    dq = 0.2 * rng.standard_normal(n).cumsum() / 50.0 - 0.3 + 1j * (2.0 + np.sin(theta / 7.0))
    flux = np.exp(1j * theta) * (d.psi_m + d.L_d * dq.real + 1j * d.L_q * dq.imag)
    i = dq * np.exp(1j * theta)
    v = np.diff(flux, prepend=flux[0]) * rate + d.R * i
    window = sensorless_fit.Window(Stretch(0, i, v, np.full(n, np.nan), np.ones(n, np.bool_)), complex(flux[0]))
    p, sigma = sensorless_fit.start(d, [window])
    p[sensorless_fit.DEAD_TIME], p[sensorless_fit.ZONE] = 0.1, math.log(0.3)
    base, columns, _, _ = sensorless_fit.rows([window], rate, p)
    for k in set(range(p.size)) - {sensorless_fit.L_D}:
        q = p.copy()
        q[k] += 1e-7 * sigma[k]
        change = (sensorless_fit.rows([window], rate, q)[0] - base) / (1e-7 * sigma[k])
        scale = np.abs(columns[:, k]).max()
        assert np.abs(change - columns[:, k]).max() < 2e-3 * scale, k


def test_words_and_dictionary() -> None:
    d, m = drive("m2", 5)
    found = identify(m, d.plate)
    lines = table(found)
    assert lines[0].split() == ["parameter", "value", "95", "%", "interval", "name", "plate", "off", "by"]
    assert max(map(len, lines)) < 80
    text = as_dict(found)
    assert text["parameters"]["R"]["value"] == found.value("R") and text["parameters"]["R"]["told"] is True
    assert any(s.startswith("R is ") for s in sentences(found))


@pytest.mark.parametrize("volts", [0.0, 100.0, 300.0])
@pytest.mark.parametrize("encoder", [True, False])
def test_samples_that_are_not_where_they_say_never_raise(volts: float, encoder: bool) -> None:
    """A slow rate, wraps of a short counter that never were, and a voltage that is noise: the search leaves where
    anything can be computed."""
    simulation = DriveSimulation(PRESETS["m2"], DriveParameters(sample_rate=1000.0, current_bandwidth=60.0),
                                 Profile(((0.0, 20.0), (4.0, -20.0)), ((0.0, 2.0), (2.0, -2.0)), duration=4.0))
    builder = MeasurementBuilder(config_from({"motor": {"preset": "m2"}}), protocol())
    node = DriveNode(protocol(), 0, simulation, DriveNodeSettings(reference_rate=200.0))
    builder.feed(node.step(4000).frames)
    m = builder.measurement()
    rng = np.random.default_rng(1)
    jump = np.cumsum(np.where(rng.random(len(m)) < 0.01, 16, 0))
    late = jump[np.searchsorted(m.sample, m.encoder_sample)]
    none = slice(None) if encoder else slice(0)
    found = identify(replace(m, sample=m.sample + jump, v_alpha=rng.normal(0.0, volts, len(m)),
                             encoder_sample=(m.encoder_sample + late)[none], encoder_theta=m.encoder_theta[none],
                             encoder_omega=m.encoder_omega[none]), PRESETS["m2"])
    assert not found.fits and not found.told and found.notes
