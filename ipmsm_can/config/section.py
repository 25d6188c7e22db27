"""A table of the configuration file, and how something wrong in it is said."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from ipmsm_can.config.keys import Key


class KeyProblem(ValueError):
    """Keys that do not fit together.  key: the one to blame, dotted or inside the section; allowed: in words.

    missing: the key has to be there and is not.
    """

    def __init__(self, key: str, allowed: str, missing: bool = False) -> None:
        super().__init__(f"{key}: allowed is {allowed}")
        self.key = key
        self.allowed = allowed
        self.missing = missing


class Section(BaseModel):
    """A table of the file: every field is a key and carries one `Key` that reads and describes it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def keys(cls) -> dict[str, Key]:
        """The keys of the section in their order."""
        return {
            name: next(item for item in field.metadata if isinstance(item, Key))
            for name, field in cls.model_fields.items()
        }

    @field_validator("*", mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        assert info.field_name is not None
        return cls.keys()[info.field_name].read(value)
