"""Every key of the configuration with its description, as a TOML file that loads."""

from __future__ import annotations

import inspect
import textwrap

from ipmsm_can.config.keys import Key, in_toml
from ipmsm_can.config.model import DriveConfig
from ipmsm_can.motor import PRESETS

_WIDTH = 98


def explain() -> str:
    """A commented TOML file: each key with its meaning, unit, range and default.

    It loads as it stands, with one preset motor and the defaults; keys without a constant default stand as
    commented-out examples.  Every word comes from the fields of the model.
    """
    lines = _comment("Configuration of one drive. A number may be written plain, in the unit given, or as a "
                     'string with one of the units listed, such as "7.6 mH".')
    for name, section in DriveConfig.sections().items():
        lines += ["", *_comment(inspect.getdoc(section) or ""), f"[{name}]"]
        for field, key in section.keys().items():
            lines += ["", *_entry(field, key, section.model_fields[field].default)]
    return "\n".join(lines) + "\n"


def _entry(name: str, key: Key, default: object) -> list[str]:
    text = f"{key.doc} Allowed: {key.allowed}."
    if default is not None:
        return [*_comment(f"{text} Default: {in_toml(default)}."), f"{name} = {in_toml(default)}"]
    # The one key that a file cannot do without is written out.
    mark = "" if key.example in PRESETS else "# "
    return [*_comment(f"{text} Default: {key.default}."), f"{mark}{name} = {in_toml(key.example)}"]


def _comment(text: str) -> list[str]:
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += textwrap.wrap(" ".join(paragraph.split()), _WIDTH, break_long_words=False)
    return [f"# {line}" for line in lines]
