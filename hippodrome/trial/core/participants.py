"""The participants of a trial: `Alone` for one, `TrialSession` (`hippodrome/trial/core/session.py`) for several. Pure.

Both have the same methods. They decide when the game is held and goes on, and which answer is stored for whom.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hippodrome.trial.core import records
from hippodrome.trial.core.effects import SaveAnswer
from hippodrome.trial.core.messages import Message
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.session import TrialSession
from hippodrome.trial.core.timing import Window


class Alone:
    """The only participant of a trial."""

    def __init__(self, progress: TrialProgress, trial_id: str) -> None:
        self._progress = progress
        self._trial_id = trial_id

    def place_of(self, human: str) -> str:
        """Return the player whom this human plays."""
        return self._progress.first

    def name_of(self, player: str) -> str | None:
        """Return the player's name for the recorded messages: None, since one participant sends them all."""
        return None

    # ---- what happens

    def come(self, player: str, now: float) -> None:
        """Do nothing when the participant connects: the game is not on before they send `start`."""

    def go(self, player: str, now: float, *, closing: bool) -> None:
        """Hold the game because the participant has left. A server that is `closing` has ended the game already."""
        if not closing:
            self._progress.leave(player)

    def stalls(self, player: str, now: float) -> bool:
        """Hold the game because the participant's page has stopped answering. Return True: they were here until now."""
        self._progress.leave(player)
        return True

    def receive(self, player: str, message: Message, window: Window, now: float) -> bool:
        """Return whether a message of the participant has an effect: always."""
        return True

    def start(self, player: str, now: float) -> None:
        """Let the participant begin the game or go on with it."""
        self._progress.start()

    def pause(self, now: float) -> None:
        """Hold the game."""
        self._progress.pause()

    def stop(self, player: str) -> None:
        """Do nothing when the participant ends the game: `Commands` ends it after the present step."""

    def stopped(self) -> None:
        """Do nothing after the participant has ended the game: no one else is to be told."""

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """Do nothing when the browser has answered a ping: only sessions limit round trips."""

    def saved(self, human: str) -> None:
        """Do nothing when a member's answer is stored: there are no members."""

    # ---- what follows

    @property
    def silent(self) -> frozenset[str]:
        """The players who cannot speak, since their participants are away for good: none."""
        return frozenset()

    def attend(self, now: float, seconds: float) -> None:
        """Do nothing: commands alone decide whether the game is held or goes on."""

    def wake_at(self, now: float) -> float | None:
        """Return None: `attend` need not be called again."""
        return None

    # ---- recordings and answers

    def reset_fields(self) -> Mapping[str, Any]:
        """Return no further fields for the line of a reset."""
        return {}

    def outcomes(self) -> Mapping[str, str | None] | None:
        """Return how the trial has ended for each member: None, since there are no members."""
        return None

    def write_lines(self) -> None:
        """Do nothing: no lines wait for an open recording."""

    def answer(self, seconds: float, *, played: bool) -> SaveAnswer:
        """Return what to store, after `seconds` of play: the answer if the game could be `played`, else none."""
        return SaveAnswer(records.answers(self._progress, seconds, self._trial_id) if played else None)

    # ---- what clients are told

    def session_version(self) -> None:
        """Return None: there are no fields about members that could change."""
        return None

    def session_fields(self, now: float) -> Mapping[str, Any] | None:
        """Return None: the messages to clients have no fields about members."""
        return None

    def sentence(self, player: str) -> str | None:
        """Return None: no sentence tells the only participant why the game is over."""
        return None

    def has_answered(self, human: str) -> bool:
        """Return False: there are no members whose own answer could be stored."""
        return False

    def answer_of(self, human: str) -> Mapping[str, Any] | None:
        """Return None: there are no members with answers of their own."""
        return None


Participants = Alone | TrialSession
"""The participants of one trial."""
