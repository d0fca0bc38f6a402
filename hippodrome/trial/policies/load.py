"""Makes the policy that `trial.players` names for a player."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hippodrome.protocol.file_names import on_disk
from hippodrome.protocol.players import AGENT_PLAYER, ALL_KINDS, SAMPLE, files_there
from hippodrome.trial.policies.policy import Policy, PolicyError, PolicyFileMissing
from hippodrome.trial.policies.simple import IdlePolicy, RandomPolicy, of_class


def load(
    spec: str,
    folder: Path,
    agent_module: Any,
    action_count: int,
    observation_space: Any = None,
    *,
    player: str = "player_1",
    idle: int = 0,
) -> Policy:
    """Make the policy `spec` for one player: `random`, `idle`, `agent:Class`, `FILE.onnx` or `sample:FILE.onnx`.

    `folder` is the project's, `agent_module` the imported agent.py (None without one), `observation_space` the
    player's space (None if it is not known), and `idle` the number of the player's idle action. A file is tried with
    one observation of zeros, if the space is known. Raises PolicyError with a sentence for the researcher, and whatever
    the researcher's class raises.
    """
    if spec == "random":
        return RandomPolicy(action_count)
    if spec == "idle":
        return IdlePolicy(action_count, idle)
    if spec.startswith(AGENT_PLAYER):
        return of_class(spec, agent_module, player, action_count)
    if spec.endswith(".onnx"):
        from hippodrome.trial.policies import onnx  # noqa: PLC0415 - it imports onnxruntime, which most projects do not need

        name = spec.removeprefix(SAMPLE)
        return onnx.load(spec, _file(folder, name), action_count, observation_space, sample=spec != name)
    raise PolicyError(f"{spec!r} is no player; write {ALL_KINDS}")


def _file(folder: Path, name: str) -> Path:
    """Find the file of this name in the folder or below it. Raises PolicyError if there is none."""
    path = on_disk(folder, name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise PolicyError(f"{name} leads out of the project's folder")
    if not path.is_file():
        raise PolicyFileMissing(f"there is no file {name}{files_there(folder)}")
    return path
