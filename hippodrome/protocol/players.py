"""Checks the values of `players`, `substitute` and `idleAction` in the section `trial`: who plays each player."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hippodrome.protocol import values
from hippodrome.protocol.similar import did_you_mean
from hippodrome.protocol.values import show

HUMAN = "human"
GYM_PLAYER = "gym://"
"""The prefix of a player that a program plays, which is connected to the trial server's /gym: `gym://partner`."""
AGENT_PLAYER = "agent:"
"""The prefix of a player that a class of agent.py plays: `agent:Partner`."""
SAMPLE = "sample:"
"""The prefix of a policy's file whose actions are drawn by the softmax of its output. Without it, the policy takes the
action with the highest output."""
ONNXRUNTIME = "onnxruntime==1.32.0"
"""The package that runs policies' files, in the version that was tested (requirements/dev.txt)."""
ALL_KINDS = "human, random, idle, agent:Class, a file such as policies/partner.onnx, or gym://name"
"""The values that a player may have, for messages."""

MAX_PLAYERS = 64
_MAX_FILES_NAMED = 5
_NAME = values.text("the name of a player", values.MAX_NAME)
_PLAYS = values.text(ALL_KINDS, 200)
_GROUP = re.compile(r"[0-9]{1,9}")
_CLASS = re.compile(r"[A-Za-z_]\w*")
_PROGRAM = re.compile(r"[A-Za-z0-9_.-]+")


def by_group(value: Mapping[Any, Any]) -> bool:
    """Return whether `players` has a map for each group: all keys are whole numbers, and all values are maps."""
    return (
        bool(value)
        and all(_GROUP.fullmatch(str(key)) for key in value)
        and all(isinstance(item, dict) for item in value.values())
    )


def players(value: object) -> dict[str, Any]:
    """Check `players` and return what plays each player, or such a map for each group.

    Raises ValueError with what to write instead.
    """
    if not isinstance(value, dict):
        raise ValueError(f'must be a map: indented lines such as "player_0: human" below it, not {show(value)}')
    if not by_group(value):
        return _players(value, "")
    players: dict[str, Any] = {}
    for group, item in value.items():
        number = str(int(group))
        if number in players:
            raise ValueError(f"must name each group once, but names group {number} also as {group}")
        players[number] = _players(item, f"group {group}: ")
    return players


def _players(value: dict[Any, Any], where: str) -> dict[str, str]:
    if len(value) > MAX_PLAYERS:
        raise ValueError(f"{where}must have at most {MAX_PLAYERS} players, not {len(value)}")
    players = {}
    for name, plays in value.items():
        player = _checked(_NAME, str(name), where)
        players[player] = _plays(plays, f"{where}{values.printable(player)} ")
    if players and HUMAN not in players.values():
        raise ValueError(f"{where}must have a human: write human for the player that the participant plays")
    return players


def policy(value: object) -> str:
    """Check `substitute` and return the policy that plays in an empty place.

    Raises ValueError with what to write instead.
    """
    plays = _plays(value, "")
    if plays == HUMAN or plays.startswith(GYM_PLAYER):
        raise ValueError(f"must be a policy: random, idle, agent:Class or a file, not {show(plays)}")
    return plays


def _plays(value: object, where: str) -> str:
    """What plays one player; `where` begins the sentence of a mistake."""
    plays: str = _checked(_PLAYS, value, where)
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
        raise ValueError(f"{where}must be {ALL_KINDS}, not {show(plays)}{_hint(plays)}")
    return plays


def _hint(plays: str) -> str:
    """The end of the message about a wrong value: what was probably meant; empty if that is not known."""
    as_class = f"; a class of agent.py is {AGENT_PLAYER}{plays}" if _CLASS.fullmatch(plays) else ""
    return did_you_mean(plays, (HUMAN, "random", "idle")) or as_class


def _checked(check: values.Check, value: object, where: str) -> Any:
    """The result of a check; `where` begins the sentence of its mistake."""
    try:
        return check(value)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from None


def idle_action(value: object) -> str | dict[str, str]:
    """Check `idleAction` and return the name of the action that is taken without a key, or one for each player.

    Raises ValueError with what to write instead.
    """
    if isinstance(value, dict):
        if len(value) > MAX_PLAYERS:
            raise ValueError(f"must have at most {MAX_PLAYERS} players, not {len(value)}")
        return {
            str(_checked(_NAME, str(name), "")): _checked(values.action_name, item, f"{values.printable(str(name))} ")
            for name, item in value.items()
        }
    return values.action_name(value)


def files(policies: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the policies' files in this map and the maps in it, each after its path of keys.

    The map need not have been checked: values that are no name of a file are left out.
    """
    for key, plays in policies.items():
        if isinstance(plays, Mapping):
            yield from (((key, *path), file) for path, file in files(plays))
        elif isinstance(plays, str) and plays.endswith(".onnx"):
            yield (key,), plays.removeprefix(SAMPLE)


def files_there(folder: Path) -> str:
    """Return the end of a message about a policy's missing file: the first five policies' files in the folder of
    agent.py; "" if it has none."""
    files = sorted(file.relative_to(folder).as_posix() for file in folder.glob("policies/**/*.onnx"))
    return f"; there are {', '.join(files[:_MAX_FILES_NAMED])}" if files else ""
