"""The keys `players` and `idleAction` of the section `trial`: who plays whom. Checks of single values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from protocol import values
from protocol.similar import did_you_mean
from protocol.values import show

HUMAN = "human"
GYM_PLAYER = "gym://"
"""Before the name of a program at the trial's /gym."""
AGENT_PLAYER = "agent:"
"""Before the name of a class of agent.py."""
SAMPLE = "sample:"
"""Before a policy's file: actions are drawn by the softmax of its output, instead of the best one being taken."""
ONNXRUNTIME = "onnxruntime==1.32.0"
"""The package that runs policies' files, in the version that was tested (requirements/dev.txt)."""
WHO = "human, random, idle, agent:Class, a file such as policies/partner.onnx, or gym://name"

MOST_PLAYERS = 64
_MOST_NEAR = 5
_NAME = values.text("the name of a player", values.LONGEST_NAME)
_PLAYS = values.text(WHO, 200)
_GROUP = re.compile(r"[0-9]{1,9}")
_CLASS = re.compile(r"[A-Za-z_]\w*")
_PROGRAM = re.compile(r"[A-Za-z0-9_.-]+")


def by_group(value: Mapping[Any, Any]) -> bool:
    """Whether `players` says it group by group: all keys are whole numbers, and all values maps."""
    return (
        bool(value)
        and all(_GROUP.fullmatch(str(key)) for key in value)
        and all(isinstance(item, dict) for item in value.values())
    )


def players(value: object) -> dict[str, Any]:
    """What plays each player, or that for each group. Raises ValueError with what to write instead."""
    if not isinstance(value, dict):
        raise ValueError(f'must be a map: indented lines such as "player_0: human" below it, not {show(value)}')
    if not by_group(value):
        return _players(value, "")
    return {str(int(group)): _players(item, f"group {group}: ") for group, item in value.items()}


def _players(value: dict[Any, Any], where: str) -> dict[str, str]:
    if len(value) > MOST_PLAYERS:
        raise ValueError(f"{where}must have at most {MOST_PLAYERS} players, not {len(value)}")
    found = {}
    for name, plays in value.items():
        known = _one(_NAME, str(name), where)
        found[known] = _plays(plays, f"{where}{values.printable(known)} ")
    if found and HUMAN not in found.values():
        raise ValueError(f"{where}must have a human: write human for the player that the participant plays")
    return found


def policy(value: object) -> str:
    """What plays in an empty place. Raises ValueError with what to write instead."""
    plays = _plays(value, "")
    if plays == HUMAN or plays.startswith(GYM_PLAYER):
        raise ValueError(f"must be a policy: random, idle, agent:Class or a file, not {show(plays)}")
    return plays


def _plays(value: object, where: str) -> str:
    plays: str = _one(_PLAYS, value, where)
    kind, _, rest = plays.partition(":")
    if plays in (HUMAN, "random", "idle"):
        return plays
    if plays.startswith(GYM_PLAYER):
        fits = _PROGRAM.fullmatch(plays.removeprefix(GYM_PLAYER))
    elif kind == "agent":
        fits = _CLASS.fullmatch(rest)
    else:
        file = plays.removeprefix(SAMPLE)
        fits = re.fullmatch(r"[^\\:]+\.onnx", file)
        if fits and (file.startswith("/") or ".." in file.split("/")):
            raise ValueError(f"{where}must be a file below the project's folder, not {show(plays)}")
    if not fits:
        raise ValueError(f"{where}must be {WHO}, not {show(plays)}{_meant(plays)}")
    return plays


def _meant(plays: str) -> str:
    """What was probably meant by what plays nobody; empty if nobody knows."""
    as_class = f"; a class of agent.py is {AGENT_PLAYER}{plays}" if _CLASS.fullmatch(plays) else ""
    return did_you_mean(plays, (HUMAN, "random", "idle")) or as_class


def _one(check: values.Check, value: object, where: str) -> Any:
    try:
        return check(value)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from None


def idle_action(value: object) -> str | dict[str, str]:
    """The name of the action of no key, or one for each player."""
    if isinstance(value, dict):
        if len(value) > MOST_PLAYERS:
            raise ValueError(f"must have at most {MOST_PLAYERS} players, not {len(value)}")
        return {
            str(_one(_NAME, str(name), "")): _one(values.action_name, item, f"{values.printable(str(name))} ")
            for name, item in value.items()
        }
    return values.action_name(value)


class Naming(Protocol):
    """A section `trial`, as far as it names policies."""

    @property
    def players(self) -> Mapping[str, Any]: ...

    @property
    def substitute(self) -> str | None: ...


def files_of(trial: Naming) -> Iterator[tuple[tuple[str, ...], str]]:
    """The policies' files that a section `trial` names, each with its path of keys."""
    for key, given in (("players", trial.players), ("substitute", {"": trial.substitute})):
        yield from (((key, *filter(None, path)), file) for path, file in files(given))


def files(given: object) -> Iterator[tuple[tuple[str, ...], str]]:
    """The policies' files that `players` names, each with its path of keys below `players`.

    `given` need not have been checked: what is no name of a file is left out.
    """
    for name, plays in given.items() if isinstance(given, Mapping) else ():
        if isinstance(plays, Mapping):
            yield from (((name, *path), file) for path, file in files(plays))
        elif isinstance(plays, str) and plays.endswith(".onnx"):
            yield (name,), plays.removeprefix(SAMPLE)


def files_there(folder: Path) -> str:
    """How a sentence about a policy's missing file ends: the files that there are beside agent.py; empty without any.

    At most five are named.
    """
    near = sorted(other.relative_to(folder).as_posix() for other in folder.glob("policies/**/*.onnx"))
    return f"; there are {', '.join(near[:_MOST_NEAR])}" if near else ""
