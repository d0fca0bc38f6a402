"""What earlier servers of the participant recorded of a step (`trial/recordings/resume.py` reads it). Pure records."""

from __future__ import annotations

from dataclasses import dataclass, field

from trial.core.progress import Episode


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One step: the human's choice (None: no key acted), its results, and the agent's feedback before it.

    `advice` is what a program advised, if that was taken.
    """

    human: int | None
    action: int | None
    reward: float
    feedback: tuple[str, ...] = ()
    advice: int | None = None


@dataclass(slots=True)
class UnfinishedEpisode:
    """An interrupted episode. `seed` is None if the environment takes none: then it cannot be replayed."""

    number: int
    seed: int | None
    steps: list[RecordedStep] = field(default_factory=list)
    unheard: list[str] = field(default_factory=list)
    """Feedback after the last step, which the agent did not hear before the server ended."""

    @property
    def score(self) -> float:
        return sum(step.reward for step in self.steps)


@dataclass(slots=True)
class RecordedTrial:
    """All that was recorded: the episodes that are over, an interrupted one if there is, and the seconds they took."""

    ended: list[Episode] = field(default_factory=list)
    unfinished: UnfinishedEpisode | None = None
    seconds: float = 0.0
