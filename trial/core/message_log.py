"""Participants' messages until they stand in the recording and the agent has heard their feedback. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from trial.core.messages import Message, is_feedback

MESSAGES_KEPT = 5000
"""Messages of one participant between two lines of the recording; a client that sends more is hostile."""
FIELDS_WAITING = 1024 * 1024
"""Characters of unknown fields that wait for the next line of the recording."""
FIELDS_KEPT = 32 * 1024 * 1024
"""Characters of unknown fields that are recorded of one trial."""


class Word(NamedTuple):
    """A word of feedback, and the player of the participant who said it; None if there is only one player."""

    text: str
    player: str | None = None


class MessageLog:
    """Keeps messages in their order. `ns` is the time of a message, in nanoseconds of a monotonic clock.

    `player` is whose participant's message it is, if there are several participants.
    """

    def __init__(self) -> None:
        self._messages: list[dict[str, Any]] = []
        self._feedback: list[Word] = []  # among them, and the agent has not heard it
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
        """Keep a message of a client, unless too many are kept."""
        if message.fields:
            length = len(str(message.fields))
            self._fields_left -= length
            self._fields_waiting += length
            if self._fields_left < 0 or self._fields_waiting > FIELDS_WAITING:
                message = replace(message, fields=None, fields_dropped=len(message.fields))
        said = message.record()
        if not said:
            return
        if self._full(player):
            self._dropped += 1
            return
        self._messages.append({"ns": ns, **_of(player), **said})
        if message.command is not None and is_feedback(message.command):
            self._feedback.append(Word(message.command, player))

    def note(self, event: str, ns: int, player: str | None = None) -> None:
        """Keep an event that is no message of a client."""
        if not self._full(player):
            self._messages.append({"ns": ns, **_of(player), "event": event})

    def _full(self, player: str | None) -> bool:
        """Whether there are too many messages of this participant: one who sends many takes no room from the others."""
        if len(self._messages) < MESSAGES_KEPT:
            return False
        return player is None or sum(said.get("player") == player for said in self._messages) >= MESSAGES_KEPT

    def repeat(self, feedback: Sequence[Word], ns: int) -> None:
        """Put feedback before all other: the agent of an earlier server did not hear it."""
        again = [{"ns": ns, **_of(word.player), "command": word.text, "again": True} for word in feedback]
        self._messages[:0] = again
        self._feedback[:0] = feedback

    def take_dropped(self) -> int:
        """How many messages were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped

    def recorded(self, messages: int, feedback: int) -> None:
        """The first `messages` are in the recording now. The agent hears no more of the first `feedback` words."""
        del self._messages[:messages]
        self._fields_waiting = 0
        self.heard(feedback)

    def heard(self, feedback: int) -> None:
        """The agent has heard the first `feedback` words."""
        del self._feedback[:feedback]


def _of(player: str | None) -> dict[str, str]:
    return {} if player is None else {"player": player}
