"""The two functions that a program may replace, as in Gymie: how an environment is made, and what a step becomes."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from trial.gym import ids
from trial.gym.errors import EnvironmentMalformed, EnvironmentNotFound, of

F = TypeVar("F", bound=Callable[..., Any])

_replaced: dict[str, Callable[..., Any]] = {}
_NAMES = ("get_env", "process_step")


def override(func_name: str) -> Callable[[F], F]:
    """Decorator: the function takes the place of `get_env` or `process_step`.

    `get_env(env_id, **params)` gets the parameters of `make` and returns an environment, of Gymnasium's kind or of
    gym's old one. `process_step((observation, reward, done, info))` returns what `step` answers. Raises AssertionError
    for another name, as Gymie does.
    """
    assert func_name in _NAMES, "Error overriding. Functions available: `get_env`, `process_step`"

    def replace(function: F) -> F:
        _replaced[func_name] = function
        return function

    return replace


def replaced(func_name: str) -> Callable[..., Any] | None:
    """The program's own function, if it has one."""
    return _replaced.get(func_name)


def get_env(env_id: str, seed: int | None = None, **options: Any) -> Any:
    """Make an environment of Gymnasium's registry; `seed` is for its first reset.

    An id that gym 0.17 had and Gymnasium has not becomes its successor's (`ids.py`). An id with a module
    (`module:Name-v0`) is refused: Gymnasium would import that module. Raises EnvironmentNotFound,
    and EnvironmentMalformed with what Gymnasium says.
    """
    import gymnasium  # noqa: PLC0415 - the process that listens does without

    if ":" in env_id:
        raise EnvironmentMalformed(env_id, "a client cannot name a module; the server imports it with --import")
    now, more = ids.present(env_id)
    if now != env_id:
        print(f"Gymnasium has no {env_id} any more; {now} is used instead.", file=sys.stderr)
    try:
        return gymnasium.make(now, **(more | options))
    except gymnasium.error.UnregisteredEnv as error:
        raise EnvironmentNotFound(env_id, of(error)) from error
    except Exception as error:
        raise EnvironmentMalformed(env_id, of(error)) from error
