"""The assignment of a participant, or of a session: `assignment.json`, which the control plane writes once.

A server reads in it which games its participants play, in which order, and what each game has for itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hippodrome.protocol.keys import NAME


@dataclass(frozen=True, slots=True)
class Game:
    """A game on a participant's path, by its key.

    `trial` are the keys of the section `trial` that it has for itself, `levels` the levels of its block's factors, and
    `position` which run of the block it is (0 outside of blocks). `answers` are the keys of the answers that its agent
    reads, each with the names under which the agent finds it: ("trust",), or ("trust", level).
    """

    key: str
    step: str
    trial: Mapping[str, Any] = field(default_factory=dict)
    levels: Mapping[str, str] = field(default_factory=dict)
    position: int = 0
    answers: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Assigned:
    """What a server learns from an assignment: the levels of the factors between people, and the games in order."""

    condition: Mapping[str, str] = field(default_factory=dict)
    games: Mapping[str, Game] = field(default_factory=dict)


def parse(body: bytes) -> Assigned:
    """Read the document. Raises ValueError if it is none of ours."""
    document = json.loads(body)
    try:
        games = {key: Game(key, **_known(value)) for key, value in document["games"].items()}
        if not all(NAME.fullmatch(key) for game in games.values() for key in (game.key, *game.answers)):
            raise ValueError("an assignment names a step that cannot be")
        return Assigned(dict(document.get("condition", {})), games)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError("this is no assignment") from error


def _known(value: Mapping[str, Any]) -> dict[str, Any]:
    fields = ("step", "trial", "levels", "position", "answers")
    return {name: value[name] for name in fields if name in value}
