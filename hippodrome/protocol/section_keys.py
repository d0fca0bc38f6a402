"""Declares the keys of config.yml's sections, and checks a section by its declaration.

A section is a dataclass with the base `Section`; each of its fields is a key, declared by one of these functions with
its check, default, meaning and JSON Schema. `hippodrome/control/config/schema.py` makes the schema for editors and the
tables of docs/config.md from the same declarations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

from hippodrome.protocol import values
from hippodrome.protocol.values import Check, KeyPath, SectionProblem, checked, is_blank

UNKNOWN_KEY = "unknown key"
"""The sentence of a problem with a key that is not declared."""

Entries = Callable[[Any, KeyPath], tuple[Any, list[SectionProblem]]]
"""Gets a map whose names the project chooses, and its path; returns its valid entries, and the problems."""


@dataclass(frozen=True, slots=True)
class Section:
    """A section of config.yml. A key without a value counts as not given, and has its default."""

    given_keys: frozenset[str] = field(default=frozenset(), compare=False, repr=False, kw_only=True)
    """The names of the keys for which the file has a valid value."""

    def given(self, key: str) -> bool:
        """Return whether the file has a valid value for this key; `key` is its name in the file."""
        return key in self.given_keys

    def without(self, names: Collection[object]) -> Self:
        """Return the section as if the file did not have the keys of these names."""
        defaults = type(self)()
        left_out = [key.attribute for key in keys(type(self)) if key.name in names]
        keys_given = frozenset(self.given_keys.difference(names))
        return dataclasses.replace(
            self, given_keys=keys_given, **{attribute: getattr(defaults, attribute) for attribute in left_out}
        )


_Declared = TypeVar("_Declared", bound=Section)


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
    needed: bool = False
    """Whether every study needs the key."""
    together: bool = False
    """Whether the key is for games of several participants."""
    kind: str = ""
    """The possible values in words, for docs/config.md; "" if the schema says enough."""
    otherwise: str = ""
    """The default in words, for docs/config.md; "" if the value says enough."""
    example: str = ""
    """A value as YAML, for docs/config.md."""
    each: Check | None = None
    """If the value is a list: the check of each item."""
    section: type[Section] | None = None
    """If the value is a section of its own: the class of its keys."""
    entries: Entries | None = None
    """If the value is a map whose names the project chooses: the check of its entries."""


def key(check: Check, default: Any, meaning: str, schema: Mapping[str, Any], **more: Any) -> Any:
    """Declare a key. `more` are further attributes of `Key`. With the default {} each section gets a map of its own.

    The name in the file is the attribute in camel case, unless `more` has a `name`.
    """
    metadata = {"check": check, "meaning": meaning, "schema": schema, **more}
    if default == {}:
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


def flag(default: bool, meaning: str, **more: Any) -> Any:
    """Declare a key that is true or false."""
    return key(values.flag, default, meaning, {"type": "boolean"}, **more)


def whole(low: int, high: int, default: int | None, meaning: str, **more: Any) -> Any:
    """Declare a key that is a whole number from `low` to `high`."""
    schema = {"type": "integer", "minimum": low, "maximum": high}
    return key(values.whole(low, high), default, meaning, schema, **more)


def seconds(most: int, default: float, meaning: str, *, least: float = 0, **more: Any) -> Any:
    """Declare a key that is a number of seconds from `least` to `most`."""
    schema = {"type": "number", "minimum": least, "maximum": most}
    return key(values.number(least, most), default, meaning, schema, **more)


def choice(words: tuple[str, ...], meaning: str, **more: Any) -> Any:
    """Declare a key that is one of these words; the first is the default."""
    return key(values.one_of(*words), words[0], meaning, {"enum": list(words)}, **more)


def text(default: str | None, meaning: str, check: Check | None = None, **more: Any) -> Any:
    """Declare a key that is a text; without a check, of up to 500 characters."""
    return key(check or values.text(), default, meaning, {"type": "string"}, **more)


def items(
    item: str,
    limit: int,
    check: Check,
    default: tuple[str, ...],
    meaning: str,
    *,
    single: bool = False,
    **more: Any,
) -> Any:
    """Declare a key that is a list of at most `limit` texts; with `single`, one of them may stand there by itself."""
    schema = {"items": {"type": "string"}, "type": ["array", "string"] if single else "array"}
    return key(values.items(item, limit, single), default, meaning, schema, each=check, **more)


def section(kind: type[Section], default: Section | None, meaning: str, line: str = "", **more: Any) -> Any:
    """Declare a key that is a section of its own; `line` is one line of it, for messages."""
    check = values.section(line or f"{min(names(kind))}: …")
    return key(check, default, meaning, {"$ref": f"#/$defs/{kind.__name__}"}, section=kind, **more)


def texts(line: str, meaning: str, entries: Entries, **more: Any) -> Any:
    """Declare a key that maps names, which the project chooses, to texts; `line` is one line of it, for messages."""
    schema = {"type": "object", "additionalProperties": {"type": ["string", "number"]}}
    return key(values.section(line), {}, meaning, schema, entries=entries, **more)


def others(entries: Entries, schema: Mapping[str, Any]) -> Any:
    """Declare the field for all keys of a section that are not declared; `schema` describes them. Default: ()."""
    return field(default=(), metadata={"others": entries, "schema": schema})


def map_of(name: Check, value: Check, limit: int | None = None) -> Entries:
    """Return the check of a map of at most `limit` entries, whose names and values pass these checks."""

    def entries(section: Mapping[Any, Any], path: KeyPath) -> tuple[dict[Any, Any], list[SectionProblem]]:
        found: dict[Any, Any] = {}
        problems: list[SectionProblem] = []
        for key, item in section.items():
            checked_name, wrong = checked(name, key, (*path, key))
            checked_value, wrong_value = checked(value, item, (*path, key))
            problems += wrong + wrong_value
            if not wrong and not wrong_value:
                found[checked_name] = checked_value
        return found, problems + (too_many(section, path, limit) if limit else [])

    return entries


def too_many(section: Mapping[Any, Any], path: KeyPath, limit: int) -> list[SectionProblem]:
    """Return the problem, in a list, of a map with more than `limit` entries."""
    if len(section) <= limit:
        return []
    return [SectionProblem(path, f"must have at most {limit} lines, not {len(section)}")]


def check_section(
    kind: type[_Declared], written: Mapping[str, Any], path: KeyPath = ()
) -> tuple[_Declared, list[SectionProblem]]:
    """Return the values of a section, and all its problems. `path` is the path of the section. Never raises.

    `written` holds JSON values, or texts and `values.Plain`. Of a wrong value the valid part stays, if it is a section
    or a map, else the default takes its place. Problems with keys that are not declared have the sentence
    `UNKNOWN_KEY`.
    """
    values: dict[str, Any] = {}
    valid: set[str] = set()
    problems: list[SectionProblem] = []
    for key in keys(kind):
        value = written.get(key.name)
        # An empty map leaves a section as it is by default.
        if is_blank(value) or (value == {} and isinstance(key.default, Section)):
            continue
        value, wrong = _value(key, value, (*path, key.name))
        problems += wrong
        if value is not None:
            values[key.attribute] = value
            valid.add(key.name)
    unknown = {name: value for name, value in written.items() if name not in names(kind)}
    declared = others_of(kind)
    if declared is None:
        problems += [SectionProblem((*path, name), UNKNOWN_KEY) for name in unknown]
    else:
        values[declared.name], wrong = declared.metadata["others"](unknown, path)
        problems += wrong
    return kind(given_keys=frozenset(valid), **values), problems


def _value(key: Key, value: Any, path: KeyPath) -> tuple[Any, list[SectionProblem]]:
    """The value of a key, or the valid part of it, or None; and the problems."""
    value, wrong = checked(key.check, value, path)
    if wrong:
        return None, wrong
    if key.each:
        read = [checked(key.each, item, (*path, index)) for index, item in enumerate(value)]
        wrong = [problem for _, problems in read for problem in problems]
        return None if wrong else tuple(item for item, _ in read), wrong
    if key.entries:
        return key.entries(value, path)
    return check_section(key.section, value, path) if key.section and value is not None else (value, [])


def document(section: Section) -> dict[str, Any]:
    """Return a section as JSON, with every default filled in, and with the project's own controls if it is `ui`."""
    values = {key.name: _json(getattr(section, key.attribute)) for key in keys(type(section))}
    return values | dict.fromkeys(getattr(section, "own", ()), True)


def _json(value: Any) -> Any:
    if isinstance(value, Section):
        return document(value)
    return list(value) if isinstance(value, tuple) else value


def keys(section: type[Section]) -> tuple[Key, ...]:
    """Return the keys of a section, in the order of its fields."""
    declared_keys = []
    for declared in dataclasses.fields(section):
        if "check" in declared.metadata:
            default = None if declared.default is dataclasses.MISSING else declared.default
            facts: dict[str, Any] = {"name": _camel(declared.name), "attribute": declared.name, "default": default}
            declared_keys.append(Key(**facts | dict(declared.metadata)))
    return tuple(declared_keys)


def names(section: type[Section]) -> frozenset[str]:
    """Return the names of a section's keys, as they stand in the file."""
    return frozenset(key.name for key in keys(section))


def others_of(section: type[Section]) -> dataclasses.Field[Any] | None:
    """Return the field for the keys that are not declared; None if the section may have no such keys."""
    return next((field for field in dataclasses.fields(section) if "others" in field.metadata), None)


def sections_in(section: type[Section], path: KeyPath = ()) -> dict[KeyPath, type[Section]]:
    """Return this section and all sections in it, by path."""
    sections = {path: section}
    for key in keys(section):
        if key.section:
            sections |= sections_in(key.section, (*path, key.name))
    return sections


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(other.capitalize() for other in others)
