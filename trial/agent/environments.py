"""What an environment is: of one player (Gymnasium) or of several (PettingZoo and others), and who these are."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


class PlayersUnknown(ValueError):
    """It cannot be told who plays, or what they can do. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Players:
    """The players of an environment."""

    env: Any
    names: tuple[str, ...]
    keys: Mapping[str, Any]
    """By the name of a player, what the environment calls them: a text, a number …"""
    action_names: Mapping[str, tuple[str, ...]]
    observation_spaces: Mapping[str, Any]
    starts: Mapping[str, int]
    """The number of each player's first action for the environment."""
    counts: Mapping[str, int | None]
    """How many actions each has for the environment; None if that is not known."""
    of_env: bool
    """`env` itself is stepped, and its `agents` are those who are still in the game."""


class AecTurns:
    """Who is to act in a PettingZoo `AECEnv` in which players take turns."""

    def __init__(self, aec: Any) -> None:
        self._aec = aec

    def selected(self) -> Any:
        """The environment's own name of the player; an empty list if none is left."""
        return self._aec.agent_selection if self._aec.agents else []


def is_module(game: str) -> bool:
    """Whether a game is named as a module with a package: `pettingzoo.butterfly.cooperative_pong_v6`."""
    return "." in game and all(part.isidentifier() for part in game.split("."))


def made_by_module(game: str) -> Any:
    """What the module's `parallel_env`, else its `env` makes, drawn as arrays; an `AECEnv` as a `ParallelEnv`.

    Raises PlayersUnknown if its package has no such module or the module makes no environment, ImportError if
    something else cannot be imported.
    """
    try:
        module = importlib.import_module(game)
    except ModuleNotFoundError as error:
        others = _similar(game) if error.name == game else []
        if not others:
            raise
        raise PlayersUnknown(f"there is no module {game}; its package has {', '.join(others)}") from None
    make = getattr(module, "parallel_env", None) or getattr(module, "env", None)
    if not callable(make):
        raise PlayersUnknown(f"the module {game} has neither parallel_env() nor env()")
    return playable(make(render_mode="rgb_array"))


def _similar(game: str) -> list[str]:
    """The modules of the same package that are another version of the game, or else all of them."""
    package, _, name = game.rpartition(".")
    folder = getattr(importlib.import_module(package), "__path__", [])
    found = [each.name for each in pkgutil.iter_modules(folder) if re.search(r"_v\d+$", each.name)]
    stem = re.sub(r"_v\d+$", "", name)
    return [other for other in found if other.startswith(f"{stem}_v")] or found


def playable(env: Any) -> Any:
    """The environment as it is; an `AECEnv` of PettingZoo as a `ParallelEnv`, by PettingZoo's own wrappers."""
    if not is_aec(env):
        return env
    from pettingzoo.utils import conversions  # noqa: PLC0415 - whoever brings an AECEnv has it

    if _at_once(env):
        return conversions.aec_to_parallel(env)
    return conversions.turn_based_aec_to_parallel(env)


def turns(env: Any) -> AecTurns | None:
    """Whose turn it is in an `AECEnv`, or in what `playable` made of it; None if players act at the same time."""
    aec = env if is_aec(env) else getattr(env, "aec_env", None)
    return None if aec is None or not is_aec(aec) or _at_once(aec) else AecTurns(aec)


def is_aec(env: Any) -> bool:
    """Whether it is a PettingZoo `AECEnv`, or has its methods."""
    return callable(getattr(env, "agent_iter", None)) and callable(getattr(env, "last", None))


def _at_once(aec: Any) -> bool:
    return bool((getattr(aec, "metadata", None) or {}).get("is_parallelizable", False))


def player_keys(*places: Any) -> list[Any]:
    """What the first of these objects that has several players calls them; empty if none has."""
    for place in places:
        for one in (place, getattr(place, "unwrapped", None)):
            keys = _keys(one)
            if keys:
                return keys
    return []


def _keys(place: Any) -> list[Any]:
    named = getattr(place, "possible_agents", None)
    return list(named) if isinstance(named, Iterable) and not isinstance(named, str) else []


def players_of(
    env: Any, keys: Sequence[Any], configured: Sequence[str], *, of_env: bool, stepped: bool = True
) -> Players:
    """The players with these keys, and their actions: the configured names first.

    `of_env`: as in `Players`. `stepped`: the environment itself gets the actions, so there are as many as its spaces
    have, and they begin there. Raises PlayersUnknown if two players have the same name as text, or if the actions of
    one cannot be told.
    """
    by_name = {str(key): key for key in keys}
    if len(by_name) != len(keys):
        raise PlayersUnknown(f"two players have the same name: {', '.join(map(str, keys))}")
    spaces = {name: _space(env, "action_space", key) for name, key in by_name.items()}
    return Players(
        env=env,
        names=tuple(by_name),
        keys=by_name,
        action_names={name: _action_names(env, spaces[name], configured, stepped) for name in by_name},
        observation_spaces={name: _space(env, "observation_space", key) for name, key in by_name.items()},
        starts={name: int(getattr(space, "start", 0)) if stepped else 0 for name, space in spaces.items()},
        counts={name: getattr(space, "n", None) for name, space in spaces.items()},
        of_env=of_env,
    )


def _space(env: Any, name: str, key: Any) -> Any:
    """The space of a player: of PettingZoo's method, of a map by player, or one space for all. None if unknown."""
    found = getattr(env, name, None)
    if callable(found) and not hasattr(found, "sample"):
        try:
            return found(key)
        except (KeyError, NotImplementedError, AttributeError):
            return None
    several = getattr(found, "spaces", found if isinstance(found, Mapping) else None)  # "in" asks a space for samples
    if several is None:
        several = getattr(env, f"{name}s", None) if found is None else None
    if isinstance(several, Mapping) and key in several:
        return several[key]
    return found


def _action_names(env: Any, space: Any, configured: Sequence[str], stepped: bool) -> tuple[str, ...]:
    if configured and not stepped:
        return tuple(configured)
    count = getattr(space, "n", None)
    names = list(configured) or _meanings(env)
    if count is None:
        if not names:
            raise PlayersUnknown(
                "list the game's actions as trial.actionSpace in config.yml; the environment does not name them"
            )
        return tuple(names)
    more = (str(index) for index in range(len(names), int(count)))
    return (*names[: int(count)], *more)


def _meanings(env: Any) -> list[str]:
    for one in (env, getattr(env, "unwrapped", env)):
        meanings = getattr(one, "get_action_meanings", None)
        if callable(meanings):
            try:
                return [str(name).strip().lower() for name in meanings()]
            except TypeError:  # it wants to know of whom
                continue
    return []
