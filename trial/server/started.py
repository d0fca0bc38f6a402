"""The researcher's agent once it has started, who plays in its environment, and the policies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from trial.agent import starting
from trial.agent.agent import AgentAdapter
from trial.agent.joint import JointAdapter
from trial.core.players import PLAYER, Player, PlayersError, who_plays
from trial.policies.places import load_policies
from trial.policies.policy import Policy
from trial.settings import TrialSettings


@dataclass(frozen=True, slots=True)
class Table:
    """Who plays whom: the players in the environment's order, and the policies of those that have one."""

    players: tuple[Player, ...]
    policies: Mapping[str, Policy]
    places: Mapping[str, str] = field(default_factory=dict)
    """In a session: the place of each member, by their id: the player whom they play."""
    seats: tuple[str, ...] = ()
    """In a session: the players of its seats, in their order."""
    vacant: tuple[str, ...] = ()
    """In a session: the places of humans that no member has. A policy plays there."""
    stand_ins: Mapping[str, Policy] = field(default_factory=dict)
    """In a session: the policies that may play for members who are away, by player."""
    gone: tuple[str, ...] = ()
    """In a session: the places of members whose data were erased, if no policy plays there. They do not come back."""


@dataclass(slots=True)
class Started:
    """What a trial is played with. Its methods block; they are for the agent's thread."""

    settings: TrialSettings
    agent: AgentAdapter | JointAdapter
    callbacks: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    """Those that the agent has."""
    _loaded: dict[int | None, Table] = field(default_factory=dict)

    @classmethod
    def start(cls, adapter: AgentAdapter, settings: TrialSettings) -> Started:
        """Start the agent, and load the policies of every group that the server may get.

        Raises PlayersError and PolicyError with a sentence, AgentError, and whatever the researcher's code raises.
        """
        config = settings.trial
        agent = starting.start(adapter, config.named_players())
        started = cls(settings, agent, agent.callbacks)
        groups: Iterable[int | None] = () if settings.assigned else config.groups()
        for group in groups or (settings.group,):
            started._loaded[started._key(group)] = started._load(group)
        return started

    def _key(self, group: int | None) -> int | None:
        """The group, if who plays whom differs between groups."""
        return group if self.settings.trial.groups() else None

    def take(self, settings: TrialSettings) -> Table:
        """Who plays whom, for one trial: the next one gets policies of its own. Raises as `start`.

        `settings` are those of now: a server may have learnt its group and its session since it has started.
        """
        table = self._loaded.pop(self._key(settings.group), None) or self._load(settings.group)
        return self._with_members(table, settings) if settings.session else table

    def _with_members(self, table: Table, settings: TrialSettings) -> Table:
        """The table of a session: each member has a place, and `substitute` plays in the places that are left."""
        config, seats = settings.trial, [player.name for player in table.players if player.human]
        if len(seats) != settings.players:
            raise PlayersError(
                f"project.players is {settings.players}, and trial.players has {len(seats)} humans; they must agree"
            )
        places = {user_id: seats[seat] for user_id, seat in settings.seats.items()}
        vacant = tuple(name for name in seats if name not in places.values())
        plays = config.substitute
        if plays is None:
            erased = {seats[member.seat] for member in settings.members if not member.user_id}
            if missing := [name for name in vacant if name not in erased]:
                raise PlayersError(
                    f"trial.substitute must say what plays in the place of {missing[0]}, who has not come"
                )
            return replace(table, places=places, seats=tuple(seats), gone=vacant)
        away = seats if config.after_absent == "policy" else vacant
        stand_ins = self._policies([replace(each, plays=plays) for each in table.players if each.name in away])
        return Table(
            tuple(replace(each, plays=plays) if each.name in vacant else each for each in table.players),
            {**table.policies, **{name: stand_ins[name] for name in vacant}},
            places,
            tuple(seats),
            vacant,
            {name: policy for name, policy in stand_ins.items() if name not in vacant},
        )

    def _load(self, group: int | None) -> Table:
        config, agent = self.settings.trial, self.agent
        if not isinstance(agent, JointAdapter):
            return Table(who_plays(config, {PLAYER: agent.action_space}, group), {})
        players = who_plays(config, {name: agent.action_spaces[name] for name in agent.players}, group)
        return Table(players, self._policies(players))

    def _policies(self, players: Iterable[Player]) -> dict[str, Policy]:
        agent = self.agent
        spaces = agent.observation_spaces if isinstance(agent, JointAdapter) else {}
        return load_policies(players, self.settings.agent_dir, agent.agent_module, spaces)
