"""Ends episodes, breaks and the trial: the last feedback, the last lines of the recording, then the answer. Pure."""

from __future__ import annotations

import logging
from collections.abc import Callable

from hippodrome.trial.core import records
from hippodrome.trial.core.effects import Effect, FeedbackCall, WriteLog
from hippodrome.trial.core.ended import Break, Episode
from hippodrome.trial.core.message_log import MessageLog
from hippodrome.trial.core.participants import Participants
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.recording import Recordings
from hippodrome.trial.core.timing import Timing
from hippodrome.trial.settings import TrialSettings

LAST_CALL_SECONDS = 2.0
"""The time in which a call of the agent must return once the server must end."""


class Ending:
    """Records the episodes and breaks that are over (`TrialProgress.ended`) in their order, and the trial's end."""

    def __init__(
        self,
        settings: TrialSettings,
        *,
        timing: Timing,
        recording: Recordings,
        message_log: MessageLog,
        emit: Callable[[Effect], None],
    ) -> None:
        self._settings = settings
        self._timing = timing
        self._recording = recording
        self._message_log = message_log
        self._emit = emit
        self._break_shut_down = False
        self.closing = False
        """Whether the server must end."""
        self.all_written = False
        """Whether the last lines are written, and the shell was asked to store the answer."""

    def last_feedback(self, progress: TrialProgress) -> FeedbackCall:
        """Return the last call of the agent before the first end in `TrialProgress.ended` is recorded.

        The call gives the agent the feedback that is left, and tells its callbacks that the episode or break is over.
        """
        return FeedbackCall(
            limit=LAST_CALL_SECONDS if self.closing else self._settings.step_seconds,
            feedback=self._message_log.feedback,
            messages=len(self._message_log.messages),
            over=progress.ended[0],
            last=progress.over and len(progress.ended) == 1,
        )

    def record(self, call: FeedbackCall, progress: TrialProgress, participants: Participants) -> None:
        """Remove the first end from `TrialProgress.ended`, and record it, with the messages before `call`."""
        over = progress.ended.pop(0)
        if isinstance(over, Episode):
            for player, late in progress.choices.policies.late().items():
                self._emit(WriteLog(logging.INFO, f"the policy of {player} was late at {late} of {over.steps} steps"))
        outcomes = participants.outcomes() if progress.over and not progress.ended else None
        self._emit(records.end(over, self._message_log.messages[: call.messages], outcomes))
        self._message_log.recorded(call.messages, len(call.feedback))
        # The break after an episode is recorded in the episode's file.
        break_follows = isinstance(progress.ended[0], Break) if progress.ended else progress.on_break
        if self._settings.trial.data_file == "episode" and not break_follows:
            self._close_recording(participants)

    def shut_down_break(self, progress: TrialProgress) -> None:
        """If the server must end during a break, add the break to `TrialProgress.ended`."""
        if self.closing and progress.on_break and not self._break_shut_down:
            self._break_shut_down = True
            progress.ended.append(Break(progress.episode, "shutdown"))

    def write_last(self, progress: TrialProgress, participants: Participants, *, broken: bool) -> None:
        """Write the last lines, and ask the shell to store the answer. A `broken` or unfinished game has no answer."""
        self.all_written = True
        if self.closing and not progress.over and not progress.on_break:
            self._emit(records.shutdown(progress, self._message_log.messages))
        self._close_recording(participants)
        self._emit(participants.answer(self._timing.seconds, played=progress.over and not broken))

    def _close_recording(self, participants: Participants) -> None:
        participants.write_lines()
        self._recording.close()
