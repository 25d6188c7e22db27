"""From a configuration to the settings of the parts that do the work."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ipmsm_can.config.model import USUAL_FREQUENCY, DriveConfig
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


SAMPLES_PER_PERIOD = 6
"""Of a probing signal with `frequency = "auto"`: an even number, so that dead time is odd in the samples, too."""
_CURRENT_SHARE = 0.65
"""Share of the limit of the high-frequency current that `amplitude = "auto"` drives through L_d; the rest is for
iron that saturates, and for noise in the measured current."""
_RAMP_S = 0.1
"""Time [s] in which the amplitude rises to its largest where no ramp is given."""
_HIGHEST = 4000.0
_EMF_SHARE = 0.19
"""Voltage error, as a share of `voltage_uncertainty`, that turns an angle found by rotation; on M1 and M2."""
_FLOOR = 4.0
"""Least amplitude in units of `voltage_uncertainty`: with less, dead time answers as much as the rotor does."""


def probing_frequency(config: DriveConfig, sample_rate: float) -> float:
    """Frequency of the probing signal [Hz] at this sample rate [Hz], 0 while not known: the given one, or for auto
    a sixth of it."""
    given = config.injection.frequency
    if isinstance(given, float):
        return given
    if not sample_rate or config.observer.kind.startswith("injection_"):
        return USUAL_FREQUENCY
    return min(float(round(sample_rate / SAMPLES_PER_PERIOD)), _HIGHEST)


def probing_amplitude(config: DriveConfig, sample_rate: float) -> float:
    """Largest amplitude of the probing signal [V peak]: the given one, or what L_d and the current limit leave."""
    given = config.injection.amplitude
    if isinstance(given, float):
        return given
    motor = config.build_motor()
    reactance = 2.0 * math.pi * probing_frequency(config, sample_rate) * min(motor.L_d, motor.L_q)
    return min(_CURRENT_SHARE * config.current_limit * reactance, config.injection.polarity_amplitude)


def estimator_settings(config: DriveConfig, sample_rate: float = 0.0) -> EstimatorSettings:
    """Settings of the estimator, derived defaults worked out; sample_rate [Hz], 0 while not known."""
    o = config.observer
    return EstimatorSettings(o.kind, config.alpha, config.gamma, o.initial_flux, config.epsilon,
                             o.excitation_window, o.speed_bandwidth, o.voltage_uncertainty, o.current_noise,
                             config.estimate.valid_sigma, probing_frequency(config, sample_rate),
                             o.resistance_uncertainty / 100.0, o.inductance_uncertainty / 100.0, o.adapt_voltage,
                             o.adapt_resistance, o.gamma == "scheduled",
                             o.voltage_delay if isinstance(o.voltage_delay, float) else None,
                             saturation_uncertainty=o.saturation_uncertainty / 100.0)


def injection_settings(config: DriveConfig, sample_rate: float = 0.0) -> InjectionSettings:
    """Settings of the injection scheduler, the current limit worked out; sample_rate [Hz], 0 while not known."""
    i, o = config.injection, config.observer
    on, off = i.speeds
    amplitude = probing_amplitude(config, sample_rate)
    target = math.radians(config.sigma_target)
    waveform = Waveform.ROTATING if i.waveform == "auto" else Waveform[i.waveform.upper()]
    emf_speed = _EMF_SHARE * o.voltage_uncertainty / (config.build_motor().psi_m * target) if target else 0.0
    return InjectionSettings(
        enabled=i.enabled, waveform=waveform, amplitude=amplitude,
        frequency=probing_frequency(config, sample_rate), speed_on=on, speed_off=off,
        excitation_on=i.excitation_on, excitation_off=i.excitation_off,
        ramp=amplitude / _RAMP_S if i.ramp is None else i.ramp, current_limit=config.current_limit,
        time_to_live=i.time_to_live, period=i.period, axis=None if i.axis is None else math.radians(i.axis),
        sigma_target=target, emf_speed=0.0 if i.by_speed else emf_speed,
        floor=min(_FLOOR * o.voltage_uncertainty, amplitude),
        along_d=i.waveform == "auto" and o.kind == "riccati" and i.axis is None)


def startup_settings(config: DriveConfig) -> StartUpSettings | None:
    """Settings of the start-up at standstill; None where it may not ask for pulses."""
    current = config.polarity_current
    if current is None:
        return None
    frequency = config.injection.frequency
    return StartUpSettings(frequency if isinstance(frequency, float) else USUAL_FREQUENCY, current,
                           config.injection.polarity_amplitude)


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
