"""Motor parameters from a measurement: with an encoder, or from currents and voltages alone."""

from ipmsm_can.identification.fitting import identify
from ipmsm_can.identification.result import Identification, Parameter

__all__ = ["Identification", "Parameter", "identify"]
