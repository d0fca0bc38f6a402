"""Gym's utilities: random numbers by NumPy's RandomState, as Gym used it, and Gymnasium's `EzPickle`."""

import sys

import numpy as np
from gymnasium.utils import EzPickle

__all__ = ["EzPickle", "np_random", "seeding"]

seeding = sys.modules[__name__]  # `gym.utils.seeding`


def np_random(seed: int | None = None) -> tuple[np.random.RandomState, int]:
    """Make a generator. Return it and its seed (random for None)."""
    used = int(np.random.SeedSequence().generate_state(1)[0]) % 2**31 if seed is None else int(seed)
    return np.random.RandomState(used), used
