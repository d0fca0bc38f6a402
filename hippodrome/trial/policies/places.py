"""Loads the policies of a trial's players, asks them for actions, and describes them for recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.trial.core.effects import ResetPolicy
from hippodrome.trial.core.players import Player
from hippodrome.trial.core.policies import AskPolicy
from hippodrome.trial.policies.inline import InlinePolicy
from hippodrome.trial.policies.load import load
from hippodrome.trial.policies.policy import Policy, PolicyError
from hippodrome.trial.policies.simple import IdlePolicy, RandomPolicy
from hippodrome.trial.policies.thread import PolicyThread

Acted = Callable[[str, int, int | None, Exception | None], None]
"""A function that gets the player, the id of a question, and the action, or None and the policy's exception."""


def load_policies(
    players: Iterable[Player], folder: Path, agent_module: Any, observation_spaces: Mapping[str, Any]
) -> dict[str, Policy]:
    """Load the policies of all players that have one, by player. It blocks the thread that calls it.

    Raises PolicyError with a sentence that names the player, and whatever the researcher's classes raise.
    """
    loaded = {}
    for player in players:
        if player.human or player.by_program:
            continue
        count, space = len(player.action_space), observation_spaces.get(player.name)
        try:
            loaded[player.name] = load(
                player.plays, folder, agent_module, count, space, player=player.name, idle=player.idle
            )
        except PolicyError as error:
            raise PolicyError(f"trial.players: {player.name} cannot be played by {player.plays}: {error}") from error
    return loaded


class Places:
    """Asks the policies of one trial. Its methods are for the event loop, which calls `acted` too."""

    def __init__(self, acted: Acted) -> None:
        self._acted = acted
        self._policies: dict[str, PolicyThread | InlinePolicy] = {}
        self.described: dict[str, Mapping[str, Any]] = {}
        """The description of each player, for the header of a recording."""

    @property
    def busy(self) -> bool:
        """Whether a method of a policy has not returned yet. It may never return."""
        return any(policy.busy for policy in self._policies.values())

    def fill(
        self,
        players: Iterable[Player],
        policies: Mapping[str, Policy],
        stand_ins: Mapping[str, Policy],
        seats: Sequence[str],
    ) -> None:
        """Set who plays. From then on each policy belongs to this trial alone.

        `policies` and `stand_ins` are by player; a stand-in plays while the player's human is away. `seats` has the
        players of the session's members, in the order of their seats.
        """
        for player in players:
            policy, stand_in = policies.get(player.name), stand_ins.get(player.name)
            self.described[player.name] = described = _described(player, policy, stand_in)
            if player.name in seats:
                described["seat"] = seats.index(player.name)
            either = policy or stand_in
            if either is not None:
                self._policies[player.name] = self._running(player, either)

    def _running(self, player: Player, policy: Policy) -> PolicyThread | InlinePolicy:
        def done(ask_id: int, action: int | None, error: Exception | None) -> None:
            self._acted(player.name, ask_id, action, error)

        if isinstance(policy, RandomPolicy | IdlePolicy):
            return InlinePolicy(policy, done)
        return PolicyThread(policy, done, name=f"policy of {player.name}")

    def ask(self, effect: AskPolicy) -> None:
        """Ask a policy for an action. `acted` is called with the answer."""
        self._policies[effect.player].ask(effect.ask_id, effect.observation, effect.info, effect.mask)

    def reset(self, effect: ResetPolicy) -> None:
        """Begin an episode for a policy, or resume it after a replay."""
        self._policies[effect.player].reset(effect.seed, effect.observed)

    def close(self) -> None:
        """Close all policies: the trial is over."""
        for policy in self._policies.values():
            policy.close()


def _described(player: Player, policy: Policy | None, stand_in: Policy | None) -> dict[str, Any]:
    if stand_in is not None:
        return {"kind": "human", "substitute": stand_in.description()}
    if player.human:
        return {"kind": "human"}
    if policy is None:
        return {"kind": "program", "policy": player.plays}
    return {"kind": "policy", "policy": player.plays, **policy.description()}
