"""The cache of compiled kernels: old ones go, those that another process may be using stay."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numba
import pytest

from ipmsm_can import _jit


def test_only_caches_unused_for_a_month_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    day = 86400.0
    for k in range(8):
        folder = tmp_path / f"kernels-{k}"
        (folder / "wire").mkdir(parents=True)
        # Four that were used within the last hours, as by several checkouts at work, and four from long ago.
        age = 3600.0 * k if k < 4 else day * (35 + k)
        os.utime(folder, (time.time() - age,) * 2)
    more = [tmp_path / f"kernels-of-today-{k}" for k in range(4)]
    for folder in more:
        folder.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)
    _jit._select_cache()
    own = Path(numba.config.CACHE_DIR)
    assert own.parent == tmp_path
    assert sorted(tmp_path.iterdir()) == sorted([*(tmp_path / f"kernels-{k}" for k in range(4)), *more, own])
