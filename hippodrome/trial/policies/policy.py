"""The interface of policies. A policy chooses the actions of one player of the environment."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from hippodrome.trial.core.players import Mask
from hippodrome.trial.core.policies import Observed


class PolicyError(Exception):
    """A policy cannot be used, or chose no action.

    The message is a sentence for the researcher, without a full stop.
    """


class PolicyFileMissing(PolicyError):
    """The policy's file does not exist."""


class Policy(Protocol):
    """Chooses the actions of one player. All methods run on the policy's thread (`trial/policies/thread.py`)."""

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        """Choose an action, and return its number. `mask` says which actions are legal now.

        Raises PolicyError if the policy chooses no legal action, and whatever the researcher's code raises.
        """
        ...

    def reset(self, seed: int) -> None:
        """Begin an episode. After the same seed, the same observations lead to the same actions."""
        ...

    def resume(self, observed: Sequence[Observed]) -> None:
        """Reach the state after these choices of the episode, which were made on an earlier server.

        Called after `reset`. Raises whatever the researcher's code raises.
        """
        ...

    def close(self) -> None:
        """Free the policy's resources."""
        ...

    def description(self) -> Mapping[str, Any]:
        """Return the policy's fields in a recording: `kind`, `policy` as in config.yml, and of a file its `sha256`."""
        ...


def choose_again(policy: Policy, observed: Sequence[Observed]) -> None:
    """Resume a policy whose choices cost nothing and follow from its seed: let it make them again."""
    for choice in observed:
        with contextlib.suppress(Exception):  # it failed on the earlier server too
            policy.act(choice.observation, choice.info, choice.mask)
