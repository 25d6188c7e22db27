"""Conventional demodulation of rotating injection: kind `injection_demodulation`.

A rotating voltage A exp(j w_h t) (the paper's GARetal's signal) drives a current with a negative sequence that
carries the angle.  Band-pass, synchronous demodulation, low-pass LP:

    theta = arg(j sgn(L_0) LP[i_h exp(j w_h t)])/2, modulo pi, for an injection of phase 0

Textbook practice, reconstructed.  The band-pass takes off the slow part with a first-order low-pass of w_h/8, as
the project's meter of the injected current does; LP is two first-order low-passes of two periods each, which
leave 1/600 of the other sequence, that stands at twice the frequency.
The phase of the injection is not known here, so the reported voltages go through the same filters, behind the
resistance: theta = arg(-sgn(L_0) LP[i_N] P)/2 with the positive sequence P of the flux (names as in `probing`).

What i_N drives through the resistance is a negative sequence of the flux, which this method neglects, as usual:
the angle is behind by R L_s/(2 w_h L_d L_q) rad (1.3 deg for the paper's M2 at 400 Hz).

Needs saliency, rotating injection, and low speed: the angle is the low-passes' time constants late (10 ms at
400 Hz), and the fundamental passes the filters in proportion to its frequency.  Injection along one axis has a
negative sequence of its own and misleads it; the 1-sigma then says so.  Units: A, Wb, 1/H, rad electrical.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.probing import axis_sigma, flux_from_increments, put_axis

_TWO_PI = 2.0 * math.pi
_SETTLED = 6.0
"""Time constants of one low-pass after which the output of both counts."""


@kernel
def injection_demodulation_block(samples: NDArray[np.float64], regression: NDArray[np.float64],
                                 parameters: NDArray[np.void], state: NDArray[np.void],
                                 out: NDArray[np.float64]) -> None:
    """Run the observer over a block; arrays and records as for `ges_block`.

    out row 4: 0.  Row 5: the 1-sigma of the axis [rad electrical], pi = unknown, as until the filters settled.
    """
    p = parameters[0]
    st = state[0]
    settled = _SETTLED / p.average
    average = p.average
    # What the two low-passes leave of the variance of white noise: the sum of their squared impulse response.
    noise = p.noise * math.sqrt(average * (1.0 + (1.0 - average) ** 2) / (2.0 - average) ** 3)
    usable = 0.0 < p.step < math.pi
    for k in range(samples.shape[1]):
        i_a = samples[0, k]
        i_b = samples[1, k]
        b = complex(0.0, 0.0)
        sigma = math.pi
        if usable:
            i = complex(i_a, i_b)
            d = complex(regression[3, k], regression[4, k])
            if st.count == 0:
                st.slow_i = i
            i -= st.slow_i
            d -= st.slow_d
            st.slow_i += p.slow * i
            st.slow_d += p.slow * d
            turn = complex(math.cos(st.phase), -math.sin(st.phase))
            back = turn.conjugate()
            st.phase += p.step
            if st.phase > math.pi:
                st.phase -= _TWO_PI
            st.bins[0] += average * (i * turn - st.bins[0])
            st.bins[1] += average * (i * back - st.bins[1])
            st.bins[2] += average * (d * turn - st.bins[2])
            st.bins[3] += average * (d * back - st.bins[3])
            for j in range(4):
                st.bins[4 + j] += average * (st.bins[j] - st.bins[4 + j])
            if st.count < settled:
                st.count += 1
            else:
                flux_p, flux_n = flux_from_increments(st.bins[6], st.bins[7], p.half_cot)
                power = abs(flux_p) ** 2
                if power > 0.0:
                    b = st.bins[5] * flux_p / power
                    sigma = axis_sigma(b, st.bins[4], st.bins[5], flux_p, flux_n, p.mean, p.difference, noise)
        put_axis(b, sigma, i_a, i_b, p, st, out, k)
