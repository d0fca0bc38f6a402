"""Keeps participants' messages until they are recorded and the agent has heard their feedback. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from hippodrome.trial.core.messages import Message, is_feedback

MESSAGES_KEPT = 5000
"""The most messages of one participant between two lines of the recording. A client that sends more is hostile."""
FIELDS_WAITING = 1024 * 1024
"""The most characters of unknown fields between two lines of the recording."""
FIELDS_KEPT = 32 * 1024 * 1024
"""The most characters of unknown fields that are recorded in one trial."""


class Word(NamedTuple):
    """A word of feedback. `player` is the player of the participant who gave it; None if there is one participant."""

    text: str
    player: str | None = None


class MessageLog:
    """Keeps messages in their order. `ns` is the time of a message, in nanoseconds of a monotonic clock.

    `player` is the player of the participant who sent the message, if there are several participants; else None.
    """

    def __init__(self) -> None:
        self._messages: list[dict[str, Any]] = []
        self._feedback: list[Word] = []  # the feedback in `_messages` that the agent has not heard yet
        self._dropped = 0
        self._fields_left = FIELDS_KEPT
        self._fields_waiting = 0

    @property
    def messages(self) -> list[dict[str, Any]]:
        """A copy of the messages that are in no line of the recording yet."""
        return self._messages.copy()

    @property
    def feedback(self) -> tuple[Word, ...]:
        """The feedback that the agent has not heard yet."""
        return tuple(self._feedback)

    def add(self, message: Message, ns: int, player: str | None = None) -> None:
        """Add a client's message. If too many wait already, drop it; if its unknown fields are too long, drop these."""
        if message.fields:
            length = len(str(message.fields))
            self._fields_left -= length
            self._fields_waiting += length
            if self._fields_left < 0 or self._fields_waiting > FIELDS_WAITING:
                message = replace(message, fields=None, fields_dropped=len(message.fields))
        record = message.record()
        if not record:
            return
        if self._full(player):
            self._dropped += 1
            return
        self._messages.append({"ns": ns, **_player_field(player), **record})
        if message.command is not None and is_feedback(message.command):
            self._feedback.append(Word(message.command, player))

    def note(self, event: str, ns: int, player: str | None = None) -> None:
        """Add an event that is not a client's message, such as a new connection. If too many messages wait, drop it."""
        if not self._full(player):
            self._messages.append({"ns": ns, **_player_field(player), "event": event})

    def _full(self, player: str | None) -> bool:
        """Whether too many messages of this participant wait. In a session each participant has their own limit."""
        if len(self._messages) < MESSAGES_KEPT:
            return False
        return player is None or sum(record.get("player") == player for record in self._messages) >= MESSAGES_KEPT

    def repeat(self, feedback: Sequence[Word], ns: int) -> None:
        """Insert feedback, which an earlier server's agent did not hear, before all other messages."""
        again = [{"ns": ns, **_player_field(word.player), "command": word.text, "again": True} for word in feedback]
        self._messages[:0] = again
        self._feedback[:0] = feedback

    def take_dropped(self) -> int:
        """Return the number of messages that were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped

    def recorded(self, messages: int, feedback: int) -> None:
        """Remove the first `messages`, which are recorded now, and the first `feedback` words."""
        del self._messages[:messages]
        self._fields_waiting = 0
        self.heard(feedback)

    def heard(self, feedback: int) -> None:
        """Remove the first `feedback` words, which the agent has heard."""
        del self._feedback[:feedback]


def _player_field(player: str | None) -> dict[str, str]:
    return {} if player is None else {"player": player}
