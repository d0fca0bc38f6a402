"""The class of a rule, and functions that make the usual kinds of rules."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from tests.infra.situations import Installation, Resource

Template = dict[str, Any]
Faults = Callable[[Installation], Iterable[str]]
Spoil = Callable[[Template], None]


@dataclass(frozen=True)
class Rule:
    """What AWS accepts of a property (`path`) of a type, and where that stands (`source`).

    `faults` finds what an installation has against it, in sentences; `spoil` changes a template so that it finds some.
    """

    kind: str
    path: str
    accepts: str
    source: str
    faults: Faults
    spoil: Spoil

    def __str__(self) -> str:
        return f"{self.kind.removeprefix('AWS::')} {self.path}: {self.accepts}"


def values(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """What lies at a path such as `Rules.*.Prefix`, with the place; nothing where a part of it is missing."""
    head, _, rest = path.partition(".")
    if not path:
        yield "", value
    elif head == "*":
        found = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
        for key, item in found:
            yield from ((f"{key}.{place}".rstrip("."), inner) for place, inner in values(item, rest))
    elif isinstance(value, dict) and head in value:
        yield from ((f"{head}.{place}".rstrip("."), inner) for place, inner in values(value[head], rest))


def put(value: Any, path: str, new: Any) -> None:
    """Set what lies at a path, in the first item of each list; what is missing on the way is made."""
    head, _, rest = path.partition(".")
    if isinstance(value, list):
        if not value:
            value.append({})
        if rest:
            put(value[0], rest, new)
        else:
            value[0] = new
        return
    if not rest:
        value[head] = new
        return
    if head not in value:
        value[head] = [] if rest.startswith("*") else {}
    put(value[head], rest, new)


def first(template: Template, kind: str) -> dict[str, Any]:
    """Return the properties of the template's first resource of a type."""
    found: dict[str, Any] = next(one for one in template["Resources"].values() if one["Type"] == kind)["Properties"]
    return found


def setting(kind: str, path: str, new: Any) -> Spoil:
    """Return a function that breaks a template by one value."""
    return lambda template: put(first(template, kind), path, new)


def text(
    kind: str,
    path: str,
    source: str,
    *,
    most: int | None = None,
    pattern: str | None = None,
    spoiled: Any = None,
    accepts: str = "",
) -> Iterator[Rule]:
    """Rules for a text: at most so many characters, and the pattern of all of it. Two limits make two rules."""
    if most is not None:
        yield Rule(
            kind,
            path,
            f"at most {most} characters",
            source,
            lambda there: (
                f"{where} has {len(said)} characters" for where, said in _texts(there, kind, path) if len(said) > most
            ),
            setting(kind, path, "x" * (most + 1)),
        )
    if pattern is not None:
        yield Rule(
            kind,
            path,
            accepts or f"characters as in {pattern}",
            source,
            lambda there: (
                f"{where} is {said!r}" for where, said in _texts(there, kind, path) if not re.fullmatch(pattern, said)
            ),
            setting(kind, path, spoiled),
        )


def _texts(there: Installation, kind: str, path: str) -> Iterator[tuple[str, str]]:
    for one in there.of(kind):
        for where, found in values(one.properties, path):
            yield f"{one.name}.{where}", str(found)


def number(kind: str, path: str, source: str, least: float, most: float) -> Rule:
    """Return a number in a range."""
    return Rule(
        kind,
        path,
        f"from {least:,} to {most:,}",
        source,
        lambda there: (
            f"{where} is {said}" for where, said in _texts(there, kind, path) if not least <= float(said) <= most
        ),
        setting(kind, path, most + 1),
    )


def one_of(kind: str, path: str, source: str, allowed: Collection[Any]) -> Rule:
    """One of these values."""
    names = {str(one) for one in allowed}
    return Rule(
        kind,
        path,
        f"one of {', '.join(sorted(names))}",
        source,
        lambda there: (f"{where} is {said}" for where, said in _texts(there, kind, path) if said not in names),
        setting(kind, path, "something-else"),
    )


def each(
    kind: str,
    path: str,
    accepts: str,
    source: str,
    wrong: Callable[[Resource, Installation], Iterable[str]],
    spoil: Spoil,
) -> Rule:
    """Return a rule for each resource of a type by itself; `wrong` says what is wrong with one."""
    return Rule(
        kind,
        path,
        accepts,
        source,
        lambda there: (f"{one.name}: {what}" for one in there.of(kind) for what in wrong(one, there)),
        spoil,
    )
