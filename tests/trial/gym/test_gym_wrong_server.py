"""RemoteEnv and a server with wrong answers: the client raises a sentence and ends the connection."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from gymnasium import spaces
from websockets.sync.server import ServerConnection, serve

from hippodrome.gym import ConnectionLost, RemoteEnv, RemoteError
from hippodrome.trial.gym import values
from hippodrome.trial.gym.forms import SUBPROTOCOL
from hippodrome.trial.gym.spaces import describe

MADE: dict[str, Any] = {
    "instance_id": "a",
    "observation_space": describe(spaces.Discrete(2)),
    "action_space": describe(spaces.Discrete(2)),
    "metadata": {},
    "render_mode": None,
    "spec": {},
}


@contextlib.contextmanager
def server_answering(*answers: str | bytes, speaks: bool = True) -> Iterator[str]:
    """A server that answers any requests with these messages, one after the other."""

    def handle(connection: ServerConnection) -> None:
        for _, answer in zip(connection, answers, strict=False):
            connection.send(answer)
        connection.recv()

    with serve(handle, "127.0.0.1", 0, subprotocols=[SUBPROTOCOL] if speaks else None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}/"
        finally:
            server.shutdown()
            thread.join()


def test_a_server_of_another_protocol_gets_a_sentence() -> None:
    with server_answering(speaks=False) as url, pytest.raises(ConnectionLost, match="does not speak"):
        RemoteEnv(url, "CartPole-v1")


@pytest.mark.parametrize(
    "answer",
    [
        "a",
        b"",
        b"\x01" * 30,
        values.to_bytes([]),
        values.to_bytes({}),
        values.to_bytes(MADE | {"observation_space": {"name": "Hexagon"}}),
        values.to_bytes(MADE | {"metadata": 3}),
    ],
    ids=lambda answer: repr(answer)[:30],
)
def test_a_wrong_answer_to_make_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with server_answering(answer) as url, pytest.raises(ConnectionLost, match=r"\.$"):
        RemoteEnv(url, "CartPole-v1")


def test_an_error_as_the_answer_to_make() -> None:
    error = {"error": {"type": "LimitReached", "message": "Too many."}}
    with server_answering(values.to_bytes(error)) as url, pytest.raises(RemoteError, match=r"^Too many\.$"):
        RemoteEnv(url, "CartPole-v1")


@pytest.mark.parametrize("answer", ["", b"", values.to_bytes([])[:-1]])
def test_an_answer_that_cannot_be_read_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with server_answering(values.to_bytes(MADE), answer) as url, RemoteEnv(url, "CartPole-v1") as env:
        with pytest.raises(ConnectionLost, match=r"\.$"):
            env.step(1)
        with pytest.raises(ConnectionLost, match="any more"):
            env.step(1)
