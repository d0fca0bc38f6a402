"""Turns the messages of clients without a subprotocol, such as HIPPO's front end, into ours. Pure.

HIPPO's server (App/trial.py since 1.0.0) repeats an action until a message names another one, takes numbers as text,
ignores unknown fields, and records every message whole. Only this module deals with these differences.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from hippodrome.trial.core import messages
from hippodrome.trial.core.messages import BadMessage, Message
from hippodrome.trial.pictures import frames

FIELDS_LENGTH = 3500
"""The most characters of JSON in the unknown fields of one message. If there are more, the fields are not recorded."""

FIELDS_DEPTH = 20
"""The most levels of nesting that recorded fields may have, since some readers of JSON take no more."""

_COMMANDS = {name.lower(): name for name in messages.PLAIN_COMMANDS | messages.FEEDBACK}
_KNOWN = ("command", "action", "held", "changeFrameRate")
_NEVER_RECORDED = ("userId", "token")


def parse(data: str | bytes, words: Collection[str] = ()) -> Message:
    """Read a message after the hello. Raises NotAMessage, and BadMessage for a wrong value of a known field.

    `words` are the feedback words of the project's own controls. Empty fields count as left out. Unknown commands and
    fields become `Message.fields`, which are recorded.
    """
    value = messages.object_of(data)
    known = {key: value[key] for key in _KNOWN if value.get(key) not in (None, "")}
    unknown = {key: each for key, each in value.items() if key not in _KNOWN and key not in _NEVER_RECORDED}
    sent_command = known.pop("command", None)
    command = _command(sent_command.strip(), words) if isinstance(sent_command, str) else None
    if command is not None:
        known["command"] = command
    elif sent_command is not None:
        unknown["command"] = sent_command
    if isinstance(known.get("changeFrameRate"), str):
        known["changeFrameRate"] = _frame_rate(known["changeFrameRate"])
    message = messages.message_of(known, words) if known else Message()
    fields = _short_enough(unknown)
    return replace(
        message,
        lasts=message.action is not None and message.held is None,
        fields=fields,
        fields_dropped=0 if fields or not unknown else len(unknown),
    )


def _command(name: str, words: Collection[str]) -> str | None:
    """Return the command or word of this name, whether its letters are upper or lower case; None if there is none."""
    own = {word.lower(): word for word in words}
    return name if name in words else _COMMANDS.get(name.lower(), own.get(name.lower()))


def sentence(words: str) -> str:
    """Build a message whose words HIPPO's front end shows to the participant. It does not show `error`."""
    return json.dumps({"error": words, "UI": [], "Instructions": [words]})


def _frame_rate(text: str) -> str | float:
    """Return `faster`, `slower` or the number in the text. Raises BadMessage."""
    word = text.strip().lower()
    if word in messages.FRAME_RATE_CONTROLS:
        return word
    try:
        return float(word[:40])
    except ValueError:
        raise BadMessage("changeFrameRate must be 'faster', 'slower' or a number") from None


def _short_enough(fields: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the fields, or None if they are empty, too long or too deep to be recorded."""
    if not fields or _too_deep(fields):
        return None
    return fields if len(json.dumps(fields)) <= FIELDS_LENGTH else None


def _too_deep(value: Any) -> bool:
    """Whether the value has more than FIELDS_DEPTH levels of nesting."""
    level = [value]
    for _ in range(FIELDS_DEPTH + 1):
        nested = [each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)]
        level = [inner for each in nested for inner in each]
    return bool(level)


_SIZE = 600, 400  # pixels; HIPPO's page shows frames in about this shape
_LETTER = 26  # pixels
_COLUMNS = 38  # letters in a line


@lru_cache(maxsize=8)
def frame_message(words: str) -> str:
    """Build a message with a frame that shows the words, in the form for clients without a subprotocol."""
    from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415 - only for such clients

    picture = Image.new("RGB", _SIZE, "white")
    text = "\n".join(textwrap.wrap(words, _COLUMNS))
    font = ImageFont.load_default(_LETTER)
    ImageDraw.Draw(picture).multiline_text((_SIZE[0] / 2, _SIZE[1] / 2), text, "black", font, "mm", spacing=10)
    return frames.jpeg_message(np.asarray(picture), 1)
