"""The recording that is open, and the lines that say what went wrong. Pure: it emits effects."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable

from trial.core.effects import CloseRecording, Effect, LogAgentError, OpenRecording, RecordLine, WriteLog
from trial.core.policies import FAILURES
from trial.core.progress import TrialProgress

_POLICY_FAILURES_SAID = 20
_LONGEST_ERROR = 2000


class Recordings:
    """The recordings of a trial, one after the other. Lines can be written while one `is_open`."""

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self.is_open = False
        self.is_awaited = False
        """One is being opened."""
        self._said: set[str] = set()  # of policies

    def ask(self, progress: TrialProgress, seed: int) -> None:
        """Ask the shell to open a recording, which begins with the present episode."""
        self.is_awaited = True
        players = tuple(progress.players.values()) if progress.several else ()
        self._emit(OpenRecording(progress.episode, seed, progress.frame_rate, progress.action_space, players))

    def opened(self) -> None:
        """The recording is open."""
        self.is_open, self.is_awaited = True, False

    def failed(self) -> None:
        """The recording cannot be opened."""
        self.is_awaited = False

    def close(self) -> None:
        """Close the recording, if one is open."""
        if self.is_open:
            self.is_open = False
            self._emit(CloseRecording())

    # ---- what went wrong

    def agent_failed(self, error: Exception, episode: int, step: int) -> None:
        """The researcher's code raised this error: say so in the log and in the recording."""
        self._emit(LogAgentError(error))
        self._emit(RecordLine("error", {"episode": episode, "step": step, "error": words_of(error)}))

    def policy_failed(self, progress: TrialProgress, player: str, words: str) -> None:
        """A policy has failed, as `words` say: say so in the log and in the recording, once for each reason."""
        plays = progress.players[player].plays
        said = [f"the policy of {player} ({plays}) failed: {words}"]
        if progress.choices.policies.idles(player):
            said.append(f"the policy of {player} failed {FAILURES} times in a row: it idles until the episode is over")
        for text in said:
            if text in self._said or len(self._said) >= _POLICY_FAILURES_SAID:
                continue
            self._said.add(text)
            self._emit(WriteLog(logging.ERROR, text))
            where = {"episode": progress.episode, "step": progress.steps, "player": player}
            self._emit(RecordLine("error", {**where, "error": text}))


def words_of(error: Exception) -> str:
    """The type of an error and its message, shortened to what a line may hold."""
    return "".join(traceback.format_exception_only(error)).strip()[:_LONGEST_ERROR]
