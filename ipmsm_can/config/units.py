"""Units of the configuration: a plain number, or a string such as "7.6 mH", becomes a float.

A `Unit` says in which unit a plain number counts and which other spellings a string may use.  Factors
are fractions, so that "7.6 mH" gives the same bits as 7.6e-3.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

_PREFIXES = {
    "n": Fraction(1, 10**9),
    "u": Fraction(1, 10**6),
    "m": Fraction(1, 1000),
    "": Fraction(1),
    "k": Fraction(1000),
    "M": Fraction(10**6),
}

# Three digits of exponent hold every float; more would let a string ask for gigabytes of digits.
_QUANTITY = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)(?![\d.])\s*(.*)", re.ASCII)

# The two code points each of micro and ohm, and what else people type or paste.
_SAME = str.maketrans(
    {"\u00b5": "u", "\u03bc": "u", "\u03a9": "ohm", "\u2126": "ohm", "²": "^2", "°": "deg", "·": " ",
     "*": " "}
)


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """What a plain number counts in, and what a string may say instead.

    label: the unit of a plain number, with its kind ("V peak", "rad/s electrical"); "" for a pure number.
    spellings: what may follow the number in a string -> factor into the plain number's unit.
    shaft: those spellings that count turns of the shaft: they also need the number of pole pairs.
    """

    label: str
    spellings: Mapping[str, Fraction] = field(default_factory=dict)
    shaft: frozenset[str] = frozenset()

    def read(self, value: object, pole_pairs: int | None = None) -> float:
        """The value in this unit, always finite.

        value: a number (not a bool) or a string of a number and one of the unit's spellings.
        pole_pairs: of the motor, for the spellings in `shaft`.

        Raises ValueError saying what is allowed, without repeating the value.
        """
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise ValueError(self.forms)
        try:
            number = self._read_text(value, pole_pairs) if isinstance(value, str) else float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise ValueError(f"{self.forms}, and finite")
        return number

    def _read_text(self, text: str, pole_pairs: int | None) -> float:
        match = _QUANTITY.fullmatch(text.strip().translate(_SAME))
        factor = self.spellings.get(" ".join(match[2].split())) if match else None
        if match is None or factor is None:
            raise ValueError(self.forms)
        if self.is_shaft(text):
            if pole_pairs is None:
                raise ValueError(f"a number of {self.label}, as rpm of the shaft need the motor's pole pairs")
            factor *= pole_pairs
        return float(Fraction(match[1]) * factor)

    def is_shaft(self, value: object) -> bool:
        """Whether the value is a string in a unit that counts turns of the shaft."""
        if not isinstance(value, str):
            return False
        match = _QUANTITY.fullmatch(value.strip().translate(_SAME))
        return match is not None and " ".join(match[2].split()) in self.shaft

    @property
    def forms(self) -> str:
        """The forms a value may have: "a number of s, or a string of number and unit (us, ms, s)"."""
        if not self.spellings:
            return f"a number of {self.label}" if self.label else "a number"
        return f'a number of {self.label}, or a string of number and unit ({", ".join(self.spellings)})'


def _scaled(symbol: str, prefixes: str, label: str = "", **more: Fraction) -> Unit:
    """A unit with SI prefixes; `prefixes` in ascending order, "-" standing for no prefix."""
    spellings = {p + symbol: _PREFIXES[p] for p in (c.replace("-", "") for c in prefixes)}
    return Unit(label or symbol, {**spellings, **more})


_TURN = Fraction(2.0 * math.pi)

NUMBER = Unit("")
SAMPLES = Unit("samples")
PERCENT = Unit("%", {"%": Fraction(1)})
HENRY = _scaled("H", "num-")
WEBER = Unit("Wb", {"mWb": Fraction(1, 1000), "Wb": Fraction(1), "V s": Fraction(1)})
OHM = _scaled("ohm", "um-")
VOLT = _scaled("V", "m-k")
VOLT_PEAK = _scaled("V", "m-k", "V peak")
AMPERE = _scaled("A", "m-k")
AMPERE_PEAK = _scaled("A", "m-k", "A peak")
AMPERE_RMS = _scaled("A", "m-k", "A rms")
SECOND = _scaled("s", "um-")
HERTZ = _scaled("Hz", "-kM")
BIT_RATE = _scaled("bit/s", "-kM")
PER_SECOND = Unit("1/s", {"1/s": Fraction(1), "rad/s": Fraction(1)})
VOLT_PER_SECOND = Unit("V/s", {"V/s": Fraction(1), "V/ms": Fraction(1000)})
EXCITATION = Unit("V^2 s", {"V^2 s": Fraction(1)})
GRADIENT_GAIN = Unit("1/(V^2 s)", {"1/(V^2 s)": Fraction(1)})
NEWTON_METRE = Unit("N m", {"mN m": Fraction(1, 1000), "N m": Fraction(1), "Nm": Fraction(1)})
FRICTION = Unit("N m s/rad mechanical", {"mN m s": Fraction(1, 1000), "N m s": Fraction(1)})
INERTIA = Unit("kg m^2", {"kg m^2": Fraction(1), "kg cm^2": Fraction(1, 10**4), "g cm^2": Fraction(1, 10**7)})
DEGREE = Unit("deg", {"deg": Fraction(1), "rad": Fraction(180.0 / math.pi)})
SPEED = Unit(
    "rad/s electrical",
    {"rad/s": Fraction(1), "Hz": _TURN, "rpm": _TURN / 60},
    shaft=frozenset({"rpm"}),
)
"""Electrical angular speed; "Hz" is the electrical frequency, "rpm" the mechanical speed of the shaft."""
