"""The researcher's agent after its start, the players of its environment, and their policies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.agent import joint
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.joint import JointAdapter
from hippodrome.trial.core.players import PLAYER, Player, PlayersError, who_plays
from hippodrome.trial.policies.places import load_policies
from hippodrome.trial.policies.policy import Policy
from hippodrome.trial.settings import TrialSettings


@dataclass(frozen=True, slots=True)
class TrialPlayers:
    """Who plays in one trial: the players in the environment's order, and the policies by player."""

    players: tuple[Player, ...]
    policies: Mapping[str, Policy]
    places: Mapping[str, str] = field(default_factory=dict)
    """In a session: the player that each member plays, by the member's id."""
    seats: tuple[str, ...] = ()
    """In a session: the player of each seat, in the order of the seats."""
    vacant: tuple[str, ...] = ()
    """In a session: the players of the seats that no member has. Policies play them."""
    stand_ins: Mapping[str, Policy] = field(default_factory=dict)
    """In a session: the policies that may play for members who are away, by player."""
    erased: tuple[str, ...] = ()
    """In a session without `substitute`: the players of members whose data were erased, and who never come."""


@dataclass(slots=True)
class StartedAgent:
    """The agent after its start, and the loaded policies. The methods block: call them on the agent's thread."""

    settings: TrialSettings
    agent: AgentAdapter | JointAdapter
    callbacks: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    """The callbacks that the agent has, by name."""
    _loaded: dict[int | None, TrialPlayers] = field(default_factory=dict)

    @classmethod
    def start(cls, adapter: AgentAdapter, settings: TrialSettings) -> StartedAgent:
        """Start the agent, and load the policies of every group that the server may be assigned to.

        Raises PlayersError and PolicyError, whose messages are for the researcher, AgentError, and any error of the
        researcher's code.
        """
        config = settings.trial
        agent = joint.start(adapter, config.named_players())
        started = cls(settings, agent, agent.callbacks)
        groups: Iterable[int | None] = () if settings.assigned else config.groups()
        for group in groups or (settings.group,):
            started._loaded[started._key(group)] = started._load(config, group)
        return started

    def _key(self, group: int | None) -> int | None:
        """Return the group under which the loaded policies are kept; None if the same policies play in all groups."""
        return group if self.settings.trial.groups() else None

    def players_of(self, settings: TrialSettings) -> TrialPlayers:
        """Return who plays in one trial. Each trial gets policy objects of its own. Raises as `start`.

        `settings` are the present settings: since its start, a server may have been assigned to a group and a session.
        """
        same = settings.trial == self.settings.trial  # a game of a study with factors may have players of its own
        loaded = self._loaded.pop(self._key(settings.group), None) if same else None
        playing = loaded or self._load(settings.trial, settings.group)
        return self._with_members(playing, settings) if settings.session else playing

    def _with_members(self, playing: TrialPlayers, settings: TrialSettings) -> TrialPlayers:
        """Give each member of the session the player of their seat. The policy `substitute` plays the other seats."""
        config, seats = settings.trial, [player.name for player in playing.players if player.human]
        if len(seats) != settings.players:
            raise PlayersError(
                f"project.players is {settings.players}, and trial.players has {len(seats)} humans; they must agree"
            )
        places = {user_id: seats[seat] for user_id, seat in settings.seats.items()}
        vacant = tuple(name for name in seats if name not in places.values())
        substitute = config.substitute
        if substitute is None:
            erased = {seats[member.seat] for member in settings.members if not member.user_id}
            if missing := [name for name in vacant if name not in erased]:
                raise PlayersError(
                    f"trial.substitute must say what plays in the place of {missing[0]}, who has not come"
                )
            return replace(playing, places=places, seats=tuple(seats), erased=vacant)
        away = seats if config.after_absent == "policy" else vacant
        stand_ins = self._policies(
            [replace(player, plays=substitute) for player in playing.players if player.name in away]
        )
        return TrialPlayers(
            tuple(replace(player, plays=substitute) if player.name in vacant else player for player in playing.players),
            {**playing.policies, **{name: stand_ins[name] for name in vacant}},
            places,
            tuple(seats),
            vacant,
            {name: policy for name, policy in stand_ins.items() if name not in vacant},
        )

    def _load(self, config: TrialSection, group: int | None) -> TrialPlayers:
        agent = self.agent
        if not isinstance(agent, JointAdapter):
            return TrialPlayers(who_plays(config, {PLAYER: agent.action_space}, group), {})
        players = who_plays(config, {name: agent.action_spaces[name] for name in agent.players}, group)
        return TrialPlayers(players, self._policies(players))

    def _policies(self, players: Iterable[Player]) -> dict[str, Policy]:
        agent = self.agent
        spaces = agent.observation_spaces if isinstance(agent, JointAdapter) else {}
        return load_policies(players, self.settings.agent_dir, agent.agent_module, spaces)
