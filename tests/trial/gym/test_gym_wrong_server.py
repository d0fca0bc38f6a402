"""RemoteEnv and a server with wrong answers: the client raises a sentence and ends the connection."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from websockets.sync.server import ServerConnection, serve

from trial.gym import ConnectionLost, RemoteEnv, RemoteError, RemoteVectorEnv, arrays
from trial.gym.forms import SUBPROTOCOL
from trial.gym.spaces import describe

SPACE = spaces.Box(-1, 1, (2,), np.float32)
MADE = {
    "instance_id": "a",
    "handle": 1,
    "num_envs": 0,
    "observation_space": describe(SPACE),
    "action_space": describe(spaces.Discrete(2)),
    "metadata": {},
    "render_mode": None,
    "autoreset_mode": "NextStep",
}
Answers = Callable[[str | bytes], str | bytes]


@contextlib.contextmanager
def server_answering(*answers: str | bytes) -> Iterator[str]:
    """A server that answers any requests with these messages, one after the other."""

    def handle(connection: ServerConnection) -> None:
        for _, answer in zip(connection, answers, strict=False):
            connection.send(answer)
        connection.recv()

    with serve(handle, "127.0.0.1", 0, subprotocols=[SUBPROTOCOL]) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}/"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize(
    "answer",
    [
        "",
        "a",
        "[]",
        "null",
        "{}",
        b"",
        b"\x01" * 30,
        "[" * 100_000,
        json.dumps(MADE | {"handle": "x"}),
        json.dumps(MADE | {"handle": 70_000}),
        json.dumps(MADE | {"num_envs": -1}),
        json.dumps(MADE | {"num_envs": None}),
        json.dumps(MADE | {"observation_space": {"name": "Hexagon"}}),
        json.dumps(MADE | {"metadata": 3}),
        json.dumps(MADE | {"metadata": {"render_modes": 3}}),
    ],
    ids=lambda answer: repr(answer)[:30],
)
def test_a_wrong_answer_to_make_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with server_answering(answer) as url, pytest.raises(ConnectionLost, match=r"\.$"):
        RemoteEnv(url, "CartPole-v1")


def test_an_error_as_the_answer_to_make() -> None:
    error = {"error": {"type": "LimitReached", "message": "Too many."}}
    with server_answering(json.dumps(error)) as url, pytest.raises(RemoteError, match=r"^Too many\.$"):
        RemoteEnv(url, "CartPole-v1")


def steps(rows: int, *, kind: int = arrays.STEP, handle: int = 1, infos: Any = ()) -> bytes:
    layout = arrays.layout(SPACE)
    flags = np.zeros(rows, bool)
    found = arrays.StepRows(layout.empty(rows), np.zeros(rows), flags, flags, list(infos))
    return arrays.steps_reply(kind, handle, layout, found)


def first(rows: int) -> bytes:
    layout = arrays.layout(SPACE)
    return arrays.reset_reply(1, layout, rows, layout.empty(rows), [])


@pytest.mark.parametrize(
    "answer",
    [
        "",
        "[]",
        "{}",
        b"",
        steps(0),
        steps(2),
        steps(1)[:-1],
        steps(1) + b"\0",
        steps(1, kind=arrays.STEP_MANY),
        steps(1, handle=2),
        steps(2, infos=[(1, {"a": 1})]),
        first(1),
    ],
    ids=lambda answer: repr(answer)[:30],
)
def test_a_wrong_answer_to_step_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with server_answering(json.dumps(MADE), answer) as url, RemoteEnv(url, "CartPole-v1") as env:
        with pytest.raises(ConnectionLost, match=r"\.$"):
            env.step(1)
        with pytest.raises(ConnectionLost, match="any more"):
            env.step(1)


@pytest.mark.parametrize("answer", [first(0), first(2), steps(1), b""], ids=["none", "two", "steps", "nothing"])
def test_a_wrong_answer_to_reset_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with (
        server_answering(json.dumps(MADE), answer) as url,
        RemoteEnv(url, "CartPole-v1") as env,
        pytest.raises(ConnectionLost, match=r"\.$"),
    ):
        env.reset()


@pytest.mark.parametrize("rows", [1, 3, 5, 6, 8])
def test_a_wrong_number_of_rows_for_a_vector(rows: int) -> None:
    """Two steps of two environments were asked for."""
    with (
        server_answering(json.dumps(MADE | {"num_envs": 2}), steps(rows, kind=arrays.STEP_MANY)) as url,
        RemoteVectorEnv(url, "CartPole-v1", 2) as env,
        pytest.raises(ConnectionLost, match=r"\.$"),
    ):
        env.step_many(np.ones((2, 2), np.int64))


@pytest.mark.parametrize("answer", ["3", '{"png": "AAAA", "shape": [1, 1, 3]}', b""])
def test_a_wrong_answer_to_render_ends_the_connection_with_a_sentence(answer: str | bytes) -> None:
    with (
        server_answering(json.dumps(MADE), answer) as url,
        RemoteEnv(url, "CartPole-v1") as env,
        pytest.raises(ConnectionLost, match=r"\.$"),
    ):
        env.render()
