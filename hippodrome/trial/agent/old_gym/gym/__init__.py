"""OpenAI Gym's old interface over Gymnasium, for agents that say `import gym`.

The trial puts this package at the end of Python's path, so a real `gym` that is installed comes first. Environments of
`make` are as in Gym 0.21: `reset()` returns the observation alone, `step()` four values, `render(mode="rgb_array")` a
picture, and `seed()` seeds. If `make` gets a `render_mode`, which came with five values, it returns Gymnasium's
environment. The spaces and errors are Gymnasium's.
"""

import sys

import gymnasium
from gymnasium import error, spaces
from gymnasium.spaces import Space

from gym import core, envs, utils, wrappers
from gym.core import ActionWrapper, Env, ObservationWrapper, RewardWrapper, Wrapper
from gym.envs import make, register

__all__ = [
    "VERSION",
    "ActionWrapper",
    "Env",
    "ObservationWrapper",
    "RewardWrapper",
    "Space",
    "Wrapper",
    "__version__",
    "core",
    "envs",
    "error",
    "make",
    "register",
    "spaces",
    "utils",
    "version",
    "wrappers",
]

__version__ = VERSION = "0.21.0"  # the last in wide use before `step` returned five values
version = sys.modules[__name__]

# So that `import gym.version`, `from gym.utils.seeding import np_random` or `from gym.spaces.box import Box` find them.
sys.modules |= {f"{__name__}.version": version}
sys.modules |= {f"{__name__}.utils.seeding": utils, f"{__name__}.envs.registration": envs}
for _name, _module in list(sys.modules.items()):
    if _name.startswith(("gymnasium.spaces", "gymnasium.error")):
        sys.modules.setdefault(_name.replace(gymnasium.__name__, __name__, 1), _module)
