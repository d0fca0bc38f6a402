"""Server-sent events, as language models stream their answers. Pure."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

_LINE_END = re.compile(r"\r\n|\n|\r")
_END = re.compile(r"\r\n\r\n|\n\n|\r\r")


class Reader:
    """Splits a stream's bytes into events: texts without the empty line at their end."""

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._rest = ""

    def feed(self, piece: bytes) -> Iterator[str]:
        """Yield the events that end in this piece."""
        *whole, self._rest = _END.split(self._rest + self._decoder.decode(piece))
        yield from (event for event in whole if event)

    def rest(self) -> str:
        """Return what came after the last event."""
        return self._rest.strip()


def data_of(event: str) -> Any:
    """Return the JSON of an event; None if it has none, as `[DONE]`."""
    lines = [line[5:].removeprefix(" ") for line in _LINE_END.split(event) if line.startswith("data:")]
    try:
        return json.loads("\n".join(lines))
    except (ValueError, RecursionError):
        return None


def is_usage_alone(data: Any) -> bool:
    """Return whether this is the event with the tokens of a chat, which has no choice. Many clients expect a choice."""
    return isinstance(data, Mapping) and data.get("choices") == [] and isinstance(data.get("usage"), Mapping)


def text_of_delta(data: Any) -> str:
    """Return the text that an event of a chat's stream adds to the answer."""
    try:
        return str(data["choices"][0]["delta"].get("content") or "")
    except (AttributeError, IndexError, KeyError, TypeError):
        return ""


def length_of_delta(data: Any) -> int:
    """Return how many characters an event of a stream adds to the answer."""
    if isinstance(data, Mapping) and isinstance(data.get("delta"), str):  # of /responses
        return len(data["delta"])
    return len(text_of_delta(data))


def length_of_answer(answer: Any) -> int:
    """Return how many characters an answer has, roughly: those of all its texts beside names."""
    if isinstance(answer, str):
        return len(answer)
    if isinstance(answer, Mapping):
        texts = (
            answer.get(key) for key in ("choices", "message", "content", "output", "text", "tool_calls", "arguments")
        )
        return sum(map(length_of_answer, texts))
    return sum(map(length_of_answer, answer)) if isinstance(answer, list) else 0


def end_of(data: Any) -> str | None:
    """Return why a chat's stream ends with this event; None if it goes on."""
    try:
        why = data["choices"][0].get("finish_reason")
    except (AttributeError, IndexError, KeyError, TypeError):
        return None
    return why if isinstance(why, str) else None
