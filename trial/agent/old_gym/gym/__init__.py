"""OpenAI Gym's old interface over Gymnasium, for agents that say `import gym`.

The trial puts this package at the end of Python's path, so a real `gym` that is installed comes first. Environments of
`make` are as in Gym before 0.26: `reset()` returns the observation alone, `step()` four values,
`render(mode="rgb_array")` a picture, and `seed()` seeds. If `make` gets a `render_mode`, which it takes since Gym 0.26,
`reset` and `step` return what they return there: two and five values.

docs/hippo.md says which parts of Gym are here.
"""

import sys

import gymnasium
from gymnasium import error, spaces, vector
from gymnasium.spaces import Space

from gym import core, envs, logger, utils, version, wrappers
from gym.core import ActionWrapper, Env, GoalEnv, ObservationWrapper, RewardWrapper, Wrapper
from gym.envs.registration import make, register, registry, spec

__all__ = [
    "ActionWrapper",
    "Env",
    "GoalEnv",
    "ObservationWrapper",
    "RewardWrapper",
    "Space",
    "Wrapper",
    "__version__",
    "core",
    "envs",
    "error",
    "logger",
    "make",
    "register",
    "registry",
    "spaces",
    "spec",
    "utils",
    "vector",
    "version",
    "wrappers",
]

__version__ = version.VERSION


def _alias() -> None:
    """Let `import gym.spaces.box` find Gymnasium's module of that name, where this package has none."""
    for name, module in list(sys.modules.items()):
        if name.startswith(("gymnasium.spaces", "gymnasium.error", "gymnasium.vector", "gymnasium.utils.")):
            sys.modules.setdefault(f"{__name__}{name.removeprefix(gymnasium.__name__)}", module)
    for ours, theirs in ((envs, gymnasium.envs), (utils, gymnasium.utils)):
        ours.__path__.extend(theirs.__path__)


_alias()
