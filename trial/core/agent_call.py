"""The call that the agent has: one at a time. Pure; the clock is passed in."""

from __future__ import annotations

from collections.abc import Callable

from trial.core.effects import Call, Effect


class AgentCall:
    """Gives the agent one call at a time.

    A call that does not come back may still run on the agent's thread: then the agent gets no other call any more.
    """

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self.call: Call | None = None
        """What the agent has to do now."""
        self.give_up_at: float | None = None
        """When the present call is given up; None: it has as long as its own limit."""
        self.hangs = False
        """A call has not come back."""

    def make(self, call: Call) -> None:
        """Give the agent this call."""
        self.call = call
        self._emit(call)

    def has_ended(self, call: Call, *, hangs: bool = False) -> bool:
        """The shell says that a call has ended. Return whether it is the call that the agent has.

        `hangs`: it has not come back within its limit.
        """
        if call is not self.call:
            return False
        self.call, self.give_up_at = None, None
        self.hangs |= hangs
        return True

    def give_up(self, now: float) -> None:
        """Give the call up if its time is over. If it comes back later, that changes nothing."""
        if self.give_up_at is not None and now >= self.give_up_at:
            self.call, self.give_up_at, self.hangs = None, None, True
