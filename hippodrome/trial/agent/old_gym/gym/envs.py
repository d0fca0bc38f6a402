"""`make` and `register`, for environments that an agent registers, and for Gymnasium's and ALE's, by old ids too."""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec, load_env_creator

from gym.core import FromGymnasium
from gym.wrappers import TimeLimit
from hippodrome.trial.agent.environments import registered_id

registration = sys.modules[__name__]  # `gym.envs.registration`
registry: dict[str, EnvSpec] = {}
"""What `register` was given, by id."""


def register(id: str, entry_point: Any, **kwargs: Any) -> None:
    """Register an environment for `make`. `entry_point` is its class, a function, or `module:Class`."""
    registry[id] = EnvSpec(id, entry_point, **kwargs)


def make(id: str, **kwargs: Any) -> Any:
    """Make a new environment. An id such as `module:Env-v0` imports the module first, which registers the id.

    Raises Gymnasium's error if it has no environment of this id.
    """
    module, colon, rest = id.partition(":")
    if colon:
        importlib.import_module(module)
        id = rest
    if id in registry:
        return _make_registered(registry[id], kwargs)
    now, more = registered_id(id)
    if now != id and not more:
        warnings.warn(f"Gymnasium has no {id} any more; {now} is used instead", stacklevel=2)
    kwargs = {"disable_env_checker": True, **more, **kwargs}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Gymnasium, that the id is old
        if "render_mode" in kwargs:
            return gymnasium.make(now, **kwargs)
        return FromGymnasium(gymnasium.make(now, render_mode="rgb_array", **kwargs))


def _make_registered(spec: EnvSpec, kwargs: dict[str, Any]) -> Any:
    create: Any = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    env = create(**{**spec.kwargs, **kwargs})
    env.unwrapped.spec = spec
    return TimeLimit(env, spec.max_episode_steps) if spec.max_episode_steps else env
