"""The players of an environment, who or what chooses the actions of each, and their actions. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from hippodrome.protocol.players import GYM_PLAYER, HUMAN
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.values import show

PLAYER = "player_0"
"""The name of the player of an environment that has a single one."""

NOOP = "noop"
"""The name of the idle action, unless `idleAction` names another or the environment has no action of this name."""

ALL = "__all__"
"""A key that an environment may return beside its players. Its value is for all of them (RLlib's `MultiAgentEnv`)."""

ACTION_MASK = "action_mask"
"""Under this key an info or an observation says which actions are legal now."""

Mask = Sequence[Any]
"""One value for each action: true if the action is legal now."""


class PlayersError(ValueError):
    """The section `trial` does not fit the environment's players. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Player:
    """A player of the environment. `plays` is its value in `trial.players`: `human`, or the policy that plays it."""

    name: str
    action_space: tuple[str, ...]
    plays: str = HUMAN
    idle: int = 0
    """The number of the idle action, which the player takes in a step for which nothing was chosen."""

    @property
    def human(self) -> bool:
        """Whether a participant chooses its actions."""
        return self.plays == HUMAN

    @property
    def by_program(self) -> bool:
        """Whether a program at the trial's /gym chooses its actions."""
        return self.plays.startswith(GYM_PLAYER)


_NOTHING: Mapping[str, Any] = {}  # may be a default value: its type forbids changes


class View(NamedTuple):
    """The players' view after a reset or a step, by player. The core reads only `to_act` and `masks`."""

    to_act: frozenset[str]
    """The players whose actions the next step takes."""
    observations: Mapping[str, Any] = _NOTHING
    infos: Mapping[str, Any] = _NOTHING
    masks: Mapping[str, Mask] = _NOTHING
    """The actions that are legal now, for each player for which the environment gives a mask."""


def alone(action_space: tuple[str, ...]) -> tuple[Player, ...]:
    """Return the players of an environment with a single player, whom a human plays."""
    return (Player(PLAYER, action_space, HUMAN, _idle(PLAYER, action_space, None)),)


def who_plays(
    config: TrialSection, action_spaces: Mapping[str, tuple[str, ...]], group: int | None
) -> tuple[Player, ...]:
    """Return the environment's players, in its order, each with the human or policy that plays it in this group.

    `action_spaces` are the names of each player's actions, in the environment's order. Raises PlayersError.
    """
    if not action_spaces:
        raise PlayersError("the environment has no players")
    named = config.players_of(group)
    names = tuple(action_spaces)
    has = f"the environment has {_listed(names)}"
    unknown = [name for name in named if name not in action_spaces]
    if unknown:
        raise PlayersError(f"trial.players names {_listed(unknown)}, but {has}")
    unnamed = [name for name in names if name not in named]
    if (named and unnamed) or (len(names) > 1 and not named):
        missing = unnamed if named else names[1:]
        raise PlayersError(f"trial.players must say who plays {_listed(missing)}; {has}")
    plays = {name: named.get(name, HUMAN) for name in names}
    if HUMAN not in plays.values():
        raise PlayersError("trial.players must name a human: at least one player")
    idles = config.idle_action
    if isinstance(idles, Mapping):
        unknown = [name for name in idles if name not in action_spaces]
        if unknown:
            raise PlayersError(f"trial.idleAction names {_listed(unknown)}, but {has}")
    return tuple(
        Player(name, space, plays[name], _idle(name, space, idles.get(name) if isinstance(idles, Mapping) else idles))
        for name, space in action_spaces.items()
    )


def _idle(player: str, action_space: Sequence[str], name: str | None) -> int:
    """Return the number of the idle action. `name` is its name in `idleAction`, if given. Raises PlayersError."""
    if name is None:
        return action_space.index(NOOP) if NOOP in action_space else 0
    if name.lower() not in action_space:
        raise PlayersError(f"trial.idleAction is {show(name)}, but {player} has the actions {_listed(action_space)}")
    return action_space.index(name.lower())


def _listed(names: Sequence[str]) -> str:
    shown = [show(name) for name in names[:20]]
    return ", ".join(shown) + (" and others" if len(names) > len(shown) else "")


def is_legal(action: int, mask: Mask | None) -> bool:
    """Whether the mask allows the action. A mask that allows no action at all is ignored.

    An action beyond the end of the mask is legal.
    """
    return mask is None or action >= len(mask) or bool(mask[action]) or not any(mask)


def legal_actions(count: int, mask: Mask | None) -> list[int]:
    """Return the numbers of the legal actions, out of `count` actions."""
    return [action for action in range(count) if is_legal(action, mask)]


def legal_or_idle(action: int, player: Player, mask: Mask | None) -> int:
    """Return the action if it is legal; else the idle action if that is legal; else the first legal action."""
    if is_legal(action, mask):
        return action
    if is_legal(player.idle, mask):
        return player.idle
    return next(iter(legal_actions(len(player.action_space), mask)), player.idle)


def random_action(player: Player, mask: Mask | None, seed: int) -> int:
    """Return a random legal action: the same one for the same seed."""
    legal = legal_actions(len(player.action_space), mask)
    return legal[seed % len(legal)] if legal else player.idle


By = Literal["human", "policy", "advice", "none", "late", "random"]
"""Who chose an action. human: a participant. policy: the player's policy. advice: a program at /gym. random: chance,
because the time of the turn was over. late: no one, because the player's policy has not answered in time. none: no one,
so the player takes the idle action, or the first legal one if the idle action is illegal."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one player in one step."""

    index: int
    name: str
    by: By = "none"
    observed: int | None = None
    """The number of steps before the observation with which a policy was asked for this action; None if none was."""
    acts: bool = True
    """Whether the player is to act in this step. If not, this is the idle action, for environments that want one."""
    pressed_at: int | None = None
    """In a session: when the message came with which the participant chose the action, in nanoseconds; else None."""

    @property
    def human(self) -> bool:
        """Whether a participant chose it."""
        return self.by == "human"


SEEDS = 2**31
"""All seeds are below this number, so that every generator of NumPy and Gymnasium takes them."""


def policy_seed(episode_seed: int, player: str) -> int:
    """Return the seed of a player's policy in an episode: the same for the same arguments on every machine."""
    digest = hashlib.sha256(f"{episode_seed}\0{player}".encode()).digest()
    return int.from_bytes(digest[:8], "big") % SEEDS
