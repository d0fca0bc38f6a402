"""A real server of environments in a process of its own, and a client that only sends messages and returns the answers."""

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

from testing import processes

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 60.0  # an answer may take so long: on a participant's server, environments have the lowest priority


@dataclass(frozen=True, slots=True)
class GymServerProcess:
    """A running server. `pid` is the id of the process that listens."""

    port: int
    pid: int

    @property
    def url(self) -> str:
        """The address to which clients connect."""
        return f"ws://127.0.0.1:{self.port}/gym"


@contextlib.contextmanager
def gym_server(
    *arguments: str,
    program: Sequence[str] = ("-m", "trial.gym"),
    cwd: Path = ROOT,
    env: Mapping[str, str] | None = None,
) -> Iterator[GymServerProcess]:
    """Run `python -m trial.gym` with these arguments at a free port for the block.

    At the end it is interrupted, as by Ctrl-C. `program` is run instead, if it is given; `env` is added to the
    environment. The program prints the server's address first.
    """
    process = subprocess.Popen(
        [sys.executable, *program, *(("--port", "0") if program[0] == "-m" else ()), *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH") or str(ROOT), **(env or {})},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=processes.interruptible,  # noqa: PLW1509 - it sets a signal and no more
    )
    assert process.stdout is not None
    try:
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
            process.stdout.close()


class TextClient:
    """A client that sends text and takes the next message for the answer, as Gymie's client does.

    With `arrays`, it asks for the binary subprotocol. All methods raise ConnectionClosed if the server has closed the
    connection.
    """

    def __init__(self, url: str, *, arrays: bool = False) -> None:
        protocols = [Subprotocol("hippodrome.gym.1")] if arrays else None
        with contextlib.ExitStack() as stack:
            self.websocket: ClientConnection = stack.enter_context(
                connect(url, compression=None, subprotocols=protocols, max_size=None, close_timeout=SECONDS)
            )
            self._stack = stack.pop_all()

    def say(self, text: str | bytes) -> Any:
        """Send this message; return the answer as it comes."""
        self.websocket.send(text)
        return self.websocket.recv(SECONDS)

    def ask(self, method: str, **params: Any) -> Any:
        """Send a request; return its answer, parsed."""
        return json.loads(self.say(json.dumps({"method": method, "params": params})))

    def make(self, env_id: str, **params: Any) -> Any:
        """Make an environment; return its id. Raises AssertionError if the answer is an error."""
        answer = self.say(json.dumps({"method": "make", "params": {"env_id": env_id, **params}}))
        made = json.loads(answer) if answer.startswith("{") else answer
        assert "error" not in made, made
        return made["instance_id"] if isinstance(made, dict) else made

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    def __enter__(self) -> TextClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
