"""The platform of the functions: AWS, unless the program that runs them has called `use`."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

from hippodrome.ports import Platform

T = TypeVar("T")
_platform: Platform | None = None
_made: dict[Callable[..., Any], Any] = {}


def use(platform: Platform | None) -> None:
    """Set the platform; None stands for AWS, with the settings in the environment."""
    global _platform  # noqa: PLW0603 - set nowhere else
    _platform = platform
    _made.clear()


def platform() -> Platform:
    """Return the platform in use."""
    if _platform is None:
        from hippodrome.aws import AwsPlatform  # noqa: PLC0415 - other platforms do without it

        use(AwsPlatform.from_env(os.environ))
    assert _platform is not None
    return _platform


def shared(kind: Callable[[Platform], T]) -> T:
    """Return the one object of this kind on the platform in use. It keeps its caches between invocations."""
    made: T | None = _made.get(kind)
    if made is None:
        made = _made.setdefault(kind, kind(platform()))
    return made
