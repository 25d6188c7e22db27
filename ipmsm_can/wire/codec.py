"""Message codecs over whole blocks of frames.

A `MessageCodec` is compiled from the layout of a message, whatever database it came from, and decodes or
encodes arrays of frames with the table-driven kernels of `ipmsm_can.wire.kernels`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipmsm_can.frames import CAN_EFF_FLAG, CANFD_BRS, CANFD_FDF, FRAME_BYTES
from ipmsm_can.wire.kernels import (
    FLOAT,
    HIGH,
    LOW,
    MIN,
    PARENT,
    SIGNED,
    UNSIGNED,
    decode_block,
    decode_raw_block,
    encode_block,
)


@dataclass(frozen=True, slots=True)
class SignalLayout:
    """One signal as a DBC describes it.

    start: the DBC's start bit: of the least significant bit for Intel, of the most significant for Motorola.
    kind: what the bits are; a float has 16, 32 or 64 bits.
    minimum, maximum: physical limits, None where the DBC gives none.
    choices: named raw values.
    multiplexer, multiplexer_ids: name of the signal that selects this one, and its raw values that do.
    """

    name: str
    start: int
    length: int
    motorola: bool = False
    kind: Literal["unsigned", "signed", "float"] = "unsigned"
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    comment: str = ""
    choices: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    multiplexer: str | None = None
    multiplexer_ids: tuple[int, ...] = ()

    @property
    def first_bit(self) -> int:
        """Position of the first bit in its byte order's own count (Motorola: from the top of byte 0)."""
        return self.start ^ 7 if self.motorola else self.start


def _raw_limits(layout: SignalLayout) -> tuple[int, int, int, int]:
    """Raw type range and, within it, the raw values of the DBC's limits: (type_min, type_max, min, max)."""
    bits = layout.length
    type_min = -(1 << bits - 1) if layout.kind == "signed" else 0
    type_max = type_min + (1 << bits) - 1
    low, high = type_min, type_max
    if layout.minimum is not None and layout.maximum is not None and layout.scale != 0.0:
        ends = sorted(np.rint((x - layout.offset) / layout.scale) for x in (layout.minimum, layout.maximum))
        if layout.minimum <= layout.maximum and np.isfinite(ends).all():
            low, high = max(low, int(ends[0])), min(high, int(ends[1]))
    return (type_min, type_max, low, high) if low <= high else (type_min, type_max, type_min, type_max)


def _as_ranges(ids: Sequence[int]) -> list[tuple[int, int]]:
    ranges: list[tuple[int, int]] = []
    for value in sorted(set(ids)):
        if ranges and ranges[-1][1] == value - 1:
            ranges[-1] = (ranges[-1][0], value)
        else:
            ranges.append((value, value))
    return ranges


@dataclass(frozen=True, slots=True)
class CodecTables:
    """Tables of a message: header word, bits of each signal, scaling, ranges, order of encoding."""

    header: np.uint64
    table: NDArray[np.int64]
    scaling: NDArray[np.float64]
    ranges: NDArray[np.int64]
    order: NDArray[np.intp]


class MessageCodec:
    """Encoder and decoder of one message; immutable, shared freely between threads.

    name, frame_id, is_extended, is_fd, length [bytes], comment: as in the DBC.
    signals: names in table order, the order of the rows of `decode` and `encode`; index: name -> row.
    layouts: one SignalLayout per signal; attributes: the DBC's message attributes by name.

    Raises ValueError for a layout that does not fit its message or cannot be coded.
    """

    def __init__(self, name: str, frame_id: int, length: int, layouts: Sequence[SignalLayout], *,
                 is_extended: bool = False, is_fd: bool = False, bit_rate_switch: bool = True,
                 comment: str = "", attributes: Mapping[str, int | float | str] | None = None) -> None:
        self.name, self.frame_id, self.length, self.comment = name, frame_id, length, comment
        self.is_extended, self.is_fd = is_extended, is_fd or length > 8
        self.layouts = tuple(layouts)
        self.signals = tuple(layout.name for layout in layouts)
        self.index: Mapping[str, int] = MappingProxyType({s: i for i, s in enumerate(self.signals)})
        self.attributes = MappingProxyType(dict(attributes or {}))
        flags = (CANFD_FDF | (CANFD_BRS if bit_rate_switch else 0)) if self.is_fd else 0
        self._header = np.uint64(frame_id | (CAN_EFF_FLAG if is_extended else 0) | length << 32 | flags << 40)
        self._n_words = (length + 7) // 8
        self._build_tables()

    def _build_tables(self) -> None:
        table = np.zeros((len(self.layouts), 13), np.int64)
        scaling = np.zeros((len(self.layouts), 6), np.float64)
        ranges: list[tuple[int, int]] = []
        for s, layout in enumerate(self.layouts):
            self._check(layout)
            ids = _as_ranges(layout.multiplexer_ids)
            named = _as_ranges([v for v in layout.choices if -(1 << 63) <= v < 1 << 63])
            first = layout.first_bit
            parent = -1 if layout.multiplexer is None else self.index[layout.multiplexer]
            kind = {"unsigned": UNSIGNED, "signed": SIGNED, "float": FLOAT}[layout.kind]
            mark = len(ranges), len(ranges) + len(ids), len(ranges) + len(ids) + len(named)
            ranges += ids + named
            type_min, type_max, low, high = _raw_limits(layout)
            table[s, :MIN] = (layout.length, 1 + first // 64, first % 64, layout.motorola, kind,
                               (first + layout.length + 7) // 8, parent, mark[0], mark[1], mark[1], mark[2])
            table[s, MIN:] = np.array([low % 2 ** 64, high % 2 ** 64], np.uint64).view(np.int64)
            scaling[s] = layout.scale, layout.offset, low, high, type_min, type_max
            if kind == FLOAT:
                limited = (layout.minimum is not None and layout.maximum is not None
                           and layout.minimum <= layout.maximum)
                scaling[s, LOW:HIGH + 1] = (layout.minimum, layout.maximum) if limited else (-np.inf, np.inf)
        self._table, self._scaling = table, scaling
        self._ranges = np.array(ranges, np.int64).reshape(-1, 2)
        depth = [self._depth(s) for s in range(len(self.layouts))]
        self._order = np.array(np.argsort(depth, kind="stable"), np.intp)
        self._no_rows = np.zeros(0, np.intp)

    def _check(self, layout: SignalLayout) -> None:
        where = f"signal {layout.name} of message {self.name}"
        allowed = (16, 32, 64) if layout.kind == "float" else range(1, 65)
        if layout.length not in allowed:
            span = "16, 32 or 64" if layout.kind == "float" else "1 to 64"
            raise ValueError(f"{where} is a {layout.kind} of {layout.length} bits; allowed is {span}")
        if layout.first_bit + layout.length > 8 * self.length:
            raise ValueError(f"{where} ends at bit {layout.first_bit + layout.length}; "
                             f"the message ends at bit {8 * self.length}")
        if layout.multiplexer is not None and layout.multiplexer not in self.index:
            raise ValueError(f"{where} is selected by {layout.multiplexer!r}; the message has no such signal")

    def _depth(self, s: int) -> int:
        for depth in range(len(self.layouts) + 1):
            if self._table[s, PARENT] < 0:
                return depth
            s = int(self._table[s, PARENT])
        raise ValueError(f"the multiplexers of message {self.name} select each other in a circle")

    @property
    def tables(self) -> CodecTables:
        """What `decode_block` and `encode_block` take, for kernels that call them themselves."""
        return CodecTables(self._header, self._table, self._scaling, self._ranges, self._order)

    def __repr__(self) -> str:
        return (f"MessageCodec({self.name!r}, id=0x{self.frame_id:X}, length={self.length}, "
                f"signals={len(self.signals)})")

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each signal by name, "" where the DBC gives none."""
        return {layout.name: layout.unit for layout in self.layouts}

    @property
    def comments(self) -> Mapping[str, str]:
        """Comment on each signal by name, "" where the DBC gives none."""
        return {layout.name: layout.comment for layout in self.layouts}

    @property
    def choices(self) -> Mapping[str, Mapping[int, str]]:
        """Value table of each signal by name, raw value -> text, empty where the DBC gives none."""
        return {layout.name: layout.choices for layout in self.layouts}

    def decode(self, words: NDArray[np.uint64]) -> NDArray[np.float64]:
        """Physical values, (n_signals, N), of the uint64 (N, 9) rows `FrameBlock.words`.

        NaN where a multiplexer selects another signal or the frame is too short to hold this one.  All rows
        are taken for this message: the identifier is not looked at.  raw * scale + offset in double
        precision, to the bit what cantools gives as long as raw * scale is below 2**53.
        """
        words = words if words.flags.carray else np.array(words)
        out = np.empty((len(self.signals), words.shape[0]))
        decode_block(words, self._no_rows, False, self._n_words, self._table, self._scaling, self._ranges,
                     out)
        return out

    def decode_rows(self, words: NDArray[np.uint64], rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """As `decode`, (n_signals, len(rows)), of the chosen rows only; rows: intp, 0..N-1, unchecked."""
        words = words if words.flags.carray else np.array(words)
        rows = rows if rows.flags.carray else np.array(rows)
        out = np.empty((len(self.signals), rows.shape[0]))
        decode_block(words, rows, True, self._n_words, self._table, self._scaling, self._ranges, out)
        return out

    def decode_raw(self, words: NDArray[np.uint64],
                   rows: NDArray[np.intp] | None = None) -> NDArray[np.int64]:
        """Raw values, int64 (n_signals, N): sign-extended if signed, else the bit pattern; 0 where absent."""
        words = words if words.flags.carray else np.array(words)
        use_rows = rows is not None
        chosen = self._no_rows if rows is None else rows if rows.flags.carray else np.array(rows)
        n = chosen.shape[0] if use_rows else words.shape[0]
        out = np.empty((len(self.signals), n), np.int64)
        decode_raw_block(words, chosen, use_rows, self._n_words, self._table, self._ranges, out)
        return out

    def encode(self, values: NDArray[np.float64] | Mapping[str, ArrayLike]) -> NDArray[np.uint8]:
        """Frames with these physical values: uint8 (N, 72) rows for `FrameBlock.raw`, header filled in.

        values: float64 (n_signals, N), or name -> scalar or (N,); a name left out counts as NaN.
        raw = (value - offset) / scale, rounded half to even as cantools does, saturated to the raw type and
        to the DBC's [minimum|maximum] unless the raw value stands in the value table.  NaN becomes raw 0 in
        an integer signal and NaN in a float signal.  A signal its multiplexer does not select is not
        written; bits no signal owns are 0.

        Raises ValueError for an unknown signal name or arrays whose shapes do not go together.
        """
        array = self._as_matrix(values)
        raw = np.empty((array.shape[1], FRAME_BYTES), np.uint8)
        words = raw.view(np.uint64)
        words[:, self._n_words + 1:] = 0
        encode_block(array, self._n_words, self._order, self._table, self._scaling, self._ranges,
                     self._header, words)
        return raw

    def _as_matrix(self, values: NDArray[np.float64] | Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        if isinstance(values, Mapping):
            unknown = [name for name in values if name not in self.index]
            if unknown:
                raise ValueError(f"message {self.name} has no signal {unknown[0]!r}; "
                                 f"it has {', '.join(self.signals)}")
            columns = {name: np.asarray(v, np.float64) for name, v in values.items()}
            sizes = {c.shape[0] for c in columns.values() if c.ndim == 1}
            if len(sizes) > 1 or any(c.ndim > 1 for c in columns.values()):
                shapes = ", ".join(f"{name} {c.shape}" for name, c in columns.items())
                raise ValueError(f"values for message {self.name} are {shapes}; "
                                 "allowed are scalars and equal lengths")
            matrix = np.full((len(self.signals), sizes.pop() if sizes else 1), np.nan)
            for name, column in columns.items():
                matrix[self.index[name]] = column
            return matrix
        plain = isinstance(values, np.ndarray) and values.dtype == np.float64 and values.flags.carray
        array = values if plain else np.array(values, np.float64, order="C", copy=None)
        if array.ndim != 2 or array.shape[0] != len(self.signals):
            raise ValueError(f"values for message {self.name} have shape {array.shape}; "
                             f"allowed is ({len(self.signals)}, N)")
        return array if array.flags.carray else array.copy()
