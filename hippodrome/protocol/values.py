"""Checks single values of config.yml. A check returns the value, or raises ValueError with what to write instead.

A check accepts a value of any type: texts, `Plain` values from YAML, and JSON values.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

Check = Callable[[object], object]
KeyPath = tuple[str | int, ...]
"""The path of a value: keys and, in lists, positions from 0."""
MAX_NAME = 64
"""Characters of the name of an action, a player, or one of the project's own controls."""

_WHOLE = re.compile(r"[-+]?[0-9]{1,18}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,18}(\.[0-9]{0,18})?|\.[0-9]{1,18})")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_STEP_FILE = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_ .-]{0,98}[A-Za-z0-9_-])?")
_SURROGATE = re.compile("[\ud800-\udfff]")
_OPTIONS_LENGTH, _OPTIONS_DEPTH = 4096, 8  # characters, levels; ECS allows 8192 characters for all variables


@dataclass(frozen=True, slots=True)
class Plain:
    """A number or true/false as YAML understood it, and the text that was written."""

    value: int | float | bool
    text: str


class SectionProblem(NamedTuple):
    """A mistake in the section `trial`: the path of the key below `trial`, and a sentence that says what to write.

    `compared` has the keys that a rule compares (`trial_check.py`); it is empty if the value is wrong by itself.
    """

    path: KeyPath
    sentence: str
    compared: tuple[str, ...] = ()


def is_blank(value: object) -> bool:
    """Return whether this is the value of a key that was left empty. Such a key counts as not given."""
    return value is None or value == ""


def checked(check: Check, value: object, path: KeyPath) -> tuple[Any, list[SectionProblem]]:
    """Return the result of the check and no problem, or None and the problem at this path."""
    try:
        return check(value), []
    except ValueError as error:
        return None, [SectionProblem(path, str(error))]


def show(value: object) -> str:
    """Return the value for a message: short, in quotes if it is a text, without invisible characters."""
    if isinstance(value, Plain):
        return printable(value.text)
    if isinstance(value, str) and value:
        return f'"{printable(value)}"'
    if is_blank(value):
        return "empty"
    if isinstance(value, bool | float) or (isinstance(value, int) and abs(value) < 10**18):
        return json.dumps(value)
    return "a map" if isinstance(value, dict) else "a list" if isinstance(value, list | tuple) else "such a value"


def printable(text: str, limit: int = 60) -> str:
    """Return the first `limit` characters of the text, with `?` for each invisible character."""
    text = text if len(text) <= limit else text[: limit - 1] + "…"
    return "".join(char if char.isprintable() else "?" for char in text)


def path_text(path: KeyPath) -> str:
    """Return the path as text: `trial.actionSpace item 3`."""
    words = ""
    for part in path:
        words += f" item {part + 1}" if isinstance(part, int) else f".{printable(part)}"
    return words.lstrip(".")


def as_text(value: object, expected: str) -> str:
    """Return a value that must be a text. Raises ValueError, which says that the value must be `expected`."""
    if isinstance(value, Plain) and isinstance(value.value, bool):
        raise ValueError(
            f'must be {expected}; YAML reads {value.text} as true or false, so write "{value.text}" in quotes'
        )
    if isinstance(value, Plain):
        return value.text
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be {expected}, not {show(value)}")
    if _CONTROL.search(value.strip()):
        raise ValueError(f"must be {expected}; take out its tabs, line ends and invisible characters")
    return value.strip()


def text(expected: str = "text", limit: int = 500) -> Check:
    """Return a check for a text of up to `limit` characters; `expected` names it in messages."""

    def check(value: object) -> str:
        text = as_text(value, expected)
        if len(text) > limit:
            raise ValueError(f"must be at most {limit} characters long, not {len(text)}")
        return text

    return check


def action_name(value: object) -> str:
    """Return the name of an action. A number is a name, too, in YAML with the digits of the file. Raises ValueError."""
    return str(_ACTION_NAME(str(value) if isinstance(value, int) and not isinstance(value, bool) else value))


_ACTION_NAME = text("the name of an action", MAX_NAME)


def step_file(text: str) -> str:
    """Return the name of a file in the folder of pages, without `.html`. Raises ValueError with what to write."""
    stem = text.removesuffix(".html")
    if "/" in text or "\\" in text:
        raise ValueError(f"must be the name of a file in the steps folder, without folders, not {show(text)}")
    if not _STEP_FILE.fullmatch(stem) or ".." in stem:
        letters = "letters (a to z), digits, spaces, dots, dashes and underscores"
        raise ValueError(f"file names may hold {letters}; rename {show(text)}")
    return stem


def number_in(value: object) -> int | float | None:
    """Return the number in a YAML or JSON number, or in a text such as "30".

    The result is None for any other value, infinity and NaN included.
    """
    if isinstance(value, Plain):
        value = value.value
    if isinstance(value, str) and _WHOLE.fullmatch(value.strip()):
        return int(value)
    if isinstance(value, str) and _DECIMAL.fullmatch(value.strip()):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return value if isinstance(value, int) or math.isfinite(value) else None


def whole(low: int, high: int) -> Check:
    """Return a check for a whole number from `low` to `high`, also as text."""

    def check(value: object) -> int:
        number = number_in(value)
        if number is None or number != int(number) or not low <= number <= high:
            raise ValueError(f"must be a whole number from {low} to {high}, not {show(value)}")
        return int(number)

    return check


def number(low: float, high: int) -> Check:
    """Return a check for a number from `low` to `high`, also as text. The check returns a whole number as an int."""

    def check(value: object) -> float:
        number = number_in(value)
        if number is None or not low <= number <= high:
            raise ValueError(f"must be a number from {low} to {high}, not {show(value)}")
        return int(number) if number == int(number) else number

    return check


def flag(value: object) -> bool:
    """Return the bool in `true` or `false`, also written as yes/no or on/off. Raises ValueError."""
    if isinstance(value, Plain):
        value = value.value if isinstance(value.value, bool) else value
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.strip().lower() in _WORDS:
        return _WORDS[value.strip().lower()]
    raise ValueError(f"must be true or false, not {show(value)}")


def one_of(*choices: str) -> Check:
    """Return a check for one of these words."""

    def check(value: object) -> str:
        if isinstance(value, str) and value.strip() in choices:
            return value.strip()
        raise ValueError(f"must be {' or '.join(choices)}, not {show(value)}")

    return check


def items(item: str, limit: int, single: bool = False) -> Callable[[object], list[object]]:
    """Return a check for a list of at most `limit` items; `item` names one in messages.

    With `single`, the check also accepts a single text, and returns a list with this text.
    """

    def check(value: object) -> list[object]:
        if single and isinstance(value, str | Plain):
            return [value]
        if not isinstance(value, list | tuple):
            raise ValueError(f"must be a list: a line with a dash for each {item}, not {show(value)}")
        if len(value) > limit:
            raise ValueError(f"must have at most {limit} items, not {len(value)}")
        return list(value)

    return check


def section(example: str) -> Check:
    """Return a check for a map of keys; `example` is one line of it, for messages."""

    def check(value: object) -> object:
        if not isinstance(value, dict):
            raise ValueError(f'must be a section: indented lines such as "{example}" below it, not {show(value)}')
        return value

    return check


def options(value: object) -> dict[str, object]:
    """Return a map of options as JSON values.

    Raises ValueError if it holds anything else, is nested too deep, or is too long.
    """
    if not isinstance(value, dict):
        raise ValueError(f'must be a map: indented lines such as "difficulty: 3" below it, not {show(value)}')
    options_read = _json_map(value, _OPTIONS_DEPTH)
    length = len(json.dumps(options_read, separators=(",", ":")))
    if length > _OPTIONS_LENGTH:
        raise ValueError(f"must be at most {_OPTIONS_LENGTH} characters long when written as JSON, not {length}")
    return options_read


def _json_map(value: dict[object, object], depth: int) -> dict[str, object]:
    return {str(_json(key, 0)): _json(item, depth - 1) for key, item in value.items()}


def _json(value: object, depth: int) -> object:
    """The value as JSON. Raises ValueError if more than `depth` lists and maps are nested in each other."""
    if isinstance(value, Plain):
        value = value.value
    if isinstance(value, dict | list):
        if not depth:
            raise ValueError(f"must be nested no more than {_OPTIONS_DEPTH} deep")
        return _json_map(value, depth) if isinstance(value, dict) else [_json(item, depth - 1) for item in value]
    if (
        value is None
        or (isinstance(value, str) and not _SURROGATE.search(value))
        or (isinstance(value, int) and abs(value) < 2**63)
        or (isinstance(value, float) and math.isfinite(value))
    ):
        return value
    raise ValueError("must be text, numbers, true or false, lists and maps; one of the values is none of these")
