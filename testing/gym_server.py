"""A real server of environments in a process of its own, and a client that knows the messages and nothing else."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from testing.preloaded import interruptible

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 60.0  # that an answer may take: environments on a participant's server give way to all other processes


@dataclass(frozen=True, slots=True)
class GymServerProcess:
    """A server that runs. `pid` is that of the process that listens."""

    port: int
    pid: int

    @property
    def url(self) -> str:
        """Where clients connect."""
        return f"ws://127.0.0.1:{self.port}/gym"


@contextlib.contextmanager
def gym_server(
    *arguments: str,
    program: Sequence[str] = ("-m", "trial.gym"),
    cwd: Path = ROOT,
    env: Mapping[str, str] | None = None,
) -> Iterator[GymServerProcess]:
    """`python -m trial.gym` with these arguments, at a port of its own; it is interrupted at the end, as by Ctrl-C."""
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, *program, *(("--port", "0") if program[0] == "-m" else ()), *arguments],
        stdout=subprocess.PIPE,
        cwd=cwd,
        env={**os.environ, **paths, **(env or {})},
        text=True,
        preexec_fn=interruptible,  # noqa: PLW1509 - it sets a signal and no more
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        yield GymServerProcess(int(line.split("/gym")[0].rpartition(":")[2]), process.pid)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        finally:
            process.stdout.close()  # type: ignore[union-attr]


class TextClient:
    """Sends and receives text, as Gymie's client does: the next message is the answer."""

    def __init__(self, url: str, *, arrays: bool = False) -> None:
        protocols = [Subprotocol("hippodrome.gym.1")] if arrays else None
        with contextlib.ExitStack() as stack:
            self.websocket: ClientConnection = stack.enter_context(
                connect(url, compression=None, subprotocols=protocols, max_size=None, close_timeout=SECONDS)
            )
            self._stack = stack.pop_all()

    def say(self, text: str | bytes) -> Any:
        """Send this message; the answer as it comes. Raises ConnectionClosed."""
        self.websocket.send(text)
        return self.websocket.recv(SECONDS)

    def ask(self, method: str, **params: Any) -> Any:
        """Send a request; what its answer says in JSON. Raises ConnectionClosed."""
        return json.loads(self.say(json.dumps({"method": method, "params": params})))

    def make(self, env_id: str, **params: Any) -> Any:
        """Make an environment; its id."""
        said = self.say(json.dumps({"method": "make", "params": {"env_id": env_id, **params}}))
        made = json.loads(said) if said.startswith("{") else said
        assert "error" not in made, made
        return made["instance_id"] if isinstance(made, dict) else made

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    def __enter__(self) -> TextClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
