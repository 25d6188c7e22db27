"""How a map names one value on the bus: `"Message.signal"`, or a table with gain, offset and sign beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ipmsm_can.config.keys import Key

METHODS = ("interpolate", "hold")
_TABLE = ("signal", "gain", "offset", "sign", "method", "constant")


@dataclass(frozen=True, slots=True)
class SignalRef:
    """One value: sign * (gain * what the DBC gives + offset), or a constant where message is "".

    method: how it is brought to the time of a sample: "interpolate" (a straight line between two reports, or on the
    circle for an angle) or "hold" (the latest report, for set points).
    """

    message: str = ""
    signal: str = ""
    gain: float = 1.0
    offset: float = 0.0
    sign: float = 1.0
    method: str = "interpolate"
    constant: float = math.nan

    @property
    def is_constant(self) -> bool:
        """Whether the map states the value instead of naming a signal."""
        return not self.message

    def __str__(self) -> str:
        return f"constant {self.constant:g}" if self.is_constant else f"{self.message}.{self.signal}"


@dataclass(frozen=True, kw_only=True, eq=False)
class SignalKey(Key):
    """A `SignalRef`; method: the one it has unless the map says otherwise."""

    method: str = "interpolate"

    @property
    def allowed(self) -> str:
        return ('"Message.signal", { signal = "Message.signal", gain = 1, offset = 0, sign = 1 or -1, '
                'method = "interpolate" or "hold" }, or { constant = a number }')

    def read(self, value: Any, pole_pairs: int | None = None) -> SignalRef:
        if isinstance(value, SignalRef):
            return value
        table = {"signal": value} if isinstance(value, str) else value
        if not isinstance(table, dict) or not set(table) <= set(_TABLE):
            raise ValueError(self.allowed)
        if "constant" in table:
            if len(table) > 1:
                raise ValueError(self.allowed)
            return SignalRef(constant=self._number(table["constant"]))
        message, dot, signal = str(table.get("signal", "")).partition(".")
        if not (message and dot and signal):
            raise ValueError(self.allowed)
        gain, offset = self._number(table.get("gain", 1.0)), self._number(table.get("offset", 0.0))
        sign, method = table.get("sign", 1), table.get("method", self.method)
        if sign not in (1, -1) or isinstance(sign, bool) or method not in METHODS or gain == 0.0:
            raise ValueError(self.allowed)
        return SignalRef(message, signal, gain, offset, float(sign), method)

    def _number(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError(self.allowed)
        return float(value)


def given(refs: Sequence[SignalRef | None]) -> int:
    """How many of these a map gives."""
    return sum(ref is not None for ref in refs)
