"""Asks a quick policy on the event loop itself, without a thread."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from hippodrome.trial.core.players import Mask
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.policy import Policy
from hippodrome.trial.policies.thread import Done


class InlinePolicy:
    """Asks a policy whose methods return at once. Has the same methods as `PolicyThread`."""

    busy = False

    def __init__(self, policy: Policy, done: Done) -> None:
        self.policy = policy
        self._done = done
        self._loop = asyncio.get_running_loop()

    def ask(self, ask_id: int, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> None:
        """Ask for an action. The event loop then calls `done(ask_id, action, None)`."""
        self._loop.call_soon(self._done, ask_id, self.policy.act(observation, info, mask), None)

    def reset(self, seed: int, observed: Sequence[Observed] = ()) -> None:
        """Begin an episode, or resume it after the choices `observed`."""
        self.policy.reset(seed)
        self.policy.resume(observed)

    def close(self) -> None:
        """Close the policy."""
        self.policy.close()
