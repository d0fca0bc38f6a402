"""The policies of all players of an environment that are no humans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from trial.agent.joint import JointAdapter
from trial.policies.load import AGENT, load
from trial.policies.policy import Policy, PolicyError


def is_policy(plays: str) -> bool:
    """Whether what `trial.players` says of a player is a policy: no human, and no program at /gym."""
    return plays in ("random", "idle") or plays.startswith(AGENT) or plays.endswith(".onnx")


def load_all(
    plays: Mapping[str, str], adapter: JointAdapter, folder: Path, idle: Mapping[str, int] | None = None
) -> dict[str, Policy]:
    """The policies by player. `plays` says who plays whom, `folder` is that of agent.py, `idle` the idle actions.

    Raises PolicyError, whose sentence begins with the player, and whatever the researcher's classes raise.
    """
    found: dict[str, Policy] = {}
    for player, spec in plays.items():
        if is_policy(spec) and player in adapter.action_spaces:
            try:
                found[player] = load(
                    spec,
                    folder,
                    adapter.agent_module,
                    len(adapter.action_spaces[player]),
                    adapter.observation_spaces[player],
                    player=player,
                    idle=(idle or {}).get(player, 0),
                )
            except PolicyError as error:
                raise type(error)(f"{player}: {error}") from error.__cause__
    return found
