"""An action of one step, and who chose it. Pure records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

By = Literal["human", "policy", "advice", "none", "late", "random"]
"""Who chose an action. none: nothing was chosen, and it is the idle one; late: the player's policy has not answered in
time; random: drawn because a turn's time was over."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one player in one step."""

    index: int
    name: str
    by: By = "none"
    observed: int | None = None
    """If a policy was asked for it: the steps of the episode that were taken when it observed."""
    acts: bool = True
    """False if it is not the player's turn, or the player has left: the environment may want an action all the same."""
    pressed_at: int | None = None
    """In a session: the time of the message by which the participant chose it, in nanoseconds."""

    @property
    def human(self) -> bool:
        """Whether a human asked for it."""
        return self.by == "human"
