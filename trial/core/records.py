"""What the core writes of how far a trial is: the ends of episodes and breaks, and the answer. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trial.core import messages
from trial.core.effects import RecordLine
from trial.core.ended import Break, Episode
from trial.core.progress import TrialProgress


def end(
    over: Episode | Break, said: Sequence[Mapping[str, Any]], outcomes: Mapping[str, str | None] | None = None
) -> RecordLine:
    """The line that ends an episode or a break. `said`: the participant's messages since the line before.

    `outcomes`: in a session, by player, how the trial has ended with it for each member.
    """
    fields: dict[str, Any] = {"episode": number(over)}
    if not isinstance(over, Break):
        fields |= {"steps": over.steps, **_scores(over.score, over.scores)}
        fields |= {} if over.limit is None else {"limit": over.limit}
    fields |= {"why": over.why, "messages": said}
    fields |= {} if outcomes is None else {"outcomes": outcomes}
    return RecordLine("break" if isinstance(over, Break) else "end", fields)


def shutdown(progress: TrialProgress, said: Sequence[Mapping[str, Any]]) -> RecordLine:
    """The line that ends the present episode because the server must end. `said` as in `end`."""
    fields: dict[str, Any] = {"episode": progress.episode, "steps": progress.steps, "why": "shutdown"}
    fields |= _scores(progress.episode_score, progress.episode_scores if progress.several else {})
    return RecordLine("end", {**fields, "messages": said})


def answers(progress: TrialProgress, seconds: float, trial_id: str) -> dict[str, Any]:
    """The answer of the step. `seconds`: how long was played."""
    return {
        "episodes": progress.episodes_played,
        **_scores(progress.score, progress.scores if progress.several else {}),
        "frames": progress.total_steps,
        "seconds": round(seconds, 3),
        "trial": trial_id,
        "outcome": progress.outcome,
    }


def member_answers(
    progress: TrialProgress, player: str, outcome: str | None, seconds: float, trial_id: str
) -> dict[str, Any]:
    """The answer of a member of a session, with their own score."""
    own = {"score": messages.tidy(progress.scores[player]), "player": player, "outcome": outcome}
    return answers(progress, seconds, trial_id) | own


def result(
    progress: TrialProgress, player: str, answers: Mapping[str, Any] | None, *, in_session: bool
) -> tuple[int, float, str | None]:
    """What a client is told when the trial is over: episodes, the player's score, and in a session the outcome.

    `answers` is the answer, if it is known: of the participant, or of the member.
    """
    if answers is None:
        return progress.episodes_played, progress.scores[player], None
    scores = {} if in_session else answers.get("scores") or {}
    score = scores.get(player, answers.get("score", 0))
    return answers.get("episodes", 0), score, answers.get("outcome") if in_session else None


def number(over: Episode | Break) -> int:
    """The number of the episode that is over; of a break, that of the episode before it."""
    return over.after if isinstance(over, Break) else over.number


def _scores(score: float, scores: Mapping[str, float]) -> dict[str, Any]:
    """A score for the records, and those of all players if there are several."""
    several = {player: messages.tidy(value) for player, value in scores.items()}
    return {"score": messages.tidy(score), **({"scores": several} if several else {})}
