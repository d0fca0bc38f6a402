"""Opens and closes recordings, and records what went wrong. Pure: it emits effects."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable

from hippodrome.trial.core.effects import CloseRecording, Effect, LogAgentError, OpenRecording, RecordLine, WriteLog
from hippodrome.trial.core.policies import FAILURES
from hippodrome.trial.core.progress import TrialProgress

_MAX_POLICY_FAILURES = 20  # the most failures of policies, each different, that a trial reports
_MAX_ERROR = 2000  # the most characters of an error


class Recordings:
    """Opens and closes the recordings of a trial, one after the other. Lines can be written while one `is_open`."""

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self.is_open = False
        self.is_awaited = False
        """Whether the shell is opening a recording."""
        self._reported: set[str] = set()  # the failures of policies that were reported

    def ask(self, progress: TrialProgress, seed: int) -> None:
        """Ask the shell to open a recording that begins with the present episode. `seed` is the episode's."""
        self.is_awaited = True
        players = tuple(progress.players.values()) if progress.several else ()
        action_space = progress.players[progress.first].action_space
        self._emit(OpenRecording(progress.episode, seed, progress.frame_rate, action_space, players))

    def opened(self) -> None:
        """Note that the shell has opened the recording."""
        self.is_open, self.is_awaited = True, False

    def failed(self) -> None:
        """Note that the shell cannot open the recording."""
        self.is_awaited = False

    def close(self) -> None:
        """Close the recording, if one is open."""
        if self.is_open:
            self.is_open = False
            self._emit(CloseRecording())

    # ---- errors

    def agent_failed(self, error: Exception, episode: int, step: int) -> None:
        """Write an error of the researcher's code to the log and to the recording."""
        self._emit(LogAgentError(error))
        self._emit(RecordLine("error", {"episode": episode, "step": step, "error": words_of(error)}))

    def policy_failed(self, progress: TrialProgress, player: str, words: str) -> None:
        """Write `words` about a policy that has failed to the log and the recording; the same words only once."""
        plays = progress.choices.policies.plays(player)
        texts = [f"the policy of {player} ({plays}) failed: {words}"]
        if progress.choices.policies.idles(player):
            texts.append(f"the policy of {player} failed {FAILURES} times in a row: it idles until the episode is over")
        for text in texts:
            if text in self._reported or len(self._reported) >= _MAX_POLICY_FAILURES:
                continue
            self._reported.add(text)
            self._emit(WriteLog(logging.ERROR, text))
            where = {"episode": progress.episode, "step": progress.steps, "player": player}
            self._emit(RecordLine("error", {**where, "error": text}))


def words_of(error: Exception) -> str:
    """Return the type and the message of an error, of at most `_MAX_ERROR` characters."""
    return "".join(traceback.format_exception_only(error)).strip()[:_MAX_ERROR]
