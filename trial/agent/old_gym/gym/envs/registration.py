"""`make` and `register`, for environments that an agent registers, and for Gymnasium's and ALE's, by old ids too."""

from __future__ import annotations

import contextlib
import copy
import importlib
import inspect
import re
import warnings
from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from gym.core import Env, FromGymnasium, Wrapper
from gym.wrappers.time_limit import TimeLimit

_ID = re.compile(r"(?P<name>.+)-v(?P<version>\d+)")
_OLD_ATARI = re.compile(r"(?P<game>[A-Z]\w*?)(?P<ram>-ram)?(?P<kind>Deterministic|NoFrameskip)?-v(?P<version>[04])")
_PICTURE = "rgb_array"


@dataclass
class EnvSpec:
    """The arguments of `register`."""

    id: str
    entry_point: str | Callable[..., Any] | None = None
    reward_threshold: float | None = None
    nondeterministic: bool = False
    max_episode_steps: int | None = None
    order_enforce: bool = True
    kwargs: dict[str, Any] = field(default_factory=dict)

    def make(self, **kwargs: Any) -> Any:
        """Make a new environment."""
        return make(self, **kwargs)


class EnvRegistry(ChainMap[str, Any]):
    """Specifications by id: those of `register` first, then Gymnasium's."""

    @property
    def env_specs(self) -> EnvRegistry:
        """The registry itself, under its older name."""
        return self

    def all(self) -> Any:
        """Return the specifications of all environments."""
        return self.values()

    def spec(self, id: str) -> Any:
        """Return the specification of this id. Raises gym.error.Error if there is none."""
        return spec(id)

    def make(self, id: str, **kwargs: Any) -> Any:
        """Make a new environment."""
        return make(id, **kwargs)

    def register(self, id: str, **kwargs: Any) -> None:
        """Register an environment: see the function `register`."""
        register(id, **kwargs)


registry = EnvRegistry({}, gymnasium.registry)


def register(id: str, entry_point: Any = None, **kwargs: Any) -> None:
    """Register an environment for `make`. `entry_point` is its class, a function, or `module:Class`."""
    known = {key: value for key, value in kwargs.items() if key in EnvSpec.__dataclass_fields__ and value is not None}
    registry[id] = EnvSpec(id, entry_point, **known)


def spec(id: str) -> Any:
    """Return the specification of an id. Raises gym.error.Error if there is none."""
    id = _imported(id)
    known = registry.maps[0].get(id)
    return gymnasium.spec(_newest(id)[0]) if known is None else known


def make(id: Any, **kwargs: Any) -> Any:
    """Make a new environment, of an id or an EnvSpec. Raises gym.error.Error if there is none of this id."""
    name = _imported(id if isinstance(id, str) else id.id)
    registered = id if isinstance(id, EnvSpec) else registry.maps[0].get(name)
    for old in ("new_step_api", "apply_api_compatibility", "autoreset", "disable_env_checker"):
        kwargs.pop(old, None)
    return _make_registered(registered, kwargs) if registered is not None else _make_of_gymnasium(name, kwargs)


def _imported(id: str) -> str:
    """Import the module in an id such as `module:Env-v0`, which registers it. Return the id without the module."""
    module, colon, rest = id.partition(":")
    if colon:
        importlib.import_module(module)
    return rest or id


def _make_registered(wanted: EnvSpec, kwargs: dict[str, Any]) -> Any:
    if wanted.entry_point is None:
        raise gymnasium.error.Error(f"{wanted.id} is registered without an entry_point")
    create: Any = load_env_creator(wanted.entry_point) if isinstance(wanted.entry_point, str) else wanted.entry_point
    steps = kwargs.pop("max_episode_steps", wanted.max_episode_steps)
    given = {**copy.deepcopy(wanted.kwargs), **kwargs}
    new = isinstance(create, type) and issubclass(create, gymnasium.Env) and not issubclass(create, Env)
    if new and "render_mode" not in given and "render_mode" in inspect.signature(create).parameters:
        given["render_mode"] = _PICTURE
    env = create(**given)
    with contextlib.suppress(AttributeError):
        env.unwrapped.spec = wanted
    if isinstance(env, gymnasium.Env) and not isinstance(env, Env):
        env = FromGymnasium(env)
    return TimeLimit(env, steps) if steps and steps > 0 else env


def _make_of_gymnasium(id: str, kwargs: dict[str, Any]) -> Any:
    id, more = _newest(id)
    kwargs = {**more, **kwargs}
    if "render_mode" in kwargs:
        return Wrapper(gymnasium.make(id, disable_env_checker=True, **kwargs))
    limit = kwargs.pop("max_episode_steps", None)
    try:
        made = _quietly(id, render_mode=_PICTURE, **kwargs)
    except TypeError as error:
        if "render_mode" not in str(error):
            raise
        made = _quietly(id, **kwargs)
    env = FromGymnasium(made)
    env.__dict__["spec"] = known = gymnasium.spec(id)
    steps = known.max_episode_steps if limit is None else limit
    return TimeLimit(env, steps) if steps and steps > 0 else env


def _quietly(id: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Make an environment of Gymnasium's without a limit of steps, and without the warning that the id is old."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(id, max_episode_steps=-1, disable_env_checker=True, **kwargs)


def _newest(id: str) -> tuple[str, dict[str, Any]]:
    """Return the environment's id in Gymnasium or ALE today, and further arguments for `gymnasium.make`."""
    atari = _OLD_ATARI.fullmatch(id)
    if (id.startswith("ALE/") or atari) and id not in gymnasium.registry:
        with contextlib.suppress(ImportError):
            import ale_py  # noqa: PLC0415 - needed for Atari games alone

            gymnasium.register_envs(ale_py)
    if id in gymnasium.registry:
        return id, {}
    if atari:
        kind = atari["kind"] if atari["kind"] == "NoFrameskip" else ""
        plain = f"{atari['game']}{kind}-v{atari['version']}"
        if plain in gymnasium.registry:
            frames = {"frameskip": 4} if atari["kind"] == "Deterministic" else {}
            return plain, {**frames, **({"obs_type": "ram"} if atari["ram"] else {})}
    named = _ID.fullmatch(id)
    if named:
        versions = [
            found for key in gymnasium.registry if (found := _ID.fullmatch(key)) and found["name"] == named["name"]
        ]
        if versions:
            now = max(versions, key=lambda found: int(found["version"]))[0]
            warnings.warn(f"Gymnasium has no {id} any more; {now} is used instead", stacklevel=4)
            return now, {}
    return id, {}
