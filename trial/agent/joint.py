"""Calls an agent whose environment has several players, and checks what it returns.

The environment is a PettingZoo `ParallelEnv` or `AECEnv` that `start` returned, or the agent's five methods take and
give dictionaries by player. Players are known by text here; the environment's own names of them may be of any type.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from trial.agent.agent import AgentAdapter, AgentError
from trial.agent.environments import AecTurns, Players
from trial.core.players import ACTION_MASK, ALL
from trial.pictures.picture import Picture

TO_ACT = "to_act"
_TO_ACT_IS = f"{TO_ACT} of %s is"
_FLAGS = frozenset({bool})


class Joint(NamedTuple):
    """What all players of an environment have after a reset or a step. All maps are by the player's name.

    A player who has left the game has no observation and no info; `terminated` and `truncated` keep saying why.
    """

    observations: Mapping[str, Any]
    infos: Mapping[str, Mapping[str, Any]]
    rewards: Mapping[str, float]
    """Of every player; 0 for those that the environment says nothing of."""
    terminated: Mapping[str, bool]
    truncated: Mapping[str, bool]
    """Of every player."""
    to_act: frozenset[str]
    """Who is to choose an action for the next step; empty when the episode is over."""
    masks: Mapping[str, tuple[bool, ...]]
    """Of players who may not take each action: which are legal now."""
    over: bool
    """The episode is over: for all players, or since none is left."""
    extra: Mapping[str, Any] | None = None
    """What else is in the dict that an agent of HIPPO's kind returns."""

    @property
    def why(self) -> str:
        """Why the episode is over: `truncated` if that is so for all who were in it, else `terminated`."""
        ended = [player for player in self.terminated if self.terminated[player] or self.truncated[player]]
        cut = bool(ended) and not any(self.terminated[player] for player in ended)
        return "truncated" if cut else "terminated"


class JointAdapter:
    """Calls an agent with several players. All methods run on the agent's thread (`trial/agent/worker.py`)."""

    def __init__(self, adapter: AgentAdapter, players: Players, turns: AecTurns | None) -> None:
        """`adapter` has started its agent. `turns` says whose turn it is in a PettingZoo `AECEnv`."""
        self._adapter = adapter
        self._reader = adapter.reader
        self._players = players
        self._turns = turns
        self._gone: set[str] = set()
        self._first: dict[str, int] = {}  # the first legal action of those with a mask
        self._terminated: dict[str, bool] = {}
        self._truncated: dict[str, bool] = {}
        self.players: tuple[str, ...] = players.names
        """In the environment's order."""
        self._named = frozenset(players.names)
        self.action_spaces: Mapping[str, tuple[str, ...]] = players.action_names
        """The names of each player's actions, in the order of their numbers."""
        self.observation_spaces: Mapping[str, Any] = players.observation_spaces
        """Gymnasium's space of each player's observations; None where it is not known."""
        self.action_counts: Mapping[str, int | None] = players.counts
        """How many actions each player has in the environment; None where it is not known."""
        self.views: tuple[str, ...] = self.players
        """The players whose pictures are wanted, where each has a view of their own."""

    @property
    def env(self) -> Any:
        """The environment, as far as it is known."""
        return self._adapter.env

    @property
    def steps_itself(self) -> bool:
        """Whether the researcher's code takes the actions, and not the environment."""
        return self._adapter.steps_itself

    @property
    def callbacks(self) -> Mapping[str, Callable[..., Any]]:
        """The callbacks that the agent has."""
        return self._adapter.callbacks

    @property
    def agent(self) -> Any:
        """The researcher's agent."""
        return self._adapter.agent

    @property
    def agent_module(self) -> Any:
        """The module that agent.py has become; None without one."""
        return self._adapter.agent_module

    def reset(self, seed: int) -> tuple[Joint, bool]:
        """Begin an episode: what the players have at its start, and whether the agent took the seed."""
        observations, infos, seeded = self._adapter.reset(seed)
        self._gone = set()
        self._terminated = dict.fromkeys(self.players, False)
        self._truncated = dict.fromkeys(self.players, False)
        if not isinstance(observations, Mapping):
            raise AgentError(f"reset() must return observations by player, not {type(observations).__name__}")
        return self._joint("reset", observations, infos, {}, over=False), seeded

    def step(self, actions: Mapping[str, int]) -> Joint:
        """Take one step with the actions' numbers by player.

        Players in the game who are not in `actions` take their first legal action: the environment wants one of each,
        also of those who are not to act.
        """
        keys, starts, first = self._players.keys, self._players.starts, self._first
        given = {
            keys[player]: starts[player] + actions.get(player, first.get(player, 0))
            for player in self.players
            if player not in self._gone
        }
        if self._reader.due:  # steps of an earlier server are taken again without pictures
            self.pictures()
        returned = _read(self._adapter.step_with(given))
        self._end(returned.terminated, self._terminated)
        self._end(returned.truncated, self._truncated)
        if True in self._terminated.values() or True in self._truncated.values():
            self._gone |= {player for player in self.players if self._terminated[player] or self._truncated[player]}
        if self._players.of_env:
            self._gone |= self._left()
        over = len(self._gone) == len(self.players)
        return self._joint(
            "step", returned.observations, returned.infos, returned.rewards, over=over, extra=returned.extra
        )

    def pictures(self) -> dict[str, Picture] | Picture:
        """The present picture; by player, for those in `views`, if `render` takes a player."""
        if self._adapter.renders_by_player:
            draw, keys = self._adapter.draw, self._players.keys
            return {player: self._reader.read(draw(keys[player]), player) for player in self.views}
        return self._reader.read(self._adapter.draw())

    def feedback(self, player: str, word: str) -> None:
        """Hand a word of this player's participant to an agent that listens: `feedback(word)` or also the player."""
        self._adapter.feedback(word, self._players.keys[player])

    def close(self) -> None:
        self._adapter.close()

    # ---- what was returned

    def _joint(
        self,
        method: str,
        observations: Mapping[Any, Any],
        infos: Any,
        rewards: Mapping[Any, Any],
        *,
        over: bool,
        extra: Mapping[str, Any] | None = None,
    ) -> Joint:
        seen = self._by_player(method, observations)
        told = self._by_player(method, infos) if infos and isinstance(infos, Mapping) else {}
        details = {player: _info(value) for player, value in told.items()}
        paid = self._by_player(method, rewards)
        masks = {} if over else self._masks(seen, details)
        self._first = {player: mask.index(True) for player, mask in masks.items()}
        return Joint(
            observations=seen,
            infos=details,
            rewards={player: _reward(player, paid.get(player)) for player in self.players},
            terminated=dict(self._terminated),
            truncated=dict(self._truncated),
            to_act=frozenset() if over else self._to_act(details),
            masks=masks,
            over=over,
            extra=extra,
        )

    def _end(self, said: Mapping[Any, Any], ended: dict[str, bool]) -> None:
        """Note for whom it is over. The value for all counts for those who are still in the game."""
        values = said.values()
        if said.keys() == self._named and _FLAGS.issuperset(map(type, values)) and True not in values:
            return  # for none of them: the usual case
        for player, value in self._by_player("step", said).items():
            ended[player] = ended[player] or _truth(value, "step() returned for %s, as its end,", player)
        if _truth(said.get(ALL), "step() returned for %s", ALL):
            ended.update(dict.fromkeys((player for player in self.players if player not in self._gone), True))

    def _by_player(self, method: str, values: Mapping[Any, Any]) -> dict[str, Any]:
        """The values by the players' names, without the value for all. Raises AgentError for one there is not."""
        if values.keys() == self._named:  # the usual case
            return dict(values)
        found = {}
        for key, value in values.items():
            player = str(key)
            if player in self._players.keys:
                found[player] = value
            elif player not in (ALL, "__common__"):
                raise AgentError(f"{method}() returned something of {player[:64]!r}; the players are {self._shown()}")
        return found

    def _shown(self) -> str:
        return ", ".join(self.players)

    def _left(self) -> set[str]:
        """Who is in the environment's `agents` no more. PettingZoo takes out whoever has ended."""
        now = getattr(self._players.env, "agents", None)
        if not isinstance(now, list | tuple):
            return set()
        return set(self.players) - {str(key) for key in now}

    def _to_act(self, infos: Mapping[str, Mapping[str, Any]]) -> frozenset[str]:
        """Who chooses an action now: whom the agent's `to_act` or PettingZoo names, else all whose info allows it."""
        there = [player for player in self.players if player not in self._gone]
        method = getattr(self._adapter.agent, TO_ACT, None)
        named: Any = None
        if callable(method):
            named = method()
        elif self._turns is not None:
            named = self._turns.selected()
        if named is not None:
            several = isinstance(named, Iterable) and not isinstance(named, str)
            names = {str(name) for name in (named if several else (named,))}
            unknown = sorted(names - set(self.players))
            if unknown:
                raise AgentError(f"to_act() returned {unknown[0]!r}; the players are {self._shown()}")
            return frozenset(player for player in there if player in names)
        if not infos:
            return frozenset(there)
        return frozenset(
            player
            for player in there
            if player not in infos or _truth(infos[player].get(TO_ACT, True), _TO_ACT_IS, player)
        )

    def _masks(
        self, observations: Mapping[str, Any], infos: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, tuple[bool, ...]]:
        found = {}
        for player in self.players:
            if player in self._gone:
                continue
            mask = infos[player].get(ACTION_MASK) if player in infos else None
            if mask is None:
                observation = observations.get(player)
                if observation is not None and isinstance(observation, Mapping):
                    mask = observation.get(ACTION_MASK)
            if mask is not None:
                try:
                    legal = tuple(np.asarray(mask).reshape(-1).astype(bool).tolist())
                except (TypeError, ValueError):
                    raise AgentError(
                        f"{ACTION_MASK} of {player} is {type(mask).__name__}, and no array of zeros and ones"
                    ) from None
                count = len(self.action_spaces[player])
                if len(legal) != count:
                    raise AgentError(f"{ACTION_MASK} of {player} has {len(legal)} values; there are {count} actions")
                if any(legal):  # PettingZoo's games give zeros to those who are not to act
                    found[player] = legal
        return found


def _info(value: Any) -> Mapping[str, Any]:
    is_map = type(value) is dict or isinstance(value, Mapping)  # the first is quicker
    return value if is_map else {} if value is None else {"info": value}


def _truth(value: Any, what: str, player: str) -> bool:
    """Raises AgentError if the value has none; the sentence begins with `what`, which has a place for the player."""
    try:
        return bool(value)
    except (TypeError, ValueError):  # such as an array of several numbers
        raise AgentError(f"{what % player} {type(value).__name__}, which is neither true nor false") from None


def _reward(player: str, value: Any) -> float:
    try:
        number = float(0.0 if value is None else value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError) as error:
        raise AgentError(f"step() returned a reward of {player} that is no number: {type(value).__name__}") from error
    if not math.isfinite(number):
        raise AgentError(f"step() returned a reward of {player} that is not finite")
    return number


_KEYS = {
    "observations": ("observation", "observations"),
    "rewards": ("reward", "rewards"),
    "terminations": ("terminated", "terminations", "done", "dones"),
    "truncations": ("truncated", "truncations"),
    "infos": ("info", "infos"),
}
"""What each part may be called in a dict, as HIPPO's agents return one."""
_MAPS = frozenset({dict})
_ENDS = ("terminations", "truncations")
_WANTED = "step() must return (observations, rewards, terminations, truncations, infos), each of them by player"


class _Returned(NamedTuple):
    """What `step` returned, each part by the environment's own names of the players."""

    observations: Mapping[Any, Any]
    rewards: Mapping[Any, Any]
    terminated: Mapping[Any, Any]
    truncated: Mapping[Any, Any]
    infos: Mapping[Any, Any]
    extra: Mapping[str, Any] | None = None


def _read(result: Any) -> _Returned:
    """The parts of a five-tuple, Gym's old four-tuple or a dict. Raises AgentError for all else."""
    extra: Mapping[str, Any] | None = None
    given = len(result) if isinstance(result, (tuple, list)) else None
    if given == 5:
        if _MAPS.issuperset(map(type, result)):  # the usual case
            return _Returned(*result)
        parts = list(result)
    elif given == 4:
        observations, rewards, done, infos = result
        parts = [observations, rewards, done, {}, infos]
    elif isinstance(result, Mapping):
        parts = [next((result[key] for key in keys if key in result), {}) for keys in _KEYS.values()]
        known = {key for keys in _KEYS.values() for key in keys}
        extra = {key: value for key, value in result.items() if key not in known} or None
    else:
        raise AgentError(f"{_WANTED}, or a dict of these")
    for name, part in zip(_KEYS, parts, strict=True):
        if part is not None and type(part) is not dict and not isinstance(part, Mapping):
            for_all = f', and {{"__all__": {part}}} is for all players' if name in _ENDS else ""
            raise AgentError(f"{_WANTED}; its {name} are {type(part).__name__}{for_all}")
    observations, rewards, terminated, truncated, infos = (part or {} for part in parts)
    return _Returned(observations, rewards, terminated, truncated, infos, extra)
