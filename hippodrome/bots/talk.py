"""What a bot says in a game in which people talk: phrases of the study, or lines of a script."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from random import Random
from typing import Any

SCRIPT = (
    "Hello!",
    "How are you?",
    "What shall we do?",
    "I am not sure about that.",
    "Why do you think so?",
    "Let us try it: 50 for you, 50 for me.",
    "Äh … ¿cómo? 好的 👍",
    "<b>Is this bold?</b> {{ 7 * 7 }} =SUM(A1:A9)",
    "OK",
    "Thank you!",
)
"""What bots say where they may type. Two lines have characters that a page or a table could misread."""
_PAUSE = (1.0, 4.0)  # seconds between two lines of a bot


class ScriptedTalk:
    """Decides what a bot says next. `chat` is the field of the controls (docs/wire.md); `now` is time.monotonic()."""

    def __init__(self, random: Random, chat: Mapping[str, Any], now: float) -> None:
        self._random = random
        self._me: str = chat["me"]
        texts: Sequence[str] = SCRIPT if chat["typing"] else chat["phrases"]
        self._texts = [text for text in texts if len(text) <= chat["maxLength"]]
        self._alternates = chat["turns"] == "alternate"
        self._turn = ""
        self._next = now + random.uniform(*_PAUSE)
        self._said = 0
        self._waiting: int | None = None  # the id of the line whose echo has not come

    def heard(self, message: Mapping[str, Any]) -> int:
        """Note a message with lines, and return how many of the bot's own lines it shows for the first time."""
        self._turn = message.get("turn", self._turn)
        echoed = any(line.get("id") == self._waiting for line in message["lines"]) and self._waiting is not None
        if echoed:
            self._waiting = None
        return int(echoed)

    def refused(self) -> None:
        """Note that the line was refused."""
        self._waiting = None

    def messages(self, now: float) -> list[dict[str, Any]]:
        """Return the messages to send now: none, or a line."""
        if now < self._next or self._waiting is not None or not self._texts:
            return []
        if self._alternates and self._turn != self._me:
            return []
        self._next = now + self._random.uniform(*_PAUSE)
        text = self._texts[self._said % len(self._texts)]
        self._said += 1
        self._waiting = int(time.time() * 1000)  # as our page does
        return [{"typing": True}, {"say": {"id": self._waiting, "text": text, "typed": 900}}]
