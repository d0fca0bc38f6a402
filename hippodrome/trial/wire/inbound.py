"""Reads a client's messages after the first, and refuses messages that are too many or make no sense. Pure."""

from __future__ import annotations

from collections.abc import Collection

from hippodrome.trial.core import messages
from hippodrome.trial.core.messages import BadMessage, CloseConnection, Message, NotAMessage
from hippodrome.trial.core.timing import Window
from hippodrome.trial.wire import plain

MESSAGES_A_SECOND = 200
"""The most messages that a client may send in a second."""
_NONSENSE_ALLOWED = 2  # messages that are not JSON objects; one more closes the connection


class RateLimit:
    """Counts messages, and limits them to `limit` in a second."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._since = 0.0
        self._count = 0

    def exceeded(self, now: float) -> bool:
        """Count one message, and return whether it is one too many."""
        if now - self._since >= 1.0:
            self._since, self._count = now, 0
        self._count += 1
        return self._count > self._limit


class Inbound:
    """Reads the messages of one connection. `window` is None for clients without a subprotocol (`trial/wire/plain.py`).

    `words` are the feedback words of the project's own controls.
    """

    def __init__(self, window: Window | None, words: Collection[str] = ()) -> None:
        self._window = window
        self._words = words
        self._rate = RateLimit(MESSAGES_A_SECOND)
        self._nonsense = 0

    def read(self, data: str | bytes, now: float) -> Message:
        """Read a message. Raises BadMessage and NotAMessage, whose words are for the client, and CloseConnection."""
        if self._rate.exceeded(now):
            raise CloseConnection(4429, f"too many messages: at most {MESSAGES_A_SECOND} a second")
        try:
            message = (plain.parse if self._window is None else messages.parse)(data, self._words)
        except NotAMessage as error:
            self._nonsense += 1
            if self._nonsense > _NONSENSE_ALLOWED:
                raise CloseConnection(4400, str(error)) from None
            raise
        if message.ack is not None and self._window is not None and message.ack > self._window.newest:
            raise BadMessage("ack of a frame that was not sent")
        return message
