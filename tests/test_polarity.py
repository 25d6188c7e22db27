"""Polarity at standstill: what a window says, when the evidence decides, and the whole start-up over the wire."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.drive.machine import advance, initial_state, pack_machine, stationary_current
from ipmsm_can.estimation import confidence, polarity
from ipmsm_can.estimation.estimator import Estimator
from ipmsm_can.estimation.polarity import Evidence, Verdict
from ipmsm_can.motor import M1, M2, Motor
from ipmsm_can.startup import Phase, StartUp, StartUpSettings, pulse_period
from ipmsm_can.wire.protocol import InjectionReason, InjectionState, MessageKind, Protocol, Waveform
from tools import standstill

Array = NDArray[np.float64]
RATE = 5000.0
PERIOD = 12
LINEAR, HARD, SOFT = (standstill.CASES[k] for k in (5, 3, 1))


def pulses(motor: Motor, saturation: float, theta: float, axis: float, n: int, amplitude: float = 18.0,
           noise: float = 0.0, seed: int = 0, offset: float = 0.0) -> Array:
    """Samples (4, n) of a machine at rest under square voltage along `axis`: no control, no wire, nothing else.

    offset: of the reported voltage [V]."""
    m = pack_machine(motor, saturation=saturation)
    x = initial_state(motor, theta)
    rng = np.random.default_rng(seed)
    out = np.zeros((4, n))
    v = 0j
    for k in range(n):
        i = stationary_current(x[0], x[1], theta, m)
        out[:2, k] = np.array(i) + noise * rng.standard_normal(2)
        out[2:, k] = v.real + offset, v.imag
        phase = (k + PERIOD // 4) // (PERIOD // 2) % 2
        v = amplitude * (-1) ** phase * np.exp(1j * axis)
        advance(x, v.real, v.imag, 0.0, 1.0 / RATE, 10, False, 0.0, 0.0, 0.2, m)
    return out


def window(motor: Motor, samples: Array, axis: float, unit: float) -> NDArray[np.void]:
    state = polarity.new_state(motor, RATE, unit, samples.shape[1])
    state["axis"] = np.exp(1j * axis)
    polarity.window_block(np.ascontiguousarray(samples), np.zeros(samples.shape[1], np.uint8), state)
    return state


# ---- a window -----------------------------------------------------------------------------------------

@pytest.mark.parametrize("theta", [-2.6, -0.4, 0.3, 1.5, 3.0])
@pytest.mark.parametrize("motor", [M1, M2])
def test_the_axis_of_a_linear_machine_is_exact_for_pulses_along_any_direction(motor: Motor, theta: float) -> None:
    for direction in (0.0, 0.7, 1.9):
        samples = pulses(motor, 0.0, theta, direction, 2 * PERIOD)
        angle, sigma = polarity.axis(window(motor, samples, direction, 0.01), 1e-3)
        # the trapezoid of R i between samples is all that is not exact
        assert abs(math.remainder(angle - theta, math.pi)) < math.radians(0.5)
        assert 0.0 < sigma < math.radians(1.0)


def test_pulses_beside_the_axis_with_inductances_told_wrong() -> None:
    """The pulses lag behind a rotor that creeps: the error of L_s then turns the axis seen, and sigma says so."""
    spread, off, ratio = 0.06, [], []
    for l_d, l_q in ((0.9, 0.9), (1.1, 1.1), (0.9, 1.0), (1.0, 1.1), (1.1, 0.95)):
        told = replace(M1, L_d=l_d * M1.L_d, L_q=l_q * M1.L_q)
        for beside in (-0.17, 0.0, 0.17):
            samples = pulses(M1, 0.0, 0.5, 0.5 + beside, 2 * PERIOD)
            state = polarity.new_state(told, RATE, 0.01, samples.shape[1], spread)
            polarity.window_block(samples, np.zeros(samples.shape[1], np.uint8), state)
            angle, sigma = polarity.axis(state, 1e-3)
            error = abs(math.remainder(angle - 0.5, math.pi))
            if beside:
                off.append(error)
                ratio.append(error / sigma)
            else:
                assert error < math.radians(0.5) and sigma < math.radians(1.0)
    assert max(off) < 0.6 * 0.17, "it was once as far off as the pulses are, and more"
    assert max(ratio) < 2.5


def test_the_axis_has_the_error_it_says() -> None:
    off, sigmas = [], []
    for seed in range(200):
        samples = pulses(M2, 0.0, 0.5, 0.4, 2 * PERIOD, amplitude=4.0, noise=0.02, seed=seed, offset=0.3)
        angle, sigma = polarity.axis(window(M2, samples, 0.4, 0.01), 0.02)
        off.append(math.remainder(angle - 0.5, math.pi))
        sigmas.append(sigma)
    assert 0.8 < np.std(off) / np.mean(sigmas) < 1.25
    assert abs(np.mean(off)) < 0.3 * np.mean(sigmas)  # a voltage offset does nothing


@pytest.mark.parametrize("saturation", [0.1, 0.2])
@pytest.mark.parametrize("theta", [-2.0, 0.3, 2.5])
def test_the_bend_points_north(theta: float, saturation: float) -> None:
    unit = M2.L_d * M2.rated_current
    bends = []
    for turned in (0.0, math.pi):
        axis = theta + turned
        samples = pulses(M2, saturation, theta, axis, 2 * PERIOD)
        bends.append(polarity.curvature(window(M2, samples, axis, unit), 1e-3)[0])
    assert bends[0] > 0.03 > 0.0 > -0.03 > bends[1]
    samples = pulses(M2, 0.0, theta, theta, 2 * PERIOD)
    assert abs(polarity.curvature(window(M2, samples, theta, unit), 1e-3)[0]) < 1e-3


def test_the_bend_has_the_variance_it_says() -> None:
    unit = M2.L_d * M2.rated_current
    pairs = np.array([polarity.curvature(
        window(M2, pulses(M2, 0.0, 0.3, 0.3, 2 * PERIOD, noise=0.02, seed=seed), 0.3, unit), 0.02)
        for seed in range(200)])
    assert 0.8 < np.std(pairs[:, 0]) / np.sqrt(np.mean(pairs[:, 1])) < 1.2
    assert abs(np.mean(pairs[:, 0])) < 0.25 * np.std(pairs[:, 0])


def test_a_window_that_says_nothing() -> None:
    samples = pulses(M2, 0.2, 0.3, 0.3, 2 * PERIOD)
    unit = M2.L_d * M2.rated_current
    # looked at along the wrong axis: the flux across would saturate, and pass for a bend
    assert polarity.curvature(window(M2, samples, 0.3 + 0.8, unit), 0.02) == (0.0, math.inf)
    # no voltage at all
    silent = window(M2, np.zeros((4, 24)), 0.0, unit)
    assert polarity.curvature(silent, 0.02)[1] == math.inf
    assert polarity.axis(silent, 0.02)[1] == math.inf
    # a filled sample: its voltage is a guess
    state = polarity.new_state(M2, RATE, unit, 24)
    filled = np.zeros(24, np.uint8)
    filled[7] = 1
    polarity.window_block(samples, filled, state)
    assert polarity.curvature(state, 0.02)[1] == math.inf and polarity.axis(state, 0.02)[1] == math.inf
    # NaN from a mad drive
    samples[2, 5] = np.nan
    assert polarity.curvature(window(M2, samples, 0.3, unit), 0.02)[1] == math.inf
    assert polarity.axis(window(M2, samples, 0.3, unit), 0.02)[1] == math.inf
    # a machine without this saliency
    other = replace(M2, L_d=M2.L_q, L_q=M2.L_d)
    alien = replace(M2, L_d=4.0 * M2.L_d, L_q=4.0 * M2.L_q)
    good = pulses(M2, 0.0, 0.3, 0.9, 2 * PERIOD)
    assert polarity.axis(window(alien, good, 0.9, unit), 0.02)[1] == math.inf
    assert abs(math.remainder(polarity.axis(window(other, good, 0.9, unit), 0.02)[0] - 0.3, math.pi)) > 1.5


def test_back_emf_is_what_turns_the_flux() -> None:
    m = pack_machine(M2)
    x = initial_state(M2, 0.2)
    out = np.zeros((4, 24))
    omega_m, last = 2.0, 0j
    for k in range(24):
        i = stationary_current(x[0], x[1], M2.pole_pairs * x[3], m)
        theta = M2.pole_pairs * x[3]
        v = 1j * M2.pole_pairs * omega_m * M2.psi_m * np.exp(1j * (theta + 0.5 * M2.pole_pairs * omega_m / RATE))
        out[:2, k] = i
        out[2:, k] = last.real, last.imag
        last = v
        x[2] = omega_m
        advance(x, v.real, v.imag, 0.0, 1.0 / RATE, 10, False, omega_m, 0.0, 0.2, m)
    emf = polarity.back_emf(window(M2, out, 0.0, 0.01), 0.2, M2)
    assert abs(emf) == pytest.approx(M2.pole_pairs * omega_m * M2.psi_m, rel=0.02)


# ---- the evidence -------------------------------------------------------------------------------------

def test_evidence_decides_by_its_own_uncertainty() -> None:
    rng = np.random.default_rng(4)
    verdicts: dict[float, list[Verdict]] = {}
    for true in (0.07, -0.07, 0.0):
        for _ in range(200):
            evidence = Evidence(M2, M2.rated_current)
            c = true * M2.rated_current / 2.0
            while evidence.verdict is Verdict.OPEN:
                evidence.add(c + 0.03 * rng.standard_normal(), 0.03**2)
            verdicts.setdefault(true, []).append(evidence.verdict)
    assert set(verdicts[0.07]) == {Verdict.NORTH}
    assert set(verdicts[-0.07]) == {Verdict.SOUTH}
    assert set(verdicts[0.0]) == {Verdict.EQUAL}


def test_evidence_that_contradicts_itself_does_not_decide() -> None:
    evidence = Evidence(M2, M2.rated_current)
    for k in range(40):
        evidence.add(0.5 if k % 2 else -0.3, 1e-4)  # far apart for their variance
    assert evidence.verdict is Verdict.OPEN
    assert evidence.sigma > 10.0 * 2.0 / M2.rated_current * math.sqrt(1e-4 / 40)


def test_few_windows_and_a_small_asymmetry_do_not_decide() -> None:
    evidence = Evidence(M2, M2.rated_current)
    for _ in range(polarity.LEAST_WINDOWS - 1):
        evidence.add(1.0, 1e-8)
    assert evidence.verdict is Verdict.OPEN
    small = Evidence(M2, M2.rated_current)
    for _ in range(100):
        small.add(0.02 * M2.rated_current / 2.0, 1e-8)  # beyond doubt, but what dead time can make of nothing
    assert small.asymmetry == pytest.approx(0.02)
    assert small.verdict is Verdict.EQUAL


@pytest.mark.parametrize(("motor", "rate"), [(M1, 5000.0), (M2, 5000.0), (M2, 10_000.0), (M1, 2500.0)])
def test_pulse_periods_are_even(motor: Motor, rate: float) -> None:
    settings = StartUpSettings(400.0, motor.rated_current, 30.0)
    period = pulse_period(motor, settings, rate)
    assert period % 2 == 0
    assert 4.0 * rate / period * motor.L_d * 0.8 * motor.rated_current <= 30.0 * 1.1
    assert pulse_period(motor, replace(settings, frequency=2000.0, amplitude=1000.0), rate) in (0, 4, 2 * (
        round(rate / 4000.0)))


# ---- the start-up, over the wire ----------------------------------------------------------------------

@pytest.mark.parametrize("case", standstill.CASES, ids=lambda c: c.name)
def test_random_starts(case: standstill.Case) -> None:
    """A slice of `python -m tools.standstill`: right, or refused, within the limits of current and motion."""
    results = standstill.runs(case, range(100_000, 100_004))
    line, good = standstill.judge(case, results)
    assert good, line


@pytest.mark.parametrize("seed", [18, 83, 98])
def test_after_the_pulses_probing_begins_once(seed: int) -> None:
    """It began rotating, until 5 ms later the angle was valid, and anew along d: meanwhile sigma grew too large."""
    results = standstill.runs(replace(standstill.CASES[0], observer="riccati"), [seed])
    line, good = standstill.judge(standstill.CASES[0], results)
    assert good, line


def test_pulses_are_not_made_stronger_for_what_the_probing_signal_still_drives() -> None:
    """Two windows of a probing signal that had not given way yet held as still as pulses do: 105 % of rated."""
    result, = standstill.runs(replace(standstill.CASES[7], observer="riccati"), [642])
    assert result.phase is Phase.KNOWN and result.pulses < 0.95


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("case", [standstill.CASES[k] for k in (0, 2, 4)], ids=lambda c: c.name)
def test_dead_time_is_not_taken_for_polarity(case: standstill.Case, seed: int) -> None:
    """0.5 V a phase on M1, whose pulses have one period in the time of two of M2's."""
    result = standstill.run(replace(case, drive=(("dead_time_voltage", 0.5),)), 200_000 + seed, 0.3)
    assert result.wrong < 10.0
    assert result.valid == (case.saturation > 0.0)


@pytest.mark.parametrize("kind", ["riccati", "chonam"])
def test_other_observers_of_flux_are_started_as_well(kind: str) -> None:
    result = standstill.run(replace(SOFT, observer=kind), 7, 0.3)
    assert result.phase is Phase.KNOWN and result.valid
    assert result.wrong < 5.0
    assert not standstill.run(replace(LINEAR, observer=kind), 7, 0.3).wrong


@pytest.mark.parametrize("kind", ["injection_extraction", "injection_demodulation"])
def test_an_observer_of_the_axis_is_told_the_pole_and_stays_invalid(kind: str) -> None:
    """Each of their angles comes from one window, and may be off by more than an angle called valid may be."""
    result = standstill.run(replace(SOFT, observer=kind), 7, 0.3, amplitude=4.2, frequency=400.0)
    assert result.phase is Phase.KNOWN and not result.valid
    assert result.error < 30.0  # on the right pole


def node_of(case: standstill.Case, seed: int, seconds: float, transmit: bool = True,
            **injection: Any) -> tuple[Any, list[tuple[str, str]], Array]:
    """(companion's node, (state, reason) as they came, waveforms the drive made)."""
    cosim = standstill.cosimulation(case, seed, transmit, injection)
    told: list[tuple[str, str]] = []
    node: Any = cosim.companion.nodes[0]
    for _ in range(round(seconds / 0.005)):
        cosim.run(0.005)
        said = (node.scheduler.state.name, node.scheduler.reason.name)
        if not told or told[-1] != said:
            told.append(said)
    return node, told, np.concatenate([s.injection_waveform for s in cosim.recording.truth[0]])


def test_what_the_companion_says_meanwhile() -> None:
    _, told, made = node_of(SOFT, 3, 0.3)
    assert ("POLARITY_PULSES", "POLARITY_UNKNOWN") in told
    assert told[-1] == ("ON", "LOW_SPEED")
    assert Waveform.POLARITY_PULSES in made and made[-1] == Waveform.ROTATING
    _, told, made = node_of(LINEAR, 3, 0.3)
    assert told[-1] == ("ON", "POLARITY_UNKNOWABLE")
    assert made[-1] == Waveform.ROTATING


def test_no_pulses_where_they_are_not_allowed() -> None:
    for keys in ({"polarity": False}, {"enabled": False}):
        node, _, made = node_of(SOFT, 3, 0.2, **keys)
        assert Waveform.POLARITY_PULSES not in made
        assert not node.view.flags & confidence.VALID
    node, _, made = node_of(SOFT, 3, 0.2, transmit=False)
    assert not made.any() and not node.view.flags & confidence.POLARITY_KNOWN
    assert config_from({"motor": {"preset": "m2"}}).polarity_current == pytest.approx(M2.rated_current)
    own = {"pole_pairs": 3, "psi_m": 0.5, "L_d": 0.01, "L_q": 0.02, "R": 1.0}
    assert config_from({"motor": own, "injection": {"current_limit": 1.0}}).polarity_current is None


def test_the_operator_can_forbid_them() -> None:
    cosim = standstill.cosimulation(SOFT, 3, True, {})
    cosim.companion.nodes[0].scheduler.operator(False)
    cosim.run(0.2)
    assert not np.concatenate([s.injection_waveform for s in cosim.recording.truth[0]]).any()


def test_pulses_end_by_themselves_when_the_companion_dies() -> None:
    cosim = standstill.cosimulation(HARD, 3, True, {})
    while cosim.companion.nodes[0].scheduler.state is not InjectionState.POLARITY_PULSES:
        cosim.run(0.005)
    cosim.run(0.02)
    drive = cosim.drives[0]
    assert drive.waveform is Waveform.POLARITY_PULSES
    rest = drive.step(400).samples.injection_amplitude
    assert 0 < int(np.argmax(rest == 0.0)) <= 0.031 * RATE


def test_a_turning_rotor_needs_no_pulses() -> None:
    """Its back-EMF shows: the observer tells north from south by itself."""
    case = replace(SOFT, drive=(("speed_imposed", True),))
    cosim = standstill.cosimulation(case, 3, True, {}, speed=10.0)
    cosim.run(1.0)
    node: Any = cosim.companion.nodes[0]
    made = np.concatenate([s.injection_waveform for s in cosim.recording.truth[0]])
    assert Waveform.POLARITY_PULSES not in made
    assert node.view.flags & confidence.POLARITY_KNOWN


def test_lost_polarity_is_found_again() -> None:
    cosim = standstill.cosimulation(SOFT, 11, True, {})
    cosim.run(0.2)
    node: Any = cosim.companion.nodes[0]
    assert node.startup.phase is Phase.KNOWN and node.view.flags & confidence.VALID
    node.startup.phase = Phase.WATCH  # as if it had turned, and
    confidence.forget(node.estimator._confidence)  # the observer lost its lock
    cosim.run(0.3)
    assert node.startup.phase is Phase.KNOWN and node.view.flags & confidence.VALID
    truth = cosim.recording.truth[0][-1].theta_e[-1]
    assert abs(math.remainder(node.view.theta - truth, 2.0 * math.pi)) < math.radians(5.0)


def test_a_rotor_that_starts_to_turn_keeps_its_polarity() -> None:
    """From an angle nobody knew to 300 rpm: the observer goes on from what the start-up gave it."""
    case = replace(SOFT, drive=(("torque_limit", 9.0),))
    cosim = standstill.cosimulation(case, 5, True, {}, speed=30.0, after=0.3)
    cosim.run(1.2)
    node: Any = cosim.companion.nodes[0]
    parts = cosim.recording.tracked[0]
    truth = np.concatenate([s.theta_e for s in cosim.recording.truth[0]])
    counter = np.concatenate([t.run.counter for t in parts])
    theta = np.concatenate([t.estimate.angle[0] for t in parts])
    valid = np.concatenate([t.estimate.flags for t in parts]) & confidence.VALID != 0
    error = np.abs(np.degrees((theta - truth[counter] + np.pi) % (2.0 * np.pi) - np.pi))
    assert valid[-1] and node.view.omega > 80.0
    assert error[valid].max() < 15.0
    assert valid[(counter > 1000) & (counter < 1500)].all()


@pytest.mark.parametrize("lost", [(), (20, 45, 46, 410)])
@pytest.mark.parametrize(("case", "pause", "end"), [
    (HARD, 12, Phase.KNOWN), (LINEAR, 12, Phase.REFUSED), (LINEAR, 4000, Phase.PULSES)],
    ids=["known", "refused", "refused, and a pause"])
def test_any_partition_gives_the_same_bits(case: standstill.Case, pause: int, end: Phase,
                                           lost: tuple[int, ...]) -> None:
    """A long pause ends a refusal where it stands, not at the end of the block."""
    cosim = standstill.cosimulation(case, 9, True, {"amplitude": 4.2, "frequency": 400.0})
    cosim.run(0.3)
    samples = np.concatenate([t.run.values for t in cosim.recording.tracked[0]], axis=1)
    node: Any = cosim.companion.nodes[0]
    settings = node._startup_settings
    outcomes: list[tuple[Any, ...]] = []
    for seed in (None, 1, 2):
        estimator = Estimator(M2, RATE, node._settings)
        startup = StartUp(M2, estimator, settings)
        n = samples.shape[1]
        cuts = [0, n] if seed is None else sorted({0, n, *np.random.default_rng(seed).integers(1, n, 60).tolist()})
        parts = []
        for a, b in pairwise(cuts):
            gap = np.zeros(b - a, np.int64)
            at = 40 if pause == 12 else 1200
            if a <= at < b:
                gap[at - a] = pause
            filled = np.isin(np.arange(a, b), lost).astype(np.uint8)
            parts.append(startup.process(np.ascontiguousarray(samples[:, a:b]), gap, filled))
        assert startup.phase is end
        assert end is Phase.KNOWN or not any(np.any(p.flags & confidence.VALID) for p in parts)
        outcomes.append((np.concatenate([p.flux for p in parts], axis=1), np.concatenate([p.flags for p in parts]),
                         np.concatenate([p.sigma for p in parts]), startup.angle, startup.evidence.asymmetry))
    for other in outcomes[1:]:
        for a, b in zip(outcomes[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_drive_that_does_not_answer_is_not_asked_for_ever() -> None:
    """It makes no pulses: after three tries of 0.4 s it is left in peace."""
    cosim = standstill.cosimulation(SOFT, 1, True, {})
    node: Any = cosim.companion.nodes[0]
    while node.startup is None or node.startup.phase is not Phase.PULSES:
        cosim.run(0.005)
    startup = node.startup
    samples = np.concatenate([t.run.values for t in cosim.recording.tracked[0]], axis=1)[:, -48:-24]
    tries = 0
    for _ in range(2000):
        before = startup.phase
        startup.process(np.ascontiguousarray(samples), np.zeros(24, np.int64), np.zeros(24, np.uint8))
        tries += before is Phase.PULSES and startup.phase is not Phase.PULSES
    assert (tries, startup.phase) == (3, Phase.REFUSED)


def test_pulses_end_where_no_window_is_ever_whole() -> None:
    """Every tenth sample lost: nothing can be learned, and the pulses do not go on for ever."""
    cosim = standstill.cosimulation(SOFT, 1, True, {})
    node: Any = cosim.companion.nodes[0]
    while node.startup is None or node.startup.phase is not Phase.PULSES:
        cosim.run(0.005)
    startup = node.startup
    samples = np.concatenate([t.run.values for t in cosim.recording.tracked[0]], axis=1)[:, -48:-24]
    filled = np.zeros(24, np.uint8)
    filled[5::10] = 1
    lasted = 0
    while startup.phase is Phase.PULSES:
        startup.process(np.ascontiguousarray(samples), np.zeros(24, np.int64), filled)
        lasted += 24
    assert 0.35 * RATE < lasted < 0.5 * RATE
    assert startup.evidence.windows == 0


def test_the_words_are_in_the_database() -> None:
    protocol = Protocol()
    codec = protocol.codecs[MessageKind.COMPANION_STATUS]
    values = np.zeros((len(codec.signals), 1))
    values[codec.index["injection_state"]] = InjectionState.POLARITY_PULSES
    values[codec.index["injection_reason"]] = InjectionReason.POLARITY_UNKNOWABLE
    raw = protocol.encode(MessageKind.COMPANION_STATUS, 0, values)
    back, _, _ = protocol.decode(MessageKind.COMPANION_STATUS, 0, raw, np.zeros(1, np.intp))
    assert back[codec.index["injection_state"], 0] == 6 and back[codec.index["injection_reason"], 0] == 11
    assert Companion([config_from({"motor": {"preset": "m1"}})], protocol, True).nodes[0].startup is None


def test_an_asymmetry_that_needs_many_windows_is_not_believed() -> None:
    evidence = Evidence(M2, M2.rated_current)
    for _ in range(200):
        evidence.add(0.1 * M2.rated_current / 2.0, (0.1 * M2.rated_current / 2.0) ** 2)  # one sigma each
        assert evidence.verdict in (Verdict.OPEN, Verdict.EQUAL)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_pulses_under_load_tell_nothing(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Across the axis the load brings the iron past its knee, where it bends the other way."""
    cosim = standstill.cosimulation(HARD, 3, True, {})
    node: Any = cosim.companion.nodes[0]
    while node.startup is None or node.startup.phase is not Phase.PULSES:
        cosim.run(0.005)
    monkeypatch.setattr(polarity, "load", lambda window: share * M2.rated_current)
    cosim.run(0.3)
    ended: Phase = node.startup.phase
    assert (ended is Phase.KNOWN) == (share == 0.0)
