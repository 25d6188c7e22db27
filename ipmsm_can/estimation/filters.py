"""First-order filters alpha/(p + alpha), discretised exactly for the kind of input they see."""

from __future__ import annotations

import math
from typing import NamedTuple


class FilterCoefficients(NamedTuple):
    """One step of F = alpha/(p + alpha) over T_s.

    Input held over the interval (a mean voltage):  f' = decay f + (1 - decay) u.
    Input linear between samples (a current, a product of filtered signals):
    f' = decay f + previous u_(k-1) + present u_k.
    """

    alpha: float
    decay: float
    previous: float
    present: float


def filter_coefficients(alpha: float, sample_period: float) -> FilterCoefficients:
    """Coefficients for bandwidth alpha [1/s] and sample period [s]; both > 0.

    decay = exp(-alpha T_s); the linear-input pair follows from integrating exp(-alpha (T_s - s)) against
    the straight line through both samples, so that previous + present = 1 - decay.
    """
    z = alpha * sample_period
    decay = math.exp(-z)
    mean_weight = -math.expm1(-z) / z
    return FilterCoefficients(alpha, decay, mean_weight - decay, 1.0 - mean_weight)
