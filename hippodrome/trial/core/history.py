"""What has happened in a game step: participants' messages, episodes and breaks, and what earlier servers played. Pure.

`MessageLog` keeps messages until a line of the recording holds them. `hippodrome/trial/recordings/resume.py` reads a
`RecordedTrial`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from hippodrome.trial.core.messages import Message, is_feedback
from hippodrome.trial.core.policies import FAILURES

PARTNER_LEFT = "partnerLeft"
"""The outcome of a trial that has ended because a member of the session stays away."""


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that is over. `score` is that of the first human; `scores` are those of all players, if several.

    `why`: terminated, truncated, reset or stopped (a command), failed (the researcher's code), turnSeconds (the time of
    a turn was over) or partnerLeft (a member of the session stays away).
    """

    number: int
    steps: int
    score: float
    why: str
    scores: Mapping[str, float] = field(default_factory=dict)
    limit: str | None = None
    """The key of `trial` whose limit truncated it, maxSteps or episodeSeconds; None if no limit did."""
    success: bool = False
    """Whether the info of its last step has a true `success`."""


@dataclass(frozen=True, slots=True)
class Break:
    """A break that is over. `after` is the number of the episode before it.

    `why`: over (its time), start, pause or stop (a participant's command), left (the participant has left), failed,
    shutdown (the server had to end) or partnerLeft (a member of the session stays away).
    """

    after: int
    why: str


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


@dataclass(frozen=True, slots=True)
class RecordedAction:
    """One player's action in a step; None if it was not the player's turn. `observed` and `by` are as in `Action`."""

    action: int | None
    reward: float
    observed: int | None = None
    by: str | None = None


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One step: the human's action (None: no key acted), the action taken, the reward, the feedback before the step.

    `advice` is the action that the agent was asked to take because no key acted; None: the idle action. `players` are
    the actions of all players, if there are several.
    """

    human: int | None
    action: int | None
    reward: float
    feedback: tuple[Word, ...] = ()
    advice: int | None = None
    players: Mapping[str, RecordedAction] = field(default_factory=dict)


@dataclass(slots=True)
class UnfinishedEpisode:
    """An interrupted episode. `seed` is None if the environment takes no seed; then the episode cannot be replayed."""

    number: int
    seed: int | None
    steps: list[RecordedStep] = field(default_factory=list)
    unheard: list[Word] = field(default_factory=list)
    """The feedback after the last step, which the earlier server's agent did not hear."""

    @property
    def score(self) -> float:
        """The sum of the rewards so far, of the first human."""
        return sum(step.reward for step in self.steps)

    @property
    def scores(self) -> dict[str, float]:
        """By player, the sum of the rewards so far, if there are several players; else empty."""
        scores: dict[str, float] = {}
        for step in self.steps:
            for player, part in step.players.items():
                scores[player] = scores.get(player, 0.0) + part.reward
        return scores

    @property
    def last_actions(self) -> dict[str, int]:
        """By player, the action of the last step, for players whose policies chose that action last."""
        chosen: dict[str, int | None] = {}
        for step in self.steps:
            asked = {player: part for player, part in step.players.items() if part.observed is not None}
            chosen |= {player: None if part.by == "none" else part.action for player, part in asked.items()}
        last = self.steps[-1].players if self.steps else {}
        return {
            player: part.action
            for player, part in last.items()
            if part.action is not None and chosen.get(player) == part.action
        }

    @property
    def failures(self) -> dict[str, int]:
        """By player, how often its policy has failed in a row, up to the last step.

        If a policy failed in a step, the step has `observed`, and its `by` is none or late. A step looks the same if
        the policy's action had become illegal when it answered. The steps after it tell the two apart: a policy with
        `FAILURES` failures in a row is not asked any more, so the next steps have no `observed`.
        """
        failures: dict[str, int] = {}
        idle: set[str] = set()
        for step in self.steps:
            for player, part in step.players.items():
                failed = part.observed is not None and part.by in ("none", "late")
                if failed:
                    failures[player] = failures.get(player, 0) + 1
                elif part.by == "none" and failures.get(player, 0) >= FAILURES:
                    idle.add(player)
                elif part.observed is not None or part.by == "human":
                    failures.pop(player, None)
                if part.observed is not None or part.by == "human":
                    idle.discard(player)
        return {player: count if player in idle else min(count, FAILURES - 1) for player, count in failures.items()}


@dataclass(slots=True)
class RecordedTrial:
    """The records of a game step: the episodes that are over, the interrupted one if any, and the seconds of play."""

    ended: list[Episode] = field(default_factory=list)
    unfinished: UnfinishedEpisode | None = None
    seconds: float = 0.0
    outcomes: dict[str, str] = field(default_factory=dict)
    """In a session, by player: how the trial has ended for the members for whom it is over."""

    @property
    def begun(self) -> bool:
        """Whether a step was taken or an episode ended. A server begins an episode before its participants come."""
        return bool(self.ended) or (self.unfinished is not None and bool(self.unfinished.steps))
