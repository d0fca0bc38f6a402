"""Environments by their ids. The classes of Gymnasium's own environments can be imported from here, too."""

from gym.envs import registration
from gym.envs.registration import make, register, registry, spec

__all__ = ["make", "register", "registration", "registry", "spec"]
