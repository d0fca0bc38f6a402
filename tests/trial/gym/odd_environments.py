"""Environments for the server's tests: each behaves badly in one way. `--import` registers them."""

from __future__ import annotations

import ctypes
import itertools
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any, ClassVar

import gymnasium
import numpy as np


class Calm(gymnasium.Env):
    """An environment that counts its steps. An episode has five, or is truncated after `cut` steps."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space: Any = gymnasium.spaces.Discrete(3)
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode: str | None = None, cut: int = 0) -> None:
        self.render_mode = render_mode
        self.steps = 0
        self.cut = cut

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return self.seen(), {"seed": seed, **(options or {})}

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.misbehave()
        return self.seen(), np.float32(self.steps), self.steps == 5, self.steps == self.cut, {"action": action}

    def render(self) -> Any:
        return np.full((4, 6, 3), self.steps, np.uint8)

    def seen(self) -> Any:
        return np.array([self.steps, 0.5], np.float32)

    def misbehave(self) -> None:
        """What the environments below do in a step."""


class Infinite(Calm):
    def seen(self) -> Any:
        return np.array([np.inf, np.nan], np.float32)


class Continuous(Calm):
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)


class Raising(Calm):
    def misbehave(self) -> None:
        raise RuntimeError("no such luck")


class Leaving(Calm):
    def misbehave(self) -> None:
        sys.exit("that was all")


class Dying(Calm):
    def misbehave(self) -> None:
        os._exit(3)


class Crashing(Calm):
    def misbehave(self) -> None:
        ctypes.string_at(0)


class Looping(Calm):
    def misbehave(self) -> None:
        while True:
            pass


class Hanging(Calm):
    """Hangs in C, where Python calls no signal handler."""

    def misbehave(self) -> None:
        sum(itertools.repeat(1, 10**13))


class Stubborn(Looping):
    """Hangs, and has taken the signal that should end it."""

    def misbehave(self) -> None:
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        super().misbehave()


class Printing(Calm):
    def misbehave(self) -> None:
        print("word " * 100_000)
        print("word " * 100_000, file=sys.stderr)


class Forking(Calm):
    """Leaves a process behind: in a session of its own, and its parent has ended."""

    def misbehave(self) -> None:
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                time.sleep(300)
            os._exit(0)
        os.wait()


class Multiplying(Calm):
    def misbehave(self) -> None:
        for _ in range(10):
            subprocess.Popen(["sleep", "300"])


class Greedy(Calm):
    def misbehave(self) -> None:
        np.ones(400 * 2**20 // 8)


class GreedyShared(Calm):
    """Each step takes 40 MB more of shared memory, which the limit of a process does not count."""

    shared: ClassVar[list[mmap.mmap]] = []

    def misbehave(self) -> None:
        self.shared.append(mmap.mmap(-1, 40 * 2**20))
        self.shared[-1].write(bytes(40 * 2**20))


class Threading(Calm):
    def misbehave(self) -> None:
        for _ in range(20):
            threading.Thread(target=time.sleep, args=(300,), daemon=True).start()


class GreedyTogether(Calm):
    """Each of its processes stays below the limit, and all together exceed it."""

    def misbehave(self) -> None:
        for _ in range(3):
            if os.fork() == 0:
                kept = np.ones(200 * 2**20 // 8)
                time.sleep(300)
                os._exit(int(kept[0]))


class Lacking(Calm):
    """Needs a package that is not installed."""

    def __init__(self, **_: Any) -> None:
        raise gymnasium.error.DependencyNotInstalled(
            "Box2D is not installed, you can install it by run `pip install swig` followed by "
            '`pip install "gymnasium[box2d]"`'
        )


class Old(Calm):
    """An environment of gym's old kind: `step` returns four values, `reset` an observation alone."""

    def reset(self) -> Any:  # type: ignore[override]
        self.steps = 0
        return self.seen()

    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info


class OldSeeded(Calm):
    """An environment of gym's old kind, with a method `seed`."""

    def seed(self, seed: int | None = None) -> list[int | None]:
        self.random = np.random.default_rng(seed)
        return [seed]

    def reset(self) -> Any:  # type: ignore[override]
        return self.random.random(2)


OLD = (Old, OldSeeded)
for made in (*Calm.__subclasses__(), Stubborn, Calm):
    gymnasium.register(f"Odd/{made.__name__}-v0", made, disable_env_checker=True, order_enforce=made not in OLD)
