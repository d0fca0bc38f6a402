"""Where the functions find their platform: AWS, unless whoever runs them has put another one in its place."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

from hippodrome.ports import Platform

T = TypeVar("T")
_platform: Platform | None = None
_made: dict[Callable[..., Any], Any] = {}


def use(platform: Platform | None) -> None:
    """Run on this platform from now on; None means AWS as the environment describes it."""
    global _platform  # noqa: PLW0603 - the one place
    _platform = platform
    _made.clear()


def platform() -> Platform:
    """The platform in use."""
    if _platform is None:
        from hippodrome.aws import AwsPlatform  # noqa: PLC0415 - not needed where another platform is used

        use(AwsPlatform.from_env(os.environ))
    assert _platform is not None
    return _platform


def shared(kind: Callable[[Platform], T]) -> T:
    """The one object of this kind on the platform in use: it lives, with its caches, as long as the function does."""
    made: T | None = _made.get(kind)
    if made is None:
        made = _made.setdefault(kind, kind(platform()))
    return made
