"""What decides who may play with whom (`matching` in config.yml): a short hash of a group, or of an answer. Pure."""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from collections.abc import Mapping
from typing import Any

from hippodrome.lobby.entries import NO_TRAIT
from hippodrome.model.matching import field_of
from hippodrome.model.project import Project

_LENGTH = 10  # hex digits


def trait(project: Project, group: int | None, answers: Mapping[str, Any]) -> str:
    """The participant's trait. Participants with no answer have one trait together."""
    if (field := field_of(project.matching)) is not None:
        return _hash(project, answers.get(field))
    return _hash(project, group) if project.matching in ("group", "mixed") else NO_TRAIT


def together(project: Project) -> bool:
    """Whether participants must have the same trait to play together; if not, different ones."""
    if isinstance(project.matching, dict):
        return "same" in project.matching
    return project.matching != "mixed"


def most_of_one(project: Project) -> int:
    """How many members of a session may have the same trait, if different ones are wanted.

    One; with `mixed` and fewer groups than players, as many as it takes.
    """
    mixed = project.matching == "mixed" and project.groups
    return math.ceil(project.players / project.groups) if mixed else 1


def _hash(project: Project, value: Any) -> str:
    """Keyed, because a listing shows it: an answer cannot be guessed from it without the project's secret."""
    told = value.strip().casefold() if isinstance(value, str) else value
    text = json.dumps(told, sort_keys=True, default=str)
    return hmac.new(project.secret.encode(), f"trait\0{text}".encode(), hashlib.sha256).hexdigest()[:_LENGTH]
