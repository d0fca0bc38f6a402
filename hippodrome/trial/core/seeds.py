"""Derives seeds from other seeds. Pure."""

from __future__ import annotations

import hashlib

SEEDS = 2**31
"""All seeds are below this number, so that every generator of NumPy and Gymnasium takes them."""


def policy_seed(episode_seed: int, player: str) -> int:
    """Return the seed of a player's policy in an episode: the same for the same arguments on every machine."""
    digest = hashlib.sha256(f"{episode_seed}\0{player}".encode()).digest()
    return int.from_bytes(digest[:8], "big") % SEEDS
