"""`make` and `register`, for environments that an agent registers, and for Gymnasium's and ALE's, by old ids too."""

from __future__ import annotations

import contextlib
import importlib
import re
import warnings
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec, load_env_creator

from gym.core import FromGymnasium
from gym.wrappers import TimeLimit

_ID = re.compile(r"(?P<name>.+)-v(?P<version>\d+)")
_OLD_ATARI = re.compile(r"(?P<game>[A-Z]\w*?)(?P<kind>Deterministic|NoFrameskip)?-v(?P<version>[04])")


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
    id, more = _present(id)
    kwargs = {"disable_env_checker": True, **more, **kwargs}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Gymnasium, that the id is old
        if "render_mode" in kwargs:
            return gymnasium.make(id, **kwargs)
        return FromGymnasium(gymnasium.make(id, render_mode="rgb_array", **kwargs))


def _make_registered(spec: EnvSpec, kwargs: dict[str, Any]) -> Any:
    create: Any = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    env = create(**{**spec.kwargs, **kwargs})
    env.unwrapped.spec = spec
    return TimeLimit(env, spec.max_episode_steps) if spec.max_episode_steps else env


def _present(id: str) -> tuple[str, dict[str, Any]]:
    """Return the environment's id in Gymnasium or ALE today, and further arguments for `gymnasium.make`."""
    atari = _OLD_ATARI.fullmatch(id)
    if (id.startswith("ALE/") or atari) and id not in gymnasium.registry:
        with contextlib.suppress(ImportError):
            import ale_py  # noqa: PLC0415 - needed for Atari games alone

            gymnasium.register_envs(ale_py)
    if id in gymnasium.registry:
        return id, {}
    if atari and (plain := f"{atari['game']}-v{atari['version']}") in gymnasium.registry:
        return plain, {"frameskip": 4}  # all other kinds are registered
    known = [match for key in gymnasium.registry if (match := _ID.fullmatch(key))]
    same = [match for match in known if match["name"] == id.rpartition("-v")[0]]
    if not same:
        return id, {}
    newest = str(max(same, key=lambda match: int(match["version"]))[0])
    warnings.warn(f"Gymnasium has no {id} any more; {newest} is used instead", stacklevel=3)
    return newest, {}
