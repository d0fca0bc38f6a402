"""The call that the agent's thread is making now, one at a time. Pure; the clock is passed in."""

from __future__ import annotations

from collections.abc import Callable

from hippodrome.trial.core.effects import Call, Effect


class AgentCall:
    """Gives the agent one call at a time.

    A call that does not return in time may still run on the agent's thread. The agent gets no further call then.
    """

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self.call: Call | None = None
        """The call that has not ended yet; None if there is none."""
        self.give_up_at: float | None = None
        """The time at which the trial gives up the present call; None: only the call's own limit counts."""
        self.hangs = False
        """Whether a call has not returned in time."""

    def make(self, call: Call) -> None:
        """Give the agent this call."""
        self.call = call
        self._emit(call)

    def has_ended(self, call: Call, *, hangs: bool = False) -> bool:
        """Note that a call has ended, and return whether its result counts: a call that was given up does not.

        `hangs`: the call has not returned within its limit.
        """
        if call is not self.call:
            return False
        self.call, self.give_up_at = None, None
        self.hangs |= hangs
        return True

    def give_up(self, now: float) -> None:
        """Give up the present call if `give_up_at` has come. A result that comes later changes nothing."""
        if self.give_up_at is not None and now >= self.give_up_at:
            self.call, self.give_up_at, self.hangs = None, None, True
