"""Reads the names of keys in config.yml, as in `KeyboardEvent.key`, with `+` between keys that are held together.

Checks also the maps of `trial` whose names the project chooses: `keys`, `labels` and `playerNames`. These checks get
such a map and its path, and return the valid entries and the problems.

Source of the names: https://www.w3.org/TR/uievents-key/. A letter is the same key with Shift and without.
"""

from __future__ import annotations

import re
from typing import Any

from hippodrome.protocol import values
from hippodrome.protocol.section_keys import map_of, too_many
from hippodrome.protocol.similar import nearest
from hippodrome.protocol.values import MAX_NAME, KeyPath, SectionProblem, checked, printable, show

MAX_TOGETHER = 4
"""The largest number of keys that may be joined by `+`."""
MAX_KEYS = 100
"""The largest number of entries in one map: keys of one player, labels, or names."""

_SPACE = " "
_NAMED = frozenset(
    {"ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Enter", "Shift"}
    | {"Home", "End", "PageUp", "PageDown", "Insert", "Delete", "Backspace"}
)
_RESERVED = {
    "Tab": "it moves the focus to the next button, which people without a mouse need",
    "Escape": "browsers leave the full screen with it",
    **dict.fromkeys(("Control", "Alt", "AltGraph", "Meta", "OS", "Fn"), "browsers take it for their own commands"),
    **dict.fromkeys(("ContextMenu", "PrintScreen", "CapsLock", "NumLock", "ScrollLock"), "it is the system's own"),
    **{f"F{number}": "browsers have commands of their own for it" for number in range(1, 25)},
}
_OTHER_NAMES = {
    **{name.lower().removeprefix("arrow"): name for name in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown")},
    "spacebar": "Space",
    "return": "Enter",
    "esc": "Escape",
    "ctrl": "Control",
    "del": "Delete",
    "plus": "+",
    "comma": ",",
    "period": ".",
    "minus": "-",
    "slash": "/",
}
_CODE = re.compile(r"(?:Key([A-Z])|(?:Digit|Numpad)([0-9]))")  # KeyboardEvent.code

_PART = re.compile(r"(\+|[^+]+)(?:\+|$)")
_SPACED = re.compile(r"\s\+\s+$|^\s+\+\s")
_JOINED = re.compile(r"(?:\+|[^+]+)(?:\+(?:\+|[^+]+))*")


def key_name(text: str) -> str:
    """Return the name of the key as in `KeyboardEvent.key`: a letter always small, and " " for `Space`.

    Raises ValueError with what to write.
    """
    if text in (_SPACE, "Space"):
        return _SPACE
    if len(text) == 1 and text.isprintable():
        lower = text.lower()
        return lower if len(lower) == 1 else text
    if text in _NAMED:
        return text
    meant = text if text in _RESERVED else _meant(text)
    if meant in _RESERVED:
        raise ValueError(f"{meant} cannot be a key of the game: {_RESERVED[meant]}")
    names = "names are those of KeyboardEvent.key: ArrowLeft, a, Space"
    raise ValueError(f"there is no key {show(text)}; {f'did you mean {meant}?' if meant else names}")


def _meant(text: str) -> str | None:
    """The name that was probably meant by a text that names no key; None if there is none."""
    code = _CODE.fullmatch(text)
    if code:
        return (code[1] or code[2]).lower()
    names = {name.lower(): name for name in (*_NAMED, *_RESERVED, "Space")}
    folded = text.strip().lower()
    if folded in names or folded in _OTHER_NAMES:
        return names.get(folded) or _OTHER_NAMES[folded]
    return nearest(folded, names.values())


def parts(combined: str) -> tuple[str, ...]:
    """Return the keys that are joined by `+`, as written. A `+` where a key must stand is the key `+` itself."""
    return tuple(part.strip() or _SPACE for part in _PART.findall(combined))


def combination(text: str) -> str:
    """Return the keys in a text, each as by `key_name`, joined by `+`. Raises ValueError with what to write."""
    if not text:
        raise ValueError("names no key; write Space for the space key")
    if not _JOINED.fullmatch(text) or _SPACED.search(text):  # only in "a+ " and " +a" is the space a key
        text = text.strip()
    if not _JOINED.fullmatch(text):
        raise ValueError("has a + that joins nothing; a++ is a and + together, and + alone is the key +")
    keys = [key_name(part) for part in parts(text)]
    if len(set(keys)) < len(keys):
        raise ValueError("names the same key twice; write it once")
    if len(keys) > MAX_TOGETHER:
        raise ValueError(f"joins {len(keys)} keys; {MAX_TOGETHER} at most, since few keyboards report more at once")
    return "+".join(keys)


def shown(combined: str) -> str:
    """Return the combination for a message, with `Space` for " "."""
    return printable("+".join("Space" if part == _SPACE else part for part in parts(combined)))


# Maps of the section `trial`


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
        key, wrong = checked(lambda text: combination(str(text)), name, here)
        action_name, wrong_action = checked(_action, action, here)
        problems += wrong + wrong_action
        if wrong or wrong_action:
            continue
        first = names.setdefault(frozenset(parts(key)), name)
        if first != name:
            problems.append(SectionProblem(here, f"is the same as {shown(first)}; keep one of them"))
        by_key[key] = action_name
    return by_key, problems + too_many(value, path, MAX_KEYS)


labels = map_of(_action, values.text("the text of a button", MAX_NAME), MAX_KEYS)
"""Checks `labels`, the texts of buttons: `{action: text}`."""
player_names = map_of(str, values.text("what participants read", MAX_NAME), MAX_KEYS)
"""Checks `playerNames`, the players' names for participants: `{player: text}`."""
