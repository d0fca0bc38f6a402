"""Declares the keys of the section `trial`: each has a check, a default, a meaning and a JSON Schema.

The fields of `TrialSection` and of the sections in it call these functions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hippodrome.protocol import values
from hippodrome.protocol.values import Check, KeyPath, SectionProblem


@dataclass(frozen=True)
class Key:
    """A key of a section: its name in the file, and the attribute that holds its value."""

    name: str
    attribute: str
    check: Check
    default: Any
    """The value if the file does not have the key; None for an empty map."""
    meaning: str
    schema: Mapping[str, Any]
    """JSON Schema of the value, for editors."""
    each: Check | None = None
    """If the value is a list: the check of each item."""
    section: type[Any] | None = None
    """If the value is a section of its own: the class of its keys."""
    entries: Callable[[Any, KeyPath], tuple[Any, list[SectionProblem]]] | None = None
    """If the value is a map whose names the project chooses: gets the map and its path, returns its valid entries and
    the problems (`hippodrome/protocol/key_maps.py`)."""


def key(check: Check, default: Any, meaning: str, schema: Mapping[str, Any], **more: Any) -> Any:
    """Declare a key. `more` are further attributes of `Key`. With the default {} each section gets a map of its own."""
    metadata = {"check": check, "meaning": meaning, "schema": schema, **more}
    if default == {}:
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


def flag(default: bool, meaning: str) -> Any:
    """Declare a key that is true or false."""
    return key(values.flag, default, meaning, {"type": "boolean"})


def whole(low: int, high: int, default: int | None, meaning: str) -> Any:
    """Declare a key that is a whole number from `low` to `high`."""
    schema = {"type": "integer", "minimum": low, "maximum": high}
    return key(values.whole(low, high), default, meaning, schema)


def seconds(most: int, default: float, meaning: str, *, least: float = 0) -> Any:
    """Declare a key that is a number of seconds from `least` to `most`."""
    return key(values.number(least, most), default, meaning, {"type": "number", "minimum": least, "maximum": most})


def choice(words: tuple[str, ...], meaning: str) -> Any:
    """Declare a key that is one of these words; the first is the default."""
    return key(values.one_of(*words), words[0], meaning, {"enum": list(words)})


def texts(example: str, meaning: str, entries: Callable[[Any, KeyPath], tuple[Any, list[SectionProblem]]]) -> Any:
    """Declare a key that maps names, which the project chooses, to texts."""
    schema = {"type": "object", "additionalProperties": {"type": ["string", "number"]}}
    return key(values.section(example), {}, meaning, schema, entries=entries)


def document(section: Any) -> dict[str, Any]:
    """Return a section as JSON, with every default filled in, and with the project's own controls if it is `ui`."""
    found = {key.name: _json(getattr(section, key.attribute), key.section is not None) for key in keys(type(section))}
    return found | dict.fromkeys(getattr(section, "own", ()), True)


def _json(value: Any, section: bool) -> Any:
    if section and value is not None:
        return document(value)
    return list(value) if isinstance(value, tuple) else value


def keys(section: type[Any]) -> tuple[Key, ...]:
    """Return the keys of a section, in the order of its fields."""
    found = []
    for each in dataclasses.fields(section):
        if not each.metadata:
            continue
        default = None if each.default is dataclasses.MISSING else each.default
        found.append(Key(name=_camel(each.name), attribute=each.name, default=default, **each.metadata))
    return tuple(found)


def names(section: type[Any]) -> frozenset[str]:
    """Return the names of a section's keys, as they stand in the file."""
    return frozenset(key.name for key in keys(section))


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(other.capitalize() for other in others)
