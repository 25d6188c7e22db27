"""[simulation]: the simulated drive.  Defaults come from the drive's own settings."""

from __future__ import annotations

from typing import Annotated

from pydantic import model_validator

from ipmsm_can.config import units
from ipmsm_can.config.keys import Choice, Quantity, Switch
from ipmsm_can.config.section import KeyProblem, Section
from ipmsm_can.drive.parameters import (
    ANGLE_SOURCES,
    FINEST_CURRENT_LOOP,
    LATEST_VOLTAGE,
    AngleSource,
    DriveNodeSettings,
    DriveParameters,
)

CLASSICAL_RATE, FD_RATE = 5000.0, 10_000.0
"""Default sample rates [Hz] of the simulated drive: what a 1 Mbit/s bus carries as single samples, and more."""


class SimulationConfig(Section):
    """The simulated drive, for ipmsm-can drive and demo; a companion on a real drive needs none of it."""

    sample_rate: Annotated[float | None, Quantity(
        doc="Control periods and samples per second.", unit=units.HERTZ, least=100, most=100e3,
        default=f"wire.sample_rate, or {CLASSICAL_RATE:g} Hz, or {FD_RATE:g} Hz with CAN FD",
        example="5 kHz")] = None
    substeps: Annotated[int, Quantity(
        doc="Integration steps in a control period.", whole=True, least=1, most=1000)] = DriveParameters.substeps
    v_dc: Annotated[float, Quantity(
        doc="Dc-link voltage; the inverter gives up to v_dc / sqrt(3) V peak.",
        unit=units.VOLT, above=0, most=10e3)] = DriveParameters.v_dc
    current_bandwidth: Annotated[float, Quantity(
        doc=f"Bandwidth of the current control, at most sample_rate / {FINEST_CURRENT_LOOP:g}.",
        unit=units.HERTZ, least=1e-3)] = DriveParameters.current_bandwidth
    speed_bandwidth: Annotated[float, Quantity(
        doc="Bandwidth of the speed control, at most current_bandwidth / 4.",
        unit=units.HERTZ, least=1e-3)] = DriveParameters.speed_bandwidth
    torque_limit: Annotated[float | None, Quantity(
        doc="Largest torque the speed control asks for.", unit=units.NEWTON_METRE, above=0,
        default="1.5 times motor.rated_torque", example="9.3 N m")] = DriveParameters.torque_limit
    i_max: Annotated[float | None, Quantity(
        doc="Largest current the control asks for.", unit=units.AMPERE_PEAK, above=0,
        default="twice the current that gives motor.rated_torque", example="4.6 A")] = DriveParameters.i_max
    mtpa: Annotated[bool, Switch(
        doc="Maximum torque per ampere instead of i_d = 0.")] = DriveParameters.mtpa
    dead_time_voltage: Annotated[float, Quantity(
        doc="Voltage that dead time takes from each phase, against its current; the samples do not show it.",
        unit=units.VOLT, least=0)] = DriveParameters.dead_time_voltage
    dead_time_zone: Annotated[float, Quantity(
        doc="Current below which that voltage fades out.", unit=units.AMPERE_PEAK,
        above=0)] = DriveParameters.dead_time_zone
    current_noise: Annotated[float, Quantity(
        doc="Noise of the current sensors, per axis.", unit=units.AMPERE_RMS,
        least=0)] = DriveParameters.current_noise
    current_offset: Annotated[tuple[float, float], Quantity(
        doc="Offset of the current sensors (alpha, beta).", unit=units.AMPERE,
        count=2)] = DriveParameters.current_offset
    current_gain: Annotated[tuple[float, float, float], Quantity(
        doc="Gain of the current sensors of the phases (a, b, c), which the control suffers from, too; 1 where "
            "they are right.", above=0, most=10, count=3)] = DriveParameters.current_gain
    adc_step: Annotated[float, Quantity(
        doc="Resolution of the current samples; 0 = no steps.", unit=units.AMPERE,
        least=0)] = DriveParameters.adc_step
    voltage_delay: Annotated[float, Quantity(
        doc="How late the reported voltage is; 0 as the wire wants it, 1 the one of the period before, -1 the one "
            "that has just begun.", unit=units.SAMPLES, least=-1,
        most=LATEST_VOLTAGE)] = DriveParameters.voltage_delay
    sampling_lead: Annotated[float, Quantity(
        doc="How long before the voltage's step the current is sampled, below 1; 0.5: in the middle of a period.",
        unit=units.SAMPLES, least=0, most=0.99)] = DriveParameters.sampling_lead
    friction: Annotated[float, Quantity(
        doc="Viscous friction at the shaft.", unit=units.FRICTION, least=0)] = DriveParameters.friction
    saturation: Annotated[float, Quantity(
        doc="Share by which L_d falls when rated current flows along the positive d-axis; 0 = linear magnetics, "
            "with which nothing can tell north from south at standstill.",
        least=0, most=0.5)] = DriveParameters.saturation
    speed_imposed: Annotated[bool, Switch(
        doc="A load machine makes the shaft follow the profile's speed; the profile's load torque is then the "
            "drive's torque reference.")] = DriveParameters.speed_imposed
    rotor_locked: Annotated[bool, Switch(
        doc="The rotor stays where it starts; torque as with speed_imposed.")] = DriveParameters.rotor_locked
    brake: Annotated[bool, Switch(
        doc="A brake holds the shaft until the drive has an angle to control with, with angle_source = "
            "\"companion\".")] = DriveParameters.brake
    injection_limit: Annotated[float, Quantity(
        doc="Largest probing amplitude the drive makes, whatever it is asked for.", unit=units.VOLT_PEAK,
        least=0)] = DriveParameters.injection_limit
    injection_ramp: Annotated[float, Quantity(
        doc="Fastest change of the probing amplitude.", unit=units.VOLT_PER_SECOND,
        above=0)] = DriveParameters.injection_ramp
    angle_source: Annotated[AngleSource, Choice(
        doc="What the control takes its angle from; encoder_then_companion swaps when the encoder fails. Without "
            "an angle that may be used the drive stops and stays stopped.",
        choices=ANGLE_SOURCES)] = DriveParameters.angle_source
    encoder_fails_at: Annotated[float | None, Quantity(
        doc="Time from which the encoder says nothing any more.", unit=units.SECOND, least=0, default="never",
        example="2 s")] = DriveParameters.encoder_fails_at
    estimate_time_to_live: Annotated[float, Quantity(
        doc="The companion's angle is used no longer than this after the sample it belongs to; 1 to 1023 samples.",
        unit=units.SECOND, above=0, most=10)] = DriveParameters.estimate_time_to_live
    angle_sigma_limit: Annotated[float, Quantity(
        doc="The companion's angle is used only while its 1-sigma is no larger than this (electrical).",
        unit=units.DEGREE, above=0, most=90)] = DriveParameters.angle_sigma_limit
    open_loop_current: Annotated[float, Quantity(
        doc="Current vector that turns the rotor until the companion knows the angle, with angle_source = "
            "\"companion\"; 0 = wait, with the current held at zero.",
        unit=units.AMPERE_PEAK, least=0)] = DriveParameters.open_loop_current
    open_loop_speed: Annotated[float, Quantity(
        doc="Speed of that vector, electrical.", unit=units.SPEED, above=0)] = DriveParameters.open_loop_speed
    open_loop_ramp: Annotated[float, Quantity(
        doc="Time it takes to reach that speed.", unit=units.SECOND, above=0)] = DriveParameters.open_loop_ramp
    fd: Annotated[bool, Switch(
        doc="Send the samples in CAN FD blocks of seven; --fd does the same.")] = DriveNodeSettings.fd
    timing_rate: Annotated[float, Quantity(
        doc="DriveTiming messages per second; 0 = none, and the companion then needs wire.sample_rate.",
        unit=units.HERTZ, least=0, most=1e3)] = DriveNodeSettings.timing_rate
    status_rate: Annotated[float, Quantity(
        doc="DriveStatus messages per second; 0 = none.",
        unit=units.HERTZ, least=0, most=1e3)] = DriveNodeSettings.status_rate
    reference_rate: Annotated[float, Quantity(
        doc="DriveReference messages (angle and speed of an encoder) per second; 0 = the drive has none.",
        unit=units.HERTZ, least=0, most=20e3)] = DriveNodeSettings.reference_rate
    encoder_counts: Annotated[int, Quantity(
        doc="Angles the encoder tells apart in one turn of the shaft; 0 = as fine as the message.",
        whole=True, least=0, most=1e9)] = DriveNodeSettings.encoder_counts

    @model_validator(mode="after")
    def _consistent(self) -> SimulationConfig:
        if self.speed_bandwidth > self.current_bandwidth / 4.0:
            raise KeyProblem("speed_bandwidth", "a frequency of at most a quarter of "
                                                f"simulation.current_bandwidth, {self.current_bandwidth:g} Hz")
        if self.sample_rate is not None and self.current_bandwidth > self.sample_rate / FINEST_CURRENT_LOOP:
            raise KeyProblem("current_bandwidth", f"a frequency of at most simulation.sample_rate / "
                                                  f"{FINEST_CURRENT_LOOP:g}, that is "
                                                  f"{self.sample_rate / FINEST_CURRENT_LOOP:g} Hz")
        if self.speed_imposed and self.rotor_locked:
            raise KeyProblem("rotor_locked", "false, as simulation.speed_imposed is true")
        return self
