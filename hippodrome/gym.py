"""Environments that run on a server, for programs that train on them: `RemoteEnv` (docs/gym.md)."""

from hippodrome.trial.gym.remote import ConnectionLost, RemoteEnv, RemoteError
from hippodrome.trial.gym.spaces import CodecError

__all__ = ["CodecError", "ConnectionLost", "RemoteEnv", "RemoteError"]
