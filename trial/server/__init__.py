"""The process of a trial server: its lifetime, its port, and the admission of clients."""

from __future__ import annotations

from typing import Any

_OF_INTERACTIVE_GYM = ("app", "callback", "game_manager", "remote_game", "server_app", "utils")


def __getattr__(name: str) -> Any:
    """Raise ImportError for a module of Interactive Gym's package `server`: they are names of `trial` here."""
    if name in _OF_INTERACTIVE_GYM:
        raise ImportError(f"write `from trial import {name}` (docs/interactive-gym.md)")
    raise AttributeError(f"module 'trial.server' has no attribute {name!r}")
