"""What earlier servers of the participant recorded of a step (`trial/recordings/resume.py` reads it). Pure records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from trial.core.ended import Episode
from trial.core.message_log import Word
from trial.core.policies import FAILURES


@dataclass(frozen=True, slots=True)
class RecordedAction:
    """One player's part of a step. `action` is None if it was not their turn; `observed` and `by` as in `Action`."""

    action: int | None
    reward: float
    observed: int | None = None
    by: str | None = None


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One step: the human's choice (None: no key acted), its results, and the agent's feedback before it.

    `advice` is what a program advised, if that was taken; `players` are all players, if there are several.
    """

    human: int | None
    action: int | None
    reward: float
    feedback: tuple[Word, ...] = ()
    advice: int | None = None
    players: Mapping[str, RecordedAction] = field(default_factory=dict)


@dataclass(slots=True)
class UnfinishedEpisode:
    """An interrupted episode. `seed` is None if the environment takes none: then it cannot be replayed."""

    number: int
    seed: int | None
    steps: list[RecordedStep] = field(default_factory=list)
    unheard: list[Word] = field(default_factory=list)
    """Feedback after the last step, which the agent did not hear before the server ended."""

    @property
    def score(self) -> float:
        return sum(step.reward for step in self.steps)

    @property
    def scores(self) -> dict[str, float]:
        """The scores of all players, if there are several."""
        found: dict[str, float] = {}
        for step in self.steps:
            for player, part in step.players.items():
                found[player] = found.get(player, 0.0) + part.reward
        return found

    @property
    def going_on(self) -> dict[str, int]:
        """By player, its last action, if a policy chose that in the last step or in an earlier one."""
        chosen: dict[str, int | None] = {}
        for step in self.steps:
            looked = {player: part for player, part in step.players.items() if part.observed is not None}
            chosen |= {player: None if part.by == "none" else part.action for player, part in looked.items()}
        last = self.steps[-1].players if self.steps else {}
        return {
            player: part.action
            for player, part in last.items()
            if part.action is not None and chosen.get(player) == part.action
        }

    @property
    def failures(self) -> dict[str, int]:
        """By player, how often its policy failed in a row at the end.

        What it looked at stands in a step that a policy failed for. An action that had become illegal when it came
        looks alike; but after that the policy is asked again, and one that idles is not.
        """
        found: dict[str, int] = {}
        idle: set[str] = set()
        for step in self.steps:
            for player, part in step.players.items():
                failed = part.observed is not None and part.by in ("none", "late")
                if failed:
                    found[player] = found.get(player, 0) + 1
                elif part.by == "none" and found.get(player, 0) >= FAILURES:
                    idle.add(player)
                elif part.observed is not None or part.by == "human":
                    found.pop(player, None)
                if part.observed is not None or part.by == "human":
                    idle.discard(player)
        return {player: count if player in idle else min(count, FAILURES - 1) for player, count in found.items()}


@dataclass(slots=True)
class RecordedTrial:
    """What was recorded: the episodes that are over, an interrupted one if there is one, and the seconds of all."""

    ended: list[Episode] = field(default_factory=list)
    unfinished: UnfinishedEpisode | None = None
    seconds: float = 0.0
    outcomes: dict[str, str] = field(default_factory=dict)
    """In a session, by player: how the trial has ended for each member, as far as it has."""

    @property
    def begun(self) -> bool:
        """Whether anything was played. A server begins an episode before its participants come."""
        return bool(self.ended) or (self.unfinished is not None and bool(self.unfinished.steps))
