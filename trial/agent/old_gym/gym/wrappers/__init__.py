"""Gym's wrappers: TimeLimit, and Gymnasium's wrappers under Gym's names."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium import wrappers

from gym.core import Env, FromGymnasium, ToGymnasium, Wrapper
from gym.wrappers.time_limit import TimeLimit

__all__ = ["Monitor", "OrderEnforcing", "TimeLimit", "Wrapper"]


class OrderEnforcing(Wrapper):
    """Has the name of Gym's wrapper, and changes nothing."""


class Monitor(Wrapper):
    """Has the name of Gym's Monitor, which wrote videos and results to a folder, and warns that it writes nothing."""

    def __init__(self, env: Any, *args: Any, **kwargs: Any) -> None:
        warnings.warn("gym.wrappers.Monitor writes nothing here: the trial records each step itself", stacklevel=2)
        super().__init__(env)


_NAMES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "AtariPreprocessing": ("AtariPreprocessing", {}),
    "ClipAction": ("ClipAction", {}),
    "FilterObservation": ("FilterObservation", {}),
    "FlattenObservation": ("FlattenObservation", {}),
    "FrameStack": ("FrameStackObservation", {"num_stack": "stack_size"}),
    "GrayScaleObservation": ("GrayscaleObservation", {}),
    "NormalizeObservation": ("NormalizeObservation", {}),
    "NormalizeReward": ("NormalizeReward", {}),
    "RecordEpisodeStatistics": ("RecordEpisodeStatistics", {"deque_size": "buffer_length"}),
    "RecordVideo": ("RecordVideo", {}),
    "RescaleAction": ("RescaleAction", {}),
    "ResizeObservation": ("ResizeObservation", {}),
    "TimeAwareObservation": ("TimeAwareObservation", {}),
    "TransformObservation": ("TransformObservation", {"f": "func"}),
    "TransformReward": ("TransformReward", {"f": "func"}),
}
"""By Gym's name of a wrapper: Gymnasium's name, and by Gym's names of its arguments those of Gymnasium."""


def _of_gymnasium(name: str, gymnasium_name: str, renamed: Mapping[str, str]) -> type[Wrapper]:
    """Make a class by which Gymnasium's wrapper wraps environments with Gym's old interface."""
    wrap: Any = getattr(wrappers, gymnasium_name)

    def __init__(self: Any, env: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        kwargs = {renamed.get(key, key): value for key, value in kwargs.items()}
        if name == "ResizeObservation":  # Gym took one number for a square
            args = tuple((size, size) if isinstance(size, int) else size for size in args)
        if name == "TransformObservation" and len(args) + len(kwargs) < 2:
            kwargs["observation_space"] = env.observation_space
        new = _new(env)
        wrapped = wrap(new if new is not None else ToGymnasium(env), *args, **kwargs)
        Wrapper.__init__(self, wrapped if new is not None else FromGymnasium(wrapped))

    return type(name, (Wrapper,), {"__init__": __init__, "__doc__": f"Gymnasium's {gymnasium_name}."})


def _new(env: Any) -> gymnasium.Env[Any, Any] | None:
    """Return Gymnasium's environment in the `Wrapper` that `make` returns with a `render_mode`; None in any other."""
    if type(env) is Wrapper and isinstance(env.env, gymnasium.Env) and not isinstance(env.env, Env):
        return env.env
    return None


for _name, (_gymnasium_name, _renamed) in _NAMES.items():
    globals()[_name] = _of_gymnasium(_name, _gymnasium_name, _renamed)
    __all__ += [_name]  # noqa: PLE0604

for _module in ("atari_preprocessing", "frame_stack", "monitor", "record_video", "transform_observation"):
    sys.modules.setdefault(f"{__name__}.{_module}", sys.modules[__name__])
