"""Where the paper's text is wrong: what docs/errata.md says at length, for the report's page."""

from __future__ import annotations

ERRATA = (
    ("injection, eq. (signal_inj)", "J = [[0, −1], [1, 1]]", "J = [[0, −1], [1, 0]]",
     "As printed the probing signal grows as exp(ω_h t/2)."),
    ("compact error equation (dyn1)", "−c0 Φ wᵀ", "+c0 Φ wᵀ", "Put d̃ = z − α wᵀx̃ into the error equation."),
    ("bound before Case 2", "|(x + x̂) xᵀ/(|x| (|x| + |x̂|))| ≤ 1, used for |I − M|", "|I − M| ≤ 2",
     "M has norm at most 1, so I − M at most 2."),
    ("bounds with ℓ", "ℓ/|x̂|", "|ℓ|/|x̂|", "ℓ = ψ_m L0 is negative for most machines."),
    ("Section 4, first sentence", "“PE Assumption 2”", "Assumption 3", "Assumption 2 is boundedness."),
    ("gradient of the observer (newobs)", "(Φ + Λ)(y − …)", "−2 (Φ + Λ)(y − …)", "Derivative of a square, and of "
                                                                                 "−Φᵀx̂."),
    ("effect of α", "“increase in the signal-to-noise ratio”", "decrease", "A larger bandwidth lets more noise "
                                                                           "through."),
    ("caption of the 20 rpm figure", "“high constant speed (20 RPM)”", "low", ""),
)
"""(where, as printed, should be, why)."""
