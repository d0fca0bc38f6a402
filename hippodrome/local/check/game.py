"""Plays whole episodes with the agent, in its process (`agent_process.py`).

Humans take random actions, and policies play the other players. The policies are called one after another, so that each
is timed by itself. If there are several humans, `substitute` plays in each of their places for a while.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from hippodrome.local.check.agent_progress import AgentProgress
from hippodrome.local.check.one_player import OnePlayer
from hippodrome.local.check.pace import Pace
from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.agent.joint import Joint, JointAdapter
from hippodrome.trial.core.players import PLAYER, Player, legal_actions, policy_seed
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.places import load_policies
from hippodrome.trial.policies.policy import Policy
from hippodrome.trial.policies.simple import AgentPolicy

BEGUN = 5  # steps of an episode with the options of another game or level
STAYS = 20  # steps for which a substitute plays in one place


class CheckedGame:
    """A game that `hippodrome check` plays: `load` its policies, `play` it, `close` it."""

    def __init__(
        self,
        adapter: JointAdapter | OnePlayer,
        players: Sequence[Player],
        config: TrialSection,
        progress: AgentProgress,
    ) -> None:
        self._adapter, self._players, self._config, self._progress = adapter, players, config, progress
        self._policies: dict[str, Policy] = {}
        self._paces: dict[str, Pace] = {}
        self._last: dict[str, int] = {}
        self._observed: dict[str, list[Observed]] = {}  # what each policy has chosen in the episode
        self._random = Random(1)  # noqa: S311 - the same each time
        self._pressed = 0
        self._substitutes: dict[str, Policy] = {}  # by the player in whose place each plays
        self._acted: set[frozenset[str]] = set()  # the groups of players that acted at the same time

    def load(self, folder: Path, agent_module: Any) -> bool:
        """Load the policies from `folder` and agent.py; return False if one cannot be loaded, which is reported."""

        def loaded(players: Sequence[Player]) -> bool:
            spaces = self._adapter.observation_spaces
            return self._progress.call("policies", lambda: load_policies(players, folder, agent_module, spaces))

        humans = [player for player in self._players if player.human]
        plays = self._config.substitute if len(humans) > 1 else None
        if not loaded(self._players):
            return False
        self._policies = self._progress.result
        if plays:
            if not loaded([replace(player, plays=plays) for player in humans]):
                return False
            self._substitutes = self._progress.result
        forget = [name for name, policy in self._policies.items() if isinstance(policy, AgentPolicy) and policy.forgets]
        self._progress.known["forgetful"] = forget
        self._paces = {name: Pace() for name in (*self._policies, *self._substitutes)}
        return True

    def play(self, first_reset: Callable[[], Any]) -> bool:
        """Play until the last episode or the time is over; return False if a call failed, which is reported."""
        progress = self._progress
        for episode in range(1, self._config.max_episodes + 1):
            if not progress.call("reset", first_reset if episode == 1 else partial(self._adapter.reset, episode)):
                return False
            now: Joint = progress.result[0]
            if not (progress.call("render", self._adapter.pictures) and self._reset_policies(episode)):
                return False
            progress.callbacks.episode_began(episode, now.observations, now.infos)
            steps = 0
            while not now.over and steps < self._config.most_steps:
                if progress.time_over():
                    progress.callbacks.session_ended()
                    return True
                self._acted.add(now.to_act)
                actions = self._actions(now, steps)
                if actions is None:
                    return False
                began = time.monotonic()
                progress.action = actions[PLAYER] if isinstance(self._adapter, OnePlayer) else actions
                if not progress.call("step", partial(self._adapter.step, actions)):
                    return False
                now, steps = progress.result, steps + 1
                progress.steps += 1
                if not progress.call("render", self._adapter.pictures):
                    return False
                progress.pace.took(time.monotonic() - began)
                progress.known["policies"] = {name: vars(pace) for name, pace in self._paces.items()}
                progress.known["takeTurns"] = self._take_turns()
                recorded = now.observations.values() if self._config.record_observations else ()
                progress.returned(recorded, now.infos.values(), now.extra)
                progress.callbacks.stepped(actions, now.rewards, now.observations, now.infos)
            progress.episodes = episode
            progress.callbacks.episode_ended(now.why if now.over else "truncated")
        progress.callbacks.session_ended()
        return True

    def begin_each(self, others: Sequence[Mapping[str, Any]], begin: Callable[[Mapping[str, Any]], None]) -> bool:
        """Begin an episode of each other game and level; return False if a call failed.

        Each has its `options` and `answers`, with which `begin` begins the agent's session.
        """
        for game in others:
            if self._progress.time_over():
                break
            begin(game)
            self._progress.known["game"] = game
            if not self._begin():
                return False
        self._progress.known.pop("game", None)
        return True

    def _begin(self) -> bool:
        """Reset, and play some steps; return False if a call failed, which is reported."""
        progress = self._progress
        if not progress.call("reset", partial(self._adapter.reset, 1)):
            return False
        now: Joint = progress.result[0]
        if not (progress.call("render", self._adapter.pictures) and self._reset_policies(1)):
            return False
        progress.callbacks.episode_began(1, now.observations, now.infos)
        for step in range(BEGUN):
            actions = None if now.over else self._actions(now, step)
            if actions is None:
                return now.over
            progress.action = actions[PLAYER] if isinstance(self._adapter, OnePlayer) else actions
            if not progress.call("step", partial(self._adapter.step, actions)):
                return False
            now = progress.result
        return True

    def close(self) -> bool:
        """Close the policies and the agent; return False if that failed, which is reported.

        Before, policies resume the last episode, as on a server that replaces a lost one.
        """
        for name, observed in self._observed.items():
            if not self._progress.call(f"policy {name} resume", partial(self._policies[name].resume, observed)):
                return False
        for policy in (*self._policies.values(), *self._substitutes.values()):
            if not self._progress.call("close", policy.close):
                return False
        return self._progress.call("close", self._adapter.close)

    def _reset_policies(self, episode: int) -> bool:
        self._last, self._observed = {}, {}
        for name, policy in (self._policies | self._substitutes).items():
            seed = policy_seed(episode, name)
            if not self._progress.call(f"policy {name} reset", partial(policy.reset, seed)):
                return False
        return True

    def _actions(self, now: Joint, step: int) -> dict[str, int] | None:
        """The actions of the players who are to act; None if a policy failed."""
        actions: dict[str, int] = {}
        replaced = self._replaced()
        for player in self._players:
            name = player.name
            if name not in now.to_act:
                continue
            allowed = legal_actions(len(player.action_space), now.masks.get(name)) or [player.idle]
            if player.human and name != replaced:
                actions[name] = self._press(allowed)
            elif name in self._policies or name == replaced:
                action = self._asked(name, now) if self._due(step) else self._between(player)
                if action is None:
                    return None
                actions[name] = action if action in allowed else allowed[0]
            else:
                actions[name] = player.idle if player.idle in allowed else allowed[0]
        return actions

    def _replaced(self) -> str | None:
        """The player whose human is replaced by the substitute at this step; None if no human is.

        Every `STAYS` steps comes the next one: nobody, then each human in turn, then nobody again.
        """
        names = (None, *self._substitutes)
        return names[self._progress.steps // STAYS % len(names)]

    def _take_turns(self) -> bool:
        """Whether each step was taken by one player alone, and not always by the same."""
        return len(self._acted) > 1 and all(len(together) == 1 for together in self._acted)

    def _press(self, allowed: Sequence[int]) -> int:
        """A human's action: first each action once, in turn; then random actions. Only legal ones are taken."""
        self._pressed += 1
        return self._pressed - 1 if self._pressed - 1 in allowed else self._random.choice(allowed)

    def _between(self, player: Player) -> int:
        """The action of a policy's player between two choices: the last one, or the idle one (`policyActions`)."""
        return self._last.get(player.name, player.idle) if self._config.policies_hold else player.idle

    def _due(self, step: int) -> bool:
        return self._config.pace == "turns" or step % self._config.frame_skip == 0

    def _asked(self, name: str, now: Joint) -> int | None:
        """The action that this player's policy chooses; None if it failed."""

        def act() -> int:
            began = time.monotonic()
            policy = self._policies.get(name) or self._substitutes[name]
            action = policy.act(now.observations.get(name), now.infos.get(name, {}), now.masks.get(name))
            self._paces[name].took(time.monotonic() - began)  # without the time of reporting
            return action

        if not self._progress.call(f"policy {name} act", act):
            return None
        self._last[name] = action = self._progress.result
        if name in self._policies:
            chosen = Observed(now.observations.get(name), now.infos.get(name, {}), now.masks.get(name), action)
            self._observed.setdefault(name, []).append(chosen)
        return self._last[name]
