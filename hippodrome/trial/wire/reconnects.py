"""Limits how often a member of a session may connect. Pure; the clock is passed in.

Each connection of a member is recorded and reported to all members, and may make a policy give the player back. Our
page does not reach the limit: it waits for at least half a second after each loss, and longer while it is refused.
"""

from __future__ import annotations

AT_ONCE = 30
"""The number of connections that a member may make at once."""
SECONDS_EACH = 2.0
"""After AT_ONCE connections, the seconds until the member may connect once more."""


class Reconnects:
    """Counts the connections of each member, and says when there are too many."""

    def __init__(self) -> None:
        self._free_at: dict[str, float] = {}
        """By member, the time at which they may connect AT_ONCE times again."""

    def allowed(self, human: str, now: float) -> bool:
        """Return whether the member may connect now. A connection that is refused does not count."""
        free_at = max(self._free_at.get(human, now), now)
        if free_at - now > (AT_ONCE - 1) * SECONDS_EACH:
            return False
        self._free_at[human] = free_at + SECONDS_EACH
        return True
