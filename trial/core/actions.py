"""An action of one step, and who chose it. Pure records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

By = Literal["human", "policy", "advice", "none", "late", "random"]
"""Who chose an action. none: no one did, so the player takes the idle action, or a legal one if that is illegal; late:
the player's policy has not answered in time; random: it was drawn, because the time of the turn was over."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one player in one step."""

    index: int
    name: str
    by: By = "none"
    observed: int | None = None
    """If a policy was asked for this action: the number of steps before the observation it was given; else None."""
    acts: bool = True
    """Whether the player is to act in this step. If not, this is the idle action, for environments that want one."""
    pressed_at: int | None = None
    """In a session: the time at which the message came by which the participant chose the action, in nanoseconds."""

    @property
    def human(self) -> bool:
        """Whether a participant chose it."""
        return self.by == "human"
