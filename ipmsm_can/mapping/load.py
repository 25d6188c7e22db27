"""From a TOML file to an `InverterMap`, and from anything wrong in it to one sentence; the shipped maps."""

from __future__ import annotations

import importlib.resources
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ipmsm_can.config.keys import in_toml
from ipmsm_can.config.load import nearest_word, shortened, toml_problem
from ipmsm_can.config.section import KeyProblem
from ipmsm_can.mapping.model import InverterMap


class MapError(ValueError):
    """A map that cannot be used; the text is one sentence: file, key, what was found and what is allowed."""


def map_folder() -> Path:
    """The folder of the maps that come with the program: inside the installed package, else in the source tree."""
    installed = Path(str(importlib.resources.files("ipmsm_can"))) / "_data" / "maps"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "dbc" / "maps"


def shipped_maps() -> dict[str, Path]:
    """Path of every map that comes with the program, by name."""
    return {path.stem: path for path in sorted(map_folder().glob("*.toml"))}


def map_path(map_or_path: str | Path) -> Path:
    """The path itself, or that of the shipped map of this name.  Raises MapError where there is neither."""
    path = Path(map_or_path)
    if path.is_file() or path.name != str(map_or_path) or path.suffix:
        return path
    shipped = shipped_maps()
    if path.name not in shipped:
        guess = nearest_word(path.name, list(shipped))
        hint = f"did you mean {guess}? " if guess else ""
        raise MapError(f"{path}: there is neither such a file nor a shipped map of this name; {hint}"
                       f"shipped are {', '.join(shipped)}")
    return shipped[path.name]


def load_map(map_or_path: str | Path) -> InverterMap:
    """The map in a TOML file, or the shipped one of this name; paths in it are relative to its folder.

    Raises MapError.
    """
    path = map_path(map_or_path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise MapError(f"{path}: there is no such file; shipped maps are {', '.join(shipped_maps())}") from None
    except OSError as error:
        raise MapError(f"{path}: the file cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: byte {error.start} is not UTF-8; a TOML file is text in UTF-8") from None
    return parse_map(text, str(path), path.parent)


def parse_map(text: str, source: str = "map.toml", folder: str | Path = ".") -> InverterMap:
    """The map in TOML text.  source: its name in messages; folder: where its paths start.  Raises MapError."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MapError(f"{source}: {toml_problem(str(error), text)}") from None
    except (ValueError, RecursionError) as error:
        raise MapError(f"{source}: not valid TOML: {error}") from None
    try:
        return InverterMap.model_validate(data, context={"folder": Path(folder)})
    except ValidationError as error:
        # A misspelt key is told before the missing one that it leaves behind.
        problems = sorted(error.errors(include_url=False), key=lambda problem: problem["type"] == "missing")
        others = len(problems) - 1
        more = f" (and {others} more problem{'s' if others > 1 else ''})" if others else ""
        raise MapError(f"{source}: {_sentence(problems[0], data)}{more}") from None


def _sentence(problem: Any, data: Mapping[str, Any]) -> str:
    path = [str(part) for part in problem["loc"][:2]]
    sections = InverterMap.sections()
    if problem["type"] == "extra_forbidden":
        return _unknown(path)
    if problem["type"] == "missing":
        if len(path) == 1:
            keys = ", ".join(sections[path[0]].model_fields)
            return f"the section [{path[0]}] is missing; it has the keys {keys}"
        return f"{'.'.join(path)} is missing; allowed is {sections[path[0]].keys()[path[1]].allowed}"
    if problem["type"] == "value_error":
        cause = problem["ctx"]["error"]
        if isinstance(cause, KeyProblem):
            return _wrong([*path, *cause.key.split(".")], cause.allowed, data)
        return _wrong(path, str(cause), data)
    if len(path) == 1:
        return _wrong(path, f"a table with the keys {', '.join(sections[path[0]].model_fields)}", data)
    return _wrong(path, f"something else: {problem['msg']}", data)


def _wrong(path: list[str], allowed: str, data: Mapping[str, Any]) -> str:
    value: Any = data
    for part in path:
        value = value.get(part) if isinstance(value, Mapping) else None
    dotted = ".".join(path)
    if value is None:
        return f"{dotted} is missing; allowed is {allowed}"
    return f"{dotted} is {shortened(in_toml(value))}; allowed is {allowed}"


def _unknown(path: list[str]) -> str:
    sections = InverterMap.sections()
    known = list(sections) if len(path) == 1 else list(sections[path[0]].model_fields)
    guess = nearest_word(path[-1], known)
    hint = f"; did you mean {guess}?" if guess else ""
    where = "a map" if len(path) == 1 else f"[{path[0]}]"
    return f"{'.'.join(path)} is not a known key{hint} ({where} allows {', '.join(known)})"
