"""From what an inverter reports to what the estimator takes: alpha and beta, peak, per phase; and a quality."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.mapping.align import on_circle
from ipmsm_can.mapping.model import CurrentMap, InverterMap, VoltageMap
from ipmsm_can.mapping.plan import ABSENT, ANGLE, CHANNELS, ENCODER, I_0, OMEGA, V_0, V_DC
from ipmsm_can.wire.receive import PLAUSIBLE

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Records = NDArray[np.void]

CURRENT_APART, VOLTAGE_APART, ANGLE_APART, OTHER_APART, IMPLAUSIBLE, MISSING = 1, 2, 4, 8, 16, 32
"""Bits of quality: reports too far apart in time from the sample, by what they are of; a value that is no
measurement (it is NaN then); a value that the map names and that did not come."""
QUALITY = {CURRENT_APART: "currents too far apart", VOLTAGE_APART: "voltage too far from the current",
           ANGLE_APART: "angle too far from the current", OTHER_APART: "other values too far from the current",
           IMPLAUSIBLE: "impossible values", MISSING: "values missing"}

(I_ALPHA, I_BETA, V_ALPHA, V_BETA, I_D, I_Q, V_D, V_Q, THETA, TURNING) = range(10)
OUTPUTS = 10

_NONE, _PHASE, _LINE, _AXES, _DQ, _DUTY = range(6)
_FORMS = {"phase": _PHASE, "line_line": _LINE, "alpha_beta": _AXES, "dq": _DQ, "duty": _DUTY}

SETTINGS = np.dtype([
    ("how", "i8", (CHANNELS,)), ("form", "i8", (2,)), ("place", "i8", (2, 3)), ("factor", "f8", (2,)),
    ("limit_angle", "f8"), ("limit_ns", "f8"),
])
STATE = np.dtype([("has", "i8"), ("t", "i8"), ("i_a", "f8"), ("i_b", "f8"), ("theta", "f8"), ("cross", "f8"),
                  ("dot", "f8"), ("all", "f8"), ("turn", "f8"), ("known", "i8")])

_FORGET = 0.95
"""How much of the turning found so far stays with the next sample, where no speed is reported."""
_COHERENT = 0.9
"""Share of the current that must turn alike from sample to sample to tell a speed: noise alone has a quarter."""
_ROOT3 = math.sqrt(3.0)


def settings(inverter: InverterMap, how: Ints) -> Records:
    """The map as the kernel takes it; how: of each channel, from the plan."""
    out = np.zeros(1, SETTINGS)
    out["how"][0] = how
    for k, section in enumerate((inverter.current, inverter.voltage)):
        if section is not None:
            out["form"][0, k] = _FORMS[section.form]
            out["place"][0, k] = ["abc".index(phase) for phase in section.order]
            out["factor"][0, k] = _factor(section)
    out["limit_angle"] = math.radians(inverter.timing.limit_angle)
    out["limit_ns"] = 1e9 * inverter.timing.limit_time
    return out


def spoils_dq(inverter: InverterMap) -> int:
    """The bits of quality that make i_d, i_q, v_d and v_q doubtful: the angle's only where it was used for them."""
    forms = [part.form for part in (inverter.current, inverter.voltage) if part is not None]
    angle = ANGLE_APART if any(form != "dq" for form in forms) else 0
    return CURRENT_APART | VOLTAGE_APART | IMPLAUSIBLE | angle


def _factor(section: CurrentMap | VoltageMap) -> float:
    """From the numbers on the bus to peak, per phase, amplitude-invariant."""
    vector = section.form in ("alpha_beta", "dq")
    factor = math.sqrt(2.0) if section.measure == "rms" else 1.0
    if vector and section.transform == "power":
        factor *= math.sqrt(2.0 / 3.0)
    if vector and isinstance(section, VoltageMap) and section.per == "line":
        factor /= _ROOT3
    return factor


@kernel
def _vector(form: int, place: Ints, factor: float, first: int, k: int, values: Floats, v_dc: float, cos: float,
            sin: float) -> tuple[float, float, float, float]:
    """(alpha, beta, d, q) from the three channels at `first`; d and q are NaN where the angle is not known."""
    x = values[first, k]
    y = values[first + 1, k]
    z = values[first + 2, k]
    if form == _AXES:
        alpha, beta = x * factor, y * factor
        return alpha, beta, alpha * cos + beta * sin, beta * cos - alpha * sin
    if form == _DQ:
        d, q = x * factor, y * factor
        return d * cos - q * sin, d * sin + q * cos, d, q
    if form in (_PHASE, _LINE):
        # The third of three values that add up to zero.
        if np.isnan(x):
            x = -(y + z)
        elif np.isnan(y):
            y = -(x + z)
        elif np.isnan(z):
            z = -(x + y)
    if form == _LINE:
        x, y, z = (x - z) / 3.0, (y - x) / 3.0, (z - y) / 3.0
    phases = np.empty(3)
    phases[place[0]] = x
    phases[place[1]] = y
    phases[place[2]] = z
    if form == _DUTY:
        factor = v_dc
    alpha = factor * (2.0 * phases[0] - phases[1] - phases[2]) / 3.0
    beta = factor * (phases[1] - phases[2]) / _ROOT3
    return alpha, beta, alpha * cos + beta * sin, beta * cos - alpha * sin


@kernel
def _turning(st: Any, t: int, i_a: float, i_b: float, theta: float, omega: float) -> float:
    """Electrical speed [rad/s] by the best there is: reported, from the angle, from the current; NaN if nothing."""
    found = np.nan
    if st.has and t > st.t:
        dt = 1e-9 * (t - st.t)
        turned = np.nan
        if np.isfinite(theta) and np.isfinite(st.theta):
            turned = on_circle(theta - st.theta)
        elif np.isfinite(i_a) and np.isfinite(st.i_a) and np.isfinite(i_b) and np.isfinite(st.i_b):
            st.cross = _FORGET * st.cross + st.i_a * i_b - st.i_b * i_a
            st.dot = _FORGET * st.dot + st.i_a * i_a + st.i_b * i_b
            st.all = _FORGET * st.all + np.hypot(st.i_a, st.i_b) * np.hypot(i_a, i_b)
            if np.hypot(st.cross, st.dot) > _COHERENT * st.all:
                turned = np.arctan2(st.cross, st.dot)
            else:
                st.known = 0
        if np.isfinite(turned):
            st.turn = turned / dt
            st.known = 1
    if st.known:
        found = st.turn
    st.has = 1
    st.t = t
    st.i_a = i_a
    st.i_b = i_b
    st.theta = theta
    return float(omega if np.isfinite(omega) else found)


@kernel
def _apart(first: int, count: int, how: Ints, k: int, apart: Floats, cross: Floats, turning: float, limit: float,
           limit_ns: float, rotates: bool) -> bool:
    """Whether one of `count` channels from `first` on was reported too far in time from row k."""
    for c in range(first, first + count):
        if how[c] == ABSENT or np.isnan(apart[c, k]):
            continue
        if apart[c, k] > limit_ns:
            return True
        if rotates and np.isfinite(turning):
            if abs(turning) * 1e-9 * apart[c, k] > limit:
                return True
            # What the chord between two reports is off from the arc.
            if c < cross.shape[0] and 0.5 * turning * turning * cross[c, k] > limit:
                return True
    return False


@kernel
def convert_block(row_t: Ints, values: Floats, apart: Floats, cross: Floats, setting: Records, state: Records,
                  out: Floats, quality: NDArray[np.uint8]) -> None:
    """R rows: out (OUTPUTS, R), quality (R,); values (CHANNELS, R) that are no measurement become NaN in place."""
    st = state[0]
    s = setting[0]
    how = s.how
    for k in range(row_t.shape[0]):
        q = 0
        for c in range(CHANNELS):
            if how[c] == ABSENT:
                continue
            if np.isnan(values[c, k]):
                q |= MISSING
            elif not abs(values[c, k]) <= (PLAUSIBLE if c < V_DC else 1e12):
                values[c, k] = np.nan
                q |= IMPLAUSIBLE
        theta = on_circle(values[ANGLE, k])
        cos, sin = np.cos(theta), np.sin(theta)
        for part in range(2):
            if s.form[part] == _NONE:
                for j in range(2):
                    out[I_ALPHA + 2 * part + j, k] = np.nan
                    out[I_D + 2 * part + j, k] = np.nan
                continue
            a, b, d, e = _vector(s.form[part], s.place[part], s.factor[part], I_0 if part == 0 else V_0, k, values,
                                 values[V_DC, k], cos, sin)
            out[I_ALPHA + 2 * part, k] = a
            out[I_BETA + 2 * part, k] = b
            out[I_D + 2 * part, k] = d
            out[I_Q + 2 * part, k] = e
        out[THETA, k] = theta
        seen = theta if np.isfinite(theta) else on_circle(values[ENCODER, k])
        turning = _turning(st, row_t[k], out[I_ALPHA, k], out[I_BETA, k], seen, values[OMEGA, k])
        out[TURNING, k] = turning
        if _apart(I_0, 3, how, k, apart, cross, turning, s.limit_angle, s.limit_ns, s.form[0] != _DQ):
            q |= CURRENT_APART
        if _apart(V_0, 3, how, k, apart, cross, turning, s.limit_angle, s.limit_ns, s.form[1] != _DQ):
            q |= VOLTAGE_APART
        if _apart(ANGLE, 2, how, k, apart, cross, turning, s.limit_angle, s.limit_ns, True):
            q |= ANGLE_APART
        if _apart(OMEGA, 3, how, k, apart, cross, turning, s.limit_angle, s.limit_ns, False):
            q |= OTHER_APART
        quality[k] = q
