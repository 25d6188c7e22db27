"""What a sample adds to a drive's course."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BIN_NS = 100_000_000
"""Length of a bin [ns]."""
_BACK = 5
"""A time stamp earlier than the newest by more bins than this means that the clock was set back."""

BIN = np.dtype([
    ("key", "i8"), ("n", "i8"), ("i2", "f8"), ("i2_max", "f8"), ("v2", "f8"), ("aligned", "i8"), ("i_d", "f8"),
    ("i_q", "f8"), ("omega", "f8"), ("omega_low", "f8"), ("omega_high", "f8"), ("sigma", "f8"), ("sigma_max", "f8"),
])
"""key: bin number since the epoch.  Sums over n samples: i2 = |i|^2, v2 = |v|^2 (vectors, peak); over the `aligned`
ones that have an angle: i_d, i_q, omega, and its range.  sigma: of the last sample."""


@kernel
def add_block(values: Floats, t_ns: Ints, theta: Floats, omega: Floats, sigma: Floats, known: float,
              bins: NDArray[np.void], newest: Ints) -> None:
    """Take in M samples: values (4, M) as i_alpha, i_beta, v_alpha, v_beta; t_ns, theta, omega, sigma (M,)."""
    for k in range(t_ns.shape[0]):
        key = t_ns[k] // BIN_NS
        if key < newest[0]:
            if newest[0] - key > _BACK:
                for j in range(bins.shape[0]):
                    bins[j].key = -1
                newest[0] = key
            else:
                key = newest[0]
        else:
            newest[0] = key
        b = bins[key % bins.shape[0]]
        if b.key != key:
            b.key = key
            b.n = 0
            b.i2 = 0.0
            b.i2_max = 0.0
            b.v2 = 0.0
            b.aligned = 0
            b.i_d = 0.0
            b.i_q = 0.0
            b.omega = 0.0
            b.omega_low = np.inf
            b.omega_high = -np.inf
            b.sigma_max = 0.0
        i2 = values[0, k] * values[0, k] + values[1, k] * values[1, k]
        b.n += 1
        b.i2 += i2
        b.i2_max = max(b.i2_max, i2)
        b.v2 += values[2, k] * values[2, k] + values[3, k] * values[3, k]
        b.sigma = sigma[k]
        b.sigma_max = max(b.sigma_max, sigma[k])
        if sigma[k] < known and theta[k] == theta[k]:
            c = math.cos(theta[k])
            s = math.sin(theta[k])
            b.aligned += 1
            b.omega += omega[k]
            b.omega_low = min(b.omega_low, omega[k])
            b.omega_high = max(b.omega_high, omega[k])
            b.i_d += c * values[0, k] + s * values[1, k]
            b.i_q += c * values[1, k] - s * values[0, k]
