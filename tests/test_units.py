"""Reading quantities: against decimal arithmetic by hand, and against anything a file may contain."""

from __future__ import annotations

import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.config import units
from ipmsm_can.config.keys import Choice, FilePath, Quantity, Switch, in_toml
from ipmsm_can.config.units import Unit

ALL_UNITS = [value for value in vars(units).values() if isinstance(value, Unit)]

# The decimal exponents once more, written out by hand.
EXPONENTS = [
    (units.HENRY, {"nH": -9, "uH": -6, "mH": -3, "H": 0}),
    (units.WEBER, {"mWb": -3, "Wb": 0, "V s": 0}),
    (units.OHM, {"uohm": -6, "mohm": -3, "ohm": 0}),
    (units.VOLT, {"mV": -3, "V": 0, "kV": 3}),
    (units.VOLT_PEAK, {"mV": -3, "V": 0, "kV": 3}),
    (units.AMPERE, {"mA": -3, "A": 0, "kA": 3}),
    (units.AMPERE_PEAK, {"mA": -3, "A": 0, "kA": 3}),
    (units.AMPERE_RMS, {"mA": -3, "A": 0, "kA": 3}),
    (units.SECOND, {"us": -6, "ms": -3, "s": 0}),
    (units.HERTZ, {"Hz": 0, "kHz": 3, "MHz": 6}),
    (units.BIT_RATE, {"bit/s": 0, "kbit/s": 3, "Mbit/s": 6}),
    (units.PER_SECOND, {"1/s": 0, "rad/s": 0}),
    (units.VOLT_PER_SECOND, {"V/s": 0, "V/ms": 3}),
    (units.EXCITATION, {"V^2 s": 0}),
    (units.GRADIENT_GAIN, {"1/(V^2 s)": 0}),
    (units.NEWTON_METRE, {"mN m": -3, "N m": 0, "Nm": 0}),
    (units.FRICTION, {"mN m s": -3, "N m s": 0}),
    (units.PERCENT, {"%": 0}),
    (units.INERTIA, {"kg m^2": 0, "kg cm^2": -4, "g cm^2": -7}),
]
CASES = [(unit, spelling, exponent) for unit, table in EXPONENTS for spelling, exponent in table.items()]


@pytest.mark.parametrize(("unit", "spelling", "exponent"), CASES)
@given(number=st.decimals(-(10**6), 10**6, places=4))
def test_a_string_gives_the_nearest_float(unit: Unit, spelling: str, exponent: int, number: Decimal) -> None:
    assert unit.read(f"{number} {spelling}") == float(f"{number}e{exponent}")


def test_every_decimal_spelling_is_tested() -> None:
    angular = {units.DEGREE, units.SPEED}
    assert {(id(unit), spelling) for unit, spelling, _ in CASES} == {
        (id(unit), spelling) for unit in ALL_UNITS if unit not in angular for spelling in unit.spellings
    }


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("7.6mH", units.HENRY, 7.6e-3),
        (" 7.6  mH ", units.HENRY, 7.6e-3),
        ("7.6 \u00b5H", units.HENRY, 7.6e-6),
        ("7.6 \u03bcH", units.HENRY, 7.6e-6),
        ("430 m\u03a9", units.OHM, 0.43),
        ("430 m\u2126", units.OHM, 0.43),
        ("1.5e-2 Wb", units.WEBER, 0.015),
        (".5 V·s", units.WEBER, 0.5),
        ("6.2 N*m", units.NEWTON_METRE, 6.2),
        ("3 V² s", units.EXCITATION, 3.0),
        ("+2. kV", units.VOLT, 2000.0),
        ("10 °", units.DEGREE, 10.0),
        ("50 1/s", units.PER_SECOND, 50.0),
    ],
)
def test_spellings_people_use(text: str, unit: Unit, expected: float) -> None:
    assert unit.read(text) == expected


def test_speeds_and_angles() -> None:
    assert units.SPEED.read("10 Hz") == pytest.approx(20.0 * math.pi, rel=1e-15)
    assert units.SPEED.read("10 rad/s") == 10.0
    # 60 rpm of the shaft = one mechanical turn per second = p electrical turns per second.
    assert units.SPEED.read("60 rpm", pole_pairs=3) == pytest.approx(6.0 * math.pi, rel=1e-15)
    assert units.SPEED.read("10 Hz", pole_pairs=3) == pytest.approx(20.0 * math.pi, rel=1e-15)
    assert units.DEGREE.read("1 rad") == pytest.approx(math.degrees(1.0), rel=1e-15)
    with pytest.raises(ValueError, match="pole pairs"):
        units.SPEED.read("60 rpm")


@pytest.mark.parametrize(
    "value",
    ["7.6", "mH", "", "7,6 mH", "7.6 mh", "7.6 MH", "7.6 kg", "1.2.3 H", "1e H", "0x10 H", "nan H", "inf H",
     "1 H 2 H", "\u0661 H", "1e999 H", "1e9999 H", True, None, [1.0], {"a": 1}, math.nan, math.inf, -math.inf,
     10**400],
)
def test_what_is_no_inductance(value: object) -> None:
    with pytest.raises(ValueError, match="a number of H, or a string of number and unit"):
        units.HENRY.read(value)


@given(value=st.one_of(st.text(max_size=30), st.floats(), st.integers(), st.booleans(), st.none(),
                       st.from_regex(r"[-+]?[0-9.]{0,6}(e[-+]?[0-9]{1,6})? ?(rpm|Hz|rad/s)")),
       unit=st.sampled_from(ALL_UNITS), pole_pairs=st.integers(1, 100))
def test_a_finite_number_or_a_value_error(value: object, unit: Unit, pole_pairs: int) -> None:
    try:
        number = unit.read(value, pole_pairs)
    except ValueError:
        return
    assert isinstance(number, float)
    assert math.isfinite(number)


def test_ranges_hold_their_ends() -> None:
    closed = Quantity(doc="", least=0, most=15, whole=True)
    assert [closed.read(0), closed.read(15), closed.read(15.0)] == [0, 15, 15]
    assert all(isinstance(closed.read(n), int) for n in (3, 3.0))
    for value in (-1, 16, 1.5, -0.001):
        with pytest.raises(ValueError, match="a whole number, from 0 to 15"):
            closed.read(value)
    opened = Quantity(doc="", unit=units.SECOND, above=0, most=10)
    assert opened.read("10 s") == 10.0
    assert opened.read(5e-324) == 5e-324
    for item in (0, -0.0, "-1 ms", 10.000001):
        with pytest.raises(ValueError, match=r"above 0 and at most 10$"):
            opened.read(item)
    assert Quantity(doc="", least=0).range == "0 or more"
    assert Quantity(doc="").range == ""


def test_pairs() -> None:
    pair = Quantity(doc="", unit=units.WEBER, count=2)
    assert pair.read([0.5, "20 mWb"]) == (0.5, 0.02)
    for value in ([1.0], [1.0, 2.0, 3.0], 1.0, "1 Wb", [1.0, "2"], [1.0, None], {"a": 1, "b": 2}):
        with pytest.raises(ValueError, match="an array of 2 values, each a number of Wb"):
            pair.read(value)


def test_words_switches_and_paths() -> None:
    choice = Choice(doc="", choices=("a", "b", "c"))
    assert choice.read("b") == "b"
    assert choice.allowed == '"a", "b" or "c"'
    for value in ("d", "A", 1, ["a"]):
        with pytest.raises(ValueError, match='"a", "b" or "c"'):
            choice.read(value)
    for word in (1, 0, "true", None):
        with pytest.raises(ValueError, match="true or false"):
            Switch(doc="").read(word)
    for path in ("", 3, "a\0b"):
        with pytest.raises(ValueError, match="path of a file"):
            FilePath(doc="").read(path)


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1"), (0.1, "0.1"), (True, "true"), ('a"b', '"a\\"b"'), ((0.5, 0), "[0.5, 0]"), (math.nan, "nan"),
     ({"a": 1}, "a table"), ([{}], "an array of tables"), (10**31, "a number of more than 30 digits")],
)
def test_values_as_they_stand_in_a_file(value: object, text: str) -> None:
    assert in_toml(value) == text
