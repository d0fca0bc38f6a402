"""The policies of a trial, by player: loaded, asked, described."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from trial.core.effects import ResetPolicy
from trial.core.players import Player
from trial.core.policies import AskPolicy
from trial.policies.inline import InlinePolicy
from trial.policies.load import load
from trial.policies.policy import Policy, PolicyError
from trial.policies.simple import IdlePolicy, RandomPolicy
from trial.policies.thread import PolicyThread

Acted = Callable[[str, int, int | None, Exception | None], None]
"""Takes the player, the id of a question, and the action or else the exception that the policy raised."""

NO_POLICIES: Mapping[str, Policy] = {}
_AGAIN = -1  # the id of questions whose answers nobody wants


def load_policies(
    players: Iterable[Player], folder: Path, agent_module: Any, observation_spaces: Mapping[str, Any]
) -> dict[str, Policy]:
    """The policies of those players that have one. Blocks. Raises PolicyError with a sentence that names the player."""
    found = {}
    for player in players:
        if player.human or player.by_program:
            continue
        count, space = len(player.action_space), observation_spaces.get(player.name)
        try:
            found[player.name] = load(
                player.plays, folder, agent_module, count, space, player=player.name, idle=player.idle
            )
        except PolicyError as error:
            raise PolicyError(f"trial.players: {player.name} cannot be played by {player.plays}: {error}") from error
    return found


class Places:
    """Asks the policies of one trial. To be called from the event loop, on which `acted` is called too."""

    def __init__(self, acted: Acted) -> None:
        self._acted = acted
        self._asked: dict[str, PolicyThread | InlinePolicy] = {}
        self.described: dict[str, Mapping[str, Any]] = {}
        """What the head of a recording says of each player."""

    @property
    def busy(self) -> bool:
        """A policy has not returned, and may never."""
        return any(policy.busy for policy in self._asked.values())

    def fill(
        self,
        players: Iterable[Player],
        policies: Mapping[str, Policy],
        stand_ins: Mapping[str, Policy] = NO_POLICIES,
        seats: Sequence[str] = (),
    ) -> None:
        """These play. Each policy is asked from now on in this trial only.

        `stand_ins` play for humans who are away, by player; `seats` are the players of the session's seats, in order.
        """
        for player in players:
            policy, stand_in = policies.get(player.name), stand_ins.get(player.name)
            self.described[player.name] = _described(player, policy)
            if stand_in is not None:
                self.described[player.name] = {"kind": "human", "substitute": stand_in.description()}
            if player.name in seats:
                self.described[player.name] = {**self.described[player.name], "seat": seats.index(player.name)}
            asked = policy or stand_in
            if asked is not None:
                self._asked[player.name] = self._place(player, asked)

    def _place(self, player: Player, policy: Policy) -> PolicyThread | InlinePolicy:
        def done(ask_id: int, action: int | None, error: Exception | None) -> None:
            if ask_id != _AGAIN:
                self._acted(player.name, ask_id, action, error)

        if isinstance(policy, RandomPolicy | IdlePolicy):
            return InlinePolicy(policy, done)
        return PolicyThread(policy, done, name=f"policy of {player.name}")

    def ask(self, effect: AskPolicy) -> None:
        """Ask for an action; `acted` follows."""
        self._asked[effect.player].ask(effect.ask_id, effect.observation, effect.info, effect.mask)

    def reset(self, effect: ResetPolicy) -> None:
        """Begin an episode, and go through what the policy acted upon in it."""
        policy = self._asked[effect.player]
        policy.reset(effect.seed)
        for seen in effect.observed:
            policy.ask(_AGAIN, seen.observation, seen.info, seen.mask)

    def close(self) -> None:
        """The trial is over."""
        for policy in self._asked.values():
            policy.close()


def _described(player: Player, policy: Policy | None) -> dict[str, Any]:
    if player.human:
        return {"kind": "human"}
    if policy is None:
        return {"kind": "program", "policy": player.plays}
    return {"kind": "policy", "policy": player.plays, **policy.description()}
