"""Environments for the tests, registered on import: `python -m trial.gym --import` and the tests themselves import it."""

from __future__ import annotations

import os
import time
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

    def __init__(self, length: int = 3, quiet: bool = False) -> None:
        self.length = length
        self.quiet = quiet

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(1000)))
        self.steps = 0
        if self.quiet:
            return self.observation_space.sample(), {}
        return self.observation_space.sample(), {"options": options, "odd": (1, np.float32(0.5), {2: np.arange(3)})}

    def step(self, action: Any) -> Any:
        self.steps += 1
        other, _ = self.observation_space.sample()
        info = {"nan": float("nan"), "steps": self.steps, "action": action, "lives": np.int16(3)}
        info = {"steps": self.steps} if self.quiet else info  # Gymnasium's vectors cannot merge all of them
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


class Bad(gymnasium.Env[Any, Any]):
    """An environment that misbehaves as its action says."""

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
        observation: Any = np.zeros(2, np.float32)
        info: Any = {}
        if action == "raise":
            raise RuntimeError("broken")
        if action == "exit":
            raise SystemExit(3)
        if action == "die":
            os._exit(3)
        if action == "sleep":
            time.sleep(30)
        if action == "print":
            os.write(1, b"x" * 100_000)
            print("y" * 100_000)
        if action == "fork":
            for _ in range(1000):
                if os.fork() == 0:
                    time.sleep(600)
                    os._exit(0)
        if action == "eat":
            eaten = []
            while True:
                eaten.append(np.ones(10_000_000))
        if action == "shape":
            observation = np.zeros(3, np.float32)
        if action == "text":
            observation = "hello"
        if action == "outside":
            observation = np.array([np.nan, 7], np.float32)
        if action == "three":
            return observation, 0.0, True
        if action == "info":
            info = ["no dict"]
        if action == "reward":
            return observation, "much", False, False, {}
        if action == "nothing":
            return None
        if action == "thing":
            info = {"self": self, "lambda": lambda: 1}
        if action == "close fds":
            os.closerange(3, 200)
        return observation, 1.0, False, False, info

    def render(self) -> Any:
        return "drawn" if self.render_mode == "ansi" else np.full((4, 5, 3), 7, np.uint8)


gymnasium.register("Everything-v0", Everything, disable_env_checker=True)
gymnasium.register("Quiet-v0", Everything, disable_env_checker=True, kwargs={"quiet": True})
gymnasium.register("Numbers-v0", Numbers, disable_env_checker=True)
gymnasium.register("Bad-v0", Bad, disable_env_checker=True)
