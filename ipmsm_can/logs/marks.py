"""Remarks in a log, between its frames: where a recording has a gap and why, what was lost, what a person noted.

candump's text, ASC and TRC hold them as comment lines, BLF as global markers.  The other formats have no place for
them: they get a text file of such lines beside the log, NAME.marks.txt.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

KEPT = 10_000
"""Marks of a log that are kept while it is read."""

SIGNS = {".asc": "//", ".trc": ";"}
"""How a comment line begins, where not with '#'."""

_LINE = re.compile(rb"^(?:#|//|;) \((\d{1,10})\.(\d{1,9})\) ([^\r\n]*)", re.MULTILINE)
_BEGIN, _END = "gap begins: ", "gap ends: "
_SECONDS = re.compile(r"(\d+\.\d+) s without a bus")


@dataclass(frozen=True, slots=True)
class Mark:
    """t_ns: time [ns] on the axis of the frames.  text: one line."""

    t_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Gap:
    """A time [ns] without a bus; ended_ns is None where the recording ended in it.  reason: what was said then."""

    began_ns: int
    ended_ns: int | None
    reason: str

    @property
    def seconds(self) -> float:
        """How long it was [s]; 0 where the recording ended in it."""
        return 0.0 if self.ended_ns is None else 1e-9 * (self.ended_ns - self.began_ns)


def gap_begins(t_ns: int, reason: str) -> Mark:
    """The bus went away."""
    return Mark(t_ns, f"{_BEGIN}{reason}")


def gap_ends(began_ns: int, t_ns: int) -> Mark:
    """It is back."""
    return Mark(t_ns, f"{_END}{max(0, t_ns - began_ns) * 1e-9:.3f} s without a bus")


def gaps(marks: Iterable[Mark]) -> list[Gap]:
    """The gaps that these marks tell of, in their order; an end without its beginning (which is in the file before)
    counts from as long before as it says."""
    found: list[Gap] = []
    for mark in marks:
        if mark.text.startswith(_BEGIN):
            found.append(Gap(mark.t_ns, None, mark.text.removeprefix(_BEGIN)))
        elif mark.text.startswith(_END):
            if found and found[-1].ended_ns is None:
                found[-1] = Gap(found[-1].began_ns, mark.t_ns, found[-1].reason)
            elif told := _SECONDS.search(mark.text):
                found.append(Gap(mark.t_ns - round(1e9 * float(told[1])), mark.t_ns, ""))
    return found


def one_line(text: str) -> str:
    """The text without line ends and control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def as_comment(mark: Mark, sign: str = "#") -> str:
    """The mark as a comment line."""
    micro = max(0, mark.t_ns) // 1000
    return f"{sign} ({micro // 1_000_000:010d}.{micro % 1_000_000:06d}) {one_line(mark.text)}\n"


def from_comments(text: bytes) -> list[Mark]:
    """The marks among the lines of a text."""
    return [Mark(int(m[1]) * 10**9 + int(m[2].ljust(9, b"0")), m[3].decode("utf-8", "replace").strip())
            for m in _LINE.finditer(text)]


def note(kept: list[Mark], more: Sequence[Mark]) -> None:
    """Keep these marks, too, up to KEPT in all."""
    kept.extend(more[:max(0, KEPT - len(kept))])


def beside(log: Path) -> Path:
    """The file with the marks of a log whose format holds none."""
    return log.with_name(f"{log.name}.marks.txt")
