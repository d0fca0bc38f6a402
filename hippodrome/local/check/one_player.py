"""Calls an agent with one player as one with several is called, so that `hippodrome check` plays both in one way."""

from __future__ import annotations

from collections.abc import Mapping

from hippodrome.trial.agent.agent import AgentAdapter, StepResult
from hippodrome.trial.agent.calls import mask_in
from hippodrome.trial.agent.joint import Joint
from hippodrome.trial.core.players import PLAYER


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
