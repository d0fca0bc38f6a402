"""Checks `keys`, `labels` and `playerNames` in the section `trial`: maps whose names the project chooses.

Each function gets such a map and its path, and returns the valid entries and the problems.
"""

from __future__ import annotations

from typing import Any

from hippodrome.protocol import keyboard, values
from hippodrome.protocol.section_keys import map_of, too_many
from hippodrome.protocol.values import MAX_NAME, KeyPath, SectionProblem, checked

MAX_KEYS = 100
"""The largest number of entries in one map: keys of one player, labels, or names."""


def _action(value: object) -> str:
    """The name of an action in small letters, as the trial server has it."""
    return values.action_name(value).lower()


def actions_of_keys(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, Any], list[SectionProblem]]:
    """Check `keys`: a map `{key: action}`, or such a map for each player.

    Returns the valid entries, and the problems.
    """
    if not value or not all(isinstance(key_map, dict) for key_map in value.values()):
        return _one_players_keys(value, path)
    by_player: dict[str, Any] = {}
    problems: list[SectionProblem] = []
    for player, keys in value.items():
        by_player[str(player)], wrong = _one_players_keys(keys, (*path, player))
        problems += wrong
    return by_player, problems


def _one_players_keys(value: dict[str, Any], path: KeyPath) -> tuple[dict[str, str], list[SectionProblem]]:
    by_key: dict[str, str] = {}
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
        by_key[key] = action_name
    return by_key, problems + too_many(value, path, MAX_KEYS)


labels = map_of(_action, values.text("the text of a button", MAX_NAME), MAX_KEYS)
"""Checks `labels`, the texts of buttons: `{action: text}`."""
player_names = map_of(str, values.text("what participants read", MAX_NAME), MAX_KEYS)
"""Checks `playerNames`, the players' names for participants: `{player: text}`."""
