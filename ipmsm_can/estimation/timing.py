"""Which voltage belongs to which current: the samples set right, and the delay between them found.

Sample k is to carry i at t_k and the mean voltage over the interval that ended at t_k.  A drive may send something
else: the voltage of the period before (it is *late* by 1 sample), the one that it has just begun to apply (late by
-1), a current taken in the middle of a period (a half).  d [samples] says how late the voltage is: the one reported
with sample k is the mean over the interval that ended at t_k - d T_s.

Setting right (`align_block`, `carry_block`).  With m = ceil(d) for d > 0, else 0, sample k hands on the current of
sample k - m and the voltage over the interval that ended there, which by then has been reported.  A fraction of a
sample is a straight line through the integral of the voltage: exact where the current was taken between the steps
of the voltage, off by at most T_s^2/8 v' where the voltage itself is a mean over parts of two steps.  What the
observer says is then m samples old and is carried forward with the speed.  What is handed on is the integral of
the voltage; so a change of d neither leaves out nor repeats a volt-second, and the flux goes on without a step.

Finding d (`align_block`).  A steadily turning rotor does not show it: a voltage that turns with the rotor and is
late looks like an angle that is off by omega T_s d.  A probing signal does: at w_h, well above the rotor's speed,

    L (i_k - i_(k-1))/T_s + R (i_(k-1) + i_k)/2 = u_k,      U = exp(j w_h T_s d) V

with U, V the components of both at w_h, taken through a Hann window of WINDOW samples.  Over both axes arg(V^H U)
= w_h T_s d for every symmetric inductance matrix, thus at any rotor angle and whatever L_d and L_q are; a wrong L
changes the length only.  What does turn it counts as 1-sigma:
    dead time   v_dt |Im(V^H B)|/|V^H U|, B the component of the direction it acts in; it vanishes under load, where
                the probing current does not cross zero, and without load it looks like a late voltage
    R           dR/(w_h L);     noise   of the current, through the window;     the rest   _FLOOR samples

The current noise comes back in the voltage, since the drive's control answers it; so nothing is concluded unless
the probing voltage is ten times what noise and dead time can make of it.  Nor is it while the voltage is so high
that the rotor might turn near w_h, |v| above _SLOW w_h psi_m; a field weakened below that takes a current that
makes |U|/|V| more than twice that of an inductance, which is looked at as well.  The delay is then unknown.  The
angle is not asked: a wrong delay may have spoiled it.

Two successive windows that agree, each more than _SURE sigma and _LEAST away from the delay in use, change it: to
a multiple of half a sample where sigma is below _FINE and one lies within 2.5 sigma, as drives that sample once or
twice a period make them, else to a tenth.  Windows that tell more than those it was taken from refine it.  The
change falls between two windows, whatever the partition into blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.voltage_errors import Uncertainty, directions
from ipmsm_can.estimation.speed import pole, wrap
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Records = NDArray[np.void]

WINDOW = 512
"""Samples from which one value of the delay is taken."""
MOST = 2.0
"""Largest delay, either way, that can be set right [samples]."""
_LEAST = 0.25
_SURE = 3.0
_AGREE = 0.2
_FINE = 0.1
_FINER = 0.8
_LEAST_FINER = 0.15
_FLOOR = 0.02
_CLEAR = 100.0
"""Least ratio of the probing signal's power to what noise and dead time make of it."""
_HARMONIC = 0.25
"""Largest harmonic of the dead time's voltage that may fall on the probing frequency, as a share of it."""
_LEAST_BINS = 8.0
_SLOW = 0.3
_GAIN_LOW, _GAIN_HIGH = 0.6, 1.6
"""|U|/|V| that L_s may make of L_d, L_q and their errors."""

STATE = np.dtype([
    ("automatic", "i8"), ("T_s", "f8"), ("R", "f8"), ("L_q", "f8"), ("inductive", "f8"), ("zone", "f8"),
    ("lagging", "f8"), ("step", "f8"), ("most_v2", "f8"), ("cosine", "f8", (WINDOW,)), ("sine", "f8", (WINDOW,)),
    # 1-sigma: voltage of dead time [V]; phase that R and the rest make [rad]^2; variance of U; least |V|^2.
    ("volts", "f8"), ("phase2", "f8"), ("noise2", "f8"), ("least", "f8"),
    # Setting right: samples seen since the start, the last two currents and voltages, the part of the voltage's
    # integral that has been handed in but not on, by how many samples the last output is to be carried forward.
    ("delay", "f8"), ("pending", "f8"), ("count", "i8"), ("i", "f8", (2, 2)), ("v", "f8", (2, 2)),
    ("open_a", "f8"), ("open_b", "f8"), ("ahead", "i8"),
    # Finding: place in the window, last current, components (axis; real, imaginary), sum of |v|^2; what came out.
    ("at", "i8"), ("started", "i8"), ("i_a", "f8"), ("i_b", "f8"), ("V", "f8", (2, 2)), ("U", "f8", (2, 2)),
    ("B", "f8", (2, 2)), ("v2", "f8"), ("found", "f8"), ("sigma", "f8"), ("candidate", "f8"),
    ("taken_sigma", "f8"),
])


@dataclass(frozen=True, slots=True)
class VoltageDelay:
    """What is known of the delay of the voltage against the current, in samples; positive: the voltage is late.

    applied: set right in the estimate.  found, sigma: what the last window that could tell measured, and its
    1-sigma; NaN = unknown so far.  automatic: applied follows what is found.
    """

    applied: float
    found: float
    sigma: float
    automatic: bool

    @property
    def words(self) -> str:
        """In words; "" while nothing is known and nothing set right."""
        found = f"{self.found:+.2f} +/- {self.sigma:.2f}" if math.isfinite(self.found) else ""
        if self.applied == 0.0:
            return f"voltage in time (found late by {found} samples)" if found else ""
        size, side = abs(self.applied), "late" if self.applied > 0.0 else "early"
        text = f"voltage {side} by {size:g} sample{'s' if size != 1.0 else ''}, set right"
        return f"{text} (found {found})" if found else text


def new_state(motor: Motor, delay: float | None, injection_frequency: float, sample_rate: float,
              uncertainty: Uncertainty, speed_bandwidth: float) -> Records:
    """Record array (1,) of STATE.

    motor: as the observer assumes it.  delay: of the voltage [samples], -MOST..MOST; None: 0 until another one is
    found.  injection_frequency, sample_rate, speed_bandwidth (of the loop that gives the speed) [Hz].
    """
    state = np.zeros(1, STATE)
    st = state[0]
    T_s = 1.0 / sample_rate
    step = 2.0 * math.pi * injection_frequency * T_s
    usable = _LEAST_BINS / WINDOW <= injection_frequency / sample_rate <= 0.25
    st["automatic"] = delay is None and usable
    st["T_s"], st["R"], st["L_q"], st["inductive"] = T_s, motor.R, motor.L_q, motor.L_s / T_s
    st["zone"], st["step"] = uncertainty.dead_zone(motor), step
    st["most_v2"] = WINDOW * (_SLOW * step / T_s * motor.psi_m) ** 2
    # See `speed.carried`: the loop's error says by how much it lags in speed.
    st["lagging"] = pole(speed_bandwidth, sample_rate) ** -2 - 1.0
    k = np.arange(WINDOW)
    hann = 0.5 - 0.5 * np.cos(2.0 * math.pi * (k + 0.5) / WINDOW)
    st["cosine"], st["sine"] = hann * np.cos(step * k), hann * np.sin(step * k)
    reactance = motor.L_s / T_s * 2.0 * math.sin(0.5 * step)
    st["volts"] = uncertainty.voltage
    st["phase2"] = (uncertainty.resistance * motor.R / reactance) ** 2 + (_FLOOR * step) ** 2
    st["noise2"] = float((hann**2).sum()) * (reactance * uncertainty.current) ** 2
    harmonic = 0.5 * float(hann.sum()) * _HARMONIC * uncertainty.voltage
    st["least"] = _CLEAR * 2.0 * (float(st["noise2"]) + harmonic**2)
    st["delay"] = st["pending"] = delay or 0.0
    st["found"] = st["sigma"] = st["candidate"] = math.nan
    return state


def restart(state: Records) -> None:
    """Begin anew after a gap in the samples, with the delay in use; state: record array (1,) of STATE."""
    st = state[0]
    st["count"] = st["at"] = st["started"] = st["ahead"] = 0
    st["V"] = st["U"] = st["B"] = 0.0
    st["v2"] = st["open_a"] = st["open_b"] = 0.0
    st["delay"] = st["pending"]
    st["candidate"] = math.nan


def known(state: Records) -> VoltageDelay:
    """What the state (1,) says."""
    st = state[0]
    return VoltageDelay(float(st["delay"]), float(st["found"]), float(st["sigma"]), bool(st["automatic"]))


@kernel
def _not_yet(behind: float, newest: float, last: float, before: float) -> float:
    """Integral of the voltage over the newest `behind` samples, 0..2 [V samples]."""
    if behind == 0.0:
        return 0.0
    if behind <= 1.0:
        return behind * newest
    if behind <= 2.0:
        return newest + (behind - 1.0) * last
    return newest + last + (behind - 2.0) * before


@kernel
def _align(samples: Floats, begin: int, end: int, st: Any, out: Floats, ahead: NDArray[np.int64]) -> None:
    delay = st.pending
    st.delay = delay
    behind = max(math.ceil(delay), 0.0)
    m = int(behind)
    behind -= delay
    i = st.i
    v = st.v
    if st.count == 0 and begin < end:
        for j in range(2):
            i[j, 0] = samples[0, begin]
            i[j, 1] = samples[1, begin]
            v[j, 0] = samples[2, begin]
            v[j, 1] = samples[3, begin]
    if delay == 0.0 and st.open_a == 0.0 and st.open_b == 0.0:
        # The usual case: nothing to set right.
        for r in range(4):
            for k in range(begin, end):
                out[r, k] = samples[r, k]
        ahead[begin:end] = 0
        for k in range(max(begin, end - 2), end):
            for axis in range(2):
                i[1, axis] = i[0, axis]
                i[0, axis] = samples[axis, k]
                v[1, axis] = v[0, axis]
                v[0, axis] = samples[2 + axis, k]
        st.count += end - begin
        st.ahead = 0
        return
    for k in range(begin, end):
        i_a = samples[0, k]
        i_b = samples[1, k]
        v_a = samples[2, k]
        v_b = samples[3, k]
        if m == 0:
            out[0, k] = i_a
            out[1, k] = i_b
        else:
            out[0, k] = i[m - 1, 0]
            out[1, k] = i[m - 1, 1]
        open_a = _not_yet(behind, v_a, v[0, 0], v[1, 0])
        open_b = _not_yet(behind, v_b, v[0, 1], v[1, 1])
        if st.count <= m:
            # There is no earlier sample yet: the machine stands still with the first current, flux included.
            out[2, k] = st.R * out[0, k]
            out[3, k] = st.R * out[1, k]
        else:
            out[2, k] = v_a + st.open_a - open_a
            out[3, k] = v_b + st.open_b - open_b
        st.open_a = open_a
        st.open_b = open_b
        ahead[k] = min(m, st.count)
        i[1, 0] = i[0, 0]
        i[1, 1] = i[0, 1]
        i[0, 0] = i_a
        i[0, 1] = i_b
        v[1, 0] = v[0, 0]
        v[1, 1] = v[0, 1]
        v[0, 0] = v_a
        v[0, 1] = v_b
        st.count += 1
        st.ahead = ahead[k]


@kernel
def _judge(st: Any) -> None:
    """What the window that just ended says of the delay."""
    last = st.candidate
    st.candidate = math.nan
    power = 0.0
    cross = 0.0j
    dead = 0.0j
    for axis in range(2):
        turned = complex(st.V[axis, 0], -st.V[axis, 1])
        power += turned.real * turned.real + turned.imag * turned.imag
        cross += turned * complex(st.U[axis, 0], st.U[axis, 1])
        dead += turned * complex(st.B[axis, 0], st.B[axis, 1])
    size = abs(cross)
    if not (power > st.least and st.v2 < st.most_v2 and _GAIN_LOW * power < size < _GAIN_HIGH * power):
        return
    delay = math.atan2(cross.imag, cross.real) / st.step
    if not abs(delay) < MOST + _LEAST:
        return
    phase2 = st.phase2 + (st.volts * dead.imag / size) ** 2 + 0.5 * st.noise2 * power / (size * size)
    st.found = delay
    st.sigma = math.sqrt(phase2) / st.step
    away = abs(delay - st.pending)
    finer = st.sigma < _FINER * st.taken_sigma and away > max(_LEAST_FINER, 2.0 * st.sigma)
    if finer or away > max(_LEAST, _SURE * math.hypot(st.sigma, st.taken_sigma)):
        st.candidate = delay
        if abs(delay - last) < _AGREE:
            taken = math.floor(2.0 * delay + 0.5) / 2.0
            if st.sigma > _FINE or abs(delay - taken) > 2.5 * st.sigma:
                taken = math.floor(10.0 * delay + 0.5) / 10.0
            st.pending = min(max(taken, -MOST), MOST)
            st.taken_sigma = st.sigma
            st.candidate = math.nan


@kernel
def _detect(samples: Floats, begin: int, end: int, st: Any) -> None:
    inductive = st.inductive
    R = st.R
    zone = st.zone
    cosine = st.cosine
    sine = st.sine
    (va_c, va_s), (vb_c, vb_s) = (st.V[0, 0], st.V[0, 1]), (st.V[1, 0], st.V[1, 1])
    (ua_c, ua_s), (ub_c, ub_s) = (st.U[0, 0], st.U[0, 1]), (st.U[1, 0], st.U[1, 1])
    (ba_c, ba_s), (bb_c, bb_s) = (st.B[0, 0], st.B[0, 1]), (st.B[1, 0], st.B[1, 1])
    at = st.at
    started = st.started
    last_a = st.i_a
    last_b = st.i_b
    v2 = st.v2
    direction = np.empty((4, 2))
    for k in range(begin, end):
        i_a = samples[0, k]
        i_b = samples[1, k]
        v_a = samples[2, k]
        v_b = samples[3, k]
        if started:
            mean_a = 0.5 * (last_a + i_a)
            mean_b = 0.5 * (last_b + i_b)
            u_a = inductive * (i_a - last_a) + R * mean_a
            u_b = inductive * (i_b - last_b) + R * mean_b
            directions(mean_a, mean_b, zone, direction)
            b_a = direction[2, 0]
            b_b = direction[2, 1]
            c = cosine[at]
            s = sine[at]
            va_c += c * v_a
            va_s -= s * v_a
            vb_c += c * v_b
            vb_s -= s * v_b
            ua_c += c * u_a
            ua_s -= s * u_a
            ub_c += c * u_b
            ub_s -= s * u_b
            ba_c += c * b_a
            ba_s -= s * b_a
            bb_c += c * b_b
            bb_s -= s * b_b
            v2 += v_a * v_a + v_b * v_b
        started = 1
        last_a = i_a
        last_b = i_b
        at += 1
    st.V[0, 0], st.V[0, 1], st.V[1, 0], st.V[1, 1] = va_c, va_s, vb_c, vb_s
    st.U[0, 0], st.U[0, 1], st.U[1, 0], st.U[1, 1] = ua_c, ua_s, ub_c, ub_s
    st.B[0, 0], st.B[0, 1], st.B[1, 0], st.B[1, 1] = ba_c, ba_s, bb_c, bb_s
    st.started = started
    st.i_a = last_a
    st.i_b = last_b
    st.v2 = v2
    if at == WINDOW:
        _judge(st)
        at = 0
        st.v2 = 0.0
        for axis in range(2):
            for part in range(2):
                st.V[axis, part] = 0.0
                st.U[axis, part] = 0.0
                st.B[axis, part] = 0.0
    st.at = at


@kernel
def align_block(samples: Floats, state: Records, out: Floats, ahead: NDArray[np.int64]) -> None:
    """Set currents and voltages of a block right, and look for their delay if it is not told.

    samples: float64 (4, N): i_alpha, i_beta [A peak], v_alpha, v_beta [V peak] as reported.  state: record array
    (1,) of STATE, updated in place.  out: the same with the voltage that belongs to the current.
    ahead: int64 (N,), how many samples the current handed on is older than the one reported.
    """
    st = state[0]
    n = samples.shape[1]
    if not st.automatic:
        _align(samples, 0, n, st, out, ahead)
        return
    begin = 0
    while begin < n:
        end = min(n, begin + WINDOW - st.at)
        _align(samples, begin, end, st, out, ahead)
        _detect(samples, begin, end, st)
        begin = end


@kernel
def carry_block(samples: Floats, ahead: NDArray[np.int64], state: Records, flux: Floats, angle: Floats) -> None:
    """Carry what an observer made of older currents forward to the samples reported, with the speed.

    samples: float64 (4, N) as reported; ahead (N,); flux (>= 4, N), angle (3, N): changed in place.
    """
    st = state[0]
    if not ahead.any():
        return
    for k in range(ahead.shape[0]):
        if ahead[k] > 0:
            turned = ahead[k] * (st.T_s * angle[2, k] + st.lagging * wrap(angle[0, k] - angle[1, k]))
            c = math.cos(turned)
            s = math.sin(turned)
            x_a = c * flux[2, k] - s * flux[3, k]
            x_b = s * flux[2, k] + c * flux[3, k]
            flux[2, k] = x_a
            flux[3, k] = x_b
            flux[0, k] = x_a + st.L_q * samples[0, k]
            flux[1, k] = x_b + st.L_q * samples[1, k]
            angle[0, k] = wrap(angle[0, k] + turned)
            angle[1, k] = wrap(angle[1, k] + turned)
