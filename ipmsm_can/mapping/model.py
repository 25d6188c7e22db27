"""The map of an inverter as frozen models: which signals of its DBC are the currents, the voltages, the angle.

`ipmsm_can.mapping.load` builds an `InverterMap` from a TOML file and words the messages.  Inside the package
everything is peak, per phase, amplitude-invariant, electrical; a map says what the bus has instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator, model_validator

from ipmsm_can.config import units
from ipmsm_can.config.keys import Choice, FilePath, Key, Quantity, Switch
from ipmsm_can.config.section import KeyProblem, Section
from ipmsm_can.mapping.signals import SignalKey, SignalRef, given

PHASE_ORDERS = ("abc", "acb", "bac", "bca", "cab", "cba")
TURN_UNITS = ("deg", "rad", "turns")
SPEED_UNITS = ("rad/s electrical", "Hz electrical", "rpm electrical", "rad/s shaft", "turns/s shaft", "rpm shaft")
LINES = ("ab", "bc", "ca")


class Words(Key):
    """A line of text."""

    @property
    def allowed(self) -> str:
        return "a line of text"

    def read(self, value: Any, pole_pairs: int | None = None) -> str:
        if not isinstance(value, str) or not value.strip() or "\n" in value:
            raise ValueError(self.allowed)
        return value


class General(Section):
    """What is mapped, and where its signals are described."""

    title: Annotated[str, Words(doc="What the map is for.", example="Somebody's inverter")]
    dbc: Annotated[Path, FilePath(doc="DBC file with the messages.", example="inverter.dbc")]
    strict: Annotated[bool, Switch(
        doc="Whether signals of the DBC that overlap are an error.")] = True
    node: Annotated[int, Quantity(
        doc="Number of the drive; shifted to the left by node_shift it is added to every identifier.",
        whole=True, least=0, most=0x1FFFFFFF)] = 0
    node_shift: Annotated[int, Quantity(
        doc="Bits by which the node number is shifted in the identifier.", whole=True, least=0, most=28)] = 0
    identifiers: Annotated[str, Choice(
        doc="Whether frames count with the length of identifier that the DBC gives (11 or 29 bit), or with either.",
        choices=("as in the DBC", "either length"))] = "as in the DBC"
    pole_pairs: Annotated[int | None, Quantity(
        doc="Pole pairs of the motor, where angles or speeds are those of the shaft and nothing else tells.",
        whole=True, least=1, most=100, default="from the drive.toml", example=4)] = None

    @field_validator("dbc", mode="after")
    @classmethod
    def _beside_the_file(cls, path: Path, info: ValidationInfo) -> Path:
        path = Path((info.context or {}).get("folder", ".")) / path
        if not path.is_file():
            raise ValueError(cls.keys()["dbc"].allowed)
        return path


_MEASURE = Choice(doc="What the numbers are: peak (instantaneous values of phases count as such), or rms.",
                  choices=("peak", "rms"), example="peak")
_TRANSFORM = Choice(doc="Transformation behind alpha_beta and dq: amplitude (2/3) or power invariant (sqrt(2/3)).",
                    choices=("amplitude", "power"))
_ORDER = Choice(doc="Which phase of the motor each of a, b, c is.", choices=PHASE_ORDERS)


class CurrentMap(Section):
    """Stator currents: two or three phases, alpha and beta, or d and q with [angle]."""

    form: Annotated[str, Choice(doc="What is on the bus.", choices=("phase", "alpha_beta", "dq"),
                                example="phase")]
    measure: Annotated[str, _MEASURE]
    transform: Annotated[str, _TRANSFORM] = "amplitude"
    order: Annotated[str, _ORDER] = "abc"
    a: Annotated[SignalRef | None, SignalKey(doc="Current of phase a.")] = None
    b: Annotated[SignalRef | None, SignalKey(doc="Current of phase b.")] = None
    c: Annotated[SignalRef | None, SignalKey(doc="Current of phase c.")] = None
    alpha: Annotated[SignalRef | None, SignalKey(doc="Current, alpha axis.")] = None
    beta: Annotated[SignalRef | None, SignalKey(doc="Current, beta axis.")] = None
    d: Annotated[SignalRef | None, SignalKey(doc="Current, d axis.")] = None
    q: Annotated[SignalRef | None, SignalKey(doc="Current, q axis.")] = None

    @property
    def components(self) -> list[SignalRef | None]:
        """The signals of the form in their order, filled up to three."""
        return _components(self, {"phase": ("a", "b", "c"), "alpha_beta": ("alpha", "beta"), "dq": ("d", "q")})

    @model_validator(mode="after")
    def _fits(self) -> CurrentMap:
        _check_components(self, {"phase": ("a", "b", "c"), "alpha_beta": ("alpha", "beta"), "dq": ("d", "q")}, {})
        return self


_VOLTAGE_FORMS = {"phase": ("a", "b", "c"), "line_line": LINES, "alpha_beta": ("alpha", "beta"),
                  "dq": ("d", "q"), "duty": ("a", "b", "c")}


class VoltageMap(Section):
    """Stator voltages: phases, lines, alpha and beta, d and q with [angle], or duty cycles with [dc_voltage]."""

    form: Annotated[str, Choice(doc="What is on the bus.", choices=tuple(_VOLTAGE_FORMS), example="alpha_beta")]
    measure: Annotated[str, _MEASURE]
    per: Annotated[str, Choice(
        doc="Whether the numbers are those of a phase against neutral or of one line against another; for duty "
            "cycles, phase.", choices=("phase", "line"), example="phase")]
    transform: Annotated[str, _TRANSFORM] = "amplitude"
    order: Annotated[str, _ORDER] = "abc"
    delay: Annotated[float, Quantity(
        doc="How many samples late the voltage is: 0 where it is the mean of the interval that ended at the "
            "sample, 1 where it is that of the interval before; -1 where it is the one that begins there.",
        unit=units.SAMPLES, least=-2, most=2)] = 0.0
    mean: Annotated[bool, Switch(
        doc="Whether it is the mean of a whole interval between two samples, as the fast observer needs it; false "
            "where it is a momentary value.")] = True
    a: Annotated[SignalRef | None, SignalKey(doc="Voltage or duty cycle (0 to 1) of phase a.")] = None
    b: Annotated[SignalRef | None, SignalKey(doc="The same of phase b.")] = None
    c: Annotated[SignalRef | None, SignalKey(doc="The same of phase c.")] = None
    ab: Annotated[SignalRef | None, SignalKey(doc="Voltage of phase a against b.")] = None
    bc: Annotated[SignalRef | None, SignalKey(doc="Voltage of phase b against c.")] = None
    ca: Annotated[SignalRef | None, SignalKey(doc="Voltage of phase c against a.")] = None
    alpha: Annotated[SignalRef | None, SignalKey(doc="Voltage, alpha axis.")] = None
    beta: Annotated[SignalRef | None, SignalKey(doc="Voltage, beta axis.")] = None
    d: Annotated[SignalRef | None, SignalKey(doc="Voltage, d axis.")] = None
    q: Annotated[SignalRef | None, SignalKey(doc="Voltage, q axis.")] = None

    @property
    def components(self) -> list[SignalRef | None]:
        """The signals of the form in their order, filled up to three."""
        return _components(self, _VOLTAGE_FORMS)

    @model_validator(mode="after")
    def _fits(self) -> VoltageMap:
        _check_components(self, _VOLTAGE_FORMS, {"duty": 3})
        wanted = {"line_line": "line", "phase": "phase", "duty": "phase"}.get(self.form, self.per)
        if self.per != wanted:
            raise KeyProblem("per", f'"{wanted}" for form = "{self.form}"')
        if self.form == "duty" and self.measure != "peak":
            raise KeyProblem("measure", '"peak" for form = "duty", where it means nothing')
        return self


def _components(section: Section, forms: dict[str, tuple[str, ...]]) -> list[SignalRef | None]:
    found = [getattr(section, name) for name in forms[section.form]]  # type: ignore[attr-defined]
    return [*found, None][:3]


def _check_components(section: Section, forms: dict[str, tuple[str, ...]], needed: dict[str, int]) -> None:
    form: str = section.form  # type: ignore[attr-defined]
    names = forms[form]
    for other in {name for group in forms.values() for name in group} - set(names):
        if getattr(section, other) is not None:
            raise KeyProblem(other, f'nothing for form = "{form}", which takes {", ".join(names)}')
    least = needed.get(form, 2)
    if given([getattr(section, name) for name in names]) < least:
        missing = next(name for name in names if getattr(section, name) is None)
        how = "all" if least == len(names) else f"at least {least}"
        raise KeyProblem(missing, f'{section.keys()[missing].allowed}: form = "{form}" needs {how} of '
                         f'{", ".join(names)}', missing=True)


class AngleMap(Section):
    """The rotor angle to which d and q belong, and a measured one to compare with unless there is [encoder]."""

    signal: Annotated[SignalRef, SignalKey(doc="The angle.", example="Message.angle")]
    unit: Annotated[str, Choice(doc="What it counts in.", choices=TURN_UNITS, example="deg")]
    of: Annotated[str, Choice(doc="Whether a turn of it is one of the shaft or an electrical one.",
                              choices=("electrical", "shaft"), example="electrical")]
    zero: Annotated[float, Quantity(
        doc="What the signal stands at, in electrical degrees before direction counts, when the north pole is on "
            "the axis of phase a.", unit=units.DEGREE)] = 0.0
    direction: Annotated[int, Quantity(
        doc="1: rises while the motor turns a, b, c; -1: falls.", whole=True, least=-1, most=1)] = 1
    measured: Annotated[bool, Switch(
        doc="Whether a sensor gives it; false where the inverter estimates it.")] = True

    @field_validator("direction", mode="after")
    @classmethod
    def _a_direction(cls, value: int) -> int:
        if value == 0:
            raise ValueError("1 or -1")
        return value


class SpeedMap(Section):
    """The speed."""

    signal: Annotated[SignalRef, SignalKey(doc="The speed, above 0 while the motor turns a, b, c.",
                                           example="Message.speed")]
    unit: Annotated[str, Choice(doc="What it counts in.", choices=SPEED_UNITS, example="rpm shaft")]


class ValueMap(Section):
    """One more value: dc voltage [V], torque [N m], or temperature [degC]."""

    signal: Annotated[SignalRef, SignalKey(doc="The value.", example="Message.value")]


class TimingMap(Section):
    """When a sample was taken, and how far reports may lie apart."""

    counter: Annotated[SignalRef | None, SignalKey(
        doc="Counter of samples, in the message of the current; without it, arrival times count the samples.",
        default="none")] = None
    bits: Annotated[int | None, Quantity(
        doc="Bits after which the counter starts at 0 again.", whole=True, least=2, most=32,
        default="those of the signal", example=8)] = None
    rate: Annotated[float | None, Quantity(
        doc="Samples per second.", unit=units.HERTZ, above=0, most=100e3,
        default="found from the arrival times", example=10000)] = None
    rate_signal: Annotated[SignalRef | None, SignalKey(
        doc="Samples per second, where the drive says so itself.", method="hold", default="none")] = None
    limit_angle: Annotated[float, Quantity(
        doc="Reports of what turns with the rotor lie too far apart when it turns more than this between the "
            "current's and theirs.", unit=units.DEGREE, above=0, most=180)] = 5.0
    limit_time: Annotated[float, Quantity(
        doc="Reports of anything else lie too far apart after this time.", unit=units.SECOND, above=0,
        most=60)] = 0.1
    wait: Annotated[float, Quantity(
        doc="How long a sample waits for later reports to interpolate to; then the last ones are held.",
        unit=units.SECOND, above=0, most=60)] = 0.5


class InverterMap(BaseModel):
    """The map of one kind of inverter; [map] is required, and so is anything to map.

    Raises pydantic.ValidationError (a ValueError) when built directly; `load_map` turns it into one sentence.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    map: General
    current: CurrentMap | None = None
    voltage: VoltageMap | None = None
    angle: AngleMap | None = None
    encoder: AngleMap | None = None
    speed: SpeedMap | None = None
    dc_voltage: ValueMap | None = None
    torque: ValueMap | None = None
    temperature: ValueMap | None = None
    timing: TimingMap = TimingMap()

    @classmethod
    def sections(cls) -> dict[str, type[Section]]:
        """The sections in the order of the file."""
        kinds = (General, CurrentMap, VoltageMap, AngleMap, AngleMap, SpeedMap, ValueMap, ValueMap, ValueMap,
                 TimingMap)
        fields: Iterable[str] = cls.model_fields
        return dict(zip(fields, kinds, strict=True))

    @model_validator(mode="after")
    def _consistent(self) -> InverterMap:
        parts = (self.current, self.voltage, self.angle, self.encoder, self.speed, self.dc_voltage, self.torque)
        if not any(parts):
            raise KeyProblem("current", "a table, as is any of voltage, angle, encoder, speed, dc_voltage, torque: "
                             "a map needs one of them at least", missing=True)
        if self.voltage is not None and self.voltage.form == "duty" and self.dc_voltage is None:
            raise KeyProblem("dc_voltage", 'a table with a signal, as voltage.form = "duty" needs the dc voltage',
                             missing=True)
        return self

    @property
    def needs_pole_pairs(self) -> str:
        """The key that counts turns of the shaft, "" if none does."""
        for name in ("angle", "encoder"):
            part: AngleMap | None = getattr(self, name)
            if part is not None and part.of == "shaft":
                return f"{name}.of"
        return "speed.unit" if self.speed is not None and self.speed.unit.endswith("shaft") else ""
