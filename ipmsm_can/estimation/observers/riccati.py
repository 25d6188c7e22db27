"""The paper's regression in a Kalman filter: kind `riccati`.

    lambda' = v + sum b_j B_j - R i + noise,      b_j' = -b_j/tau_j + noise      (`voltage_errors`)
    y       = Phi^T x + d + sum b_j n_j + noise,      x = lambda - L_q i,      theta_hat = atan2(x_hat)
    d       = -l H[i^T sigma(x)],      l = psi_m L_0

Between samples lambda advances exactly by the regression's increment; y is one scalar measurement a sample, linear
in lambda but for the small d, so the filter converges from every initial flux, as the paper's gradient does.  d is
taken at the estimate.  While its angle is not known it counts as noise of its own size, (l |H[i]| theta~)^2; once
it is, its derivative along x, the Lambda of `chonam`, is added to Phi.

Noise, in physical units, nothing tuned.
    process        2 v_r^2 CORRELATION_TIME a second in each direction, v_r: what `voltage_errors` leaves
    y, white       2 alpha psi_m L_q s_i: the current noise through x and H
    shape          of dead time near zero current: how much a phase loses there, but for its corner, is anybody's
                   guess, SHAPE of what it loses elsewhere.  It is a function of the currents, so it keeps its sign
                   as long as these do: it counts for a sixth of a radian of the rotor, at most LONGEST
    square         the regression holds the voltage's errors with their square (`voltage_errors`).  What they are
                   still wrong by multiplies the error of x_hat, which grew out of them: 2 e~^T x~, and
                   e~^2/alpha, noise that lasts as long as the shape.  Its mean, what x~ and e~ have in common by P,
                   is taken off y
    lost samples   `lost_steps`
    length         at standstill y says next to nothing of the length of x_hat, and what it says of it under probing
                   is wrong: |x| = psi_m + L_0 i_d is measured, too, to LENGTH, the less the faster the rotor turns
    y, coloured    2 psi_m v_r, the same voltage error through F.  It keeps its sign for CORRELATION_TIME, so that
                   many samples together say no more than one: its variance counts 2 CORRELATION_TIME/T_s times
    y, transients  2 psi_m dL |H[i]|: a wrong inductance shows while the current changes
    cross-saturation   under load the axis of the saliency leaves the rotor's by an angle nobody has measured,
                   `tilt` at rated current and with its square below; 2 psi_m L_0 H[i] times that angle shows in
                   y, as long as the load lasts.  At speed it is small beside Phi; at standstill it limits probing
    y, memory      after a loss of lock Lemma 1 does not hold until the filters have forgotten: an error of at most
                   4 alpha psi_m^2 that dies out with exp(-alpha t), the paper's epsilon_t, coloured as well
The angle's 1-sigma is the covariance across x_hat, the current noise L_q s_i, and dL i_q with what saturation may
take from L_q, each over |x_hat|.

Loss of lock.  The squared innovation over its variance and that of the length of x_hat against psi_m + L_0 i_d,
whichever is larger, averaged over INNOVATION_TIME; beyond _LOST_ABOVE everything is forgotten but the flux itself.

Polarity.  Standstill makes |Phi| = |L_0 H[i]| and the voltage error twice its size; only while Phi is longer than
both together does a sample count for the polarity.  It is known once these samples alone, against all of the
voltage error as noise, fix the flux in every direction to _POLARITY_SHARE of psi_m.  A turning rotor does that; a
constant error of the voltage, whatever its size, points in one direction and does not.  What was learned of the
voltage before that, with the rotor taken to be half a turn away perhaps, counts no more than the priors.

Not quoted from the paper, which leaves the gain to the user.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.common import FITS, FLUX_STATES, POLARITY, along
from ipmsm_can.estimation.observers.covariance import (
    ANGLE_KNOWN,
    across,
    angle_sigma,
    correct,
    limit,
    voltage_variance,
)
from ipmsm_can.estimation.observers.forgetting import distrust, forget, start_over
from ipmsm_can.estimation.observers.lost_steps import left_out, straight_on
from ipmsm_can.estimation.observers.voltage_errors import (
    BIASES,
    SUMMED,
    directions,
    near_zero,
    predict,
    rounded,
    shifted,
)
from ipmsm_can.estimation.speed import follow

Floats = NDArray[np.float64]

CORRELATION_TIME = 0.01
"""Time [s] over which a voltage error that is no state is taken as constant."""
SHAPE = 0.2
"""What a phase near zero current loses, 1-sigma as a share of the dead time's voltage."""
LONGEST = 0.2
"""Longest time [s] for which the shape of dead time is taken to keep its sign."""
_SIXTH = 1.0 / 6.0
INNOVATION_TIME = 0.005
"""Averaging time [s] of the innovation test."""
CURVED = 8.0
"""Variance of the product of two errors over that of each: both grow out of the same voltage error, and so go
together."""
LENGTH = 0.05
"""1-sigma of the length of the active flux at standstill, relative to psi_m, for LONGEST."""
_TURNING = 25.0
"""Square of the back-EMF over the voltage's uncertainty from which on the length is left to the regression."""
MODEL_ERROR = 0.1
"""1-sigma of the length of x_hat that wrong parameters explain, relative to psi_m."""
_LOST_ABOVE = 9.0
_FITS_BELOW = 4.0
_POLARITY_SHARE = 0.25
_POLARITY_LOST = math.radians(45.0)
_HUGE = 1e100


@kernel
def _filter_units(B: Floats, phi_a: float, phi_b: float, st: Any, p: Any) -> None:
    """F[B_j], F[Phi'^T F[B_j]] and F[e^2] after one interval; Phi' = Phi + 2 e, e = sum b_j F[B_j]."""
    e_a = 0.0
    e_b = 0.0
    for j in range(BIASES):
        st.unit[j, 0] = p.decay * st.unit[j, 0] + (1.0 - p.decay) * B[j, 0]
        st.unit[j, 1] = p.decay * st.unit[j, 1] + (1.0 - p.decay) * B[j, 1]
        if j < SUMMED:
            e_a += st.bias[j] * st.unit[j, 0]
            e_b += st.bias[j] * st.unit[j, 1]
    square = e_a * e_a + e_b * e_b
    st.f_square = p.decay * st.f_square + p.previous * st.square + p.present * square
    st.square = square
    for j in range(BIASES):
        new = (phi_a + 2.0 * e_a) * st.unit[j, 0] + (phi_b + 2.0 * e_b) * st.unit[j, 1]
        st.f_product[j] = p.decay * st.f_product[j] + p.previous * st.product[j] + p.present * new
        st.product[j] = new


@kernel
def _gradient(i_a: float, i_b: float, x_a: float, x_b: float, epsilon: float) -> tuple[float, float]:
    """Gradient of i^T sigma(x) [A/Wb], the u of `chonam`."""
    x2 = x_a * x_a + x_b * x_b
    if not x2 >= epsilon * epsilon:
        return 0.0, 0.0
    share = (x_a * i_b - x_b * i_a) / (x2 * math.sqrt(x2))
    return -share * x_b, share * x_a


@kernel
def _count_clear(phi_a: float, phi_b: float, noise: float, process: float, ceiling: float, counts: bool,
                 st: Any) -> float:
    """Take the sample, if it counts, into the covariance that polarity rests on; its larger eigenvalue [Wb^2]."""
    aa = min(st.clear[0] + process, ceiling)
    ab = st.clear[1]
    bb = min(st.clear[2] + process, ceiling)
    if counts:
        b_a = aa * phi_a + ab * phi_b
        b_b = ab * phi_a + bb * phi_b
        total = max(b_a * phi_a + b_b * phi_b, 0.0) + noise
        aa -= b_a * b_a / total
        ab -= b_a * b_b / total
        bb -= b_b * b_b / total
    st.clear[0] = aa
    st.clear[1] = ab
    st.clear[2] = bb
    return float(0.5 * (aa + bb) + math.sqrt(0.25 * (aa - bb) ** 2 + ab * ab))


@kernel
def riccati_block(samples: Floats, regression: Floats, parameters: NDArray[np.void], state: NDArray[np.void],
                  out: Floats) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`.

    out (7, N): row 5 is the 1-sigma of theta_hat [rad electrical], pi = unknown; row 6 the bits FITS (innovation
    and length of x_hat are what they should be) and POLARITY.
    """
    p = parameters[0]
    T_s = p.T_s
    L_q = p.L_q
    L_0 = p.L_0
    psi_m = p.psi_m
    alpha = p.alpha
    epsilon = p.epsilon
    decay = p.decay
    ell_alpha = p.ell * alpha
    ceiling = 4.0 * psi_m * psi_m
    correlated = 2.0 * CORRELATION_TIME / T_s
    # A process noise of nothing at all would leave P to rounding.
    growth = 2.0 * CORRELATION_TIME * T_s
    tiny = 1e-14 * psi_m * psi_m * T_s
    white = (2.0 * alpha * psi_m * L_q * p.noise) ** 2 + 1e-24 * psi_m**4
    smoothing = 1.0 - math.exp(-T_s / INNOVATION_TIME)
    st = state[0]
    P = st.P
    bias = st.bias
    unit = st.unit
    B = np.zeros((BIASES, 2))
    B[0, 0] = 1.0
    B[1, 1] = 1.0
    h = np.zeros(FLUX_STATES)
    gain = np.zeros(FLUX_STATES)
    l_a = st.lambda_a
    l_b = st.lambda_b
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        y = regression[0, k]
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        h_a = regression[5, k]
        h_b = regression[6, k]
        i2 = i_a * i_a + i_b * i_b
        residual2 = p.residual * p.residual + p.residual_R * p.residual_R * i2
        # Dead time as far as it is known: what it is taken for, and what it may be besides.
        shape, unknown = near_zero(i_a, i_b, p.zone, p.corner)
        shape2 = SHAPE * SHAPE * (bias[2] * bias[2] * shape + P[4, 4] * (shape + unknown))
        holds = min(max(_SIXTH / max(abs(st.pll_omega), 1e-9), CORRELATION_TIME), LONGEST)
        begins = st.started == 0
        straight = straight_on(samples, k, st)
        if begins:
            st.started = 1
            if P[0, 0] == 0.0:
                forget(P, st, p, ceiling)
        else:
            # While the voltage is held the back-EMF turns: i'' = L^-1 omega^2 x bends the current away.
            bend = (T_s * st.pll_omega) ** 2 / (12.0 * p.L_d)
            flows_a = 0.5 * (st.i_a + i_a) - bend * st.x_a - bias[5]
            flows_b = 0.5 * (st.i_b + i_b) - bend * st.x_b - bias[6]
            directions(flows_a, flows_b, p.zone, B)
            rounded(flows_a, flows_b, p.corner, B)
            shifted(flows_a, flows_b, p.zone, p.corner, bias[2], bias[4], B)
            l_a += regression[3, k]
            l_b += regression[4, k]
            for j in range(BIASES):
                if j < SUMMED:
                    l_a += T_s * B[j, 0] * bias[j]
                    l_b += T_s * B[j, 1] * bias[j]
                bias[j] *= p.keep[j]
            missed = left_out(i_a - st.i_a, i_b - st.i_b, regression[3, k], regression[4, k], straight, st, p)
            st.memory += correlated * (2.0 * alpha * psi_m) ** 2 * missed
            predict(P, B, T_s, p.keep, p.prior, growth * residual2 + 2.0 * holds * T_s * shape2 + missed + tiny)
            _filter_units(B, phi_a, phi_b, st, p)
        st.i_a = i_a
        st.i_b = i_b
        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        x2 = x_a * x_a + x_b * x_b
        h2 = h_a * h_a + h_b * h_b
        phi2 = phi_a * phi_a + phi_b * phi_b
        if not (x2 < 400.0 * psi_m * psi_m and phi2 < _HUGE and abs(y) < _HUGE and h2 < _HUGE):
            # An absurd sample.  Start from no angle, and count on nothing until the filters have forgotten it.
            l_a = L_q * i_a if abs(i_a) < 1e9 else 0.0
            l_b = L_q * i_b if abs(i_b) < 1e9 else 0.0
            start_over(P, st, p, ceiling)
            st.memory = correlated * (4.0 * alpha * psi_m * psi_m) ** 2
            out[0, k] = l_a
            out[1, k] = l_b
            out[2, k] = 0.0
            out[3, k] = 0.0
            out[4, k] = 0.0
            out[5, k] = math.pi
            out[6, k] = 0.0
            continue

        # d and its gradient at the prediction.
        s = along(i_a, i_b, x_a, x_b, epsilon)
        u_a, u_b = _gradient(i_a, i_b, x_a, x_b, epsilon)
        if begins:
            # The same fictitious past as the regression's: H[.] = 0 at the first sample.
            open_s = (1.0 - p.present) * s
            open_ua = (1.0 - p.present) * u_a
            open_ub = (1.0 - p.present) * u_b
        else:
            open_s = decay * st.f_s + p.previous * st.s
            open_ua = decay * st.f_u_a + p.previous * st.u_a
            open_ub = decay * st.f_u_b + p.previous * st.u_b
        angle2 = 2.0
        if x2 > epsilon * epsilon:
            angle2 = min(across(P, x_a, x_b) / x2, 2.0)
        known = angle2 < ANGLE_KNOWN

        # The measurement's row, its prediction and its noise.
        innovation = y - (phi_a * x_a + phi_b * x_b) + ell_alpha * (s - (open_s + p.present * s))
        h[0] = phi_a
        h[1] = phi_b
        volts2 = 0.0
        e2 = 0.0
        w_a = 2.0 * x_a - (phi_a + L_0 * h_a) / alpha - L_0 * (i_a - h_a / alpha)
        w_b = 2.0 * x_b - (phi_b + L_0 * h_b) / alpha - L_0 * (i_b - h_b / alpha)
        if known:
            for j in range(SUMMED):
                w_a -= 2.0 / alpha * bias[j] * unit[j, 0]
                w_b -= 2.0 / alpha * bias[j] * unit[j, 1]
            innovation -= (st.square + st.f_square) / alpha
            e2 = voltage_variance(P, unit)
        for j in range(BIASES):
            e_a = unit[j, 0]
            e_b = unit[j, 1]
            h[2 + j] = 0.0
            if known:
                n = w_a * e_a + w_b * e_b - st.f_product[j] / alpha
                innovation -= 2.0 * (P[0, 2 + j] * e_a + P[1, 2 + j] * e_b)
                h[2 + j] = n
                if j < SUMMED:
                    innovation -= bias[j] * n
                    h[0] += 2.0 * bias[j] * e_a
                    h[1] += 2.0 * bias[j] * e_b
            else:
                volts2 += P[2 + j, 2 + j] * (e_a * e_a + e_b * e_b)
        if known:
            h[0] -= ell_alpha * (u_a - (open_ua + p.present * u_a))
            h[1] -= ell_alpha * (u_b - (open_ub + p.present * u_b))
        d2 = p.ell * p.ell * h2 * (0.25 * angle2 * angle2 if known else angle2)
        coloured = 4.0 * psi_m * psi_m * (residual2 + shape2)
        load_a = i_a - h_a / alpha
        load_b = i_b - h_b / alpha
        tilt = p.tilt * (load_a * load_a + load_b * load_b) / (p.rated * p.rated)
        cross2 = (L_0 * min(tilt, 1.0)) ** 2 * h2
        coloured += 4.0 * psi_m * psi_m * cross2
        second2 = CURVED * e2 * (max(P[0, 0] + P[1, 1], 0.0) + e2 / (alpha * alpha))
        lasting = 4.0 * psi_m * psi_m * (correlated * residual2 + 2.0 * holds / T_s * (shape2 + cross2))
        lasting += 2.0 * holds / T_s * second2
        coloured += second2
        rest = white + d2 + 4.0 * psi_m * psi_m * (volts2 + (p.spread_L * L_q) ** 2 * h2)
        seen = correct(P, h, gain, rest + lasting + st.memory)
        misfit = innovation * innovation / (seen + rest + coloured + st.memory / correlated)
        l_a += gain[0] * innovation
        l_b += gain[1] * innovation
        for j in range(BIASES):
            bias[j] += gain[2 + j] * innovation
        # What turns shows its length by itself; at standstill nothing but the magnet tells.
        fast = (psi_m * st.pll_omega / max(p.volts, 1e-6)) ** 2
        if known and fast < _TURNING:
            length = math.sqrt(x2)
            h[0] = x_a / length
            h[1] = x_b / length
            for j in range(BIASES):
                h[2 + j] = 0.0
            off = psi_m + L_0 * s - length - (h[0] * gain[0] + h[1] * gain[1]) * innovation
            noise2 = 2.0 * LONGEST / T_s * psi_m * psi_m * (
                LENGTH * LENGTH + 0.5 * angle2 * angle2) * (1.0 + fast * fast)
            correct(P, h, gain, noise2)
            l_a += gain[0] * off
            l_b += gain[1] * off
            for j in range(BIASES):
                bias[j] += gain[2 + j] * off
        limit(P, ceiling)
        st.memory *= decay * decay

        x_a = l_a - L_q * i_a
        x_b = l_b - L_q * i_b
        x2 = x_a * x_a + x_b * x_b
        s = along(i_a, i_b, x_a, x_b, epsilon)
        st.s = s
        st.f_s = open_s + p.present * s
        u_a, u_b = _gradient(i_a, i_b, x_a, x_b, epsilon)
        st.u_a = u_a
        st.u_b = u_b
        st.f_u_a = open_ua + p.present * u_a
        st.f_u_b = open_ub + p.present * u_b

        st.x_a = x_a
        st.x_b = x_b
        angle = math.atan2(x_b, x_a)
        st.pll_theta, st.pll_omega, st.pll_difference = follow(
            angle, x2 < epsilon * epsilon, st.pll_started, st.pll_hat, st.pll_theta, st.pll_omega,
            st.pll_difference, T_s, p.pole)
        st.pll_started = 1
        st.pll_hat = angle

        # What to think of it.
        sigma = math.pi
        if x2 > epsilon * epsilon:
            sigma = angle_sigma(P, x_a, x_b, max(i2 - s * s, 0.0), p)
            along2 = max(P[0, 0] + P[1, 1] - across(P, x_a, x_b), 0.0)
            off = math.sqrt(x2) - (psi_m + L_0 * s)
            misfit = max(misfit, off * off / (along2 + (MODEL_ERROR * psi_m) ** 2))
        if not sigma < math.pi:
            sigma = math.pi
        st.test += smoothing * (min(misfit, 1e4) - st.test)
        if st.test > _LOST_ABOVE:
            st.lost += 1
            forget(P, st, p, ceiling)
            st.memory = correlated * (4.0 * alpha * psi_m * psi_m) ** 2
            sigma = math.pi
        error2 = (16.0 / 9.0) * p.volts * p.volts + p.spread_R * p.spread_R * i2
        bound = 2.0 * abs(L_0) * math.sqrt(h2) + 4.0 * math.sqrt(error2)
        open2 = _count_clear(phi_a, phi_b, rest + correlated * 4.0 * psi_m * psi_m * error2,
                             growth * error2 + tiny, ceiling, phi2 > bound * bound, st)
        fits = st.test < _FITS_BELOW
        if sigma > _POLARITY_LOST:
            st.polarity = 0
            if open2 < _POLARITY_SHARE * _POLARITY_SHARE * psi_m * psi_m:
                st.clear[0] = ceiling
                st.clear[1] = 0.0
                st.clear[2] = ceiling
        elif fits and open2 < _POLARITY_SHARE * _POLARITY_SHARE * psi_m * psi_m:
            if st.polarity == 0:
                distrust(P, st.test, p)
            st.polarity = 1
        out[0, k] = l_a
        out[1, k] = l_b
        out[2, k] = x_a
        out[3, k] = x_b
        out[4, k] = innovation
        out[5, k] = sigma
        out[6, k] = FITS * fits + POLARITY * st.polarity
    st.lambda_a = l_a
    st.lambda_b = l_b
