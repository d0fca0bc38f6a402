"""Environments over a WebSocket: Gymie's messages, and a binary subprotocol for training (docs/gym.md)."""

from __future__ import annotations

from trial.gym.embedded import start
from trial.gym.errors import EnvironmentMalformed, EnvironmentNotFound, InstanceNotFound, WrongAction
from trial.gym.overrides import override

__all__ = ["EnvironmentMalformed", "EnvironmentNotFound", "InstanceNotFound", "WrongAction", "override", "start"]
