"""What earlier servers have recorded of a game step. `hippodrome/trial/recordings/resume.py` reads it. Pure records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from hippodrome.trial.core.ended import Episode
from hippodrome.trial.core.message_log import Word
from hippodrome.trial.core.policies import FAILURES


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
