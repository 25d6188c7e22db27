"""A companion process for IPMSM drives on CAN: rotor position from sampled currents and voltages.

For scripts and notebooks:

    from ipmsm_can import M2, estimate
    result = estimate(i, v, sample_rate=5000.0, motor=M2)
    result.theta, result.omega, result.sigma_theta, result.excitation

What is imported is loaded at first use, so that `import ipmsm_can` and `ipmsm-can --help` cost nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from ipmsm_can.api import Estimate, estimate
    from ipmsm_can.motor import M1, M2, Motor

__all__ = ["M1", "M2", "Estimate", "Motor", "__version__", "estimate"]

_HOME = {"Estimate": "api", "estimate": "api", "M1": "motor", "M2": "motor", "Motor": "motor"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        from importlib import import_module

        return getattr(import_module(f"ipmsm_can.{_HOME[name]}"), name)
    raise AttributeError(f"module 'ipmsm_can' has no attribute {name!r}")
