"""Environments by their ids."""

from gym.envs.registration import make, register

__all__ = ["make", "register"]
