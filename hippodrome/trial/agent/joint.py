"""Calls an agent whose environment has several players, and checks what it returns.

The environment is a PettingZoo `ParallelEnv` or `AECEnv`, or the agent's five methods take and return dictionaries by
player. Here a player's name is a text. The environment's own key of a player may be of any type.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hippodrome.trial.agent import environments
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.environments import Players
from hippodrome.trial.agent.loading import AgentError
from hippodrome.trial.core.players import ACTION_MASK, ALL
from hippodrome.trial.pictures.reader import Picture

TO_ACT = "to_act"
_TO_ACT_IS = f"{TO_ACT} of %s is"
_FLAGS = frozenset({bool})


class Joint(NamedTuple):
    """The results of a reset or a step for all players of an environment. All maps are by the player's name.

    A player who has left the game may have no observation and no info; `terminated` and `truncated` still say why.
    """

    observations: Mapping[str, Any]
    infos: Mapping[str, Mapping[str, Any]]
    rewards: Mapping[str, float]
    """The reward of every player; 0 if the environment gives none."""
    terminated: Mapping[str, bool]
    truncated: Mapping[str, bool]
    """By player, whether the episode was truncated; every player has an entry."""
    to_act: frozenset[str]
    """The players who are to choose an action for the next step; empty when the episode is over."""
    masks: Mapping[str, tuple[bool, ...]]
    """By player, whether each action is legal now, for those players for whom the environment gives a mask."""
    over: bool
    """Whether the episode is over for all players."""
    extra: Mapping[str, Any] | None = None
    """Further entries of the dict that `step` returned; None if there are none."""

    @property
    def why(self) -> str:
        """`truncated` if the episode was truncated for some player and terminated for none, else `terminated`."""
        ended = [player for player in self.terminated if self.terminated[player] or self.truncated[player]]
        cut = bool(ended) and not any(self.terminated[player] for player in ended)
        return "truncated" if cut else "terminated"


class JointAdapter:
    """Calls an agent with several players. All methods run on the agent's thread (`trial/agent/worker.py`)."""

    def __init__(self, adapter: AgentAdapter, players: Players) -> None:
        """`adapter` has started its agent."""
        self._adapter = adapter
        self._reader = adapter.reader
        self._players = players
        self._ended: set[str] = set()  # players for whom the episode is over
        self._first_legal: dict[str, int] = {}  # the first legal action of each player with a mask
        self._terminated: dict[str, bool] = {}
        self._truncated: dict[str, bool] = {}
        self.players: tuple[str, ...] = players.names
        """The players' names, in the environment's order."""
        self._names = frozenset(players.names)
        self.action_spaces: Mapping[str, tuple[str, ...]] = players.action_names
        """The names of each player's actions, in the order of their numbers."""
        self.observation_spaces: Mapping[str, Any] = players.observation_spaces
        """The space (Gymnasium) of each player's observations; None if it is not known."""
        self.action_counts: Mapping[str, int | None] = players.counts
        """The number of each player's actions in the environment; None if it is not known."""
        self.action_starts: Mapping[str, int] = {name: start for name, start in players.starts.items() if start}
        """The environment's number of each player's action 0, where it is not 0."""
        self.views: tuple[str, ...] = self.players
        """The players whose pictures are drawn, if `render` takes a player."""

    @property
    def env(self) -> Any:
        """The environment, as in `AgentAdapter.env`."""
        return self._adapter.env

    @property
    def steps_itself(self) -> bool:
        """Whether the researcher has written `step`, as in `AgentAdapter.steps_itself`."""
        return self._adapter.steps_itself

    @property
    def callbacks(self) -> Mapping[str, Callable[..., Any]]:
        """The callbacks that the agent has, once it has started."""
        return self._adapter.callbacks

    @property
    def talk(self) -> Mapping[str, Callable[..., Any]]:
        """The methods `reply` and `moderate` that the agent has."""
        return self._adapter.talk

    @property
    def agent(self) -> Any:
        """The researcher's agent, once it has started."""
        return self._adapter.agent

    @property
    def agent_module(self) -> Any:
        """The imported agent.py, as in `AgentAdapter.agent_module`."""
        return self._adapter.agent_module

    def set_game(self, options: Mapping[str, Any], answers: Mapping[str, Any] | None = None) -> None:
        """Give `reset` these options and answers from now on, as in `AgentAdapter.set_game`."""
        self._adapter.set_game(options, answers)

    def reset(self, seed: int) -> tuple[Joint, bool]:
        """Begin an episode. Return its first observations and infos, and whether `reset` took the seed.

        Raises AgentError if `reset` returns anything but observations by player.
        """
        observations, infos, seeded = self._adapter.reset(seed)
        self._ended = set()
        self._terminated = dict.fromkeys(self.players, False)
        self._truncated = dict.fromkeys(self.players, False)
        if not isinstance(observations, Mapping):
            raise AgentError(f"reset() must return observations by player, not {type(observations).__name__}")
        return self._joint("reset", observations, infos, {}, over=False), seeded

    def step(self, actions: Mapping[str, int]) -> Joint:
        """Take one step with the numbers of the actions by player. Raises AgentError if the result cannot be read.

        The environment takes an action of each player in the game, also of a player who is not to act. So a player
        without an entry in `actions` takes their first legal action.
        """
        keys, starts, first_legal = self._players.keys, self._players.starts, self._first_legal
        given = {
            keys[player]: starts[player] + actions.get(player, first_legal.get(player, 0))
            for player in self.players
            if player not in self._ended
        }
        if self._reader.first_due:  # no picture yet: an earlier server's steps are repeated without them
            self.pictures()
        returned = _read(self._adapter.step_with(given))
        self._end(returned.terminated, self._terminated)
        self._end(returned.truncated, self._truncated)
        if True in self._terminated.values() or True in self._truncated.values():
            self._ended |= {player for player in self.players if self._terminated[player] or self._truncated[player]}
        self._ended |= self._no_agents()
        over = len(self._ended) == len(self.players)
        return self._joint(
            "step", returned.observations, returned.infos, returned.rewards, over=over, extra=returned.extra
        )

    def pictures(self) -> dict[str, Picture] | Picture:
        """Draw the present picture; if `render` takes a player, a picture for each player in `views`."""
        if self._adapter.renders_by_player:
            draw, keys = self._adapter.draw, self._players.keys
            return {player: self._reader.read(draw(keys[player]), player) for player in self.views}
        return self._reader.read(self._adapter.draw())

    def feedback(self, player: str, word: str) -> None:
        """Call the agent's `feedback` with a word of this player's participant (`AgentAdapter.feedback`)."""
        self._adapter.feedback(word, self._players.keys[player])

    def close(self) -> None:
        """Call the agent's `close`."""
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
        observations = self._by_player(method, observations)
        infos = self._by_player(method, infos) if infos and isinstance(infos, Mapping) else {}
        infos = {player: _info(value) for player, value in infos.items()}
        rewards = self._by_player(method, rewards)
        masks = {} if over else self._masks(observations, infos)
        self._first_legal = {player: mask.index(True) for player, mask in masks.items()}
        return Joint(
            observations=observations,
            infos=infos,
            rewards={player: _reward(player, rewards.get(player)) for player in self.players},
            terminated=dict(self._terminated),
            truncated=dict(self._truncated),
            to_act=frozenset() if over else self._to_act(infos),
            masks=masks,
            over=over,
            extra=extra,
        )

    def _end(self, returned: Mapping[Any, Any], ended: dict[str, bool]) -> None:
        """Set `ended` for the players whose episode is over by `returned`. ALL means all who are still in the game."""
        values = returned.values()
        if returned.keys() == self._names and _FLAGS.issuperset(map(type, values)) and True not in values:
            return  # the episode is over for none of them: the usual case
        for player, value in self._by_player("step", returned).items():
            ended[player] = ended[player] or _truth(value, "step() returned for %s, as its end,", player)
        if _truth(returned.get(ALL), "step() returned for %s", ALL):
            ended.update(dict.fromkeys((player for player in self.players if player not in self._ended), True))

    def _by_player(self, method: str, values: Mapping[Any, Any]) -> dict[str, Any]:
        """Return the values by players' names, without the value of ALL. Raises AgentError for an unknown player."""
        if values.keys() == self._names:  # the usual case
            return dict(values)
        found = {}
        for key, value in values.items():
            player = str(key)
            if player in self._players.keys:
                found[player] = value
            elif player not in (ALL, "__common__"):  # RLlib's key of an info for all players
                raise AgentError(
                    f"{method}() returned something of {player[:64]!r}; the players are {', '.join(self.players)}"
                )
        return found

    def _no_agents(self) -> frozenset[str]:
        """Return the players whose episode is over: PettingZoo has removed them from the environment's `agents`.

        An attribute `agents` that holds anything but players is not PettingZoo's.
        """
        agents = getattr(self.env, "agents", None)
        if not isinstance(agents, list | tuple):
            return frozenset()
        in_game = {str(key) for key in agents}
        return self._names - in_game if in_game <= self._names else frozenset()

    def _to_act(self, infos: Mapping[str, Mapping[str, Any]]) -> frozenset[str]:
        """Return the players who choose an action now.

        The agent's method `to_act` names them, or else the turn of an `AECEnv`, or else `to_act` in their infos.
        """
        in_game = [player for player in self.players if player not in self._ended]
        method = getattr(self._adapter.agent, TO_ACT, None)
        named = method() if callable(method) else environments.turn(self.env)
        if named is not None:
            several = isinstance(named, Iterable) and not isinstance(named, str)
            names = {str(name) for name in (named if several else (named,))}
            unknown = sorted(names - self._names)
            if unknown:
                raise AgentError(f"to_act() returned {unknown[0]!r}; the players are {', '.join(self.players)}")
            return frozenset(player for player in in_game if player in names)
        if not infos:
            return frozenset(in_game)
        return frozenset(
            player
            for player in in_game
            if player not in infos or _truth(infos[player].get(TO_ACT, True), _TO_ACT_IS, player)
        )

    def _masks(
        self, observations: Mapping[str, Any], infos: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, tuple[bool, ...]]:
        """Return the `action_mask` of each player in the game, from their info, else from their observation (a map)."""
        masks = {}
        for player in self.players:
            if player in self._ended:
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
                if any(legal):  # all zeros is no mask: PettingZoo gives it to a player who is not to act
                    masks[player] = legal
        return masks


def _info(value: Any) -> Mapping[str, Any]:
    """Return an info as a map. Anything but a map becomes the value of `info` in a new one."""
    is_map = type(value) is dict or isinstance(value, Mapping)  # the first check is quicker
    return value if is_map else {} if value is None else {"info": value}


def _truth(value: Any, beginning: str, player: str) -> bool:
    """Convert the value to a bool. Raises AgentError if it has no truth value.

    The error's sentence starts with `beginning`, in which `%s` stands for the player.
    """
    try:
        return bool(value)
    except (TypeError, ValueError):  # such as an array of several numbers
        raise AgentError(f"{beginning % player} {type(value).__name__}, which is neither true nor false") from None


def _reward(player: str, value: Any) -> float:
    """Convert the reward to a number; None to 0. Raises AgentError if it is no finite number."""
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
"""The keys under which each part may stand if `step` returns a dict, as HIPPO's agents do."""
_MAPS = frozenset({dict})
_ENDS = ("terminations", "truncations")
_WANTED = "step() must return (observations, rewards, terminations, truncations, infos), each of them by player"


class _Returned(NamedTuple):
    """The parts of what `step` returned, each by the environment's own keys of the players."""

    observations: Mapping[Any, Any]
    rewards: Mapping[Any, Any]
    terminated: Mapping[Any, Any]
    truncated: Mapping[Any, Any]
    infos: Mapping[Any, Any]
    extra: Mapping[str, Any] | None = None


def _read(result: Any) -> _Returned:
    """Read Gymnasium's five values, Gym's old four values, or a dict. Raises AgentError for anything else."""
    extra: Mapping[str, Any] | None = None
    count = len(result) if isinstance(result, (tuple, list)) else None
    if count == 5:
        if _MAPS.issuperset(map(type, result)):  # the usual case
            return _Returned(*result)
        parts = list(result)
    elif count == 4:
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


def start(adapter: AgentAdapter, players: Sequence[str] = ()) -> AgentAdapter | JointAdapter:
    """Start the agent's game. Return the adapter itself if the game has one player, else a JointAdapter.

    `players` are the names in `trial.players`. The game has several players if the environment (`adapter.env`) or the
    agent has `possible_agents`, or if `players` has more than one name. But an agent with a `step` of its own may play
    the others itself: its game has one player unless `players` or its own `possible_agents` name several. Raises
    AgentError, and whatever the researcher's code raises.
    """
    adapter.start(players)
    env = adapter.env
    keys = environments.player_keys(adapter.agent)
    if not keys and (len(players) > 1 or not adapter.steps_itself):
        keys = environments.player_keys(env)
    if not keys and len(players) > 1:
        keys = list(players)
    if not keys:
        adapter.name_actions()
        return adapter
    try:
        found = environments.players_of(
            adapter.agent if env is None else env, keys, adapter.configured_actions, stepped=not adapter.steps_itself
        )
    except environments.PlayersUnknown as error:
        raise AgentError(str(error)) from None
    return JointAdapter(adapter, found)
