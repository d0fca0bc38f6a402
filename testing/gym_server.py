"""A real server of environments in a process of its own, and a client that only sends messages and returns the answers."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 60.0  # an answer may take so long on a busy machine


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
    *arguments: str, program: Sequence[str] = ("-m", "hippodrome", "gym", "--port", "0"), cwd: Path = ROOT
) -> Iterator[GymServerProcess]:
    """Run `hippodrome gym` with these arguments at a free port for the block, or another `program` of Python."""
    command = [sys.executable, "-W", "ignore", *program, *arguments]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=cwd, env=os.environ | {"PYTHONPATH": f"{ROOT}:{cwd}"}
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            yield GymServerProcess(int(line.split("/gym")[0].rpartition(":")[2]), process.pid)
        finally:
            process.terminate()
            process.wait(SECONDS)


class TextClient:
    """A client that sends text and takes the next message for the answer, as Gymie's client does.

    All methods raise ConnectionClosed if the server has closed the connection.
    """

    def __init__(self, url: str) -> None:
        with contextlib.ExitStack() as stack:
            self.websocket: ClientConnection = stack.enter_context(
                connect(url, compression=None, max_size=None, close_timeout=SECONDS)
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
