"""OpenAI Gym's old interface over Gymnasium, for agents that say `import gym`.

The trial puts it at the end of Python's path, so a real `gym` that is installed comes first. `make` returns what Gym
before 0.26 returned: `reset()` gives the observation alone, `step()` four values, `render(mode="rgb_array")` a picture,
and `seed()` seeds. With `render_mode` it returns Gym 0.26's five values instead, since that is where `make` got it.

docs/hippo.md says what is here and what is not.
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
    """Let `import gym.spaces.box` find what Gymnasium has under that name and this package has not."""
    for name, module in list(sys.modules.items()):
        if name.startswith(("gymnasium.spaces", "gymnasium.error", "gymnasium.vector", "gymnasium.utils.")):
            sys.modules.setdefault(f"{__name__}{name.removeprefix(gymnasium.__name__)}", module)
    for ours, theirs in ((envs, gymnasium.envs), (utils, gymnasium.utils)):
        ours.__path__.extend(theirs.__path__)


_alias()
