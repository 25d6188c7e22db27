"""One row per sample in a file: the result of a replay as CSV or Parquet, whole blocks at a time.

A log of an hour holds tens of millions of samples.  Python's own formatting would take a minute for each
million; so CSV text is made by a kernel that works on the arrays, and Parquet is left to pyarrow.
"""

from __future__ import annotations

import math
import queue
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel

if TYPE_CHECKING:
    import pyarrow

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

COLUMNS = ("sample", "filled", "time_s", "theta_rad", "omega_rad_s", "valid", "locked", "injecting",
           "excitation", "lambda_alpha", "lambda_beta")
"""The columns of every file, in this order."""

SUFFIXES = (".csv", ".parquet")

_DIGITS = 10
_LOWEST = 10 ** (_DIGITS - 1)
_HIGHEST = 10 ** _DIGITS
_POWERS = 10.0 ** np.arange(309)
_TINY = 1e-290
"""Below this a number is written as 0: the powers of ten end there, and no quantity of ours gets there."""
_NANO = 1_000_000_000
_LOG10_2 = math.log10(2.0)
_HUNDRED = np.uint64(100)
_TENS = np.array([48 + k // 10 for k in range(100)], np.uint8)
_ONES = np.array([48 + k % 10 for k in range(100)], np.uint8)
_INF, _MINUS_INF, _NAN = (int.from_bytes(word) for word in (b"inf", b"-inf", b"nan"))
_BLOCKS_AHEAD = 4
_ROW_BYTES = 10 + 1 + 30 + 5 * 18 + 4 + len(COLUMNS)


@dataclass(frozen=True, slots=True)
class RowBlock:
    """N rows; the fields are COLUMNS, each (N,) and C-contiguous.

    sample int64 (0..2^32-1); filled, valid, locked, injecting uint8 (0 or 1); time_s [s]; theta_rad
    [rad electrical]; omega_rad_s [rad/s electrical]; excitation [V^2 s]; lambda_alpha, lambda_beta [Wb].
    """

    sample: NDArray[np.int64]
    filled: Bytes
    time_s: Floats
    theta_rad: Floats
    omega_rad_s: Floats
    valid: Bytes
    locked: Bytes
    injecting: Bytes
    excitation: Floats
    lambda_alpha: Floats
    lambda_beta: Floats

    def __len__(self) -> int:
        return len(self.sample)


class RowFile(Protocol):
    """A file that takes rows; complete after `close`, and readable up to the last `write` at any time (CSV)."""

    path: Path

    def write(self, rows: RowBlock) -> None:
        """Append rows."""

    def close(self) -> None:
        """Finish the file."""


@kernel
def _put_word(word: int, count: int, out: Bytes, at: int) -> int:
    """The last `count` bytes of a number as characters, highest first."""
    for j in range(count):
        out[at + j] = (word >> 8 * (count - 1 - j)) & 0xFF
    return at + count


@kernel
def _put_digits(digits: int, count: int, out: Bytes, at: int) -> int:
    """Exactly `count` digits, leading zeros included."""
    left = np.uint64(digits)
    j = at + count
    while j >= at + 2:
        rest = left // _HUNDRED
        pair = left - rest * _HUNDRED
        out[np.uint64(j - 1)] = _ONES[pair]
        out[np.uint64(j - 2)] = _TENS[pair]
        left = rest
        j -= 2
    if j > at:
        out[np.uint64(at)] = _ONES[left % _HUNDRED]
    return at + count


@kernel
def _put_whole(value: int, out: Bytes, at: int) -> int:
    """A whole number of 0 or more."""
    width = 1
    limit = 10
    while value >= limit and width < 19:
        limit *= 10
        width += 1
    return _put_digits(value, width, out, at)


@kernel
def _put_seconds(value: float, out: Bytes, at: int) -> int:
    """Seconds of 0 or more to the nanosecond, without trailing zeros."""
    whole = int(value)
    nano = int((value - whole) * _NANO + 0.5)
    if nano >= _NANO:
        whole += 1
        nano -= _NANO
    at = _put_whole(whole, out, at)
    if nano == 0:
        return at
    out[at] = 46
    at = _put_digits(nano, 9, out, at + 1)
    while out[at - 1] == 48:
        at -= 1
    return at


@kernel
def _put_scientific(digits: int, count: int, exponent: int, out: Bytes, at: int) -> int:
    _put_digits(digits, count, out, at + 1)
    out[at] = out[at + 1]
    if count > 1:
        out[at + 1] = 46
        at += count + 1
    else:
        at += 1
    out[at] = 101  # e
    out[at + 1] = 45 if exponent < 0 else 43
    size = abs(exponent)
    return _put_digits(size, 2 if size < 100 else 3, out, at + 2)


@kernel
def _put_real(value: float, out: Bytes, at: int) -> int:
    """A number with ten significant digits, as Python's format(value, ".10g") writes it."""
    if not np.isfinite(value):
        if value > 0.0:
            return _put_word(_INF, 3, out, at)
        if value < 0.0:
            return _put_word(_MINUS_INF, 4, out, at)
        return _put_word(_NAN, 3, out, at)
    if value < 0.0:
        out[at] = 45
        at += 1
        value = -value
    if value < _TINY:
        out[at] = 48
        return at + 1
    # log10(2) times the binary exponent: right or one too low
    exponent = int(np.floor((math.frexp(value)[1] - 1) * _LOG10_2))
    shift = _DIGITS - 1 - exponent
    scaled = value * _POWERS[shift] if shift >= 0 else value / _POWERS[-shift]
    if scaled >= _HIGHEST:
        scaled /= 10.0
        exponent += 1
    digits = int(np.rint(scaled))
    if digits == _HIGHEST:
        digits = _LOWEST
        exponent += 1
    count = _DIGITS
    while digits % 10 == 0 and count > 1:
        digits //= 10
        count -= 1
    if exponent < -4 or exponent >= _DIGITS:
        return _put_scientific(digits, count, exponent, out, at)
    if exponent < 0:
        out[at] = 48
        out[at + 1] = 46
        at = _put_digits(0, -exponent - 1, out, at + 2)
        return _put_digits(digits, count, out, at)
    if count <= exponent + 1:
        at = _put_digits(digits, count, out, at)
        return _put_digits(0, exponent + 1 - count, out, at)
    # one place more than needed, then the part before the point moved one to the left
    _put_digits(digits, count, out, at + 1)
    for j in range(at, at + exponent + 1):
        out[j] = out[j + 1]
    out[at + exponent + 1] = 46
    return at + count + 1


@kernel
def format_rows(sample: NDArray[np.int64], filled: Bytes, time_s: Floats, theta: Floats, omega: Floats,
                valid: Bytes, locked: Bytes, injecting: Bytes, excitation: Floats, lambda_a: Floats,
                lambda_b: Floats, out: Bytes) -> int:
    """Write CSV lines into out (uint8, room for 160 bytes a row); returns how many bytes."""
    at = 0
    for k in range(sample.shape[0]):
        at = _put_whole(sample[k], out, at)
        out[at] = 44
        out[at + 1] = 48 + filled[k]
        out[at + 2] = 44
        at = _put_seconds(time_s[k], out, at + 3)
        out[at] = 44
        at = _put_real(theta[k], out, at + 1)
        out[at] = 44
        at = _put_real(omega[k], out, at + 1)
        out[at] = 44
        out[at + 1] = 48 + valid[k]
        out[at + 2] = 44
        out[at + 3] = 48 + locked[k]
        out[at + 4] = 44
        out[at + 5] = 48 + injecting[k]
        out[at + 6] = 44
        at = _put_real(excitation[k], out, at + 7)
        out[at] = 44
        at = _put_real(lambda_a[k], out, at + 1)
        out[at] = 44
        at = _put_real(lambda_b[k], out, at + 1)
        out[at] = 10
        at += 1
    return at


def warm_up() -> None:
    """Compile or load the kernel behind CSV before there is anything to measure."""
    whole, real, flag = np.zeros(1, np.int64), np.zeros(1), np.zeros(1, np.uint8)
    format_rows(whole, flag, real, real, real, flag, flag, flag, real, real, real, np.empty(_ROW_BYTES, np.uint8))


class CsvRows:
    """CSV with a header line; floats with ten significant digits, seconds to the nanosecond, flags 0 or 1.

    Every `write` reaches the operating system at once, so an interrupted run leaves whole rows behind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: IO[bytes] = path.open("wb", buffering=0)
        self._file.write((",".join(COLUMNS) + "\n").encode())
        self._text = np.empty(0, np.uint8)

    def write(self, rows: RowBlock) -> None:
        """Append rows."""
        room = len(rows) * _ROW_BYTES
        if self._text.size < room:
            self._text = np.empty(room, np.uint8)
        size = format_rows(rows.sample, rows.filled, rows.time_s, rows.theta_rad, rows.omega_rad_s, rows.valid,
                           rows.locked, rows.injecting, rows.excitation, rows.lambda_alpha, rows.lambda_beta,
                           self._text)
        left = memoryview(self._text.data)[:size]
        while left:
            left = left[self._file.write(left):]

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


class ParquetRows:
    """Parquet, one row group per `write`; flags are booleans, all else is kept to the last bit.

    A Parquet file can be read only after `close`.
    """

    def __init__(self, path: Path) -> None:
        import pyarrow
        import pyarrow.parquet

        self.path = path
        kinds = dict.fromkeys(COLUMNS, pyarrow.float64())
        kinds |= dict.fromkeys(("filled", "valid", "locked", "injecting"), pyarrow.bool_())
        kinds["sample"] = pyarrow.uint32()
        self._schema: pyarrow.Schema = pyarrow.schema(list(kinds.items()))
        self._writer: Any = pyarrow.parquet.ParquetWriter(path, self._schema)

    def write(self, rows: RowBlock) -> None:
        """Append rows."""
        import pyarrow

        columns = [pyarrow.array(_as_stored(getattr(rows, name)), self._schema.field(name).type)
                   for name in COLUMNS]
        self._writer.write_table(pyarrow.Table.from_arrays(columns, schema=self._schema))

    def close(self) -> None:
        """Write the footer that makes the file readable."""
        self._writer.close()


class BackgroundRows:
    """Another RowFile, written by a thread of its own while the next block is computed.

    An error of the thread is raised by the next `write` or by `close`.
    """

    def __init__(self, file: RowFile) -> None:
        self.path = file.path
        self._file = file
        self._error: BaseException | None = None
        self._queue: queue.Queue[RowBlock | None] = queue.Queue(_BLOCKS_AHEAD)
        self._thread = threading.Thread(target=self._work, name=f"rows {file.path.name}", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while (rows := self._queue.get()) is not None:
            if self._error is None:
                try:
                    self._file.write(rows)
                except BaseException as error:
                    self._error = error

    def write(self, rows: RowBlock) -> None:
        """Hand over rows; waits while the thread is more than a few blocks behind."""
        self._raise()
        self._queue.put(rows)

    def close(self) -> None:
        """Wait until everything is written and finish the file."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
            self._file.close()
        self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error


def _as_stored(column: NDArray[Any]) -> NDArray[Any]:
    if column.dtype == np.uint8:
        return column.view(np.bool_)
    return column.astype(np.uint32) if column.dtype == np.int64 else column


def check_rows_path(path: Path) -> None:
    """Raise ValueError, before any work is done, if rows cannot be written to this path."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} has the suffix {path.suffix!r}; allowed are {' and '.join(SUFFIXES)}")
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError:
            raise ValueError(f"{path}: Parquet needs the package pyarrow, which is not installed; "
                             "install it (pip install pyarrow) or write .csv") from None
    if path.is_dir():
        raise ValueError(f"{path} is a folder; allowed is the path of a file")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")


def open_rows(path: Path) -> RowFile:
    """A new file for rows, its format by its suffix: .csv or .parquet; an existing one is replaced.

    Raises ValueError for another suffix, a missing folder or missing pyarrow; OSError if it cannot be written.
    """
    check_rows_path(path)
    return BackgroundRows(CsvRows(path) if path.suffix.lower() == ".csv" else ParquetRows(path))
