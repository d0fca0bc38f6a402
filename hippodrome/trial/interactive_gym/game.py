"""Interactive Gym's callbacks, and their argument, the `RemoteGame`: the present state of the game."""

from __future__ import annotations

import collections
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hippodrome.trial.core.players import ALL


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
        self._ends: Sequence[Any] = (False, False)  # `terminated` and `truncated` of the last step
        self.current_ping: dict[Any, int] = collections.defaultdict(int)
        self.document_focus_status: dict[Any, bool] = collections.defaultdict(lambda: True)
        self.record: Callable[[str, Any], None] = _unrecorded
        """In a callback: `record(name, value)` writes a value into the recording (docs/callbacks.md)."""

    def began(self, observation: Any) -> None:
        """Set the attributes after the environment has been reset."""
        self.status = GameStatus.Active
        self.obs = observation
        self.prev_rewards, self.prev_actions = {}, {}
        self._ends = (False, False)
        self.tick_num = 0
        self.episode_num += 1
        self.episode_rewards = collections.defaultdict(float)

    def stepped(self, actions: Mapping[Any, Any], result: tuple[Any, Any, Any, Any, Any]) -> None:
        """Set the attributes after a step has been taken."""
        self.obs, rewards, *self._ends, _ = result
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
        ends = self._ends
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


_EVENTS = "episode_start episode_end game_tick_start game_tick_end graphics_start graphics_end game_end "
_WAITING = "waitroom_start waitroom_join waitroom_end waitroom_timeout"
for _event in (_EVENTS + _WAITING).split():
    setattr(GameCallback, f"on_{_event}", lambda _self, _remote_game: None)
