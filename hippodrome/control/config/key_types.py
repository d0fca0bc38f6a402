"""The types of sections and keys: pydantic's models, with Hippodrome's own checks and messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic.alias_generators import to_camel
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from hippodrome.protocol import values
from hippodrome.protocol.values import Check


@dataclass(frozen=True, eq=False)  # equal only to itself, so that it can be hashed
class Rule:
    """Validates a field by `check`, whose message the researcher reads; `schema` describes the field to editors."""

    check: Check
    schema: Mapping[str, Any] = field(default_factory=lambda: {"type": "string"})

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, _schema: CoreSchema, _handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return dict(self.schema)


def whole(low: int, high: int) -> Rule:
    """Return the rule for a whole number from `low` to `high`."""
    return Rule(values.whole(low, high), {"type": "integer", "minimum": low, "maximum": high})


def one_of(*choices: str) -> Rule:
    """Return the rule for one of these words."""
    return Rule(values.one_of(*choices), {"enum": list(choices)})


def items(item: str, limit: int, single: bool = False) -> BeforeValidator:
    """Return the validator for a list of at most `limit` items (`values.items`)."""
    return BeforeValidator(values.items(item, limit, single))


class Model(BaseModel):
    """A section of the file. A key without a value counts as not given."""

    model_config = ConfigDict(frozen=True, extra="forbid", alias_generator=to_camel)

    @classmethod
    def names(cls) -> frozenset[str]:
        """Return the names of the section's keys, as they stand in the file."""
        return frozenset(info.alias or name for name, info in cls.model_fields.items())

    def given(self, key: str) -> bool:
        """Return whether the file has a valid value for this key; `key` is its name in the file."""
        return any(type(self).model_fields[name].alias == key for name in self.model_fields_set)

    @model_validator(mode="before")
    @classmethod
    def _drop_empty(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        return {key: value for key, value in data.items() if not values.is_blank(value) or key not in cls.names()}
