"""Who takes part in a trial, and what follows from it: one participant alone, or the members of a session.

`Alone` is for one participant, `TrialSession` (`trial/core/session.py`) for several. Both have the same calls.
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
    """The one participant of a trial: who comes and goes, and what follows from it."""

    def __init__(self, progress: TrialProgress, trial_id: str) -> None:
        self._progress = progress
        self._trial_id = trial_id

    def place_of(self, human: str) -> str:
        """The player whom this human plays."""
        return self._progress.first

    def name_of(self, player: str) -> str | None:
        """The name in the recording for the participant who plays this player: None, since there is one participant."""
        return None

    # ---- what happens

    def come(self, player: str, now: float) -> None:
        """The participant has connected. They begin, or go on, by `start`."""

    def go(self, player: str, now: float, *, closing: bool) -> None:
        """The participant has left: hold the game, unless the server is `closing`, which has ended the game itself."""
        if not closing:
            self._progress.leave(player)

    def stalls(self, player: str, now: float) -> bool:
        """The participant's page has stopped answering: treat them as gone. Return whether that is new."""
        self._progress.leave(player)
        return True

    def receive(self, player: str, message: Message, window: Window, now: float) -> bool:
        """A message has come. Return whether it is read: always."""
        return True

    def start(self, player: str, now: float) -> None:
        """The participant begins or goes on."""
        self._progress.start()

    def pause(self, now: float) -> None:
        """The participant holds the game."""
        self._progress.pause()

    def stop(self, player: str) -> None:
        """End the game for the participant, after the step that is being taken."""

    def stopped(self) -> None:
        """The game has ended because the participant has stopped it."""

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """The participant's browser has answered a ping. Only sessions measure it."""

    def saved(self, human: str) -> None:
        """A member's answer is stored. Alone, there is none."""

    # ---- what follows

    def attend(self, now: float, seconds: float) -> None:
        """Hold the game, or let it go on, as the members are there. Alone, only commands decide."""

    def wake_at(self, now: float) -> float | None:
        """When to call `attend` again if nothing happens: never."""
        return None

    # ---- recordings and answers

    def of_reset(self) -> Mapping[str, Any]:
        """Further fields for the line of a reset: none."""
        return {}

    def outcomes(self) -> Mapping[str, str | None] | None:
        """How the trial has ended for each member: None, since there are no members."""
        return None

    def write_lines(self) -> None:
        """Write the lines that wait for an open recording: there are none."""

    def answer(self, seconds: float, *, played: bool) -> SaveAnswer:
        """What to store; `seconds` were played. Without an answer if the game could not be `played`."""
        return SaveAnswer(records.answers(self._progress, seconds, self._trial_id) if played else None)

    # ---- what the participant is told

    def state(self) -> None:
        """A value that changes when members are to be told of each other: always None."""
        return None

    def told(self, now: float) -> Mapping[str, Any] | None:
        """What all members are told of each other: None."""
        return None

    def sentence(self, player: str) -> str | None:
        """The words that tell a member why the game is over: None."""
        return None

    def has_answered(self, human: str) -> bool:
        """Whether a member's answer is stored: no."""
        return False

    def answer_of(self, human: str) -> Mapping[str, Any] | None:
        """A member's own answer: None."""
        return None


Participants = Alone | TrialSession
"""Those of one trial, however many they are."""
