"""Seeds that follow from others. Pure."""

from __future__ import annotations

import hashlib

SEEDS = 2**31
"""Seeds are below this: what NumPy's and Gymnasium's generators all take."""


def policy_seed(episode_seed: int, player: str) -> int:
    """The seed of a player's policy in an episode. It depends on its arguments alone, on every machine and version."""
    digest = hashlib.sha256(f"{episode_seed}\0{player}".encode()).digest()
    return int.from_bytes(digest[:8], "big") % SEEDS
