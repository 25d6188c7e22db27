"""Reports in separate frames brought to one time: against plain numpy, and whatever the blocks are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ipmsm_can.frames import FrameBlock
from ipmsm_can.mapping import InverterMap
from ipmsm_can.mapping.convert import ANGLE_APART, CURRENT_APART, OTHER_APART
from ipmsm_can.mapping.plan import ANGLE, I_1, V_DC
from ipmsm_can.wire.sequence_kernel import RESTARTED
from tests.mapping_traffic import dbc_text, frames, make_map, run, same

FLOAT = '{name} : {start}|32@1- (1,0) [0|0] ""'
DBC = dbc_text({
    1: ("A", [FLOAT.format(name="alpha", start=0), 'count : 32|8@1+ (1,0) [0|255] ""']),
    2: ("B", [FLOAT.format(name="beta", start=0), FLOAT.format(name="vdc", start=32)]),
    3: ("C", [FLOAT.format(name="theta", start=0), FLOAT.format(name="omega", start=32)]),
    4: ("D", [FLOAT.format(name="set", start=0)]),
}) + "\n" + "\n".join(f"SIG_VALTYPE_ {m} {s} : 1;" for m, s in (
    (1, "alpha"), (2, "beta"), (2, "vdc"), (3, "theta"), (3, "omega"), (4, "set")))
CURRENT = '[current]\nform = "alpha_beta"\nmeasure = "peak"\nalpha = "A.alpha"\nbeta = "B.beta"\n'
MAP = CURRENT + """[angle]
signal = "C.theta"
unit = "rad"
of = "electrical"
[dc_voltage]
signal = "B.vdc"
[torque]
signal = { signal = "D.set", method = "hold" }
[timing]
wait = 1
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("maps")


@pytest.fixture(scope="module")
def inverter(folder: Path) -> InverterMap:
    return make_map(folder, DBC, MAP)


def _times(draw_ms: list[int]) -> np.ndarray:
    return np.sort(np.array(draw_ms, float)) * 1e-3


MS = st.lists(st.integers(0, 400), min_size=1, max_size=25)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(a=MS, b=MS, c=MS, d=MS, seed=st.integers(0, 1000), edges=st.lists(st.integers(0, 100), max_size=6))
def test_alignment_is_that_of_numpy_and_blocks_change_no_bit(inverter: InverterMap, a: list[int], b: list[int],
                                                            c: list[int], d: list[int], seed: int,
                                                            edges: list[int]) -> None:
    # Distinct times within a message; those of different messages may coincide.
    t = [_times(sorted(set(x))) for x in (a, b, c, d)]
    rng = np.random.default_rng(seed)
    alpha, beta, vdc, theta, setpoint = (rng.normal(size=x.size).astype(np.float32).astype(float)
                                         for x in (t[0], t[1], t[1], t[2], t[3]))
    block = frames(DBC, {"A": (t[0], {"alpha": alpha}), "B": (t[1], {"beta": beta, "vdc": vdc}),
                         "C": (t[2], {"theta": theta}), "D": (t[3], {"set": setpoint})})
    whole = run(block, inverter)
    assert np.array_equal(whole.t_ns, block.t_ns[block.can_id == 1])
    assert np.allclose(whole.i_alpha, alpha, atol=0)
    for found, times, values in ((whole.i_beta, t[1], beta), (whole.v_dc, t[1], vdc)):
        assert np.allclose(found, np.interp(t[0], times, values), atol=1e-6)
    # A set point of the same instant counts only if its frame came before: the order of the frames decides.
    order = np.searchsorted(t[3], t[0], side="left") - 1
    later = np.searchsorted(t[3], t[0], side="right") - 1
    expected = np.where(order >= 0, setpoint[order], np.nan)
    alternative = np.where(later >= 0, setpoint[later], np.nan)
    either = [np.isclose(whole.torque, e, equal_nan=True) for e in (expected, alternative)]
    assert (either[0] | either[1]).all()
    # On the circle, the short way round.
    unit = np.exp(1j * theta)
    after = np.clip(np.searchsorted(t[2], t[0]), 0, t[2].size - 1)
    before = np.where(t[2][after] == t[0], after, np.maximum(after - (t[2][after] > t[0]), 0))
    span = t[2][after] - t[2][before]
    share = np.where(span > 0, (t[0] - t[2][before]) / np.where(span > 0, span, 1), 0)
    turned = np.angle(unit[after] / unit[before])
    expected_angle = np.exp(1j * (theta[before] + share * turned))
    assert np.allclose(np.exp(1j * whole.theta_e), expected_angle, atol=1e-5)
    nearest = np.abs(t[1][None, :] - t[0][:, None]).min(axis=1)
    assert np.allclose(whole.apart[I_1], 1e9 * nearest, atol=2)
    assert np.allclose(whole.apart[ANGLE], 1e9 * np.abs(t[2][None, :] - t[0][:, None]).min(axis=1), atol=2)
    same(whole, run(block, inverter, [e % (len(block) + 1) for e in edges]))


def test_frame_by_frame_gives_the_same_bits(inverter: InverterMap) -> None:
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 5, 300))
    block = frames(DBC, {"A": (t, {"alpha": rng.normal(size=300)}),
                         "B": (t[::3] + 1e-3, {"beta": rng.normal(size=100), "vdc": 300.0}),
                         "C": (t[::7] + 2e-3, {"theta": rng.uniform(-3, 3, 43)})})
    same(run(block, inverter), run(block, inverter, list(range(1, len(block)))))


def test_an_angle_goes_the_turns_that_the_speed_says(folder: Path) -> None:
    inverter = make_map(folder, DBC, MAP + '[speed]\nsignal = "C.omega"\nunit = "rad/s electrical"\n')
    omega = 2 * math.pi * 230.0  # 2.3 turns between two reports
    t = np.arange(20) * 1e-2
    block = frames(DBC, {"A": (t + 3.3e-3, {"alpha": 1.0}), "B": (t + 3.3e-3, {"beta": 0.0}),
                         "C": (t, {"theta": omega * t, "omega": 0.98 * omega})})
    found = run(block, inverter)
    error = np.angle(np.exp(1j * (found.theta_e[:-1] - omega * (t[:-1] + 3.3e-3))))
    assert np.abs(error).max() < 2e-3
    assert (found.quality & ANGLE_APART != 0).all()  # it turned by 274 deg since the report
    slow = make_map(folder, DBC, MAP)
    error = np.angle(np.exp(1j * (run(block, slow).theta_e[:-1] - omega * (t[:-1] + 3.3e-3))))
    assert np.abs(error).max() > 1.0  # without a speed nothing can tell


@pytest.mark.parametrize(("hertz", "apart"), [(2.0, False), (20.0, True)])
def test_too_far_apart_depends_on_the_speed(folder: Path, hertz: float, apart: bool) -> None:
    inverter = make_map(folder, DBC, CURRENT + "[timing]\nlimit_angle = 5\n")
    t = np.arange(200) * 1e-2
    w = 2 * math.pi * hertz
    # beta is 2 ms off: 1.4 deg at 2 Hz, 14 deg at 20 Hz
    block = frames(DBC, {"A": (t, {"alpha": np.cos(w * t)}), "B": (t - 2e-3, {"beta": np.sin(w * (t - 2e-3))})})
    found = run(block, inverter)
    assert np.mean(found.quality[20:-1] & CURRENT_APART != 0) == float(apart)


def test_a_silent_signal_is_waited_for_no_longer_than_wait(folder: Path) -> None:
    inverter = make_map(folder, DBC, MAP.replace("wait = 1", "wait = 0.05\nlimit_time = 0.2"))
    t = np.arange(100) * 1e-2
    block = frames(DBC, {"A": (t, {"alpha": 1.0}), "B": (t[:50], {"beta": t[:50], "vdc": 300.0 + t[:50]}),
                         "C": (t, {"theta": 0.0})})
    found = run(block, inverter)
    assert len(found) == 100
    assert np.allclose(found.v_dc[50:], 300.49)  # held
    assert np.allclose(found.apart[V_DC, 50:], 1e9 * (t[50:] - 0.49))
    assert np.array_equal(found.quality & OTHER_APART != 0, np.round(t - 0.49, 6) > 0.2)
    early = run(block.take(slice(0, 200)), inverter)
    assert len(early) < len(found)


def test_the_counter_numbers_samples_through_wraps_losses_and_repeats(folder: Path) -> None:
    inverter = make_map(folder, DBC, CURRENT.replace("B.beta", "A.alpha")
                        + '[timing]\ncounter = "A.count"\nbits = 4\nrate = 1000\n')
    number = np.concatenate([np.arange(40), np.arange(43, 60), [59], np.arange(60, 70), np.arange(170, 180)])
    t = number * 1e-3 + np.random.default_rng(0).uniform(0, 3e-4, number.size)
    t[57] = t[56] + 1e-4
    block = frames(DBC, {"A": (np.sort(t), {"alpha": 1.0, "count": number % 16})})
    found = run(block, inverter)
    kept = np.delete(number, 57)
    assert np.array_equal(found.sample, kept)
    assert np.array_equal(found.gap, np.diff(kept, prepend=-1) - 1)
    same(found, run(block, inverter, [1, 2, 41, 57, 58, 70]))


def test_without_a_counter_the_pace_of_arrival_counts(folder: Path) -> None:
    inverter = make_map(folder, DBC, CURRENT.replace("B.beta", "A.alpha") + "[timing]\nrate = 100\n")
    number = np.array([0, 1, 2, 3, 6, 7, 8])
    found = run(frames(DBC, {"A": (number * 1e-2 + 1e-3 * (number % 2), {"alpha": 1.0})}), inverter)
    assert np.array_equal(found.sample, number)
    assert found.gap.tolist() == [0, 0, 0, 0, 2, 0, 0]


def test_time_that_runs_back_begins_anew_and_a_little_does_not(inverter: InverterMap) -> None:
    t = np.arange(30) * 1e-2
    block = frames(DBC, {"A": (t, {"alpha": t}), "B": (t + 1e-3, {"beta": t, "vdc": 300.0}),
                         "C": (t, {"theta": 0.0})})
    second = FrameBlock(block.raw, block.t_ns - 3_600_000_000_000)
    both = FrameBlock.concat([block, second])
    found = run(both, inverter)
    assert len(found) == 60 and found.gap[30] == RESTARTED and not found.gap[31:].any()
    assert np.isfinite(found.i_beta).all()
    same(found, run(both, inverter, [17, 90, 91, 100]))
    late = FrameBlock(block.raw, block.t_ns.copy())
    late.t_ns[45] -= 50_000_000
    found = run(late, inverter)
    assert (np.diff(found.t_ns) >= 0).all() and len(found) == 30 and found.gap.max() < RESTARTED
