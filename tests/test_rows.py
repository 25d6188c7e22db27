"""Files of rows: every number as Python writes it, and what cannot be written."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.bus.rows import COLUMNS, RowBlock, check_rows_path, open_rows


def some_rows(reals: list[float]) -> RowBlock:
    n = len(reals)
    x = np.array(reals)
    flag = (np.arange(n) % 2).astype(np.uint8)
    return RowBlock(np.arange(n) + (1 << 32) - n, flag, np.arange(n) / 7000.0, x, -x, 1 - flag, flag, flag, x, x, x)


@given(st.lists(st.floats() | st.floats(-10, 10) | st.integers(-10**6, 10**6).map(lambda k: k / 1000),
                min_size=1, max_size=20))
def test_numbers_are_written_as_python_writes_them(tmp_path_factory: pytest.TempPathFactory,
                                                   reals: list[float]) -> None:
    path = tmp_path_factory.mktemp("rows") / "a.csv"
    rows = some_rows(reals)
    file = open_rows(path)
    file.write(rows)
    file.close()
    with path.open(newline="") as stream:
        table = list(csv.reader(stream))
    assert tuple(table[0]) == COLUMNS
    for k, line in enumerate(table[1:]):
        assert line[0] == str(rows.sample[k])
        assert [line[1], line[5], line[6], line[7]] == [str(int(v[k])) for v in (
            rows.filled, rows.valid, rows.locked, rows.injecting)]
        assert abs(float(line[2]) - rows.time_s[k]) < 6e-10
        for text, value in zip(line[3:5], (reals[k], -reals[k]), strict=True):
            if abs(value) < 1e-280:
                assert abs(float(text)) <= 1e-280
            elif math.isinf(float(format(value, ".10g"))):
                assert float(text) in (value, math.copysign(math.inf, value))  # ten digits round it up to there
            elif math.isfinite(value):
                # the last digit may differ where the eleventh is a five
                assert float(text) == pytest.approx(value, rel=5.1e-10)
                assert len(text) <= len(format(value, ".10g")) + 1
            else:
                assert text == format(value, ".10g")
        assert line[8] == line[9] == line[10] == line[3]
    assert len(table) == len(reals) + 1


@pytest.mark.parametrize("value", [0.1, 1.0, 123456.0, 9999999999.0, 9.99999999996, 1e10, 1e-4, 9.99e-5, 0.00012345,
                                   3.14159265358979, 1e100, 2.5e-100, 1e22, 512.0, 1000.5])
def test_the_layout_of_a_number(tmp_path: Path, value: float) -> None:
    file = open_rows(tmp_path / "a.csv")
    file.write(some_rows([value]))
    file.close()
    assert (tmp_path / "a.csv").read_text().splitlines()[1].split(",")[3] == format(value, ".10g")


def test_parquet_keeps_every_bit(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rng = np.random.default_rng(0)
    rows = some_rows(rng.normal(size=1000).tolist())
    file = open_rows(tmp_path / "a.parquet")
    file.write(rows)
    file.write(rows)
    file.close()
    table = parquet.read_table(tmp_path / "a.parquet")
    assert tuple(table.column_names) == COLUMNS
    for name in COLUMNS:
        assert np.array_equal(table[name].to_numpy(), np.tile(getattr(rows, name), 2)), name


@pytest.mark.parametrize(("name", "words"), [("a.txt", "allowed are .csv and .parquet"), ("a", "suffix ''"),
                                             ("nowhere/a.csv", "does not exist")])
def test_paths_that_cannot_be(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_rows_path(tmp_path / name)


def test_without_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ValueError, match="needs the package pyarrow"):
        check_rows_path(tmp_path / "a.parquet")


def test_a_full_disk_is_an_error(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    link = tmp_path / "a.csv"
    link.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space"):
        file = open_rows(link)
        file.write(some_rows([1.0]))
        file.close()
