"""SavvyCAN's CSV (GVRET), and what a CSV is: that one, or python-can's.

    Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
    166064000,0000021A,false,0,8,FE,36,12,FE,69,05,07,AD,

Time stamps are microseconds of the adapter's clock; newer versions have a column Dir (Rx or Tx) before Bus.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    import can

_COLUMNS_OF_PYTHON_CAN = 7


class SavvyCanReader:
    """Messages of such a text, as python-can's readers give them.  Raises ValueError with the line's number."""

    def __init__(self, lines: TextIO, header: list[str]) -> None:
        self._lines = lines
        self._at = {name: k for k, name in enumerate(header)}

    def __iter__(self) -> Iterator[can.Message]:
        for number, line in enumerate(self._lines, 2):
            if line.strip():
                try:
                    yield self._message([field.strip() for field in line.split(",")])
                except (ValueError, IndexError) as error:
                    raise ValueError(f"line {number} is no frame: {line.strip()[:60]!r}") from error

    def _message(self, fields: list[str]) -> can.Message:
        import can

        at = self._at
        length, first = int(fields[at["len"]]), at["d1"]
        data = bytes(int(byte, 16) for byte in fields[first:first + length])
        if len(data) < length or length > 64:
            raise ValueError("bytes are missing")
        return can.Message(
            timestamp=1e-6 * int(fields[at["time stamp"]]), arbitration_id=int(fields[at["id"]], 16),
            is_extended_id=fields[at["extended"]].lower() in ("true", "1"), is_fd=length > 8, data=data,
            is_rx="dir" not in at or fields[at["dir"]].lower() != "tx", channel=fields[at["bus"]])

    def stop(self) -> None:
        """Nothing to let go of: the lines are closed by who opened them."""


def csv_reader(lines: TextIO) -> Any:
    """The reader for a CSV, by its first line.  Raises ValueError where that is neither of the two."""
    import can

    begin = lines.readline()
    header = [name.strip().lower() for name in begin.split(",")]
    if {"time stamp", "id", "extended", "bus", "len", "d1"} <= set(header):
        return SavvyCanReader(lines, header)
    if begin and len(header) != _COLUMNS_OF_PYTHON_CAN:
        raise ValueError(f"its first line is {begin.strip()[:60]!r}; allowed are the columns of python-can "
                         "(timestamp,arbitration_id,extended,remote,error,dlc,data) and of SavvyCAN (Time Stamp,ID,"
                         "Extended,Bus,LEN,D1,...)")
    return can.CSVReader(_Again(begin, lines))  # type: ignore[arg-type]


class _Again:
    """Lines with their first put back."""

    def __init__(self, first: str, rest: TextIO) -> None:
        self._first = [first] if first else []
        self._rest = rest

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        return self._first.pop() if self._first else next(self._rest)

    def read(self) -> str:
        """python-can takes an object for a file where it has this."""
        return ""

    def close(self) -> None:
        """The lines are closed by who opened them."""
