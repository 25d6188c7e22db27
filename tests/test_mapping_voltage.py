"""Which interval a voltage belongs to: said by the map, obeyed by the estimator."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.config import config_from
from ipmsm_can.drive import profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSamples, DriveSimulation
from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping import make_plan, mapped
from ipmsm_can.mapping.track import MappedTracking, settings_with
from ipmsm_can.motor import M2
from ipmsm_can.wire.dbc import Database
from tests.mapping_traffic import T0, dbc_text, make_map

RATE = 5000.0
DBC = (dbc_text({k + 1: (f"M{k}", [f'{a} : 0|32@1- (1,0) [0|0] ""', f'{b} : 32|32@1- (1,0) [0|0] ""'])
                 for k, (a, b) in enumerate((("i_d", "i_q"), ("v_d", "v_q"), ("theta", "omega"),
                                             ("v_alpha", "v_beta")))})
       + "\n" + "\n".join(f"SIG_VALTYPE_ {k + 1} {s} : 1;" for k, pair in enumerate(
           (("i_d", "i_q"), ("v_d", "v_q"), ("theta", "omega"), ("v_alpha", "v_beta"))) for s in pair))
CURRENT = '[current]\nform = "dq"\nmeasure = "peak"\nd = "M0.i_d"\nq = "M0.i_q"\n'
ANGLE = '[angle]\nsignal = "M2.theta"\nunit = "rad"\nof = "electrical"\n'
DQ = '[voltage]\nform = "dq"\nmeasure = "peak"\nper = "phase"\nd = "M1.v_d"\nq = "M1.v_q"\n'
AXES = '[voltage]\nform = "alpha_beta"\nmeasure = "peak"\nper = "phase"\nalpha = "M3.v_alpha"\nbeta = "M3.v_beta"\n'


@pytest.fixture(scope="module")
def drive() -> DriveSamples:
    return DriveSimulation(M2, DriveParameters(sample_rate=RATE), profile.torque_pulses()).run(10000)


def _traffic(folder: Path, s: DriveSamples, late: int) -> FrameBlock:
    """Four frames a sample: dq voltages stand at the angle of the middle of the interval that ended."""
    (folder / "x.dbc").write_text(DBC)
    database = Database.load(folder / "x.dbc")
    north = np.exp(1j * s.theta_e)
    i = (s.i_alpha + 1j * s.i_beta) / north
    v = s.v_alpha + 1j * s.v_beta
    middle = np.exp(1j * (s.theta_e - 0.5 * s.omega_e / RATE))
    older = np.roll(v, late)
    sent = {"M0": {"i_d": i.real, "i_q": i.imag}, "M1": {"v_d": (v / middle).real, "v_q": (v / middle).imag},
            "M2": {"theta": s.theta_e, "omega": s.omega_e}, "M3": {"v_alpha": older.real, "v_beta": older.imag}}
    t_ns = T0 + np.rint(1e9 * np.arange(v.size) / RATE).astype(np.int64)
    parts = [FrameBlock(database.messages[name].encode(values), t_ns) for name, values in sent.items()]
    both = FrameBlock.concat(parts)
    return both.take(np.argsort(both.t_ns, kind="stable"))


def _error(folder: Path, s: DriveSamples, body: str, late: int = 0) -> float:
    """Angle error [deg rms] of the second half, at a voltage_delay as the map says."""
    inverter = make_map(folder, DBC, CURRENT + body + ANGLE)
    config = config_from({"motor": {"preset": "m2"}})
    angles: list[np.ndarray] = []
    tracking = MappedTracking(config, inverter, RATE, lambda rows: angles.append(rows.theta_rad))
    for block in mapped([_traffic(folder, s, late)], inverter, rate=RATE):
        tracking.feed(block)
    off = np.angle(np.exp(1j * (np.concatenate(angles) - s.theta_e)))[5000:]
    return math.degrees(math.sqrt(float(np.mean(off**2))))


def test_a_late_voltage_is_set_right_by_the_map(tmp_path: Path, drive: DriveSamples) -> None:
    in_time = _error(tmp_path, drive, AXES)
    late = _error(tmp_path, drive, AXES, late=1)
    put_right = _error(tmp_path, drive, AXES + "delay = 1\n", late=1)
    assert in_time < 0.1 and late > 2.0 and put_right < 0.1


def test_dq_voltages_at_the_middle_of_the_interval_are_half_a_sample_early(tmp_path: Path,
                                                                          drive: DriveSamples) -> None:
    # They are turned by the angle at the sample, which the rotor reaches half an interval later.
    early = _error(tmp_path, drive, DQ)
    put_right = _error(tmp_path, drive, DQ + "delay = -0.5\n")
    assert early > 1.0 and put_right < 0.2


def test_the_drive_file_outranks_the_map(tmp_path: Path) -> None:
    inverter = make_map(tmp_path, DBC, CURRENT + AXES + "delay = 1\n" + ANGLE)
    assert make_plan(inverter).map.voltage is not None
    auto, given = ({"motor": {"preset": "m2"}, "observer": o} for o in ({}, {"voltage_delay": 0.25}))
    assert settings_with(config_from(auto), inverter, 1000.0).voltage_delay == 1.0
    assert settings_with(config_from(given), inverter, 1000.0).voltage_delay == 0.25
    plain = make_map(tmp_path, DBC, CURRENT + AXES + ANGLE)
    assert settings_with(config_from(auto), plain, 1000.0).voltage_delay is None
