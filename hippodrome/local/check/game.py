"""Plays whole episodes with the agent, in its process (`agent_process.py`).

Humans take random actions, and policies play the other players. If there are several humans, `substitute` plays in each
of their places for a while.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from hippodrome.local.check.agent_progress import AgentProgress
from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.agent.agent import AgentAdapter, StepResult
from hippodrome.trial.agent.calls import mask_in
from hippodrome.trial.agent.joint import Joint, JointAdapter
from hippodrome.trial.core.players import PLAYER, Player, legal_actions, policy_seed
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.places import load_policies
from hippodrome.trial.policies.policy import AgentPolicy, Policy

BEGUN = 5  # steps of an episode with the options of another game or level
STAYS = 20  # steps for which a substitute plays in one place


class OnePlayer:
    """An agent with one player, with the attributes and methods of `JointAdapter` that `CheckedGame` uses."""

    def __init__(self, adapter: AgentAdapter, *, masked: bool) -> None:
        """`masked`: whether an `action_mask` in the info says which actions are legal. Servers ask it turn by turn."""
        self._adapter = adapter
        self._masked = masked
        self.action_spaces = {PLAYER: adapter.action_space}
        self.observation_spaces = {PLAYER: None}  # needed for policies only, and a human plays
        self.pictures, self.close = adapter.render, adapter.close

    def reset(self, seed: int) -> tuple[Joint, bool]:
        """Begin an episode. Return its first results, and whether `reset` took the seed."""
        observation, info, seeded = self._adapter.reset(seed)
        return self._joint(StepResult(observation, 0.0, False, False, info)), seeded

    def step(self, actions: Mapping[str, int]) -> Joint:
        """Take one step with the number of the player's action. Raises AgentError if the result cannot be read."""
        return self._joint(self._adapter.step(actions[PLAYER]))

    def _joint(self, result: StepResult) -> Joint:
        mask = mask_in(result.info) if self._masked else None
        over = result.terminated or result.truncated
        return Joint(
            observations={PLAYER: result.observation},
            infos={PLAYER: result.info},
            rewards={PLAYER: result.reward},
            terminated={PLAYER: result.terminated},
            truncated={PLAYER: result.truncated},
            to_act=frozenset() if over else frozenset({PLAYER}),
            masks={} if mask is None else {PLAYER: tuple(mask)},
            over=over,
            extra=result.extra,
        )


class CheckedGame:
    """A game that `hippodrome check` plays. Each method returns False if a call failed, which is reported."""

    def __init__(
        self,
        adapter: JointAdapter | OnePlayer,
        players: Sequence[Player],
        config: TrialSection,
        progress: AgentProgress,
    ) -> None:
        self._adapter, self._players, self._config, self._progress = adapter, players, config, progress
        self._policies: dict[str, Policy] = {}
        self._substitutes: dict[str, Policy] = {}  # by the player in whose place each plays
        self._last: dict[str, int] = {}
        self._observed: dict[str, list[Observed]] = {}  # what each policy has chosen in the episode
        self._random = Random(1)  # noqa: S311 - the same each time
        self._pressed = 0

    def load(self, folder: Path, agent_module: Any) -> bool:
        """Load the policies from `folder` and agent.py."""
        progress, spaces = self._progress, self._adapter.observation_spaces
        humans = [player for player in self._players if player.human]
        plays = self._config.substitute if len(humans) > 1 else None
        if not progress.call("policies", lambda: load_policies(self._players, folder, agent_module, spaces)):
            return False
        self._policies = progress.result
        if plays:
            replaced = [replace(player, plays=plays) for player in humans]
            if not progress.call("policies", lambda: load_policies(replaced, folder, agent_module, spaces)):
                return False
            self._substitutes = progress.result
        forget = [name for name, policy in self._policies.items() if isinstance(policy, AgentPolicy) and policy.forgets]
        progress.facts["forgetful"] = forget
        return True

    def play(self, first_reset: Callable[[], Any]) -> bool:
        """Play until the last episode or the time is over."""
        for episode in range(1, self._config.max_episodes + 1):
            reset = first_reset if episode == 1 else partial(self._adapter.reset, episode)
            if not self._episode(episode, reset, self._config.most_steps):
                return False
            if self._progress.facts["episodes"] < episode:
                break
        self._progress.callbacks.session_ended()
        return True

    def begin_each(self, others: Sequence[Mapping[str, Any]], begin: Callable[[Mapping[str, Any]], None]) -> bool:
        """Begin an episode of each other game and level.

        Each has its `options` and `answers`, with which `begin` begins the agent's session.
        """
        for game in others:
            if self._progress.time_over():
                break
            begin(game)
            self._progress.facts["game"] = game
            if not self._episode(1, partial(self._adapter.reset, 1), BEGUN):
                return False
        self._progress.facts.pop("game", None)
        return True

    def close(self) -> bool:
        """Close the policies and the agent.

        Before, policies resume the last episode, as on a server that replaces a lost one.
        """
        for name, observed in self._observed.items():
            if not self._progress.call(f"policy {name} resume", partial(self._policies[name].resume, observed)):
                return False
        closed = [policy.close for policy in (*self._policies.values(), *self._substitutes.values())]
        return all(self._progress.call("close", close) for close in (*closed, self._adapter.close))

    def _episode(self, episode: int, reset: Callable[[], Any], most_steps: float) -> bool:
        """Play an episode until it ends, or the time is over."""
        progress, facts = self._progress, self._progress.facts
        if not progress.call("reset", reset):
            return False
        now: Joint = progress.result[0]
        if not (progress.call("render", self._adapter.pictures) and self._reset_policies(episode)):
            return False
        progress.callbacks.episode_began(episode, now.observations, now.infos)
        for step in itertools.count():
            if now.over or step >= most_steps:
                facts["episodes"] = max(episode, facts["episodes"])
                progress.callbacks.episode_ended(now.why if now.over else "truncated")
                break
            if progress.time_over():
                break
            actions = self._actions(now, step)
            if actions is None:
                return False
            facts["action"] = actions[PLAYER] if isinstance(self._adapter, OnePlayer) else actions
            if not progress.call("step", partial(self._adapter.step, actions)):
                return False
            now = progress.result
            facts["steps"] += 1
            if not progress.call("render", self._adapter.pictures):
                return False
            recorded = now.observations.values() if self._config.record_observations else ()
            progress.returned(recorded, now.infos.values(), now.extra)
            progress.callbacks.stepped(actions, now.rewards, now.observations, now.infos)
        return True

    def _reset_policies(self, episode: int) -> bool:
        self._last, self._observed = {}, {}
        return all(
            self._progress.call(f"policy {name} reset", partial(policy.reset, policy_seed(episode, name)))
            for name, policy in (self._policies | self._substitutes).items()
        )

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
        steps: int = self._progress.facts["steps"]
        return names[steps // STAYS % len(names)]

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
        policy = self._policies.get(name) or self._substitutes[name]
        seen = (now.observations.get(name), now.infos.get(name, {}), now.masks.get(name))
        if not self._progress.call(f"policy {name} act", partial(policy.act, *seen)):
            return None
        action: int = self._progress.result
        self._last[name] = action
        if name in self._policies:
            self._observed.setdefault(name, []).append(Observed(*seen, action))
        return action
