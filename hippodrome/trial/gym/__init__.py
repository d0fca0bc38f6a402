"""Serves environments over a WebSocket: Gymie's messages, and a binary subprotocol for training (docs/gym.md).

The client, `RemoteEnv`, is imported from `hippodrome.gym`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hippodrome.trial.gym.forms import EnvironmentMalformed, EnvironmentNotFound, InstanceNotFound, WrongAction
    from hippodrome.trial.gym.overrides import override
    from hippodrome.trial.gym.server import start

__all__ = [
    "EnvironmentMalformed",
    "EnvironmentNotFound",
    "InstanceNotFound",
    "WrongAction",
    "override",
    "start",
]

_LATER = {
    "EnvironmentMalformed": "forms",
    "EnvironmentNotFound": "forms",
    "InstanceNotFound": "forms",
    "WrongAction": "forms",
    "override": "overrides",
    "start": "server",
}


def __getattr__(name: str) -> Any:
    """Import what is used, when it is first used: clients need no server, and a server starts numpy without threads
    (`server.py`)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
