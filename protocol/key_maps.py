"""The keys `keys`, `labels` and `playerNames` of the section `trial`: maps of names of the project's own.

Each function returns what is good of the map at this path, and what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from protocol import keyboard, values
from protocol.values import LONGEST_NAME, Keys, SectionProblem, checked

MAX_KEYS = 100
"""Keys of one player, and labels."""
_LABEL = values.text("the text of a button", LONGEST_NAME)
_NAME = values.text("what participants read", LONGEST_NAME)


def actions_of_keys(value: dict[str, Any], path: Keys) -> tuple[dict[str, Any], list[SectionProblem]]:
    """What the keys do: `{key: action}`, or such a map for each player."""
    if not value or not all(isinstance(each, dict) for each in value.values()):
        return _one_players_keys(value, path)
    read = {str(player): _one_players_keys(each, (*path, player)) for player, each in value.items()}
    return {player: found for player, (found, _) in read.items()}, [one for _, many in read.values() for one in many]


def _one_players_keys(value: dict[str, Any], path: Keys) -> tuple[dict[str, str], list[SectionProblem]]:
    found: dict[str, str] = {}
    problems: list[SectionProblem] = []
    known: dict[frozenset[str], str] = {}
    for name, action in value.items():
        here = (*path, name)
        key, wrong = checked(lambda text: keyboard.combination(str(text)), name, here)
        named, wrong_action = checked(_action, action, here)
        problems += wrong + wrong_action
        if wrong or wrong_action:
            continue
        same = known.setdefault(frozenset(keyboard.parts(key)), name)
        if same != name:
            problems.append(SectionProblem(here, f"is the same as {keyboard.shown(same)}; keep one of them"))
        found[key] = named
    return found, _few(value, problems, path)


def labels(value: dict[str, Any], path: Keys) -> tuple[dict[str, str], list[SectionProblem]]:
    """The texts of buttons: `{action: text}`."""
    return _texts(value, path, _action, _LABEL)


def player_names(value: dict[str, Any], path: Keys) -> tuple[dict[str, str], list[SectionProblem]]:
    """What participants read of players: `{player: text}`."""
    return _texts(value, path, str, _NAME)


def _texts(
    value: dict[str, Any], path: Keys, key: Callable[[Any], Any], text: Callable[[Any], Any]
) -> tuple[dict[str, str], list[SectionProblem]]:
    found: dict[str, str] = {}
    problems: list[SectionProblem] = []
    for given, said in value.items():
        here = (*path, given)
        name, wrong = checked(key, given, here)
        words, wrong_text = checked(text, said, here)
        problems += wrong + wrong_text
        if not wrong and not wrong_text:
            found[name] = words
    return found, _few(value, problems, path)


def _few(value: Mapping[str, Any], problems: list[SectionProblem], path: Keys) -> list[SectionProblem]:
    if len(value) <= MAX_KEYS:
        return problems
    return [*problems, SectionProblem(path, f"must have at most {MAX_KEYS} lines, not {len(value)}")]


def _action(value: object) -> str:
    """The name of an action as the trial has it, in small letters."""
    return values.action_name(value).lower()
