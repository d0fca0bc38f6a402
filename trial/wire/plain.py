"""Clients without a subprotocol, such as HIPPO's front end: what they say, turned into our messages. Pure.

HIPPO (App/trial.py since 1.0.0) keeps an action until the next message with one, takes numbers as text, ignores
what it does not know, and records every message whole. All of this is here, and nothing of it further in.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from trial.core import messages
from trial.core.messages import BadMessage, Message

FIELDS_LENGTH = 3500
"""The unknown fields of one message are recorded if they have at most so many characters of JSON."""

FIELDS_DEPTH = 20
"""And if they are nested no deeper: not every reader of JSON takes all that another does."""

_COMMANDS = {name.lower(): name for name in messages.PLAIN_COMMANDS | messages.FEEDBACK}
_KNOWN = ("command", "action", "held", "changeFrameRate")
_NEVER_RECORDED = ("userId", "token")


def parse(data: str | bytes, words: Collection[str] = ()) -> Message:
    """Read a message after the first. Raises NotAMessage, and BadMessage for a wrong value of a known field.

    `words` are what the project's own controls say.

    Fields that are empty count as left out. Unknown commands and fields become `fields`, which are recorded.
    """
    value = messages.object_of(data)
    said = {key: value[key] for key in _KNOWN if value.get(key) not in (None, "")}
    rest = {key: each for key, each in value.items() if key not in _KNOWN and key not in _NEVER_RECORDED}
    command = said.pop("command", None)
    known = _command(command.strip(), words) if isinstance(command, str) else None
    if known is not None:
        said["command"] = known
    elif command is not None:
        rest["command"] = command
    if isinstance(said.get("changeFrameRate"), str):
        said["changeFrameRate"] = _frame_rate(said["changeFrameRate"])
    message = messages.message_of(said, words) if said else Message()
    kept = _short_enough(rest)
    return replace(
        message,
        lasts=message.action is not None and message.held is None,
        fields=kept,
        fields_dropped=0 if kept or not rest else len(rest),
    )


def _command(said: str, words: Collection[str]) -> str | None:
    """The command or word that was meant, in small letters or large ones; None if there is none."""
    own = {word.lower(): word for word in words}
    return said if said in words else _COMMANDS.get(said.lower(), own.get(said.lower()))


def sentence(words: str) -> str:
    """A message that HIPPO's front end shows to the participant; it shows no `error`."""
    return json.dumps({"error": words, "UI": [], "Instructions": [words]})


def _frame_rate(text: str) -> str | float:
    """`faster`, `slower` or the number in the text."""
    word = text.strip().lower()
    if word in messages.FRAME_RATE_CONTROLS:
        return word
    try:
        return float(word[:40])
    except ValueError:
        raise BadMessage("changeFrameRate must be 'faster', 'slower' or a number") from None


def _short_enough(fields: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The fields, if they are few enough to be recorded."""
    if not fields or _too_deep(fields):
        return None
    return fields if len(json.dumps(fields)) <= FIELDS_LENGTH else None


def _too_deep(value: Any) -> bool:
    """Whether there are values below FIELDS_DEPTH levels."""
    level = [value]
    for _ in range(FIELDS_DEPTH + 1):
        nested = [each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)]
        level = [inner for each in nested for inner in each]
    return bool(level)
