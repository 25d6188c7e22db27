"""The C library of firmware_stub, compiled for this machine and opened with cffi.

It is compiled on first use, by whatever C compiler there is, into the user's cache; the folder there carries a
digest of the sources and of the command, so another version never runs by mistake.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.resources
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from ipmsm_can._jit import cache_root

_COMPILERS = ("cc", "gcc", "clang")
_FOLDERS = ("include", "src", "codec", "ports/blocks")
_HEADER = Path("ports/blocks/blocks_port.h")
# Contraction of a * b + c is off so that every machine gives the same bits, as in firmware_stub/Makefile.
_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")


class FirmwareError(ValueError):
    """The C library cannot be had or used here; the text says what is missing."""


def sources_folder() -> Path:
    """Folder of the C library: inside the installed package, else in the source tree.

    Raises FirmwareError if neither is there.
    """
    installed = Path(str(importlib.resources.files("ipmsm_can"))) / "_data" / "firmware"
    source = Path(__file__).resolve().parents[2] / "firmware_stub"
    for path in (installed, source):
        if (path / _HEADER).is_file():
            return path
    raise FirmwareError(f"the C library is found neither at {installed} nor at {source}")


@functools.cache
def load() -> tuple[Any, Any]:
    """(ffi, lib) of ports/blocks/blocks_port.h.

    Raises FirmwareError without cffi, without a C compiler, or with one that fails.
    """
    try:
        import cffi
    except ImportError:
        raise FirmwareError("the C library is called through cffi, which is not installed; "
                            "`pip install 'ipmsm_can[firmware]'` brings it") from None
    folder = sources_folder()
    ffi = cffi.FFI()
    header = (folder / _HEADER).read_text("utf-8")
    ffi.cdef("\n".join(line for line in header.splitlines() if not line.startswith("#")))
    return ffi, ffi.dlopen(str(compiled(folder)))


def compiled(folder: Path) -> Path:
    """The shared library made of the sources in `folder`; compiled if the cache does not have it.

    Raises FirmwareError without a C compiler, or with one that fails.
    """
    command = [_compiler(), *_FLAGS, *(f"-I{folder / name}" for name in _FOLDERS),
               *(str(path) for path in _files(folder, ".c")), "-lm"]
    digest = hashlib.sha256("\0".join(command).encode())
    for path in (*_files(folder, ".c"), *_files(folder, ".h")):
        digest.update(path.read_bytes())
    target = _writable_cache() / f"firmware-{digest.hexdigest()[:16]}.so"
    if not target.is_file():
        _compile(command, target)
    return target


def _files(folder: Path, suffix: str) -> list[Path]:
    return sorted(path for name in _FOLDERS for path in (folder / name).rglob(f"*{suffix}"))


def _compiler() -> str:
    named = os.environ.get("CC")
    for name in (named,) if named else _COMPILERS:
        found = shutil.which(name)
        if found:
            return found
    if named:
        raise FirmwareError(f"the environment variable CC is {named!r}, and there is no such program; allowed is "
                            "the name of a C compiler")
    raise FirmwareError(f"the C library is compiled on first use, and none of {', '.join(_COMPILERS)} is "
                        "installed; install one or name it in the environment variable CC")


def _writable_cache() -> Path:
    root = cache_root()
    try:
        root.mkdir(parents=True, exist_ok=True)
        if os.access(root, os.W_OK):
            return root
    except OSError:
        pass
    return _temporary_cache()


@functools.cache
def _temporary_cache() -> Path:
    """For a read-only home: what is compiled there lasts as long as the machine leaves it."""
    return Path(tempfile.mkdtemp(prefix="ipmsm_can-"))


def _compile(command: list[str], target: Path) -> None:
    # Under another name first: two processes may compile at once, and nobody must open half a library.
    handle, name = tempfile.mkstemp(suffix=".so", dir=target.parent)
    os.close(handle)
    half_done = Path(name)
    try:
        done = subprocess.run([*command, "-o", name], capture_output=True, text=True, errors="replace", check=False)
        if done.returncode != 0:
            told = next((line for line in done.stderr.splitlines() if "error" in line), "it says nothing")
            raise FirmwareError(f"{command[0]} cannot compile the C library: {told.strip()}")
        half_done.replace(target)
    finally:
        half_done.unlink(missing_ok=True)
