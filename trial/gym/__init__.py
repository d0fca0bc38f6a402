"""Serves environments over a WebSocket: Gymie's messages, and a binary subprotocol for training (docs/gym.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trial.gym.embedded import start
from trial.gym.errors import EnvironmentMalformed, EnvironmentNotFound, InstanceNotFound, WrongAction
from trial.gym.overrides import override

if TYPE_CHECKING:
    from trial.gym.client import ConnectionLost, RemoteError
    from trial.gym.remote import RemoteEnv, RemoteVectorEnv

__all__ = [
    "ConnectionLost",
    "EnvironmentMalformed",
    "EnvironmentNotFound",
    "InstanceNotFound",
    "RemoteEnv",
    "RemoteError",
    "RemoteVectorEnv",
    "WrongAction",
    "override",
    "start",
]

_CLIENTS = {"ConnectionLost": "client", "RemoteError": "client", "RemoteEnv": "remote", "RemoteVectorEnv": "remote"}


def __getattr__(name: str) -> Any:
    """Import the clients when they are first used: the process that listens must not import Gymnasium and numpy."""
    if name not in _CLIENTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415

    return getattr(import_module(f"{__name__}.{_CLIENTS[name]}"), name)
