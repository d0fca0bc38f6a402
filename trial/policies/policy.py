"""What a policy is: it chooses the actions of one player of the environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from trial.core.players import Mask


class PolicyError(Exception):
    """A policy cannot be used, or gave no action. The message is a sentence for the researcher, without its end."""


class PolicyFileMissing(PolicyError):
    """There is no such file."""


class Policy(Protocol):
    """Chooses the actions of one player. All methods run on the policy's thread (`trial/policies/thread.py`)."""

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        """The index of the action to take. Raises PolicyError, and whatever the researcher's code raises."""
        ...

    def reset(self, seed: int) -> None:
        """Begin an episode. After the same seed, the same observations lead to the same actions."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...

    def description(self) -> Mapping[str, Any]:
        """What a recording says of it: `kind`, `policy` as config.yml has it, `sha256` of a file."""
        ...
