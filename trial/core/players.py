"""Who plays whom: the players of an environment, and who or what chooses the actions of each. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from protocol.players import GYM_PLAYER, HUMAN
from protocol.trial import TrialSection
from protocol.values import show

PLAYER = "player_0"
"""The player of an environment that has one."""

NOOP = "noop"
"""The action of no key, if the environment has one of this name and `idleAction` names no other."""

ALL = "__all__"
"""In what an environment returns, a key beside the players: the value for all of them (RLlib's `MultiAgentEnv`)."""

ACTION_MASK = "action_mask"
"""Under this key an info or an observation says which actions are legal now."""

Mask = Sequence[Any]
"""One value for each action: whether it is legal now."""


class PlayersError(ValueError):
    """The section `trial` and the environment's players do not fit. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Player:
    """A place of the environment. `plays` is what `trial.players` says: human, or who else chooses its actions."""

    name: str
    action_space: tuple[str, ...]
    plays: str = HUMAN
    idle: int = 0
    """The action of a step in which nothing was chosen."""

    @property
    def human(self) -> bool:
        return self.plays == HUMAN

    @property
    def by_program(self) -> bool:
        """Whether a program at the trial's /gym chooses its actions."""
        return self.plays.startswith(GYM_PLAYER)


_NOTHING: Mapping[str, Any] = {}  # the type forbids changes


class View(NamedTuple):
    """What the players see after a reset or a step, by player. The core reads `to_act` and `masks` only."""

    to_act: frozenset[str]
    """The players whose actions the next step takes."""
    observations: Mapping[str, Any] = _NOTHING
    infos: Mapping[str, Any] = _NOTHING
    masks: Mapping[str, Mask] = _NOTHING
    """Which actions are possible now, for those players for which the environment says so."""


def alone(action_space: tuple[str, ...]) -> tuple[Player, ...]:
    """The players of an environment that has one, who is a human."""
    return (Player(PLAYER, action_space, HUMAN, _idle(PLAYER, action_space, None)),)


def who_plays(
    config: TrialSection, action_spaces: Mapping[str, tuple[str, ...]], group: int | None
) -> tuple[Player, ...]:
    """The players of the environment, in its order, each with what plays it in this group.

    `action_spaces` has the environment's players in their order. Raises PlayersError.
    """
    if not action_spaces:
        raise PlayersError("the environment has no players")
    named = config.players_of(group)
    names = tuple(action_spaces)
    has = f"the environment has {_listed(names)}"
    unknown = [name for name in named if name not in action_spaces]
    if unknown:
        raise PlayersError(f"trial.players names {_listed(unknown)}, but {has}")
    lacking = [name for name in names if name not in named]
    if (named and lacking) or (len(names) > 1 and not named):
        missing = lacking if named else names[1:]
        raise PlayersError(f"trial.players must say who plays {_listed(missing)}; {has}")
    plays = {name: named.get(name, HUMAN) for name in names}
    if HUMAN not in plays.values():
        raise PlayersError("trial.players must name a human: at least one player")
    idles = config.idle_action
    if isinstance(idles, Mapping):
        strange = [name for name in idles if name not in action_spaces]
        if strange:
            raise PlayersError(f"trial.idleAction names {_listed(strange)}, but {has}")
    return tuple(
        Player(name, space, plays[name], _idle(name, space, idles.get(name) if isinstance(idles, Mapping) else idles))
        for name, space in action_spaces.items()
    )


def _idle(player: str, action_space: Sequence[str], name: str | None) -> int:
    """The action of no key. Raises PlayersError."""
    if name is None:
        return action_space.index(NOOP) if NOOP in action_space else 0
    if name.lower() not in action_space:
        raise PlayersError(f"trial.idleAction is {show(name)}, but {player} has the actions {_listed(action_space)}")
    return action_space.index(name.lower())


def _listed(names: Sequence[str]) -> str:
    shown = [show(name) for name in names[:20]]
    return ", ".join(shown) + (" and others" if len(names) > len(shown) else "")


def is_legal(action: int, mask: Mask | None) -> bool:
    """Whether the mask allows the action. A mask that is too short, or allows no action at all, forbids nothing."""
    return mask is None or action >= len(mask) or bool(mask[action]) or not any(mask)


def legal_actions(count: int, mask: Mask | None) -> list[int]:
    """Those of `count` actions that are legal."""
    return [action for action in range(count) if is_legal(action, mask)]


def legal_or_idle(action: int, player: Player, mask: Mask | None) -> int:
    """The action if it is legal; else the idle action if that is legal; else the first legal one."""
    if is_legal(action, mask):
        return action
    if is_legal(player.idle, mask):
        return player.idle
    return next(iter(legal_actions(len(player.action_space), mask)), player.idle)


def random_action(player: Player, mask: Mask | None, seed: int) -> int:
    """A random legal action: the same one for the same seed."""
    choice = legal_actions(len(player.action_space), mask)
    return choice[seed % len(choice)] if choice else player.idle
