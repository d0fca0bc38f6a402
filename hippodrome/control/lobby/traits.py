"""A participant's trait, which decides who may play with whom (`matching` in config.yml): a short hash. Pure."""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from collections.abc import Mapping
from typing import Any

from hippodrome.control.lobby.entries import NO_TRAIT
from hippodrome.control.model.matching import field_of
from hippodrome.control.model.project import Project

_LENGTH = 10  # hex digits


def trait(project: Project, group: int | None, answers: Mapping[str, Any]) -> str:
    """Return the participant's trait: a hash of the answer or of the group by which `matching` matches.

    Participants without an answer have the same trait as each other.
    """
    if (field := field_of(project.matching)) is not None:
        return _hash(project, answers.get(field))
    return _hash(project, group) if project.matching in ("group", "mixed") else NO_TRAIT


def together(project: Project) -> bool:
    """Return whether the members of a session must have the same trait; if not, they must have different ones."""
    if isinstance(project.matching, dict):
        return "same" in project.matching
    return project.matching != "mixed"


def most_of_one(project: Project) -> int:
    """Return how many members of a session may have the same trait if members must have different ones.

    This is one. But with `matching: mixed` and fewer groups than players, several members must share a group: then it
    is the number of players divided by the number of groups, rounded up.
    """
    mixed = project.matching == "mixed" and project.groups
    return math.ceil(project.players / project.groups) if mixed else 1


def _hash(project: Project, value: Any) -> str:
    """The keyed hash of a value. A listing shows it, and only with the project's secret the value can be guessed."""
    normalised = value.strip().casefold() if isinstance(value, str) else value
    text = json.dumps(normalised, sort_keys=True, default=str)
    return hmac.new(project.secret.encode(), f"trait\0{text}".encode(), hashlib.sha256).hexdigest()[:_LENGTH]
