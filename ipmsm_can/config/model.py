"""The configuration of one drive as frozen models: sections, keys, defaults and what must fit together.

`ipmsm_can.config.load` builds a `DriveConfig` from a TOML file and words the messages;
`ipmsm_can.config.explain` prints the same keys with their descriptions.  Plain numbers are SI unless a
key says otherwise; speeds and angles are electrical, voltages and currents of probing signals are peak.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator, model_validator

from ipmsm_can.config import units
from ipmsm_can.config.keys import Choice, FilePath, Quantity, QuantityOrWord, Switch
from ipmsm_can.config.section import KeyProblem, Section
from ipmsm_can.config.simulation import CLASSICAL_RATE, FD_RATE, SimulationConfig
from ipmsm_can.estimation.observers.kinds import WINDOW_CAPACITY
from ipmsm_can.motor import PRESETS, Motor

ObserverKind = Literal["ges", "riccati", "spmsm_gradient", "spmsm_gradient_max", "spmsm_regression",
                       "active_flux_regression", "chonam", "injection_extraction", "injection_demodulation"]
OBSERVER_KINDS: tuple[str, ...] = get_args(ObserverKind)
"""The observers a configuration may ask for; the one list of them."""

Waveform = Literal["auto", "rotating", "pulsating"]

ROTATING_CONVERGENCE = 70.0
"""Convergence rate gamma |Phi|^2 [1/s] of a fast-turning rotor that the default gamma gives."""

USUAL_FREQUENCY = 400.0
"""Frequency [Hz] that the polarity pulses start from where that of the probing signal is chosen by itself, and of
the probing signal itself while the sample rate is not known and for the kinds injection_*."""
ALPHA, RICCATI_ALPHA = 10.0, 100.0
"""Default bandwidth of the filters [1/s]: the paper's, and for riccati the inverse of a voltage error's correlation
time, as the filter has a covariance to hold what a narrow one would have to hold."""

CURRENT_LIMIT_SHARE = 0.15
"""Default limit of the high-frequency current as a share of the rated current."""

SPEED_ON, SPEED_OFF = 40.0, 60.0
"""Speeds [rad/s electrical] between which injection starts and stops, where speed decides and none is given."""

SIGMA_TARGET = 3.0
"""Default 1-sigma [deg electrical] that injection is to keep riccati below."""

_FROM_PRESET = "from the preset"
_MOTOR_NEEDS = ("pole_pairs", "psi_m", "L_d", "L_q", "R")


class MotorConfig(Section):
    """The motor: a preset, a preset with single values replaced, or pole_pairs, psi_m, L_d, L_q and R."""

    preset: Annotated[str | None, Choice(
        doc="Motor to start from: m1 and m2 are the simulation and the experiment motor of the paper.",
        choices=tuple(PRESETS), default="none", example="m2")] = None
    pole_pairs: Annotated[int | None, Quantity(
        doc="Number of pole pairs.", whole=True, least=1, most=100, default=_FROM_PRESET, example=3)] = None
    psi_m: Annotated[float | None, Quantity(
        doc="Flux linkage of the permanent magnets, peak, per phase.",
        unit=units.WEBER, least=1e-6, most=10, default=_FROM_PRESET, example="590 mWb")] = None
    L_d: Annotated[float | None, Quantity(
        doc="d-axis inductance.",
        unit=units.HENRY, least=1e-7, most=1, default=_FROM_PRESET, example="7.6 mH")] = None
    L_q: Annotated[float | None, Quantity(
        doc="q-axis inductance.",
        unit=units.HENRY, least=1e-7, most=1, default=_FROM_PRESET, example="12.9 mH")] = None
    R: Annotated[float | None, Quantity(
        doc="Stator resistance per phase, at working temperature.",
        unit=units.OHM, least=0, most=1000, default=_FROM_PRESET, example="1.059 ohm")] = None
    J: Annotated[float | None, Quantity(
        doc="Inertia at the shaft, for the simulated drive, and for how far a rotor may turn while "
            "samples are missing.", unit=units.INERTIA, above=0, most=1e6,
        default=f"{_FROM_PRESET}, or {Motor.__dataclass_fields__['J'].default}",
        example="100 kg cm^2")] = None
    rated_torque: Annotated[float | None, Quantity(
        doc="Rated torque; the default of injection.current_limit comes from it.",
        unit=units.NEWTON_METRE, above=0, most=1e6, default=_FROM_PRESET, example="6.2 N m")] = None

    @model_validator(mode="after")
    def _complete(self) -> MotorConfig:
        if self.preset is None:
            for name in _MOTOR_NEEDS:
                if getattr(self, name) is None:
                    presets = " or ".join(f'preset = "{preset}"' for preset in PRESETS)
                    raise KeyProblem(name, f"{self.keys()[name].allowed}, or take {presets}", missing=True)
        return self

    def build(self) -> Motor:
        """The motor's parameters."""
        given = self.model_dump(exclude={"preset"}, exclude_none=True)
        if self.preset is None:
            return Motor(**given)
        base = PRESETS[self.preset]
        values = {name: getattr(base, name) for name in Motor.__dataclass_fields__}
        return Motor(**{**values, **given, "name": f"{base.name} with changes" if given else base.name})


class WireConfig(Section):
    """What is on the bus."""

    node: Annotated[int, Quantity(
        doc="Number of the drive on the bus; it is added to every CAN identifier.",
        whole=True, least=0, most=15)] = 0
    dbc: Annotated[Path | None, FilePath(
        doc="DBC file with this project's messages in other scalings or identifiers.",
        default="the one that comes with the program", example="ipmsm_can.dbc")] = None
    sample_rate: Annotated[float | None, Quantity(
        doc="Samples per second, used until the drive sends DriveTiming, or if it never does.",
        unit=units.HERTZ, least=100, most=100e3, default="wait for DriveTiming", example="10 kHz")] = None
    max_gap: Annotated[int, Quantity(
        doc="Longest run of lost samples that is filled by interpolation; a longer one, or one of more than "
            "1.7 ms, restarts the filters.",
        unit=units.SAMPLES, whole=True, least=0, most=64)] = 8
    bitrate: Annotated[int, Quantity(
        doc="Nominal bit rate, for the bus load.",
        unit=units.BIT_RATE, whole=True, least=10_000, most=1_000_000)] = 1_000_000
    data_bitrate: Annotated[int, Quantity(
        doc="Bit rate of the data phase of CAN FD, for the bus load; not below bitrate.",
        unit=units.BIT_RATE, whole=True, least=10_000, most=8_000_000)] = 5_000_000

    @field_validator("dbc", mode="after")
    @classmethod
    def _beside_the_file(cls, path: Path | None, info: ValidationInfo) -> Path | None:
        if path is not None:
            path = Path((info.context or {}).get("folder", ".")) / path
            if not path.is_file():
                raise ValueError(cls.keys()["dbc"].allowed)
        return path

    @model_validator(mode="after")
    def _consistent(self) -> WireConfig:
        if self.data_bitrate < self.bitrate:
            raise KeyProblem("data_bitrate", f"wire.bitrate ({self.bitrate} bit/s) or more")
        return self


class ObserverConfig(Section):
    """The position observer and what it may assume about the samples."""

    kind: Annotated[ObserverKind, Choice(
        doc="Observer; ges is the one of the paper's Proposition 1, riccati its regression in a Kalman filter, "
            "the default unless a gamma is given, "
            "which has no gain to choose and knows its uncertainty. The spmsm kinds are for motors with "
            "L_d = L_q; "
            "the injection kinds need a salient motor that injects at injection.frequency, find the angle modulo "
            "half a turn, and never call it valid.", choices=OBSERVER_KINDS)] = "riccati"
    alpha: Annotated[float | None, Quantity(
        doc="Bandwidth of the regression's filters (the paper's alpha). In the spmsm_gradient and injection kinds "
            "the angle does not depend on it.",
        unit=units.PER_SECOND, least=1e-3, most=1e5,
        default=f"{ALPHA:g} 1/s; {RICCATI_ALPHA:g} 1/s for riccati", example=10)] = None
    gamma: Annotated[float | Literal["scheduled"] | None, QuantityOrWord(
        doc="Observer gain (the paper's gamma). Above the rate of turning, more gain converges more slowly; "
            "scheduled, for ges, follows the speed: 2 |omega| / |Phi|^2. "
            "The spmsm_gradient kinds count it in 1/(Wb^2 s); riccati and the injection kinds have none.",
        word="scheduled", unit=units.GRADIENT_GAIN, above=0,
        default=f"{ROTATING_CONVERGENCE:g} 1/s / (2 alpha psi_m)^2, which converges at "
                f"gamma |Phi|^2 = {ROTATING_CONVERGENCE:g} 1/s at high speed; "
                f"{0.5 * ROTATING_CONVERGENCE:g} 1/s / psi_m^2 for the spmsm_gradient kinds", example=0.5)] = None
    initial_flux: Annotated[tuple[float, float], Quantity(
        doc="Stator flux linkage (alpha, beta) the observer starts from; with the default it starts from no "
            "assumed angle.", unit=units.WEBER, count=2)] = (0.0, 0.0)
    epsilon: Annotated[float | None, Quantity(
        doc="Active flux below which its direction sigma(x) counts as unknown and is 0; less than psi_m.",
        unit=units.WEBER, above=0, default="psi_m / 10", example="59 mWb")] = None
    excitation_window: Annotated[float, Quantity(
        doc="Length of the window over which excitation, the smallest eigenvalue of the integral of "
            "Phi Phi^T, is judged.", unit=units.SECOND, above=0, most=10)] = 0.1
    speed_bandwidth: Annotated[float, Quantity(
        doc="Natural frequency of the phase-locked loop that gives the speed; where a drive controls its speed "
            "with it, several times the drive's bandwidth.",
        unit=units.HERTZ, above=0, most=1000)] = 100.0
    voltage_uncertainty: Annotated[float, Quantity(
        doc="What the reported mean voltage may be wrong by (dead time, offsets); widens the reported sigma.",
        unit=units.VOLT, least=0)] = 0.5
    current_noise: Annotated[float, Quantity(
        doc="Noise of the sampled currents, per axis.", unit=units.AMPERE_RMS, above=0)] = 0.02
    resistance_uncertainty: Annotated[float, Quantity(
        doc="1-sigma of motor.R, as a share of it; for riccati.", unit=units.PERCENT, least=0, most=100)] = 12.0
    inductance_uncertainty: Annotated[float, Quantity(
        doc="1-sigma of motor.L_d and motor.L_q, as a share of them; for riccati.",
        unit=units.PERCENT, least=0, most=100)] = 6.0
    saturation_uncertainty: Annotated[float, Quantity(
        doc="By how much L_d may fall at rated current, 1-sigma as a share of it, for riccati and the start-up: "
            "under load that turns the axis that probing sees. 0 for a machine known not to saturate.",
        unit=units.PERCENT, least=0, most=50)] = 20.0
    adapt_voltage: Annotated[bool, Switch(
        doc="Whether riccati estimates dead time and a lasting offset of the voltage beside the flux, as far as "
            "the samples tell; else they count as noise.")] = True
    adapt_resistance: Annotated[bool, Switch(
        doc="Whether riccati estimates the error of motor.R as well.")] = True
    voltage_delay: Annotated[float | Literal["auto"], QuantityOrWord(
        doc="How late the reported voltage is against the current; 0: as said in docs/wire.md. auto takes it for 0 "
            "until the probing signal shows another one.", unit=units.SAMPLES, least=-2, most=2,
        word="auto")] = "auto"


    @model_validator(mode="before")
    @classmethod
    def _a_gain_means_a_gradient(cls, value: Any) -> Any:
        # A file with the paper's gains and no kind means the paper's observer.
        if isinstance(value, dict) and "kind" not in value and "gamma" in value:
            return {**value, "kind": "ges"}
        return value


class EstimateConfig(Section):
    """What the companion reports, and how often; never more often than samples come in."""

    rate: Annotated[float, Quantity(
        doc="PositionEstimate messages per second.", unit=units.HERTZ, least=1, most=20e3)] = 1000.0
    flux_rate: Annotated[float, Quantity(
        doc="ActiveFluxEstimate messages per second.", unit=units.HERTZ, least=1, most=20e3)] = 50.0
    status_rate: Annotated[float, Quantity(
        doc="CompanionStatus messages per second.", unit=units.HERTZ, least=1, most=1e3)] = 10.0
    valid_sigma: Annotated[float, Quantity(
        doc="An angle whose 1-sigma uncertainty is larger is never called valid (electrical). An error "
            "of two of them is rare, of three very rare: 5 deg stands for 15 deg at most.",
        unit=units.DEGREE, above=0, most=90)] = 7.5


class InjectionConfig(Section):
    """The probing signal: when, how strong, which waveform. Nothing is sent without --transmit."""

    enabled: Annotated[bool, Switch(doc="Whether injection commands may be sent at all.")] = True
    waveform: Annotated[Waveform, Choice(
        doc="rotating in the stationary frame, pulsating along the estimated d-axis, where it makes least torque, "
            "or auto: rotating, and pulsating while the angle of riccati is valid.",
        choices=get_args(Waveform))] = "auto"
    amplitude: Annotated[float | Literal["auto"], QuantityOrWord(
        doc="Largest amplitude of the injected voltage; sigma_target may ask for less. auto: two thirds of what "
            "drives current_limit through L_d at that frequency, at most polarity_amplitude.",
        word="auto", unit=units.VOLT_PEAK, above=0, most=1000)] = "auto"
    frequency: Annotated[float | Literal["auto"], QuantityOrWord(
        doc="Frequency of the injected voltage; less than half of wire.sample_rate. auto: a sixth of the sample "
            "rate, at most 4 kHz; 400 Hz for the observers of kind injection_.",
        word="auto", unit=units.HERTZ, least=1, most=20e3)] = "auto"
    sigma_target: Annotated[float | None, Quantity(
        doc="1-sigma that injection is to keep the angle of riccati below, with the least amplitude (electrical); "
            "0: always the full amplitude. Where it cannot be kept the amplitude is the full one.",
        unit=units.DEGREE, least=0, most=45,
        default=f"{SIGMA_TARGET:g} deg for riccati; 0 for the other kinds, and where speed_on, speed_off or "
                "excitation_on is given", example="3 deg")] = None
    speed_on: Annotated[float | None, Quantity(
        doc="Injection starts below this speed. Hz is the electrical frequency, rpm the shaft's speed.",
        unit=units.SPEED, least=0,
        default=f"what sigma_target needs; {SPEED_ON:g} rad/s or two thirds of speed_off without one",
        example=SPEED_ON)] = None
    speed_off: Annotated[float | None, Quantity(
        doc="Injection stops above this speed; above speed_on. Hz and rpm as there.",
        unit=units.SPEED, above=0,
        default=f"what sigma_target needs; {SPEED_OFF:g} rad/s or one and a half of speed_on without one",
        example=SPEED_OFF)] = None
    excitation_on: Annotated[float, Quantity(
        doc="Injection also starts when excitation falls below this, whatever the speed; 0 = judge by speed "
            "only. A turning rotor gives 2 (alpha psi_m)^2 excitation_window at high speed.",
        unit=units.EXCITATION, least=0)] = 0.0
    excitation_off: Annotated[float, Quantity(
        doc="Excitation above which the former reason to inject ends; above excitation_on, or both 0.",
        unit=units.EXCITATION, least=0)] = 0.0
    ramp: Annotated[float | None, Quantity(
        doc="Rate at which the amplitude rises and falls.", unit=units.VOLT_PER_SECOND, above=0,
        default="the largest amplitude in 0.1 s", example="60 V/s")] = None
    current_limit: Annotated[float | None, Quantity(
        doc="Limit of the high-frequency current; the amplitude is reduced to stay below it.",
        unit=units.AMPERE_PEAK, above=0,
        default=f"{100 * CURRENT_LIMIT_SHARE:g} % of the current that gives motor.rated_torque",
        example="350 mA")] = None
    time_to_live: Annotated[float, Quantity(
        doc="A drive stops injecting when the last command is older than this.",
        unit=units.SECOND, above=0, most=0.5)] = 0.1
    period: Annotated[float, Quantity(
        doc="Time between repeated commands; below half of time_to_live, so that one may get lost.",
        unit=units.SECOND, above=0)] = 0.02
    axis: Annotated[float | None, Quantity(
        doc="Fixed axis of the waveform in the stationary frame (electrical): pulsating at 0 probes v_alpha only; "
            "rotating starts there, and its phase then does not follow the rotor.",
        unit=units.DEGREE, least=-180, most=180, default="along the estimated d-axis", example="0 deg")] = None

    polarity: Annotated[bool, Switch(
        doc="Whether the drive may be asked for polarity pulses at standstill, which tell the magnet's north from "
            "its south where the iron saturates.")] = True
    polarity_current: Annotated[float | None, Quantity(
        doc="Largest current of the polarity pulses.", unit=units.AMPERE_PEAK, above=0,
        default="the current that gives motor.rated_torque; where that is not given, there are no pulses",
        example="2.3 A")] = None
    polarity_amplitude: Annotated[float, Quantity(
        doc="Largest voltage of the polarity pulses.", unit=units.VOLT_PEAK, above=0, most=1000)] = 30.0

    @model_validator(mode="after")
    def _consistent(self) -> InjectionConfig:
        if self.speed_on is not None and self.speed_off is not None and self.speed_off <= self.speed_on:
            raise KeyProblem(
                "speed_off", f"a speed above injection.speed_on, {self.speed_on:g} rad/s electrical")
        if self.excitation_off <= self.excitation_on and (self.excitation_on, self.excitation_off) != (0, 0):
            raise KeyProblem(
                "excitation_off",
                f"a value above injection.excitation_on, {self.excitation_on:g} V^2 s, or 0 for both")
        if self.period >= self.time_to_live / 2:
            raise KeyProblem(
                "period", f"a time below half of injection.time_to_live, {self.time_to_live:g} s")
        return self

    @property
    def speeds(self) -> tuple[float, float]:
        """Speeds [rad/s electrical] below which injection starts and above which it stops, where speed decides."""
        on, off = self.speed_on, self.speed_off
        if on is None:
            on = SPEED_ON if off is None else min(SPEED_ON, off / 1.5)
        return on, max(SPEED_OFF, 1.5 * on) if off is None else off

    @property
    def by_speed(self) -> bool:
        """Whether a key says by speed or excitation when to inject."""
        return self.speed_on is not None or self.speed_off is not None or self.excitation_on > 0.0


class DriveConfig(BaseModel):
    """The configuration of one drive; [motor] is required, every other section has its defaults.

    Raises pydantic.ValidationError (a ValueError) when built directly; `load_config` turns it into one
    sentence.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    motor: MotorConfig
    wire: WireConfig = WireConfig()
    observer: ObserverConfig = ObserverConfig()
    estimate: EstimateConfig = EstimateConfig()
    injection: InjectionConfig = InjectionConfig()
    simulation: SimulationConfig = SimulationConfig()

    @classmethod
    def sections(cls) -> dict[str, type[Section]]:
        """The sections in the order of the file."""
        fields: Iterable[tuple[str, Any]] = cls.model_fields.items()
        return {name: field.annotation for name, field in fields}

    @field_validator("injection", "simulation", mode="before")
    @classmethod
    def _shaft_speeds(cls, value: Any, info: ValidationInfo) -> Any:
        # rpm counts turns of the shaft: only here are the pole pairs known.  Without a valid motor the
        # values are left out, so that the message is about the motor alone.
        if not isinstance(value, dict):
            return value
        motor = info.data.get("motor")
        result = dict(value)
        for name, key in cls.sections()[info.field_name or ""].keys().items():
            if isinstance(key, Quantity) and key.unit.is_shaft(value.get(name)):
                if isinstance(motor, MotorConfig):
                    try:
                        result[name] = key.read(value[name], motor.build().pole_pairs)
                    except ValueError as problem:
                        raise KeyProblem(name, str(problem)) from None
                else:
                    del result[name]
        return result

    @model_validator(mode="after")
    def _consistent(self) -> DriveConfig:
        psi_m = self.motor.build().psi_m
        if self.epsilon >= psi_m:
            raise KeyProblem("observer.epsilon", f"a flux below the motor's psi_m, {psi_m:g} Wb")
        if self.observer.gamma == "scheduled" and self.observer.kind != "ges":
            raise KeyProblem("observer.gamma", f"a number for observer.kind {self.observer.kind}; only ges has a "
                                               "schedule")
        rate, frequency = self.wire.sample_rate, self.injection.frequency
        if frequency == "auto":
            if not self.observer.kind.startswith("injection_"):
                return self._limited()
            frequency = USUAL_FREQUENCY
        if rate is not None and self.observer.kind.startswith("injection_"):
            # A window of whole periods, of samples that are faster than two a period.
            low = rate / WINDOW_CAPACITY if self.observer.kind == "injection_extraction" else 0.0
            if not low <= frequency < rate / 2:
                raise KeyProblem(
                    "injection.frequency", f"a frequency from {low:g} Hz to below half of the sample rate of "
                    f"{rate:g} Hz, for observer.kind {self.observer.kind}")
        if rate is not None and self.injection.enabled and frequency >= rate / 2:
            raise KeyProblem(
                "injection.frequency", f"a frequency below half of wire.sample_rate, {rate:g} Hz")
        return self._limited()

    def _limited(self) -> DriveConfig:
        if (self.injection.enabled and self.injection.current_limit is None
                and self.motor.preset is None and self.motor.rated_torque is None):
            # Motor's own default torque belongs to the paper's machines: no basis for a limit elsewhere.
            raise KeyProblem(
                "injection.current_limit",
                f"{InjectionConfig.keys()['current_limit'].allowed}, or motor.rated_torque to derive it "
                "from, or injection.enabled = false", missing=True)
        return self

    def simulation_rate(self, fd: bool = False) -> float:
        """Sample rate [Hz] of the simulated drive; fd: CAN FD was asked for from outside."""
        given = self.simulation.sample_rate or self.wire.sample_rate
        return given or (FD_RATE if fd or self.simulation.fd else CLASSICAL_RATE)

    def build_motor(self) -> Motor:
        """The motor's parameters."""
        return self.motor.build()

    @property
    def alpha(self) -> float:
        """Bandwidth of the regression's filters [1/s]: the given one, or 10, for riccati 100."""
        given = self.observer.alpha
        return given if given is not None else RICCATI_ALPHA if self.observer.kind == "riccati" else ALPHA

    @property
    def gamma(self) -> float:
        """Observer gain: the given one, or 70 1/s over (2 alpha psi_m)^2 [1/(V^2 s)], also where it is scheduled.

        For the gradients on the flux's length, which converge at 2 gamma psi_m^2, 35 1/s over psi_m^2 [1/(Wb^2 s)].
        """
        if isinstance(self.observer.gamma, float):
            return self.observer.gamma
        if self.observer.kind.startswith("spmsm_gradient"):
            return float(0.5 * ROTATING_CONVERGENCE / self.motor.build().psi_m ** 2)
        return float(ROTATING_CONVERGENCE / (2.0 * self.alpha * self.motor.build().psi_m) ** 2)

    @property
    def epsilon(self) -> float:
        """Active flux [Wb] below which sigma(x) is 0: the given one, or psi_m / 10."""
        given = self.observer.epsilon
        return given if given is not None else self.motor.build().psi_m / 10.0

    @property
    def sigma_target(self) -> float:
        """1-sigma [deg electrical] that injection is to keep the angle below; 0: none."""
        given = self.injection.sigma_target
        if self.observer.kind != "riccati":  # only its sigma tells what injection does for the angle
            return 0.0
        if given is not None:
            return given
        return 0.0 if self.injection.by_speed else SIGMA_TARGET

    @property
    def polarity_current(self) -> float | None:
        """Largest current of the polarity pulses [A peak]; None: no pulses."""
        i = self.injection
        if not (i.enabled and i.polarity):
            return None
        if i.polarity_current is None and self.motor.preset is None and self.motor.rated_torque is None:
            return None  # Motor's own default torque is no basis for a current elsewhere
        return i.polarity_current if i.polarity_current is not None else self.motor.build().rated_current

    @property
    def current_limit(self) -> float:
        """Limit of the high-frequency current [A peak]: the given one, or 15 % of the rated current."""
        given = self.injection.current_limit
        return given if given is not None else CURRENT_LIMIT_SHARE * self.motor.build().rated_current
