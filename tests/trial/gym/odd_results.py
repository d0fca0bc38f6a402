"""An environment whose steps return, raise or draw something unusual: the action names what."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

CALM = np.zeros(2, np.float32)


class WithoutText(Exception):
    """An exception whose text raises."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class TextOfAnotherType(Exception):
    """An exception whose `__str__` returns no str."""

    def __str__(self) -> str:
        return 5  # type: ignore[return-value] # noqa: PLE0307


class Key:
    """A key of a dict; its text raises."""

    def __str__(self) -> str:
        raise RuntimeError("no words")

    __repr__ = __str__


def _raise(error: BaseException) -> Any:
    raise error


def nested(levels: int) -> Any:
    """Return a list in a list in a list."""
    found: list[Any] = []
    for _ in range(levels):
        found = [found]
    return found


def _result(**changed: Any) -> Callable[[], Any]:
    named = {"observation": CALM, "reward": 1.0, "terminated": False, "truncated": False, "info": {}} | changed
    return lambda: tuple(named.values())


RESULTS: dict[str, Callable[[], Any]] = {
    "calm": _result(),
    # results that get a sentence; long texts are made when they are asked for
    "exception without text": lambda: _raise(WithoutText()),
    "exception with odd text": lambda: _raise(TextOfAnotherType()),
    "three values": lambda: (CALM, 1.0, False),
    "nothing": lambda: None,
    "generator": lambda: (part for part in range(5)),
    "reward of text": _result(reward="much"),
    "no reward": _result(reward=None),
    "complex reward": _result(reward=1j),
    "huge reward": _result(reward=10**400),
    "info without end": lambda: (CALM, 1.0, False, False, {"text": "y" * 250_000_000}),
    # results that arrive
    "reward in an array": _result(reward=np.array([2.0])),
    "infinite reward": _result(reward=float("inf")),
    "info of text": _result(info="word"),
    "no info": _result(info=None),
    "info with odd keys": _result(info={Key(): 4}),
    "info too deep": _result(info={"deep": nested(100_000)}),
    "list": lambda: [CALM, 1.0, False, False, {}],
}

PICTURES: dict[str, Callable[[], Any]] = {
    "raised": lambda: _raise(WithoutText()),
    "thing": Key,
    "deep": lambda: nested(100_000),
    "huge": lambda: np.zeros((30_000, 30_000, 3), np.uint8),
}


class Results(gymnasium.Env[Any, Any]):
    """Its action is a number of RESULTS, or after these one of PICTURES, which `render` returns then."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(len(RESULTS) + len(PICTURES))
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return CALM, {}

    def step(self, action: int) -> Any:
        if action >= len(RESULTS):
            self.picture = list(PICTURES.values())[action - len(RESULTS)]
            return _result()()
        return list(RESULTS.values())[action]()

    def render(self) -> Any:
        return self.picture()


gymnasium.register("Odd/Results-v0", Results, disable_env_checker=True)
