"""From a configuration to the settings of the parts that do the work."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ipmsm_can.config.model import DriveConfig
from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.estimation.estimator import EstimatorSettings
from ipmsm_can.injection.scheduler import InjectionSettings
from ipmsm_can.startup import StartUpSettings
from ipmsm_can.wire.dbc import Database
from ipmsm_can.wire.protocol import Protocol, Waveform


def build_protocol(configs: Sequence[DriveConfig]) -> Protocol:
    """The messages as wire.dbc describes them; the project's own where none is given.

    Raises ValueError when the drives of one bus name different files, or the file does not fit.
    """
    files = sorted({str(c.wire.dbc or "") for c in configs})
    if len(files) > 1:
        named = " and ".join(name or "none" for name in files)
        raise ValueError(f"wire.dbc is {named}; allowed is the same file for all drives on a bus")
    return Protocol(Database.load(files[0]) if files and files[0] else None)


def estimator_settings(config: DriveConfig) -> EstimatorSettings:
    """Settings of the estimator, derived defaults (gamma, epsilon) worked out."""
    o = config.observer
    return EstimatorSettings(o.kind, config.alpha, config.gamma, o.initial_flux, config.epsilon,
                             o.excitation_window, o.speed_bandwidth, o.voltage_uncertainty, o.current_noise,
                             config.estimate.valid_sigma, config.injection.frequency,
                             o.resistance_uncertainty / 100.0, o.inductance_uncertainty / 100.0, o.adapt_voltage,
                             o.adapt_resistance, o.gamma == "scheduled",
                             o.voltage_delay if isinstance(o.voltage_delay, float) else None,
                             saturation_uncertainty=o.saturation_uncertainty / 100.0)


def injection_settings(config: DriveConfig) -> InjectionSettings:
    """Settings of the injection scheduler, the current limit worked out."""
    i = config.injection
    return InjectionSettings(i.enabled, Waveform[i.waveform.upper()], i.amplitude, i.frequency, i.speed_on,
                             i.speed_off, i.excitation_on, i.excitation_off, i.ramp, config.current_limit,
                             i.time_to_live, i.period,
                             None if i.axis is None else math.radians(i.axis))


def startup_settings(config: DriveConfig) -> StartUpSettings | None:
    """Settings of the start-up at standstill; None where it may not ask for pulses."""
    current = config.polarity_current
    if current is None:
        return None
    return StartUpSettings(config.injection.frequency, current, config.injection.polarity_amplitude)


def drive_parameters(config: DriveConfig, fd: bool = False) -> DriveParameters:
    """Settings of the simulated drive; fd: CAN FD was asked for, whatever simulation.fd says.

    Raises ValueError naming the key where the sample rate of [wire] does not go with the bandwidths.
    """
    given = config.simulation.model_dump(include=set(DriveParameters.__dataclass_fields__))
    try:
        return DriveParameters(**{**given, "sample_rate": config.simulation_rate(fd)})
    except ValueError as error:  # a sample rate from [wire] may not go with the rest
        raise ValueError(f"simulation.{error}") from None


def drive_node_settings(config: DriveConfig, fd: bool = False) -> DriveNodeSettings:
    """What the simulated drive sends; fd as for `drive_parameters`."""
    s = config.simulation
    return DriveNodeSettings(s.fd or fd, s.timing_rate, s.status_rate, s.reference_rate, s.encoder_counts)
