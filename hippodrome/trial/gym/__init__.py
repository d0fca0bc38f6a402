"""Serves environments over a WebSocket: Gymie's messages, and a binary subprotocol for training (docs/gym.md)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hippodrome.trial.gym.errors import EnvironmentMalformed, EnvironmentNotFound, InstanceNotFound, WrongAction
from hippodrome.trial.gym.overrides import override

if TYPE_CHECKING:
    from hippodrome.trial.gym.client import ConnectionLost, RemoteError
    from hippodrome.trial.gym.remote import RemoteEnv
    from hippodrome.trial.gym.server import start

__all__ = [
    "ConnectionLost",
    "EnvironmentMalformed",
    "EnvironmentNotFound",
    "InstanceNotFound",
    "RemoteEnv",
    "RemoteError",
    "WrongAction",
    "override",
    "start",
]

_LATER = {
    "ConnectionLost": "client",
    "RemoteError": "client",
    "RemoteEnv": "remote",
    "start": "server",
}


def __getattr__(name: str) -> Any:
    """Import server and clients when they are first used: a server starts numpy without threads (`server.py`)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
