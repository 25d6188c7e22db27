"""The one place where kernels are compiled.

Every hot loop of the package is a function decorated with `kernel`.  It is compiled by numba in
nopython mode, without fast-math (so that the same samples give the same bits whatever the block
partition) and without the GIL, and the machine code is cached on disk.

numba's own cache notices a change of the file a kernel stands in, but not of a file whose kernels it
calls, or whose constants it takes.  A `git pull` could therefore leave stale machine code behind; so the cache
folder carries a digest of every source file of the package that holds kernels or is imported by one that does.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

_F = TypeVar("_F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(rb"^from (ipmsm_can[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_CACHES_KEPT = 4
_UNUSED_S = 30 * 86400.0
"""A cache folder that no process began to use for so long may go; a younger one may still be written to."""


def _kernel_sources() -> list[Path]:
    """Every file of the package with kernels, and what those files import from it: constants are compiled in."""
    source = {path: path.read_bytes() for path in _PACKAGE.rglob("*.py")}
    wanted = [path for path, text in source.items() if b"@kernel" in text]
    found: set[Path] = set()
    while wanted:
        path = wanted.pop()
        if path in found:
            continue
        found.add(path)
        for module, names in _IMPORT.findall(source[path]):
            folder = _PACKAGE.joinpath(*module.decode().split(".")[1:])
            files = [folder.with_suffix(".py"),
                     *(folder / f"{name}.py" for name in re.findall(r"\w+", names.decode()))]
            wanted += [file for file in files if file in source]
    return sorted(found)


def _kernel_digest() -> str:
    digest = hashlib.sha256()
    for path in _kernel_sources():
        digest.update(path.relative_to(_PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Folder for what is compiled on this machine; it need not exist."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "ipmsm_can"


def _select_cache() -> None:
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    root = Path(chosen) if chosen else cache_root()
    folder = root / f"kernels-{_kernel_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        older = sorted(root.glob("kernels-*"), key=lambda p: p.stat().st_mtime)[:-_CACHES_KEPT]
        for path in older:
            if time.time() - path.stat().st_mtime > _UNUSED_S:
                shutil.rmtree(path, ignore_errors=True)
    except OSError:
        return  # a read-only home: numba then falls back to __pycache__ or a folder of its own
    numba.config.CACHE_DIR = str(folder)


_select_cache()


def kernel(function: _F) -> _F:
    """Compile `function` as a cached nopython kernel; a division by zero gives inf or nan, as in NumPy."""
    compiled: _F = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled
