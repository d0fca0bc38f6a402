"""The researcher's agent once it has started, who plays in its environment, and the policies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from trial.agent import starting
from trial.agent.agent import AgentAdapter
from trial.agent.joint import JointAdapter
from trial.core.players import PLAYER, Player, who_plays
from trial.policies.policy import Policy
from trial.policies.seats import load_policies
from trial.settings import Settings


@dataclass(frozen=True, slots=True)
class Table:
    """Who plays whom in a group: the players in the environment's order, and the policies of those that have one."""

    players: tuple[Player, ...]
    policies: Mapping[str, Policy]


@dataclass(slots=True)
class Started:
    """What a trial is played with. Its methods block; they are for the agent's thread."""

    settings: Settings
    agent: AgentAdapter | JointAdapter
    callbacks: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    """Those that the agent has."""
    _loaded: dict[int | None, Table] = field(default_factory=dict)

    @classmethod
    def start(cls, adapter: AgentAdapter, settings: Settings) -> Started:
        """Start the agent, and load the policies of every group that the server may get.

        Raises PlayersError and PolicyError with a sentence, AgentError, and whatever the researcher's code raises.
        """
        config = settings.trial
        agent = starting.start(adapter, config.player_names())
        started = cls(settings, agent, agent.callbacks)
        groups: Iterable[int | None] = config.groups() if settings.warm_server else ()
        for group in groups or (settings.group,):
            started._loaded[started._key(group)] = started._load(group)
        return started

    def _key(self, group: int | None) -> int | None:
        """The group, if who plays whom differs between groups."""
        return group if self.settings.trial.groups() else None

    def take(self, group: int | None) -> Table:
        """Who plays whom in this group, for one trial: the next one gets policies of its own. Raises as `start`."""
        return self._loaded.pop(self._key(group), None) or self._load(group)

    def _load(self, group: int | None) -> Table:
        config, agent = self.settings.trial, self.agent
        if not isinstance(agent, JointAdapter):
            return Table(who_plays(config, {PLAYER: agent.action_space}, group), {})
        players = who_plays(config, {name: agent.action_spaces[name] for name in agent.players}, group)
        folder, spaces = self.settings.agent_dir, agent.observation_spaces
        return Table(players, load_policies(players, folder, agent.agent_module, spaces))
