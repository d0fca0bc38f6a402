"""Interactive Gym's callbacks, and their argument, the `RemoteGame`: the present state of the game."""

from __future__ import annotations

import collections
import uuid
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from trial.core.players import ALL


class GameStatus:
    """The values of `RemoteGame.status`."""

    Done = "done"
    Active = "active"
    Inactive = "inactive"
    Reset = "reset"


def _unrecorded(name: str, value: Any) -> None:
    """Record nothing: only a callback can record values."""


class RemoteGame:
    """The present facts about the game, in Interactive Gym's attributes. Changing them does not change the game.

    `current_ping` is always 0, and `document_focus_status` always true: neither is measured here.
    """

    def __init__(self, config: Any, env: Any, players: Mapping[Any, Any], subject: str = "") -> None:
        """`players` is `policy_mapping`. `subject` is the participant's id; empty if several people play."""
        self.config = config
        self.env = env
        self.status = GameStatus.Inactive
        self.obs: Any = None
        self.game_id: Any = 0
        self.game_uuid = str(uuid.uuid4())
        self.tick_num = 0
        self.episode_num = 0
        self.human_players = {key: subject for key, plays in players.items() if plays == "human"}
        self.bot_players = {key: plays for key, plays in players.items() if plays != "human"}
        self.episode_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_positive_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_negative_rewards: dict[Any, float] = collections.defaultdict(float)
        self.prev_rewards: dict[Any, float] = {}
        self.prev_actions: dict[Any, Any] = {}
        self.current_infos: Any = {}
        self.terminateds: Any = False
        self.truncateds: Any = False
        self.current_ping: dict[Any, int] = collections.defaultdict(int)
        self.document_focus_status: dict[Any, bool] = collections.defaultdict(lambda: True)
        self.record: Callable[[str, Any], None] = _unrecorded
        """In a callback: `record(name, value)` writes a value into the recording (docs/callbacks.md)."""

    @property
    def observation(self) -> Any:
        """The observations that the environment returned last."""
        return self.obs

    @property
    def rewards(self) -> dict[Any, float]:
        """The rewards of the last step."""
        return self.prev_rewards

    def began(self, observation: Any, infos: Any) -> None:
        """Set the attributes after the environment has been reset."""
        self.status = GameStatus.Active
        self.obs, self.current_infos = observation, infos
        self.prev_rewards, self.prev_actions = {}, {}
        self.terminateds = self.truncateds = False
        self.tick_num = 0
        self.episode_num += 1
        self.episode_rewards = collections.defaultdict(float)

    def stepped(self, actions: Mapping[Any, Any], result: tuple[Any, Any, Any, Any, Any]) -> None:
        """Set the attributes after a step has been taken."""
        self.obs, rewards, self.terminateds, self.truncateds, self.current_infos = result
        self.prev_actions = dict(actions)
        self.prev_rewards = rewards if isinstance(rewards, dict) else {"reward": rewards}
        for key, reward in (rewards if isinstance(rewards, dict) else {0: rewards}).items():
            self.episode_rewards[key] += reward
            self.total_rewards[key] += reward
            self.total_positive_rewards[key] += max(0, reward)
            self.total_negative_rewards[key] += min(0, reward)
        self.tick_num += 1
        if self.over:
            last = self.episode_num >= self.config.num_episodes
            self.status = GameStatus.Done if last else GameStatus.Reset

    @property
    def over(self) -> bool:
        """Whether the episode has ended for all players."""
        ends = (self.terminateds, self.truncateds)
        if not all(isinstance(end, Mapping) for end in ends):
            return any(map(bool, ends))
        players = {player for end in ends for player in end} - {ALL}
        all_ended = all(any(end.get(player) for end in ends) for player in players)
        return any(end.get(ALL) for end in ends) or (bool(players) and all_ended)


class GameCallback:
    """A callback that does nothing: the base class of an experiment's callbacks, with a method for each event.

    Those of the waiting room are never called: participants wait in the lobby, before their server runs.
    """

    def __init__(self, **_options: Any) -> None:
        """Take any options, as Interactive Gym does."""


class MultiCallback(GameCallback):
    """Calls several callbacks in turn; `callbacks` are their classes.

    Each method returns a map of the values that the callbacks return, by the names of their classes, without None.
    """

    def __init__(self, callbacks: Iterable[type[GameCallback]], **_options: Any) -> None:
        super().__init__()
        self.callbacks = [callback() for callback in callbacks]


def _call_all(event: str) -> Any:
    """Return the method of `MultiCallback` for an event."""

    def call(self: MultiCallback, remote_game: RemoteGame) -> dict[str, Any] | None:
        values = {type(callback).__name__: getattr(callback, event)(remote_game) for callback in self.callbacks}
        return {name: value for name, value in values.items() if value is not None} or None

    return call


for _event in (
    *("on_episode_start", "on_episode_end", "on_game_tick_start", "on_game_tick_end", "on_game_end"),
    *("on_graphics_start", "on_graphics_end"),
    *("on_waitroom_start", "on_waitroom_join", "on_waitroom_end", "on_waitroom_timeout"),
):
    setattr(GameCallback, _event, lambda _self, _remote_game: None)
    setattr(MultiCallback, _event, _call_all(_event))
