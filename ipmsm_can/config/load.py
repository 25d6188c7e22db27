"""From a TOML file to a `DriveConfig`, and from anything wrong in it to one sentence."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ipmsm_can.config.keys import in_toml
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.config.section import KeyProblem
from ipmsm_can.motor import PRESETS


class ConfigError(ValueError):
    """A configuration that cannot be used; the text is one sentence: file, key, what it got and allows."""


def load_config(path: str | Path) -> DriveConfig:
    """The configuration in a TOML file; paths in it are relative to its folder.

    Raises ConfigError.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file; "
                          "ipmsm-can config --explain prints one to start from") from None
    except OSError as error:
        raise ConfigError(f"{path}: the file cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is not UTF-8; a TOML file is text in UTF-8") from None
    return parse_config(text, source=str(path), folder=path.parent)


def load_configs(paths: Iterable[str | Path]) -> tuple[DriveConfig, ...]:
    """The configurations of several drives on one bus, each with a node number of its own.

    Raises ConfigError.
    """
    configs: list[DriveConfig] = []
    owner: dict[int, str | Path] = {}
    for path in paths:
        config = load_config(path)
        node = config.wire.node
        if node in owner:
            raise ConfigError(f"{path}: wire.node is {node}, which {owner[node]} has already; "
                              "allowed is another node for each drive on the bus")
        owner[node] = path
        configs.append(config)
    return tuple(configs)


def parse_config(text: str, source: str = "drive.toml", folder: str | Path = ".") -> DriveConfig:
    """The configuration in TOML text.  source: its name in messages; folder: where its paths start.

    Raises ConfigError.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: {toml_problem(str(error), text)}") from None
    except ValueError as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from None  # a number of thousands of digits
    except RecursionError:
        raise ConfigError(f"{source}: brackets are nested too deeply for a configuration") from None
    return config_from(data, source, folder)


def config_from(data: Mapping[str, Any], source: str = "drive.toml", folder: str | Path = ".") -> DriveConfig:
    """The configuration in a mapping of sections, as `tomllib` gives it.

    Raises ConfigError.
    """
    try:
        return DriveConfig.model_validate(dict(data), context={"folder": Path(folder)})
    except ValidationError as error:
        # A misspelt [motor] is told before the missing one that it leaves behind.
        problems = sorted(error.errors(include_url=False), key=lambda problem: problem["type"] == "missing")
        others = len(problems) - 1
        more = f" (and {others} more problem{'s' if others > 1 else ''})" if others else ""
        raise ConfigError(f"{source}: {_sentence(problems[0], data)}{more}") from None


def toml_problem(message: str, text: str) -> str:
    at = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    what = message[: at.start()] if at else message
    line = int(at[1]) if at and at[1] else len(text.splitlines()) or 1
    column = f", column {at[2]}" if at and at[2] else ""
    return f"line {line}{column}: not valid TOML: {what[:1].lower()}{what[1:]}"


def _sentence(problem: Any, data: Mapping[str, Any]) -> str:
    path = [str(part) for part in problem["loc"][:2]]
    if problem["type"] == "extra_forbidden":
        return _unknown(path, data)
    if problem["type"] == "missing":
        return _no_motor()
    if problem["type"] == "value_error":
        cause = problem["ctx"]["error"]
        if isinstance(cause, KeyProblem):
            path = [*path, *cause.key.split(".")]
            return _wrong(path, cause.allowed, data, cause.missing)
        return _wrong(path, str(cause), data)
    if len(path) == 1:
        return _wrong(path, f"a table with the keys {_keys(path[0])}", data)
    return _wrong(path, f"something else: {problem['msg']}", data)


def _wrong(path: list[str], allowed: str, data: Mapping[str, Any], missing: bool = False) -> str:
    value: Any = data
    for part in path:
        value = value.get(part) if isinstance(value, Mapping) else None
    dotted = ".".join(path)
    if missing and value is None:
        return f"{dotted} is missing; allowed is {allowed}"
    if value is None:
        return f"{dotted} is {in_toml(_default(path))} by default; allowed is {allowed}"
    return f"{dotted} is {shortened(in_toml(value))}; allowed is {allowed}"


def shortened(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:90]}... ({len(text)} characters)"


def _default(path: list[str]) -> Any:
    section, key = path
    return DriveConfig.sections()[section].model_fields[key].default


def _unknown(path: list[str], data: Mapping[str, Any]) -> str:
    sections = DriveConfig.sections()
    what = "section" if len(path) == 1 and isinstance(data.get(path[0]), dict) else "key"
    known = list(sections) if len(path) == 1 else list(sections[path[0]].model_fields)
    everywhere = [f"{section}.{key}" for section, model in sections.items() for key in model.model_fields]
    # A key that exists in another section was put into the wrong one; only then it may be misspelt.
    homes = [key for key in everywhere if key.split(".")[1] == path[-1] and what == "key"]
    nearest = nearest_word(path[-1], known)
    guess = homes[0] if homes else ".".join([*path[:-1], nearest]) if nearest else None
    hint = f"; did you mean {guess}?" if guess else ""
    names = ", ".join(known)
    allowed = f"allowed sections are {names}" if len(path) == 1 else f"[{path[0]}] allows {names}"
    return f"{'.'.join(path)} is not a known {what}{hint}" + (f" ({allowed})" if hint else f"; {allowed}")


def nearest_word(word: str, known: list[str]) -> str | None:
    folded = {name.lower(): name for name in reversed(known)}
    match = difflib.get_close_matches(word.lower(), folded, n=1, cutoff=0.6)
    return folded[match[0]] if match else None


def _keys(section: str) -> str:
    return ", ".join(DriveConfig.sections()[section].model_fields)


def _no_motor() -> str:
    presets = " or ".join(in_toml(name) for name in PRESETS)
    return (f"the section [motor] is missing; allowed is [motor] with preset = {presets}, or with its own "
            f"values ({_keys('motor')})")
