"""DBC files: loading with cantools and compiling every message into a codec.

cantools takes a second to import, so it is imported when a database is loaded and not before.
"""

from __future__ import annotations

import importlib.resources
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from ipmsm_can.wire.codec import MessageCodec, SignalLayout

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


class DbcError(ValueError):
    """A database that cannot be read or used; the text names the file and what is wrong with it."""


def default_dbc_path() -> Path:
    """Path of the project's own ipmsm_can.dbc: inside the installed package, else in the source tree.

    Raises DbcError if neither is there.
    """
    installed = Path(str(importlib.resources.files("ipmsm_can"))) / "_data" / "ipmsm_can.dbc"
    source = Path(__file__).resolve().parents[2] / "dbc" / "ipmsm_can.dbc"
    for path in (installed, source):
        if path.is_file():
            return path
    raise DbcError(f"ipmsm_can.dbc is found neither at {installed} nor at {source}")


@dataclass(frozen=True, slots=True)
class Database:
    """The messages of one DBC, each compiled into a codec.

    messages: codec by message name, in the order of the file.
    attributes: the network's attributes by name, such as ProtocolVersion; only those the file sets.
    source: where it came from, for messages to the user.
    """

    messages: Mapping[str, MessageCodec]
    attributes: Mapping[str, int | float | str]
    source: str
    _by_id: Mapping[tuple[int, bool], MessageCodec]

    @classmethod
    def load(cls, path: str | Path, *, strict: bool = True) -> Database:
        """Read a DBC file (UTF-8, else Windows-1252).

        strict: refuse signals that overlap or leave their message; files found in the field may need False,
        though a signal outside its message stays an error.
        Raises DbcError naming the file and the fault.
        """
        try:
            content = Path(path).read_bytes()
        except OSError as error:
            raise DbcError(f"{path} cannot be read: {error.strerror or error}") from error
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252", errors="replace")
        return cls.loads(text, source=str(path), strict=strict)

    @classmethod
    def loads(cls, text: str, *, source: str = "DBC text", strict: bool = True) -> Database:
        """Compile the text of a DBC; as `load`, with `source` naming it in errors."""
        import cantools.database

        try:
            loaded = cantools.database.load_string(text, database_format="dbc", strict=strict)
            assert isinstance(loaded, cantools.database.can.Database)
        except Exception as error:  # cantools raises whatever its parser tripped over
            reason = " ".join(str(error).removeprefix('DBC: "').removesuffix('"').split())
            raise DbcError(f"{source} is no usable DBC: {reason or type(error).__name__}") from error
        messages: dict[str, MessageCodec] = {}
        by_id: dict[tuple[int, bool], MessageCodec] = {}
        for message in loaded.messages:
            try:
                codec = _compile(message)
            except ValueError as error:
                raise DbcError(f"{source} is no usable DBC: {error}") from error
            messages[codec.name] = codec
            by_id[codec.frame_id, codec.is_extended] = codec
        return cls(MappingProxyType(messages), MappingProxyType(_attributes(loaded.dbc)), source,
                   MappingProxyType(by_id))

    @property
    def codecs(self) -> tuple[MessageCodec, ...]:
        """All codecs in the order of the file."""
        return tuple(self.messages.values())

    def by_id(self, frame_id: int, is_extended: bool = False) -> MessageCodec | None:
        """The codec of an identifier (without flag bits), None if the database has none."""
        return self._by_id.get((frame_id, is_extended))


def _attributes(dbc: object) -> dict[str, int | float | str]:
    found: dict[str, int | float | str] = {}
    for name, attribute in (getattr(dbc, "attributes", None) or {}).items():
        value = attribute.value
        found[str(name)] = value if isinstance(value, (int, float)) else str(value)
    return found


def _compile(message: Message) -> MessageCodec:
    attributes = _attributes(message.dbc)
    return MessageCodec(
        message.name, message.frame_id, message.length, [_layout(signal) for signal in message.signals],
        is_extended=message.is_extended_frame, is_fd=message.is_fd, comment=message.comment or "",
        bit_rate_switch=str(attributes.get("CANFD_BRS", "1")) != "0", attributes=attributes)


def _layout(signal: Signal) -> SignalLayout:
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0.0):
        raise ValueError(f"signal {signal.name} has factor {scale} and offset {offset}; "
                         "allowed are finite numbers and a factor other than 0")
    return SignalLayout(
        name=signal.name, start=signal.start, length=signal.length,
        motorola=signal.byte_order == "big_endian",
        kind="float" if signal.is_float else "signed" if signal.is_signed else "unsigned",
        scale=scale, offset=offset,
        minimum=None if signal.minimum is None else float(signal.minimum),
        maximum=None if signal.maximum is None else float(signal.maximum),
        unit=signal.unit or "", comment=signal.comment or "",
        choices=MappingProxyType({int(k): str(v) for k, v in (signal.choices or {}).items()}),
        multiplexer=signal.multiplexer_signal,
        multiplexer_ids=tuple(signal.multiplexer_ids or ()))
