"""Checks `keys`, `labels` and `playerNames` in the section `trial`: maps whose names the project chooses.

Each function gets such a map and its path, and returns the valid entries and the problems.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hippodrome.protocol import keyboard, values
from hippodrome.protocol.values import MAX_NAME, KeyPath, SectionProblem, checked

MAX_KEYS = 100
"""The largest number of entries in one map: keys of one player, labels, or names."""
_LABEL = values.text("the text of a button", MAX_NAME)
_NAME = values.text("what participants read", MAX_NAME)


def actions_of_keys(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, Any], list[SectionProblem]]:
    """Check `keys`: a map `{key: action}`, or such a map for each player.

    Returns the valid entries, and the problems.
    """
    if not value or not all(isinstance(each, dict) for each in value.values()):
        return _one_players_keys(value, path)
    found: dict[str, Any] = {}
    problems: list[SectionProblem] = []
    for player, keys in value.items():
        found[str(player)], wrong = _one_players_keys(keys, (*path, player))
        problems += wrong
    return found, problems


def _one_players_keys(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, str], list[SectionProblem]]:
    found: dict[str, str] = {}
    problems: list[SectionProblem] = []
    names: dict[frozenset[str], str] = {}  # by combination: the same one can be written in several ways
    for name, action in value.items():
        here = (*path, name)
        key, wrong = checked(lambda text: keyboard.combination(str(text)), name, here)
        action_name, wrong_action = checked(_action, action, here)
        problems += wrong + wrong_action
        if wrong or wrong_action:
            continue
        first = names.setdefault(frozenset(keyboard.parts(key)), name)
        if first != name:
            problems.append(SectionProblem(here, f"is the same as {keyboard.shown(first)}; keep one of them"))
        found[key] = action_name
    return found, problems + _too_many(value, path)


def labels(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, str], list[SectionProblem]]:
    """Check `labels`, the texts of buttons: `{action: text}`.

    Returns the valid entries, and the problems.
    """
    return _texts(value, path, _action, _LABEL)


def player_names(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, str], list[SectionProblem]]:
    """Check `playerNames`, the players' names for participants: `{player: text}`.

    Returns the valid entries, and the problems.
    """
    return _texts(value, path, str, _NAME)


def _texts(
    value: dict[str, Any], path: KeyPath, key: Callable[[Any], Any], text: Callable[[Any], Any]
) -> tuple[dict[str, str], list[SectionProblem]]:
    found: dict[str, str] = {}
    problems: list[SectionProblem] = []
    for name, item in value.items():
        here = (*path, name)
        checked_name, wrong = checked(key, name, here)
        checked_text, wrong_text = checked(text, item, here)
        problems += wrong + wrong_text
        if not wrong and not wrong_text:
            found[checked_name] = checked_text
    return found, problems + _too_many(value, path)


def _too_many(value: Mapping[str, Any], path: KeyPath) -> list[SectionProblem]:
    if len(value) <= MAX_KEYS:
        return []
    return [SectionProblem(path, f"must have at most {MAX_KEYS} lines, not {len(value)}")]


def _action(value: object) -> str:
    """The name of an action in small letters, as the trial server has it."""
    return values.action_name(value).lower()
