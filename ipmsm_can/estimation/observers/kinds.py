"""The observers by name and number; kept apart from the kernels, so that a configuration is read without them."""

from __future__ import annotations

GES = 0
RICCATI = 1
SPMSM_GRADIENT = 2
SPMSM_GRADIENT_MAX = 3
SPMSM_REGRESSION = 4
ACTIVE_FLUX_REGRESSION = 5
CHONAM = 6
INJECTION_EXTRACTION = 7
INJECTION_DEMODULATION = 8

KINDS = {
    "ges": GES,
    "riccati": RICCATI,
    "spmsm_gradient": SPMSM_GRADIENT,
    "spmsm_gradient_max": SPMSM_GRADIENT_MAX,
    "spmsm_regression": SPMSM_REGRESSION,
    "active_flux_regression": ACTIVE_FLUX_REGRESSION,
    "chonam": CHONAM,
    "injection_extraction": INJECTION_EXTRACTION,
    "injection_demodulation": INJECTION_DEMODULATION,
}
"""Name in a configuration -> number on the wire (CompanionStatus.observer)."""

NON_SALIENT = (SPMSM_GRADIENT, SPMSM_GRADIENT_MAX, SPMSM_REGRESSION)
"""Kinds that take the machine for one with L_d = L_q = L_s."""
MODULO_PI = (INJECTION_EXTRACTION, INJECTION_DEMODULATION)
"""Kinds that see the rotor's axis and not which of its ends is north."""

WINDOW_CAPACITY = 512
"""Samples that the window of `injection_extraction` can hold."""
