"""Opens and closes recordings; builds lines about errors and ends, and the answers. Pure: it emits effects."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import CloseRecording, Effect, LogAgentError, OpenRecording, RecordLine, WriteLog
from hippodrome.trial.core.history import Break, Episode
from hippodrome.trial.core.policies import FAILURES
from hippodrome.trial.core.progress import TrialProgress


def end(
    over: Episode | Break, received: Sequence[Mapping[str, Any]], outcomes: Mapping[str, str | None] | None = None
) -> RecordLine:
    """Build the line that ends an episode or a break. `received`: the clients' messages since the line before.

    `outcomes`: if the trial of a session ends with it, how it has ended for each member, by player.
    """
    fields: dict[str, Any] = {"episode": number(over)}
    if not isinstance(over, Break):
        fields |= {"steps": over.steps, **_scores(over.score, over.scores)}
        fields |= {} if over.limit is None else {"limit": over.limit}
    fields |= {"why": over.why, "messages": received}
    fields |= {} if outcomes is None else {"outcomes": outcomes}
    return RecordLine("break" if isinstance(over, Break) else "end", fields)


def shutdown(progress: TrialProgress, received: Sequence[Mapping[str, Any]]) -> RecordLine:
    """Build the line that ends the present episode because the server must end. `received` as in `end`."""
    fields: dict[str, Any] = {"episode": progress.episode, "steps": progress.steps, "why": "shutdown"}
    fields |= _scores(progress.episode_score, progress.episode_scores if progress.several else {})
    return RecordLine("end", {**fields, "messages": received})


def answers(progress: TrialProgress, seconds: float, trial_id: str) -> dict[str, Any]:
    """Build the answer of the game step. `seconds`: the time that was played."""
    return {
        "episodes": progress.episodes_played,
        **_scores(progress.score, progress.scores if progress.several else {}),
        "frames": progress.total_steps,
        "seconds": round(seconds, 3),
        "trial": trial_id,
        "outcome": progress.outcome,
        **({"reached": progress.reached} if progress.config.until else {}),
    }


def member_answers(
    progress: TrialProgress, player: str, outcome: str | None, seconds: float, trial_id: str
) -> dict[str, Any]:
    """Build the answer of a member of a session, with their own score and outcome. `seconds` as in `answers`."""
    own = {"score": messages.tidy(progress.scores[player]), "player": player, "outcome": outcome}
    return answers(progress, seconds, trial_id) | own


def result(
    progress: TrialProgress, player: str, answers: Mapping[str, Any] | None, *, in_session: bool
) -> tuple[int, float, str | None]:
    """Return the values of a client's last message: episodes, the player's score, and in a session the outcome.

    `answers` is the stored answer of the participant or member; None if there is none.
    """
    if answers is None:
        return progress.episodes_played, progress.scores[player], None
    scores = {} if in_session else answers.get("scores") or {}
    score = scores.get(player, answers.get("score", 0))
    return answers.get("episodes", 0), score, answers.get("outcome") if in_session else None


def number(over: Episode | Break) -> int:
    """Return the number of the episode that is over, or of the episode before the break that is over."""
    return over.after if isinstance(over, Break) else over.number


def _scores(score: float, scores: Mapping[str, float]) -> dict[str, Any]:
    """Return the fields of a score, and of the scores of all players if there are several."""
    several = {player: messages.tidy(value) for player, value in scores.items()}
    return {"score": messages.tidy(score), **({"scores": several} if several else {})}


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
