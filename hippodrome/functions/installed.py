"""The platform that the handlers use: AWS, unless the program that runs them has set another one with `use`."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

from hippodrome.control.ports import Platform

T = TypeVar("T")
_platform: Platform | None = None
_made: dict[Callable[..., Any], Any] = {}


def use(platform: Platform | None) -> None:
    """Set the platform for all handlers. None stands for AWS, with the settings in the environment variables."""
    global _platform  # noqa: PLW0603 - set nowhere else
    _platform = platform
    _made.clear()


def platform() -> Platform:
    """Return the platform in use."""
    if _platform is None:
        from hippodrome.control.aws import AwsPlatform  # noqa: PLC0415 - other platforms do without it

        use(AwsPlatform(os.environ))
    assert _platform is not None
    return _platform


def shared(kind: Callable[[Platform], T]) -> T:
    """Return `kind(platform())`, made at the first call only, so that the object's caches outlive an invocation."""
    made: T | None = _made.get(kind)
    if made is None:
        made = _made.setdefault(kind, kind(platform()))
    return made
