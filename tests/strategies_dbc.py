"""Hypothesis strategies that make up databases: one message of random signals, written as DBC text."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn

LENGTHS = (1, 2, 3, 5, 7, 8, 8, 8, 12, 16, 24, 64)
SCALES = ("1", "2", "-3", "0.005", "-0.025", "0.1", "1e-05", "9.587379924285257e-05", "7.25")
OFFSETS = ("0", "0", "-40", "17", "0.5", "-273.15")


@dataclass(frozen=True)
class RandomSignal:
    """A signal of a random message; mux is the DBC's multiplexer mark, such as "M", "m3" or "m3M"."""

    name: str
    first: int
    length: int
    motorola: bool
    kind: str
    scale: str
    offset: str
    mux: str = ""
    limits: str = "0|0"

    @property
    def bits(self) -> frozenset[int]:
        """The bits it owns, as 8 * byte + bit with bit 0 the least significant of the byte."""
        span = range(self.first, self.first + self.length)
        return frozenset(b ^ 7 for b in span) if self.motorola else frozenset(span)

    @property
    def line(self) -> str:
        start = self.first ^ 7 if self.motorola else self.first
        sign = "+" if self.kind == "unsigned" else "-"
        mux = f" {self.mux}" if self.mux else ""
        return (f" SG_ {self.name}{mux} : {start}|{self.length}@{0 if self.motorola else 1}{sign} "
                f"({self.scale},{self.offset}) [{self.limits}] \"u\" Vector__XXX")


@dataclass(frozen=True)
class RandomMessage:
    """A message and the multiplexer lines that go with it."""

    length: int
    signals: tuple[RandomSignal, ...]
    mux_lines: tuple[str, ...] = field(default=())
    frame_id: int = 0x123

    @property
    def text(self) -> str:
        """The DBC."""
        lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_:", "",
                 f"BO_ {self.frame_id} Random: {self.length} Vector__XXX", *(s.line for s in self.signals),
                 ""]
        lines += [f"SIG_VALTYPE_ {self.frame_id} {s.name} : {2 if s.length == 64 else 1};"
                  for s in self.signals if s.kind == "float"]
        return "\n".join([*lines, *self.mux_lines]) + "\n"


@st.composite
def _signal(draw: DrawFn, name: str, total: int, mux: str = "") -> RandomSignal:
    kind = draw(st.sampled_from(("unsigned", "signed", "unsigned", "signed", "float")))
    widths = [w for w in (16, 32, 64) if w <= total]
    if not widths and kind == "float":
        kind = "unsigned"
    length = draw(st.sampled_from(widths) if kind == "float" else st.integers(1, min(64, total)))
    if kind != "float" and draw(st.booleans()):
        length = min(length, 12)
    return RandomSignal(
        name=name, first=draw(st.integers(0, total - length)), length=length, motorola=draw(st.booleans()),
        kind=kind, scale=draw(st.sampled_from(SCALES)), offset=draw(st.sampled_from(OFFSETS)), mux=mux)


def _selector(draw: DrawFn, name: str, total: int, length: int, mux: str) -> RandomSignal:
    return RandomSignal(name, draw(st.integers(0, total - length)), length, draw(st.booleans()),
                        "unsigned", "1", "0", mux)


def _fill(draw: DrawFn, prefix: str, count: int, total: int, taken: set[int],
          mux: str = "") -> list[RandomSignal]:
    placed = []
    for j in range(count):
        signal = draw(_signal(f"{prefix}{j}", total, mux))
        if not signal.bits & taken:
            taken |= signal.bits
            placed.append(signal)
    return placed


@st.composite
def messages(draw: DrawFn) -> RandomMessage:
    """A message without multiplexing."""
    length = draw(st.sampled_from(LENGTHS))
    signals = _fill(draw, "s", draw(st.integers(1, 10)), 8 * length, set())
    return RandomMessage(length, tuple(signals))


@st.composite
def multiplexed_messages(draw: DrawFn) -> RandomMessage:
    """A message with one multiplexer, values 0..3 in 2 bits, each with signals of its own."""
    length = draw(st.sampled_from([n for n in LENGTHS if n >= 2]))
    total = 8 * length
    selector = _selector(draw, "mux", total, 2, "M")
    common = set(selector.bits)
    signals = [selector, *_fill(draw, "c", 2, total, common)]
    for value in range(4):
        signals += _fill(draw, f"m{value}_", 3, total, set(common), f"m{value}")
    return RandomMessage(length, tuple(signals))


@st.composite
def extended_messages(draw: DrawFn) -> RandomMessage:
    """Extended multiplexing: a multiplexer below a multiplexer, and signals chosen by several values.

    The outer one has 2 bits: 0 and 2 choose the inner one and `both`, 1 and 3 choose `other`.  The inner
    one has 1 bit; each of its values chooses one signal.
    """
    length = draw(st.sampled_from([n for n in LENGTHS if n >= 3]))
    total = 8 * length
    outer = _selector(draw, "outer", total, 2, "M")
    inner = _selector(draw, "inner", total, 1, "m0M")
    while inner.bits & outer.bits:
        inner = replace(inner, first=(inner.first + 1) % total)
    base = outer.bits | inner.bits
    taken = set(base)
    signals = [outer, inner, *_fill(draw, "both", 1, total, taken, "m0")]
    lines = ["SG_MUL_VAL_ 291 inner outer 0-0, 2-2;"]
    lines += [f"SG_MUL_VAL_ 291 {s.name} outer 0-0, 2-2;" for s in signals[2:]]
    for value in (0, 1):
        group = _fill(draw, f"in{value}_", 2, total, set(taken), f"m{value}")
        lines += [f"SG_MUL_VAL_ 291 {s.name} inner {value}-{value};" for s in group]
        signals += group
    group = _fill(draw, "other", 2, total, set(outer.bits), "m1")
    lines += [f"SG_MUL_VAL_ 291 {s.name} outer 1-1, 3-3;" for s in group]
    return RandomMessage(length, (*signals, *group), tuple(lines))


def any_message() -> st.SearchStrategy[RandomMessage]:
    """Any of the above."""
    return st.one_of(messages(), multiplexed_messages(), extended_messages())


def same(ours: float, theirs: float) -> bool:
    """Equal to the bit, NaN equal to NaN, zeros of either sign equal."""
    return ours == theirs or (math.isnan(ours) and math.isnan(theirs))
