"""Gym's utilities: `seeding` of this package, and Gymnasium's `EzPickle`."""

from gymnasium.utils import EzPickle

from gym.utils import seeding

__all__ = ["EzPickle", "seeding"]
