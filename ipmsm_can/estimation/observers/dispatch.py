"""The choice among the observers inside a compiled call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers.chonam import chonam_block
from ipmsm_can.estimation.observers.common import OPINION
from ipmsm_can.estimation.observers.ges import ges_block
from ipmsm_can.estimation.observers.injection_demodulation import injection_demodulation_block
from ipmsm_can.estimation.observers.injection_extraction import injection_extraction_block
from ipmsm_can.estimation.observers.kinds import (
    ACTIVE_FLUX_REGRESSION,
    CHONAM,
    GES,
    INJECTION_DEMODULATION,
    INJECTION_EXTRACTION,
    RICCATI,
    SPMSM_GRADIENT,
    SPMSM_GRADIENT_MAX,
    SPMSM_REGRESSION,
)
from ipmsm_can.estimation.observers.linear_regression import linear_regression_block
from ipmsm_can.estimation.observers.riccati import riccati_block
from ipmsm_can.estimation.observers.spmsm_gradient import spmsm_gradient_block


@kernel
def observer_block(samples: NDArray[np.float64], regression: NDArray[np.float64], parameters: NDArray[np.void],
                   state: NDArray[np.void], out: NDArray[np.float64]) -> None:
    """Run the observer that `parameters.kind` names over a block; arrays and records as for `ges_block`."""
    kind = parameters[0].kind
    if kind == RICCATI:
        riccati_block(samples, regression, parameters, state, out)
        return
    for k in range(out.shape[1]):
        out[OPINION, k] = 0.0
    if kind == GES:
        ges_block(samples, regression, parameters, state, out)
    elif kind == CHONAM:
        chonam_block(samples, regression, parameters, state, out)
    elif kind in (ACTIVE_FLUX_REGRESSION, SPMSM_REGRESSION):
        linear_regression_block(samples, regression, parameters, state, out)
    elif kind in (SPMSM_GRADIENT, SPMSM_GRADIENT_MAX):
        spmsm_gradient_block(samples, regression, parameters, state, out)
    elif kind == INJECTION_EXTRACTION:
        injection_extraction_block(samples, regression, parameters, state, out)
    elif kind == INJECTION_DEMODULATION:
        injection_demodulation_block(samples, regression, parameters, state, out)
