"""What is said and waits to be sent to one client. Pure."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_LINES = 500  # the most lines in a message


class PendingTalk:
    """The messages about talk that wait for a client. Of a line, only the newest text waits."""

    def __init__(self) -> None:
        self._lines: dict[int, Mapping[str, Any]] = {}
        self._history = False  # whether a message with lines is due, also if there are none
        self._turn: str | None = None
        self._typing: dict[str, bool] = {}
        self._refused: list[Mapping[str, Any]] = []

    def __bool__(self) -> bool:
        return bool(self._lines or self._history or self._turn is not None or self._typing or self._refused)

    def add(self, fields: Mapping[str, Any]) -> None:
        """Add the fields of a message: `lines`, `turn`, `typing` or `refused`."""
        self._history = self._history or fields.get("lines") == []
        for line in fields.get("lines", ()):
            self._lines.pop(line["n"], None)
            self._lines[line["n"]] = line
        self._turn = fields.get("turn", self._turn)
        self._typing |= fields.get("typing", {})
        if "refused" in fields and len(self._refused) < _LINES:
            self._refused.append(fields["refused"])

    def take(self) -> str:
        """Return the next message to send."""
        if self._typing:
            typing, self._typing = self._typing, {}
            return json.dumps({"typing": typing})
        if self._refused:
            return json.dumps({"refused": self._refused.pop(0)})
        self._history = False
        numbers = list(self._lines)[:_LINES]
        message: dict[str, Any] = {"lines": [self._lines.pop(number) for number in numbers]}
        if self._turn is not None and not self._lines:
            message["turn"], self._turn = self._turn, None
        return json.dumps(message, ensure_ascii=False)
