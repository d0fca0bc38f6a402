"""The participants of a trial: `Alone` for one, `TrialSession` (`trial/core/session.py`) for several. Pure.

Both have the same methods. They decide when the game is held and goes on, and what is answered for whom.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trial.core import records
from trial.core.effects import SaveAnswer
from trial.core.flow_control import Window
from trial.core.messages import Message
from trial.core.progress import TrialProgress
from trial.core.session import TrialSession


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
        """The participant has connected. The game is not on before they send `start`."""

    def go(self, player: str, now: float, *, closing: bool) -> None:
        """The participant has left: hold the game. Not if the server is `closing`: it has ended the game already."""
        if not closing:
            self._progress.leave(player)

    def stalls(self, player: str, now: float) -> bool:
        """The participant's page has stopped answering: treat them as gone. Return whether that is new."""
        self._progress.leave(player)
        return True

    def receive(self, player: str, message: Message, window: Window, now: float) -> bool:
        """A message has come. Return whether it has an effect: always."""
        return True

    def start(self, player: str, now: float) -> None:
        """The participant begins or goes on."""
        self._progress.start()

    def pause(self, now: float) -> None:
        """The participant holds the game."""
        self._progress.pause()

    def stop(self, player: str) -> None:
        """The participant ends the game. There is nothing to remember: `Commands` ends it after the present step."""

    def stopped(self) -> None:
        """The game has ended because the participant has stopped it. No one else is to be told."""

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """The participant's browser has answered a ping: no effect, since only sessions limit round trips."""

    def saved(self, human: str) -> None:
        """A member's answer is stored: no effect, since there are no members."""

    # ---- what follows

    def attend(self, now: float, seconds: float) -> None:
        """Hold the game, or let it go on, depending on who is here: no effect, since commands alone decide that."""

    def wake_at(self, now: float) -> float | None:
        """Return when to call `attend` again if nothing happens: never."""
        return None

    # ---- recordings and answers

    def reset_fields(self) -> Mapping[str, Any]:
        """Return further fields for the line of a reset: none."""
        return {}

    def outcomes(self) -> Mapping[str, str | None] | None:
        """Return how the trial has ended for each member: None, since there are no members."""
        return None

    def write_lines(self) -> None:
        """Write the lines that wait for an open recording: none do."""

    def answer(self, seconds: float, *, played: bool) -> SaveAnswer:
        """Return what to store, after `seconds` of play: the answer if the game could be `played`, else none."""
        return SaveAnswer(records.answers(self._progress, seconds, self._trial_id) if played else None)

    # ---- what clients are told

    def session_version(self) -> None:
        """Return a value that changes when the fields about members do: always None."""
        return None

    def session_fields(self, now: float) -> Mapping[str, Any] | None:
        """Return the fields about members in the messages to clients: None."""
        return None

    def sentence(self, player: str) -> str | None:
        """Return the sentence that tells a member why the game is over: None."""
        return None

    def has_answered(self, human: str) -> bool:
        """Whether a member's own answer is stored: no, since there are no members."""
        return False

    def answer_of(self, human: str) -> Mapping[str, Any] | None:
        """Return a member's own answer: None."""
        return None


Participants = Alone | TrialSession
"""The participants of one trial."""
