"""Every way to write currents, voltages, angles and speeds in a map, against plain numpy."""

from __future__ import annotations

import math
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from ipmsm_can.mapping import MapError, make_plan
from ipmsm_can.mapping.convert import IMPLAUSIBLE, MISSING
from tests.mapping_traffic import Truth, dbc_text, frames, make_map, run

NAMES = ("x", "y", "z", "r", "s", "t", "u", "p")
DBC = (dbc_text({1: ("M", [f'{n} : {32 * (k % 2)}|32@1- (1,0) [0|0] ""' for k, n in enumerate(("x", "y"))]),
                 2: ("N", ['z : 0|32@1- (1,0) [0|0] ""', 'r : 32|32@1- (1,0) [0|0] ""']),
                 3: ("O", ['s : 0|32@1- (1,0) [0|0] ""', 't : 32|32@1- (1,0) [0|0] ""']),
                 4: ("P", ['u : 0|32@1- (1,0) [0|0] ""', 'p : 32|32@1- (1,0) [0|0] ""'])})
       + "\n" + "\n".join(f"SIG_VALTYPE_ {m} {s} : 1;" for m, s in (
           (1, "x"), (1, "y"), (2, "z"), (2, "r"), (3, "s"), (3, "t"), (4, "u"), (4, "p"))))
TRUTH = Truth()
T = np.arange(40) * 1e-3
ANGLE = '[angle]\nsignal = "O.t"\nunit = "rad"\nof = "electrical"\n'
CURRENT = '[current]\nform = "alpha_beta"\nmeasure = "peak"\nalpha = "M.x"\nbeta = "M.y"\n'


def _block(**values: object):  # type: ignore[no-untyped-def]
    where = {"x": "M", "y": "M", "z": "N", "r": "N", "s": "O", "t": "O", "u": "P", "p": "P"}
    return frames(DBC, {m: (T, {s: v for s, v in values.items() if where[s] == m}) for m in "MNOP"})


def _near(found: np.ndarray, expected: np.ndarray) -> None:
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("order", ["".join(p) for p in permutations("abc")])
def test_three_phases_in_any_order_with_a_common_mode(tmp_path: Path, order: str) -> None:
    phases = dict(zip("abc", TRUTH.phases(TRUTH.i(T)), strict=True))
    sent = {signal: phases[phase] + 0.7 for signal, phase in zip("xyz", order, strict=True)}
    inverter = make_map(tmp_path, DBC, f'[current]\nform = "phase"\nmeasure = "peak"\norder = "{order}"\n'
                        'a = "M.x"\nb = "M.y"\nc = "N.z"\n')
    found = run(_block(**sent), inverter)
    _near(found.i_alpha + 1j * found.i_beta, TRUTH.i(T))


@pytest.mark.parametrize(("left_out", "order"), [("a", "abc"), ("b", "abc"), ("c", "abc"), ("c", "cab")])
def test_two_phases_are_enough(tmp_path: Path, left_out: str, order: str) -> None:
    phases = dict(zip("abc", TRUTH.phases(TRUTH.i(T)), strict=True))
    signals = dict(zip("abc", ("M.x", "M.y", "N.z"), strict=True))
    sent = {signals[key][2]: phases[phase] for key, phase in zip("abc", order, strict=True)}
    lines = "".join(f'{key} = "{signal}"\n' for key, signal in signals.items() if key != left_out)
    inverter = make_map(tmp_path, DBC, f'[current]\nform = "phase"\nmeasure = "peak"\norder = "{order}"\n{lines}')
    found = run(_block(**sent), inverter)
    _near(found.i_alpha + 1j * found.i_beta, TRUTH.i(T))


def test_gain_offset_and_sign(tmp_path: Path) -> None:
    i = TRUTH.i(T)
    inverter = make_map(tmp_path, DBC, '[current]\nform = "alpha_beta"\nmeasure = "peak"\n'
                        'alpha = { signal = "M.x", gain = 0.5, offset = -3, sign = -1 }\nbeta = "M.y"\n')
    found = run(_block(x=(-i.real + 3.0) / 0.5, y=i.imag), inverter)
    _near(found.i_alpha + 1j * found.i_beta, i)


@pytest.mark.parametrize(("measure", "transform", "factor"), [
    ("peak", "amplitude", 1.0), ("rms", "amplitude", 1 / math.sqrt(2)), ("peak", "power", math.sqrt(1.5))])
def test_dq_in_rms_or_power_invariant(tmp_path: Path, measure: str, transform: str, factor: float) -> None:
    i = TRUTH.i_dq(T) * factor
    inverter = make_map(tmp_path, DBC, f'[current]\nform = "dq"\nmeasure = "{measure}"\ntransform = "{transform}"\n'
                        'd = "M.x"\nq = "M.y"\n' + ANGLE)
    found = run(_block(x=i.real, y=i.imag, t=TRUTH.theta(T)), inverter)
    _near(found.i_d + 1j * found.i_q, TRUTH.i_dq(T))
    _near(found.i_alpha + 1j * found.i_beta, TRUTH.i(T))


def _voltage(tmp_path: Path, body: str, **sent: object):  # type: ignore[no-untyped-def]
    i = TRUTH.i(T)
    inverter = make_map(tmp_path, DBC, CURRENT + f"[voltage]\n{body}\n" + ANGLE)
    return run(_block(x=i.real, y=i.imag, t=TRUTH.theta(T), **sent), inverter)


@pytest.mark.parametrize("left_out", ["", "ab", "bc", "ca"])
@pytest.mark.parametrize("measure", ["peak", "rms"])
def test_line_voltages(tmp_path: Path, left_out: str, measure: str) -> None:
    a, b, c = TRUTH.phases(TRUTH.v(T))
    scale = 1 / math.sqrt(2) if measure == "rms" else 1.0
    keys = {"ab": ("N.z", a - b), "bc": ("N.r", b - c), "ca": ("O.s", c - a)}
    lines = "\n".join(f'{key} = "{signal}"' for key, (signal, _) in keys.items() if key != left_out)
    found = _voltage(tmp_path, f'form = "line_line"\nmeasure = "{measure}"\nper = "line"\n{lines}',
                     **{signal[2]: scale * value for signal, value in keys.values()})
    _near(found.v_alpha + 1j * found.v_beta, TRUTH.v(T))
    _near(found.v_d + 1j * found.v_q, TRUTH.v_dq(T))


def test_dq_voltage_line_to_line(tmp_path: Path) -> None:
    v = TRUTH.v_dq(T) * math.sqrt(3.0)
    found = _voltage(tmp_path, 'form = "dq"\nmeasure = "peak"\nper = "line"\nd = "N.z"\nq = "N.r"',
                     z=v.real, r=v.imag)
    _near(found.v_alpha + 1j * found.v_beta, TRUTH.v(T))


def test_duty_cycles_times_the_dc_voltage(tmp_path: Path) -> None:
    v_dc = 400.0 + 20 * np.sin(30 * T)
    a, b, c = (0.5 + 0.03 * np.cos(90 * T) + phase / v_dc for phase in TRUTH.phases(TRUTH.v(T)))
    body = ('form = "duty"\nmeasure = "peak"\nper = "phase"\na = "N.z"\nb = "N.r"\nc = "O.s"\n'
            '[dc_voltage]\nsignal = "P.u"\n')
    found = _voltage(tmp_path, body, z=a, r=b, s=c, u=v_dc)
    _near(found.v_alpha + 1j * found.v_beta, TRUTH.v(T))


@pytest.mark.parametrize(("unit", "of", "scale"), [
    ("rad", "electrical", 1.0), ("deg", "electrical", 180 / math.pi), ("turns", "electrical", 0.5 / math.pi),
    ("deg", "shaft", 45 / math.pi), ("turns", "shaft", 0.125 / math.pi)])
@pytest.mark.parametrize("direction", [1, -1])
def test_angles(tmp_path: Path, unit: str, of: str, scale: float, direction: int) -> None:
    zero = math.radians(37.0)
    shown = scale * (direction * TRUTH.theta(T) + zero)
    inverter = make_map(tmp_path, DBC, CURRENT + f'[encoder]\nsignal = "O.t"\nunit = "{unit}"\nof = "{of}"\n'
                        f"zero = 37\ndirection = {direction}\n")
    i = TRUTH.i(T)
    found = run(_block(x=i.real, y=i.imag, t=shown), inverter, pole_pairs=4)
    assert np.allclose(np.exp(1j * found.theta_encoder), np.exp(1j * TRUTH.theta(T)), atol=1e-5)
    assert np.isnan(found.theta_e).all() and np.isnan(found.i_d).all()  # the encoder is not the frame of d and q


@pytest.mark.parametrize(("unit", "scale"), [
    ("rad/s electrical", 1.0), ("Hz electrical", 0.5 / math.pi), ("rpm electrical", 30 / math.pi),
    ("rad/s shaft", 0.25), ("turns/s shaft", 0.125 / math.pi), ("rpm shaft", 7.5 / math.pi)])
def test_speeds(tmp_path: Path, unit: str, scale: float) -> None:
    inverter = make_map(tmp_path, DBC, CURRENT + f'[speed]\nsignal = "O.t"\nunit = "{unit}"\n')
    found = run(_block(x=1.0, y=0.0, t=scale * TRUTH.omega(T)), inverter, pole_pairs=4)
    _near(found.omega_e, TRUTH.omega(T))
    if unit.endswith("shaft"):
        with pytest.raises(MapError, match=r"speed.unit counts turns of the shaft"):
            make_plan(inverter)


def test_what_is_no_measurement_becomes_nan_and_is_told(tmp_path: Path) -> None:
    x = np.ones(40)
    x[5], x[6] = 1e9, math.inf
    inverter = make_map(tmp_path, DBC, CURRENT + '[torque]\nsignal = "P.p"\n[dc_voltage]\nsignal = "P.u"\n')
    block = frames(DBC, {"M": (T, {"x": x, "y": 0.0}), "P": (T[1:], {"u": 300.0, "p": 1.0})})
    found = run(block, inverter)
    assert np.flatnonzero(np.isnan(found.i_alpha)).tolist() == [5, 6]
    assert np.flatnonzero(found.quality & IMPLAUSIBLE).tolist() == [5, 6]
    silent = run(block.take(block.can_id != 4), inverter)
    assert (silent.quality & MISSING != 0).all() and np.isnan(silent.torque).all()


def test_the_current_tells_a_speed_where_nothing_else_does_and_noise_tells_none(tmp_path: Path) -> None:
    inverter = make_map(tmp_path, DBC, CURRENT)
    rng = np.random.default_rng(1)
    noise = rng.normal(size=40) + 1j * rng.normal(size=40)
    i = TRUTH.i(T) + 0.02 * noise
    turning = run(_block(x=i.real, y=i.imag), inverter).turning
    assert np.abs(turning[12:] / TRUTH.omega(T)[12:] - 1.0).max() < 0.1
    assert np.isnan(run(_block(x=noise.real, y=noise.imag), inverter).turning[15:]).all()


def test_a_multiplexed_signal_counts_where_it_is_selected(tmp_path: Path) -> None:
    dbc = dbc_text({9: ("Rec", ['segment M : 0|8@1+ (1,0) [0|255] ""', 'ia m1 : 16|16@1- (0.1,0) [0|0] "A"',
                                'ib m1 : 32|16@1- (0.1,0) [0|0] "A"', 'vd m2 : 16|16@1- (0.1,0) [0|0] "V"'])})
    inverter = make_map(tmp_path, dbc, '[current]\nform = "phase"\nmeasure = "peak"\na = "Rec.ia"\nb = "Rec.ib"\n'
                        '[dc_voltage]\nsignal = "Rec.vd"\n[timing]\nlimit_time = 1\n')
    a, b, _ = TRUTH.phases(TRUTH.i(T))
    one = frames(dbc, {"Rec": (T, {"segment": 1.0, "ia": a, "ib": b, "vd": 0.0})})
    two = frames(dbc, {"Rec": (T, {"segment": 2.0, "ia": 0.0, "ib": 0.0, "vd": 300.0 + 1e3 * T})})
    two.t_ns[:] += 500_000
    both = type(one).concat([one, two])
    found = run(both.take(np.argsort(both.t_ns, kind="stable")), inverter)
    assert len(found) == 40
    assert np.abs(found.i_alpha + 1j * found.i_beta - TRUTH.i(T)).max() < 0.15
    assert np.abs(found.v_dc[1:] - 300.0 - 1e3 * (T[1:] - 5e-4)).max() < 0.11
