"""Builds the lines that end episodes and breaks, and the answers. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import RecordLine
from hippodrome.trial.core.ended import Break, Episode
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
