"""Environments for the tests, registered on import: `hippodrome gym --import` and the tests themselves import it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

EVERYTHING = spaces.Dict(
    {
        "box": spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
        "bytes": spaces.Box(0, 255, (3,), np.uint8),
        "discrete": spaces.Discrete(5, start=-2),
        "binary": spaces.MultiBinary([2, 2]),
        "many": spaces.MultiDiscrete([3, 4], start=[1, 0]),
        "text": spaces.Text(6, min_length=0, charset="äbc "),
        "pair": spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1, (), np.float32)]),
        "sequence": spaces.Sequence(spaces.Discrete(9)),
        "stack": spaces.Sequence(spaces.Box(-1, 1, (2,)), stack=True),
        "graph": spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3)),
        "one": spaces.OneOf([spaces.Discrete(3), spaces.Text(2)]),
    }
)


class Everything(gymnasium.Env[Any, Any]):
    """An environment with every kind of space: its observation repeats its action. Its infos are of many kinds."""

    observation_space = spaces.Tuple([EVERYTHING, EVERYTHING])
    action_space = EVERYTHING

    def __init__(self, length: int = 3) -> None:
        self.length = length

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(1000)))
        self.steps = 0
        return self.observation_space.sample(), {"options": options, "odd": (1, np.float32(0.5), {2: np.arange(3)})}

    def step(self, action: Any) -> Any:
        self.steps += 1
        other, _ = self.observation_space.sample()
        info = {"nan": float("nan"), "steps": self.steps, "action": action, "lives": np.int16(3)}
        return (action, other), np.float32(0.1) * self.steps, False, self.steps >= self.length, info


class Numbers(gymnasium.Env[Any, Any]):
    """An environment with nested spaces, episodes of different lengths, and infos of all kinds."""

    observation_space = spaces.Dict(
        {
            "position": spaces.Box(-10, 10, (2,), np.float32),
            "pair": spaces.Tuple([spaces.Discrete(100), spaces.MultiBinary(3)]),
            "name": spaces.Text(4),
        }
    )
    action_space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)})

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(1000)))
        self.left = int(self.np_random.integers(2, 9))
        return self.observation_space.sample(), {"left": self.left, "start": np.arange(2.0)}

    def step(self, action: Any) -> Any:
        self.left -= 1
        info: dict[str, Any] = {"sum": np.float32(action["a"].sum()), "b": int(action["b"]), "word": "x" * self.left}
        if self.left == 1:
            info["nearly"] = {"deep": True, "array": np.zeros((2, 1), np.int8)}
        return self.observation_space.sample(), float(action["a"][0]), self.left <= 0, False, info


class WithoutText(Exception):
    """An exception whose text raises."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


def _raise(error: BaseException) -> Any:
    raise error


def _result(**changed: Any) -> Callable[[], Any]:
    named = {"observation": np.zeros(2, np.float32), "reward": 1.0, "terminated": False, "truncated": False, "info": {}}
    return lambda: tuple((named | changed).values())


RESULTS: dict[str, Callable[[], Any]] = {
    "calm": _result(),
    "raises": lambda: _raise(RuntimeError("broken")),
    "raises without text": lambda: _raise(WithoutText()),
    "exits": lambda: _raise(SystemExit(3)),
    "three values": lambda: (0, 1.0, False),
    "nothing": lambda: None,
    "generator": lambda: (part for part in range(5)),
    "reward of text": _result(reward="much"),
    "no reward": _result(reward=None),
    "huge reward": _result(reward=10**400),
    "info without end": lambda: (0, 1.0, False, False, {"text": "y" * 250_000_000}),
    "dies": lambda: os._exit(3),
    "sleeps": lambda: time.sleep(30),
    "outside": _result(observation=np.array([np.nan, 7], np.float32)),
    "another shape": _result(observation=np.zeros(3, np.float32)),
    "text": _result(observation="hello"),
    "reward in an array": _result(reward=np.array([2.0])),
    "info of text": _result(info="word"),
    "no info": _result(info=None),
    "list": lambda: [*_result()()],
}


class Bad(gymnasium.Env[Any, Any]):
    """An environment whose steps return or do what the action names."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Text(40, charset="abcdefghijklmnopqrstuvwxyz ")
    metadata = {"render_modes": ["rgb_array", "ansi"]}  # noqa: RUF012 - as Gymnasium has it

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if options == {"raise": True}:
            raise RuntimeError("no reset today")
        return np.zeros(2, np.float32), {}

    def step(self, action: str) -> Any:
        return RESULTS[action]()

    def render(self) -> Any:
        return "drawn" if self.render_mode == "ansi" else np.full((4, 5, 3), 7, np.uint8)


gymnasium.register("Everything-v0", Everything, disable_env_checker=True)
gymnasium.register("Numbers-v0", Numbers, disable_env_checker=True)
gymnasium.register("Bad-v0", Bad, disable_env_checker=True)
