"""Tries the policies of an experiment on the researcher's machine: each is loaded and asked for one action."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from protocol.players import ONNXRUNTIME
from trial.agent.tracebacks import where
from trial.interactive_gym import looking, playing
from trial.interactive_gym.configuration_constants import PolicyTypes
from trial.interactive_gym.looking import Look
from trial.interactive_gym.playing import Unplayable
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.sources import Locate
from trial.policies import onnx
from trial.policies.policy import PolicyError

_LONGEST = 300  # the most characters of an error


def try_policies(config: RemoteConfig, look: Look, find: Locate, root: Path) -> Iterator[str]:
    """Try each player's policy with that player's first observation. Yield a sentence if policies cannot be tried.

    `find` finds a file that an option names, `root` is the folder of the experiment's modules. Raises Unplayable if a
    policy's file cannot be read, if a policy does not fit the environment or raises an exception, or if it chooses an
    action that does not exist.
    """
    untried = False
    for player, plays in playing.mapping_of(config).items() if look.several else ():
        if isinstance(plays, str) and plays in (PolicyTypes.Human, PolicyTypes.Random):
            continue
        if looking.is_file(config, plays):
            file = find(plays)
            if file is None or not file.is_file():
                continue  # `project.py` gives a remark about it when it copies the files
            if importlib.util.find_spec("onnxruntime") is None:
                untried = True
                continue
            if look.joined_as_sorted:
                _try_file(player, file, look)
                continue
        _try_functions(config, player, look, find, root)
    if untried:
        yield f"ONNX files are not tried, since onnxruntime is not installed here: pip install {ONNXRUNTIME}"


def _try_file(player: Any, file: Path, look: Look) -> None:
    """Load an ONNX file as a server does, and ask it for one action. Raises Unplayable if it does not fit."""
    try:
        policy = onnx.load(file.name, file, look.counts[player], look.spaces.get(player), sample=True)
        if player in look.observations:
            policy.act(look.observations[player], {}, None)
    except PolicyError as error:
        raise Unplayable(f"the policy of {player} does not fit: {error}") from error


def _try_functions(config: RemoteConfig, player: Any, look: Look, find: Locate, root: Path) -> None:
    """Make a policy of the experiment's functions, as a server does, and ask it for one action. Raises Unplayable."""

    def locate(name: Any) -> Any:
        path = find(name) if isinstance(name, str) else None
        return str(path) if path is not None and path.is_file() else name

    try:
        policy = playing.policy_class(config, player, locate)()
        action = policy.act(look.observations[player], {}) if player in look.observations else 0
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        place = where(error, root)
        at = f" ({place})" if place else ""
        raise Unplayable(f"the policy of {player} fails: {text[:_LONGEST]}{at}") from error
    if not 0 <= action < look.counts[player]:
        raise Unplayable(f"the policy of {player} chose action {action}; there are 0 to {look.counts[player] - 1}")
