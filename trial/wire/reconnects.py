"""How often a member of a session may connect. Pure.

Every connection of a member is written down, tells all others, and may let a policy take or give back a place. So who
connects without end is told to wait. An honest page does not meet the limit: it waits half a second at least after each
loss, and longer while it is not let in.
"""

from __future__ import annotations

AT_ONCE = 30
"""So many connections of one member are let in at once,"""
SECONDS_EACH = 2.0
"""and then one more for each of so many seconds."""


class Reconnects:
    """Counts the connections of each member."""

    def __init__(self) -> None:
        self._free_at: dict[str, float] = {}
        """By member, when all AT_ONCE are theirs again."""

    def allowed(self, human: str, now: float) -> bool:
        """Whether the member may connect now. Only then it counts."""
        free_at = max(self._free_at.get(human, now), now)
        if free_at - now > (AT_ONCE - 1) * SECONDS_EACH:
            return False
        self._free_at[human] = free_at + SECONDS_EACH
        return True
