"""An action of one step, and who chose it. Pure records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

By = Literal["human", "policy", "advice", "none", "late", "random"]
"""Who chose an action. human: a participant. policy: the player's policy. advice: a program at /gym. random: chance,
because the time of the turn was over. late: no one, because the player's policy has not answered in time. none: no one,
so the player takes the idle action, or the first legal one if the idle action is illegal."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one player in one step."""

    index: int
    name: str
    by: By = "none"
    observed: int | None = None
    """The number of steps before the observation with which a policy was asked for this action; None if none was."""
    acts: bool = True
    """Whether the player is to act in this step. If not, this is the idle action, for environments that want one."""
    pressed_at: int | None = None
    """In a session: when the message came with which the participant chose the action, in nanoseconds; else None."""

    @property
    def human(self) -> bool:
        """Whether a participant chose it."""
        return self.by == "human"
