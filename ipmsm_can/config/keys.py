"""What a key of the configuration may hold: the one place for its unit, range, choices and description.

A field of a section is `Annotated[float, Quantity(...)]`, `Annotated[str, Choice(...)]` and so on.  The
section reads values through it, the messages and `explain` take their words from it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipmsm_can.config.units import NUMBER, Unit


def in_toml(value: object) -> str:
    """A value as it stands in a TOML file; a table or a foreign object in a few words."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, (list, tuple)):
        if any(isinstance(item, dict) for item in value):
            return "an array of tables"
        return "[" + ", ".join(in_toml(item) for item in value) + "]"
    if isinstance(value, (str, bool)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Path):
        return in_toml(value.as_posix())
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, int) and abs(value) >= 10**30:
        return "a number of more than 30 digits"  # Python refuses to print one of thousands
    return str(value)


@dataclass(frozen=True, kw_only=True, eq=False)
class Key:
    """doc: what the key means.  default: where a missing value comes from, when that is no constant.
    example: a value as it would stand in the file, for keys without a constant default."""

    doc: str
    default: str = ""
    example: Any = None

    @property
    def allowed(self) -> str:
        """What the key allows, in words that follow 'allowed is'."""
        raise NotImplementedError

    def read(self, value: Any, pole_pairs: int | None = None) -> Any:
        """The value as the model holds it.  Raises ValueError; its text says what is allowed."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True, eq=False)
class Quantity(Key):
    """A number with a unit; `count` > 1: an array of so many.

    above, least, below, most: open lower, closed lower, open upper and closed upper bound, in the unit.
    whole: a whole number, read as int.
    """

    unit: Unit = NUMBER
    above: float | None = None
    least: float | None = None
    most: float | None = None
    whole: bool = False
    count: int = 1

    @property
    def range(self) -> str:
        """The range in words: "above 0", "from 0 to 15", or "" when every finite number will do."""
        if self.least is not None:
            low = f"{self.least:.12g}"
            return f"{low} or more" if self.most is None else f"from {low} to {self.most:.12g}"
        words = [f"above {self.above:.12g}"] if self.above is not None else []
        if self.most is not None:
            words.append(f"at most {self.most:.12g}")
        return " and ".join(words)

    @property
    def allowed(self) -> str:
        forms = self.unit.forms
        if self.whole:
            forms = forms.replace("a number", "a whole number", 1)
        if self.count > 1:
            forms = f"an array of {self.count} values, each {forms}"
        return f"{forms}, {self.range}" if self.range else forms

    def read(self, value: Any, pole_pairs: int | None = None) -> Any:
        if self.count > 1:
            if not isinstance(value, (list, tuple)) or len(value) != self.count:
                raise ValueError(self.allowed)
            return tuple(self._read_one(item, pole_pairs) for item in value)
        return self._read_one(value, pole_pairs)

    def _read_one(self, value: Any, pole_pairs: int | None) -> float:
        if self.unit.is_shaft(value) and pole_pairs is None:
            return self.unit.read(value)  # raises, and says what is missing
        try:
            number = self.unit.read(value, pole_pairs)
        except ValueError:
            raise ValueError(self.allowed) from None
        if not self._in_range(number) or (self.whole and number != int(number)):
            raise ValueError(self.allowed)
        return int(number) if self.whole else number

    def _in_range(self, number: float) -> bool:
        return (
            (self.above is None or number > self.above)
            and (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class QuantityOrWord(Quantity):
    """A number with a unit, or one word that stands for a rule."""

    word: str

    @property
    def allowed(self) -> str:
        return f"{super().allowed}, or {in_toml(self.word)}"

    def read(self, value: Any, pole_pairs: int | None = None) -> Any:
        return value if value == self.word else super().read(value, pole_pairs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice(Key):
    """One of a few words."""

    choices: Sequence[str]

    @property
    def allowed(self) -> str:
        words = [in_toml(choice) for choice in self.choices]
        return " or ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]

    def read(self, value: Any, pole_pairs: int | None = None) -> str:
        if not isinstance(value, str) or value not in self.choices:
            raise ValueError(self.allowed)
        return value


@dataclass(frozen=True, kw_only=True, eq=False)
class Switch(Key):
    """true or false."""

    @property
    def allowed(self) -> str:
        return "true or false"

    def read(self, value: Any, pole_pairs: int | None = None) -> bool:
        if not isinstance(value, bool):
            raise ValueError(self.allowed)
        return value


@dataclass(frozen=True, kw_only=True, eq=False)
class FilePath(Key):
    """The path of a file."""

    @property
    def allowed(self) -> str:
        return "the path of a file that exists, relative to this file's folder"

    def read(self, value: Any, pole_pairs: int | None = None) -> Path:
        if not isinstance(value, (str, Path)) or not str(value) or "\0" in str(value):
            raise ValueError(self.allowed)
        return Path(value).expanduser()
