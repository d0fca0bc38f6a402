"""The functions that a program may replace, as in Gymie: `get_env` makes environments, `process_step` changes steps."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from hippodrome.trial.agent import environments
from hippodrome.trial.gym.forms import EnvironmentMalformed, EnvironmentNotFound, described

F = TypeVar("F", bound=Callable[..., Any])

_replaced: dict[str, Callable[..., Any]] = {}
_NAMES = ("get_env", "process_step")


def override(func_name: str) -> Callable[[F], F]:
    """Replace `get_env` or `process_step` by the decorated function.

    `get_env(env_id, **params)` gets the parameters of `make`. It returns an environment of Gymnasium's kind or of gym's
    old kind. `process_step((observation, reward, done, info))` returns these four values as `step` is to answer them.
    Raises AssertionError for another name, as Gymie does.
    """
    assert func_name in _NAMES, "Error overriding. Functions available: `get_env`, `process_step`"

    def replace(function: F) -> F:
        _replaced[func_name] = function
        return function

    return replace


def replaced(func_name: str) -> Callable[..., Any] | None:
    """Return the program's own function in the place of the one named `func_name`; None if it has not replaced that."""
    return _replaced.get(func_name)


def get_env(env_id: str, seed: int | None = None, **options: Any) -> Any:
    """Make an environment of Gymnasium's registry. `seed` has no effect here: the first reset uses it.

    An id of gym 0.17 that Gymnasium does not have is replaced by the newest one (`registered_id`). An id with a module
    (`module:Name-v0`) is refused, since Gymnasium would import that module. Raises EnvironmentNotFound, and
    EnvironmentMalformed with Gymnasium's reason.
    """
    import gymnasium  # noqa: PLC0415 - the process that listens must not import it

    if ":" in env_id:
        raise EnvironmentMalformed(env_id, "a client cannot name a module; the server imports it with --import")
    now, more = environments.registered_id(env_id)
    if now != env_id:
        print(f"Gymnasium has no {env_id} any more; {now} is used instead.", file=sys.stderr)
    try:
        return gymnasium.make(now, **(more | options))
    except gymnasium.error.UnregisteredEnv as error:
        failed = EnvironmentNotFound if environments.has_version(env_id) else EnvironmentMalformed  # as in gym 0.17
        raise failed(env_id, described(error)) from error
    except Exception as error:
        raise EnvironmentMalformed(env_id, described(error)) from error
