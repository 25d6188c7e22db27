"""Position from the response to an injected voltage, averaged over its period: kind `injection_extraction`.

The paper's YIetal ("signal probed only into v_alpha"), whose own text was not at hand; reconstructed.  With
v_alpha = V sin(w_h t) and S = -(V/w_h) cos(w_h t),

    i = ibar + S y_v,    y_v = (L_s - (L_0/2) cos 2 theta, -(L_0/2) sin 2 theta)/(L_d L_q)
    ibar = mean of i over one injection period,    y_v = sum S (i - ibar) / sum S^2
    theta = atan2(y_v2, y_v1 - L_s/(L_d L_q))/2 for L_0 < 0, modulo pi

Here S is not generated but taken from the reported voltages: the flux at the probing frequency in the same
window, behind the resistance.  The least-squares fit of L^-1(theta) to it,

    b = [(i_P - a P) N + (i_N - a N) P] / (|P|^2 + |N|^2),    theta = arg(-sgn(L_0) b)/2

is the formula above for v_alpha-only injection, and holds for any axis and for rotating injection as well; see
`probing` for the names.  The window holds whole periods: 25 samples, two periods, for 400 Hz at 5 kHz.

Needs saliency, injection, and low speed: the angle is that of the window's middle, w T/2 late, and what turns
with the rotor leaks into the window in proportion to w^2.  Uses no R-L model of the fundamental, no alpha, no
gamma.  Units: A, Wb, 1/H, rad electrical.  The sums restart from zero with every turn of the window, so that no
rounding error accumulates over hours.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.probing import axis_sigma, flux_from_increments, put_axis

_TWO_PI = 2.0 * math.pi


@kernel
def _accumulate(sums: NDArray[np.complex128], i: complex, d: complex, turn: complex, sign: float) -> None:
    """Add (sign 1) or take off (-1) a sample: sequences of current and flux increment, and plain sums."""
    forward = sign * turn
    back = sign * turn.conjugate()
    sums[0] += i * forward
    sums[1] += i * back
    sums[2] += d * forward
    sums[3] += d * back
    sums[4] += sign * i
    sums[5] += sign * d
    sums[6] += forward


@kernel
def injection_extraction_block(samples: NDArray[np.float64], regression: NDArray[np.float64],
                               parameters: NDArray[np.void], state: NDArray[np.void],
                               out: NDArray[np.float64]) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`.

    out row 4: 0.  Row 5: the 1-sigma of the axis [rad electrical], pi = unknown, as until the window is full.
    """
    p = parameters[0]
    st = state[0]
    n = p.window
    noise = p.noise / math.sqrt(max(n, 1))
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        b = complex(0.0, 0.0)
        sigma = math.pi
        if n > 0:
            i = complex(i_a, i_b)
            d = complex(regression[3, k], regression[4, k])
            turn = complex(math.cos(st.phase), -math.sin(st.phase))
            st.phase += p.step
            if st.phase > math.pi:
                st.phase -= _TWO_PI
            slot = st.slot
            if st.count == n:
                _accumulate(st.sums, st.ring[slot, 0], st.ring[slot, 1], st.ring[slot, 2], -1.0)
            else:
                st.count += 1
            st.ring[slot, 0] = i
            st.ring[slot, 1] = d
            st.ring[slot, 2] = turn
            _accumulate(st.sums, i, d, turn, 1.0)
            _accumulate(st.fresh, i, d, turn, 1.0)
            slot += 1
            if slot == n:
                slot = 0
                for j in range(7):
                    st.sums[j] = st.fresh[j]
                    st.fresh[j] = 0.0
            st.slot = slot
            if st.count == n:
                # Without the means, which whole periods would not contain.
                i_mean = st.sums[4] / n
                d_mean = st.sums[5] / n
                turns = st.sums[6]
                i_p = (st.sums[0] - i_mean * turns) / n
                i_n = (st.sums[1] - i_mean * turns.conjugate()) / n
                flux_p, flux_n = flux_from_increments((st.sums[2] - d_mean * turns) / n,
                                                      (st.sums[3] - d_mean * turns.conjugate()) / n, p.half_cot)
                power = abs(flux_p) ** 2 + abs(flux_n) ** 2
                if power > 0.0:
                    b = ((i_p - p.mean * flux_p) * flux_n + (i_n - p.mean * flux_n) * flux_p) / power
                    sigma = axis_sigma(b, i_p, i_n, flux_p, flux_n, p.mean, p.difference, noise)
        put_axis(b, sigma, i_a, i_b, p, st, out, k)
