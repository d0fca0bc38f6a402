"""An action of one step, and who chose it. Pure records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

By = Literal["human", "policy", "advice", "none", "late", "random"]
"""Who chose an action. none: no one did, so it is the idle action or a legal one in its place; late: the player's
policy has not answered in time; random: it was drawn, because the time of the turn was over."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one player in one step."""

    index: int
    name: str
    by: By = "none"
    observed: int | None = None
    """If a policy was asked: how many steps of the episode had been taken at the observation that it was given."""
    acts: bool = True
    """Whether the player is to act in this step. Some environments want an action of the other players, too."""
    pressed_at: int | None = None
    """In a session: when the message came by which the participant chose the action, in nanoseconds."""

    @property
    def human(self) -> bool:
        """Whether a participant chose it."""
        return self.by == "human"
