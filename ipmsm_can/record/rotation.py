"""When a recording goes on in another file, and what that is called."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from ipmsm_can.config.units import Unit
from ipmsm_can.logs.source import LogError

SIZE = Unit("bytes", {"B": Fraction(1), "kB": Fraction(10**3), "MB": Fraction(10**6), "GB": Fraction(10**9),
                      "KiB": Fraction(2**10), "MiB": Fraction(2**20), "GiB": Fraction(2**30)})
DURATION = Unit("s", {"s": Fraction(1), "min": Fraction(60), "h": Fraction(3600), "d": Fraction(86400)})
_LEAST_SIZE, _LEAST_TIME = 10_000.0, 1.0


@dataclass(frozen=True, slots=True)
class Rotation:
    """A new file once the present one has `size` bytes or holds `seconds` of the bus; None: never for that.

    Both are looked at about twice a second, so files are larger or longer by as much.
    Raises ValueError below 10 kB or 1 s.
    """

    size: float | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.size is not None and self.size < _LEAST_SIZE:
            raise ValueError(f"a file of the recording is to have {self.size:g} bytes; allowed is 10 kB or more")
        if self.seconds is not None and self.seconds < _LEAST_TIME:
            raise ValueError(f"a file of the recording is to last {self.seconds:g} s; allowed is 1 s or more")

    @property
    def on(self) -> bool:
        """There will be several files, so they are numbered."""
        return self.size is not None or self.seconds is not None

    def due(self, size: int, seconds: float) -> bool:
        """Whether the present file has enough."""
        return (self.size is not None and size >= self.size) or (
            self.seconds is not None and seconds >= self.seconds)


class Names:
    """The names of the files of a recording: the path itself, or with rotation run_001.blf and so on, behind the
    highest number there is.  No file that exists is ever overwritten.

    Raises LogError where the path itself exists, or its folder does not.
    """

    def __init__(self, path: Path, rotation: Rotation) -> None:
        self._path = path
        self._number = 0
        if not path.parent.is_dir():
            raise LogError(f"{path}: the folder {path.parent} does not exist")
        if path.is_dir():
            raise LogError(f"{path} is a folder; allowed is the name of a new file")
        kept = 2 if path.suffix.lower() == ".gz" else 1
        suffix = "".join(path.suffixes[-kept:])
        self._stem, self._suffix = path.name[:len(path.name) - len(suffix)], suffix
        self._numbered = rotation.on
        if not self._numbered and path.exists():
            raise LogError(f"{path} exists, and recordings are never overwritten; allowed is a new name "
                           "(--rotate-size and --rotate-time number the files)")
        if self._numbered:
            pattern = re.compile(re.escape(self._stem) + r"_(\d+)" + re.escape(suffix))
            found = [pattern.fullmatch(p.name) for p in path.parent.iterdir()]
            self._number = max((int(m[1]) for m in found if m), default=0)

    def following(self) -> Path:
        """The name of the next file."""
        if not self._numbered:
            return self._path
        self._number += 1
        return self._path.with_name(f"{self._stem}_{self._number:03d}{self._suffix}")
