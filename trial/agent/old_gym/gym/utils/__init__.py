"""Gymnasium's, but for seeding."""

from gymnasium.utils import EzPickle, colorize

from gym.utils import seeding

__all__ = ["EzPickle", "colorize", "seeding"]
