"""The interface of policies, and those without a model: a random action, the idle action, a class of agent.py."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, Protocol

from hippodrome.trial.agent import signatures
from hippodrome.trial.core.players import Mask, is_legal, legal_actions
from hippodrome.trial.core.policies import Observed


class PolicyError(Exception):
    """A policy cannot be used, or chose no action.

    The message is a sentence for the researcher, without a full stop.
    """


class PolicyFileMissing(PolicyError):
    """The policy's file does not exist."""


class Policy(Protocol):
    """Chooses the actions of one player of the environment. All methods run on the policy's thread (`places.py`)."""

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


class RandomPolicy:
    """Takes a random action. All legal actions are equally likely."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._random = Random(0)  # noqa: S311 - a game

    def act(self, _observation: Any, _info: Mapping[str, Any], mask: Mask | None) -> int:
        return self._random.choice(legal_actions(self._count, mask))

    def reset(self, seed: int) -> None:
        self._random.seed(seed)

    def resume(self, observed: Sequence[Observed]) -> None:
        choose_again(self, observed)

    def close(self) -> None:
        """Do nothing: there is nothing to free."""

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": "random"}


class IdlePolicy:
    """Takes the idle action, or the first legal action if the idle action is not legal."""

    def __init__(self, count: int, idle: int) -> None:
        self._count, self._idle = count, idle

    def act(self, _observation: Any, _info: Mapping[str, Any], mask: Mask | None) -> int:
        allowed = legal_actions(self._count, mask)
        return self._idle if self._idle in allowed else allowed[0]

    def reset(self, seed: int) -> None:
        """Do nothing: no episode differs from another."""

    def resume(self, observed: Sequence[Observed]) -> None:
        """Do nothing: no choice changes another."""

    def close(self) -> None:
        """Do nothing: there is nothing to free."""

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": "idle"}


class AgentPolicy:
    """Calls an object of a class of agent.py with `act(observation, info)` or `act(observation, info, mask)`.

    `reset(seed)` or `reset()`, `resume(steps)`, and `close()`, are called if the class has them.
    """

    def __init__(self, spec: str, instance: Any, count: int) -> None:
        """`instance` is the object, and `count` the number of the player's actions."""
        self._spec, self._instance, self._count = spec, instance, count
        self._act: Callable[..., Any] = instance.act
        self._takes_mask = _takes(instance.act, 3)
        self._reset, self._resume = getattr(instance, "reset", None), getattr(instance, "resume", None)
        self._reset_takes_seed = callable(self._reset) and _takes(self._reset, 1)

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        more = (mask,) if self._takes_mask else ()
        return checked(self._act(observation, info, *more), self._count, mask)

    def reset(self, seed: int) -> None:
        if callable(self._reset):
            self._reset(*((seed,) if self._reset_takes_seed else ()))

    @property
    def forgets(self) -> bool:
        """Whether the object has a state, and loses it with its server: it has `reset`, but no `resume`."""
        return callable(self._reset) and not callable(self._resume)

    def resume(self, observed: Sequence[Observed]) -> None:
        """Tell the object what it was asked and what it chose. It is not asked again: that may take long, or cost."""
        if callable(self._resume):
            self._resume([(choice.observation, choice.info, choice.action) for choice in observed])

    def close(self) -> None:
        close = getattr(self._instance, "close", None)
        if callable(close):
            close()

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": self._spec}


def checked(action: Any, count: int, mask: Mask | None) -> int:
    """Return the action of `act` as a number. Raises PolicyError if it is no action, or is not legal now."""
    try:
        if isinstance(action, bool):
            raise TypeError
        index = int(action)
        if index != action:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise PolicyError(f"act() returned {str(action)[:40]!r}, which is no action; return its number") from None
    if not 0 <= index < count:
        raise PolicyError(f"act() returned action {index}; there are 0 to {count - 1}")
    if not is_legal(index, mask):
        raise PolicyError(f"act() returned action {index}, which action_mask forbids now")
    return index


def of_class(spec: str, module: Any, player: str, count: int) -> AgentPolicy:
    """Make the policy `agent:Name` for this player. The class gets the player's name if it has a parameter `player`.

    Raises PolicyError if agent.py has no class of this name with a method `act` that can be called, and whatever the
    class raises.
    """
    name = spec.partition(":")[2]
    policy_class = getattr(module, name, None)
    if module is None:
        raise PolicyError(f"{spec} is a class of agent.py, and there is no agent.py")
    if not isinstance(policy_class, type):
        others = [key for key, value in vars(module).items() if isinstance(value, type) and hasattr(value, "act")]
        hint = f"; classes with act() there: {', '.join(others)}" if others else ""
        raise PolicyError(f"there is no class {name} in agent.py{hint}")
    if not callable(getattr(policy_class, "act", None)):
        raise PolicyError(f"class {name} in agent.py has no act(observation, info)")
    instance = policy_class(player=player) if signatures.names(policy_class, "player") else policy_class()
    if _has_signature(instance.act) and not (_takes(instance.act, 2) or _takes(instance.act, 3)):
        raise PolicyError(f"act of class {name} in agent.py takes other values; write act(self, observation, info)")
    resume = getattr(instance, "resume", None)
    if callable(resume) and _has_signature(resume) and not _takes(resume, 1):
        raise PolicyError(f"resume of class {name} in agent.py takes other values; write resume(self, steps)")
    return AgentPolicy(spec, instance, count)


def _takes(function: Callable[..., Any], count: int) -> bool:
    """Whether the function can be called with `count` positional arguments."""
    try:
        inspect.signature(function).bind(*[None] * count)
    except (TypeError, ValueError):
        return False
    return True


def _has_signature(function: Callable[..., Any]) -> bool:
    try:
        inspect.signature(function)
    except (TypeError, ValueError):  # some functions in C have no signature, and can be called all the same
        return False
    return True
