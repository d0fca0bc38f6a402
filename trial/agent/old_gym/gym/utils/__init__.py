"""Gym's utilities: Gymnasium's, and `seeding` of this package."""

from gymnasium.utils import EzPickle, colorize

from gym.utils import seeding

__all__ = ["EzPickle", "colorize", "seeding"]
