"""Finds environments, their players, one (Gymnasium) or several (PettingZoo and others), and the players' actions."""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_ID = re.compile(r"(?P<name>.+)-v(?P<version>\d+)")
_OLD_ATARI = re.compile(r"(?P<game>[A-Z]\w*?)(?P<ram>-ram)?(?P<kind>Deterministic|NoFrameskip)?-v(?P<version>[04])")

ACTIONS_UNKNOWN = "list the game's actions as trial.actionSpace in config.yml; the environment does not name them"


class PlayersUnknown(ValueError):
    """The environment does not exist, or its players or actions are not known. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Players:
    """The players of an environment. All mappings are by the player's name."""

    names: tuple[str, ...]
    keys: Mapping[str, Any]
    """The environment's own name of each player: a text, a number …"""
    action_names: Mapping[str, tuple[str, ...]]
    observation_spaces: Mapping[str, Any]
    starts: Mapping[str, int]
    """The environment's number of each player's first action."""
    counts: Mapping[str, int | None]
    """The number of each player's actions in the environment; None if it is not known."""


def is_module(game: str) -> bool:
    """Whether `game` is the name of a module in a package, such as `pettingzoo.butterfly.cooperative_pong_v6`."""
    return "." in game and all(part.isidentifier() for part in game.split("."))


def made_by_module(game: str) -> Any:
    """Make the environment of a module by its `parallel_env`, or else by its `env`, with pictures as arrays.

    An `AECEnv` becomes a `ParallelEnv`. Raises PlayersUnknown if the package has no such module, but others, or if the
    module makes no environment; ImportError if something else cannot be imported.
    """
    try:
        module = importlib.import_module(game)
    except ModuleNotFoundError as error:
        others = _other_modules(game) if error.name == game else []
        if not others:
            raise
        raise PlayersUnknown(f"there is no module {game}; its package has {', '.join(others)}") from None
    make = getattr(module, "parallel_env", None) or getattr(module, "env", None)
    if not callable(make):
        raise PlayersUnknown(
            f"the module {game} has neither parallel_env() nor env(); name the module of a game, or make the "
            "environment in agent.py"
        )
    return playable(make(render_mode="rgb_array"))


def _other_modules(game: str) -> list[str]:
    """Return the other versions of the game in its package; if there are none, all the package's games."""
    package, _, name = game.rpartition(".")
    folder = getattr(importlib.import_module(package), "__path__", [])
    games = [each.name for each in pkgutil.iter_modules(folder) if re.search(r"_v\d+$", each.name)]
    stem = re.sub(r"_v\d+$", "", name)
    return [other for other in games if other.startswith(f"{stem}_v")] or games


def registered_id(env_id: str) -> tuple[str, dict[str, Any]]:
    """Find the id under which an environment of Gym's is registered now, and further arguments for `gymnasium.make`.

    A version that Gymnasium does not have any more becomes the newest one. An unknown id stays as it is. For the id of
    an Atari game, ALE's environments are registered first, if ALE is installed.
    """
    import gymnasium  # noqa: PLC0415 - a researcher's own agent may need no Gymnasium

    atari = _OLD_ATARI.fullmatch(env_id)
    if (env_id.startswith("ALE/") or atari) and env_id not in gymnasium.registry:
        with contextlib.suppress(ImportError):
            import ale_py  # noqa: PLC0415 - only Atari games need it

            gymnasium.register_envs(ale_py)
    if env_id in gymnasium.registry:
        return env_id, {}
    if atari:
        frameskip = "NoFrameskip" if atari["kind"] == "NoFrameskip" else ""
        plain = f"{atari['game']}{frameskip}-v{atari['version']}"
        if plain in gymnasium.registry:
            options = {"frameskip": 4} if atari["kind"] == "Deterministic" else {}
            return plain, options | ({"obs_type": "ram"} if atari["ram"] else {})
    return _newest(env_id, list(gymnasium.registry)), {}


def has_version(env_id: str) -> bool:
    """Whether the id ends in a version, which every id of Gym does."""
    return _ID.fullmatch(env_id) is not None


def _newest(env_id: str, env_ids: list[str]) -> str:
    """Return the newest version of the environment among `env_ids`; `env_id` itself if there is no newer one."""
    wanted_id = _ID.fullmatch(env_id)
    if wanted_id is None:
        return env_id
    same = [match for key in env_ids if (match := _ID.fullmatch(key)) and match["name"] == wanted_id["name"]]
    newest = max(same, key=lambda match: int(match["version"]), default=wanted_id)
    return newest[0] if int(newest["version"]) > int(wanted_id["version"]) else env_id


def playable(env: Any) -> Any:
    """Turn a PettingZoo `AECEnv` into a `ParallelEnv`, by PettingZoo's own wrappers; return anything else as it is."""
    if not is_aec(env):
        return env
    from pettingzoo.utils import conversions  # noqa: PLC0415 - with an AECEnv, PettingZoo is installed

    if _at_once(env):
        return conversions.aec_to_parallel(env)
    return conversions.turn_based_aec_to_parallel(env)


def turn(env: Any) -> Any:
    """Return the environment's own name of the player whose turn it is; an empty list if no player is left.

    Only an `AECEnv` has turns, also if `playable` has made a `ParallelEnv` of it. Return None if all act at once.
    """
    aec: Any = env if is_aec(env) else getattr(env, "aec_env", None)
    if not is_aec(aec) or _at_once(aec):
        return None
    return aec.agent_selection if aec.agents else []


def is_aec(env: Any) -> bool:
    """Whether `env` has the methods of a PettingZoo `AECEnv`."""
    return callable(getattr(env, "agent_iter", None)) and callable(getattr(env, "last", None))


def _at_once(aec: Any) -> bool:
    """Whether the players of an `AECEnv` act at the same time."""
    return bool((getattr(aec, "metadata", None) or {}).get("is_parallelizable", False))


def player_keys(owner: Any) -> list[Any]:
    """Return the `possible_agents` of an agent or environment, or of the one it wraps; empty if there are none."""
    for one in (owner, getattr(owner, "unwrapped", None)):
        keys = getattr(one, "possible_agents", None)
        if isinstance(keys, Iterable) and not isinstance(keys, str) and (listed := list(keys)):
            return listed
    return []


def players_of(owner: Any, keys: Sequence[Any], configured: Sequence[str], *, stepped: bool) -> Players:
    """Return the players with these keys, and the names of their actions.

    `owner` has the players' spaces: it is the environment, or an agent without one. `configured` are the actions' names
    in config.yml. `stepped` says that the environment's own `step` gets the actions: then each player has as many
    actions as their action space, and these are numbered as there. Raises PlayersUnknown if two keys are the same text,
    or if a player's actions are not known.
    """
    by_name = {str(key): key for key in keys}
    if len(by_name) != len(keys):
        raise PlayersUnknown(
            f"two players have the same name: {', '.join(map(str, keys))}; their keys must differ as text, too"
        )
    spaces = {name: _space(owner, "action_space", key) for name, key in by_name.items()}
    return Players(
        names=tuple(by_name),
        keys=by_name,
        action_names={name: _action_names(owner, spaces[name], configured, stepped) for name in by_name},
        observation_spaces={name: _space(owner, "observation_space", key) for name, key in by_name.items()},
        starts={name: first_number(space) if stepped else 0 for name, space in spaces.items()},
        counts={name: count_of(space) for name, space in spaces.items()},
    )


def count_of(space: Any) -> int | None:
    """Return how many actions a space has whose actions are single numbers (`Discrete`); None for any other space."""
    count = getattr(space, "n", None)
    return None if count is None or getattr(space, "shape", None) else int(count)  # MultiBinary has a shape


def first_number(space: Any) -> int:
    """Return the environment's number of the first action: `start` of a `Discrete`, else 0."""
    return 0 if count_of(space) is None else int(getattr(space, "start", 0))


def _space(env: Any, name: str, key: Any) -> Any:
    """Return a player's space, by PettingZoo's method, a map by player, or the space of all; None if unknown."""
    found = getattr(env, name, None)
    if callable(found) and not hasattr(found, "sample"):
        try:
            return found(key)
        except (KeyError, NotImplementedError, AttributeError):
            return None
    # A Dict space is a Mapping too, but `key in space` would ask whether the key is a sample of it: so take its dict.
    several = getattr(found, "spaces", found if isinstance(found, Mapping) else None)
    if several is None:
        several = getattr(env, f"{name}s", None) if found is None else None
    if isinstance(several, Mapping) and key in several:
        return several[key]
    return found


def _action_names(env: Any, space: Any, configured: Sequence[str], stepped: bool) -> tuple[str, ...]:
    if configured and not stepped:
        return tuple(configured)
    check_numbered(space, stepped)
    count = count_of(space)
    names = list(configured) or action_meanings(env)
    if count is None:
        if not names:
            raise PlayersUnknown(ACTIONS_UNKNOWN)
        return tuple(names)
    more = (str(index) for index in range(len(names), count))
    return (*names[:count], *more)


def check_numbered(space: Any, stepped: bool) -> None:
    """Raise PlayersUnknown if the environment's own `step` (`stepped`) gets a number, and takes no single numbers.

    An object without `sample` is not a space, so nothing is known of the actions.
    """
    if stepped and callable(getattr(space, "sample", None)) and count_of(space) is None:
        raise PlayersUnknown(
            f"the environment takes actions of {str(space)[:100]}, and a key is the number of an action; write "
            "step(self, action) in class Agent of agent.py, which makes such an action of each number, and list the "
            "names of these actions as trial.actionSpace in config.yml"
        )


def action_meanings(env: Any) -> list[str]:
    """Return the actions' names by `get_action_meanings` of the environment; empty if it does not name them."""
    for one in (env, getattr(env, "unwrapped", env)):
        meanings = getattr(one, "get_action_meanings", None)
        if callable(meanings):
            try:
                return [str(name).strip().lower() for name in meanings()]
            except TypeError:  # `meanings` takes a player
                continue
    return []
