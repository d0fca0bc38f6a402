"""A model's API that misbehaves, and a client that leaves: the game goes on, within bounds of time and size."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hippodrome.local import fake_model
from hippodrome.local.fake_model import FakeModel
from hippodrome.trial.llm import client
from hippodrome.trial.llm.client import ModelError, ModelRefused, ModelUnavailable
from tests.trial.llm.conftest import KEY, World, chat

Worlds = Callable[..., World]


class Hostile(FakeModel):
    """A model's API whose answers to all requests are these raw pieces, with a pause before each but the first."""

    def __init__(self, pieces: Callable[[], Iterator[bytes]], pause: float = 0.0) -> None:
        super().__init__({})
        outer = self

        class Handler(fake_model._Handler):
            model = outer

            def answer(self, path: str, request: dict[str, Any]) -> None:
                self.close_connection = True
                for piece in pieces():
                    self.wfile.write(piece)
                    outer.written += len(piece)
                    time.sleep(pause)

        self.written = 0
        self._server.RequestHandlerClass = Handler


def head(kind: str, *more: str, status: str = "200 OK") -> bytes:
    return "\r\n".join([f"HTTP/1.1 {status}", f"Content-Type: {kind}", *more, "", ""]).encode()


def silent() -> Iterator[bytes]:
    yield b""
    time.sleep(60)


def drips() -> Iterator[bytes]:
    yield b"HTTP/1.1 200 OK\r\nX: "
    yield from (b"x" for _ in range(1000))


def redirects() -> Iterator[bytes]:
    yield head("text/html", "Location: http://127.0.0.1:1/v1", "Content-Length: 0", status="307 Temporary Redirect")


def large() -> Iterator[bytes]:
    yield head("application/json", "Connection: close")
    yield from (b" " * 100_000 for _ in range(100))


def a_page() -> Iterator[bytes]:
    yield head("text/html", "Content-Length: 6") + b"<html>"


def cut() -> Iterator[bytes]:
    yield head("application/json", "Content-Length: 600") + b'{"choices": ['


def nothing() -> Iterator[bytes]:
    yield b""


def nested() -> Iterator[bytes]:
    yield head("application/json", "Connection: close") + b"[" * 1_000_000


def event(text: str) -> bytes:
    return b"data: " + json.dumps({"choices": [{"index": 0, "delta": {"content": text}}]}).encode() + b"\n\n"


def endless() -> Iterator[bytes]:
    yield head("text/event-stream", "Connection: close")
    while True:
        yield event("x" * 10_000)


def slow_stream() -> Iterator[bytes]:
    yield head("text/event-stream", "Connection: close")
    while True:
        yield event("x")


def quotes_the_key() -> Iterator[bytes]:
    body = json.dumps({"error": {"message": f"Incorrect API key: {KEY}"}}).encode()
    yield head("application/json", f"Content-Length: {len(body)}", status="401 Unauthorized") + body


@pytest.fixture
def hostile() -> Iterator[Callable[..., Hostile]]:
    made: list[Hostile] = []

    def make(*args: Any) -> Hostile:
        made.append(Hostile(*args))
        return made[-1]

    yield make
    for one in made:
        one.stop()


@pytest.mark.parametrize(
    ("pieces", "status", "code"),
    [
        (silent, 504, "timeout"),
        (drips, 504, "timeout"),
        (redirects, 502, "redirected"),
        (large, 502, "too_large"),
        (a_page, 502, "not_json"),
        (cut, 502, "not_json"),
        (nothing, 502, "unavailable"),
        (nested, 502, "not_json"),
    ],
)
def test_an_answer_that_is_none_becomes_an_error_in_time(
    world: Worlds, hostile: Callable[..., Hostile], pieces: Any, status: int, code: str
) -> None:
    here = world(model_of=hostile(pieces, 0.05 if pieces is drips else 0.0), seconds=1)
    began = time.monotonic()
    found, answer, _ = here.send(chat("Hi"))
    assert (found, answer["error"]["code"]) == (status, code)
    assert time.monotonic() - began < 5
    assert here.tape.records[0]["status"] == status
    assert here.tape.records[0]["tokens"] == {"input": 0, "output": 0}


def test_nobody_at_the_address(world: Worlds) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    status, answer, _ = world(url=f"http://127.0.0.1:{port}/v1").send(chat("Hi"))
    assert (status, answer["error"]["code"]) == (502, "unavailable")


@pytest.mark.parametrize(("pieces", "code"), [(endless, "too_large"), (slow_stream, "timeout")])
def test_an_endless_stream_ends_with_an_error(
    world: Worlds, hostile: Callable[..., Hostile], pieces: Any, code: str
) -> None:
    here = world(
        model_of=hostile(pieces, 0.1 if pieces is slow_stream else 0.0), seconds=1 if code == "timeout" else 60
    )
    status, text, _ = here.send(chat("Hi", stream=True))
    last = json.loads(text.strip().rpartition("\n")[2].removeprefix("data: "))
    assert (status, last["error"]["code"]) == (200, code)
    [record] = here.tape.records
    assert record["tokens"]["output"] > 0
    assert record["tokens"]["estimated"]
    assert world(here.tape.records).send(chat("Hi", stream=True))[1] == text


def test_a_client_that_leaves_a_stream_ends_it_for_the_model_too(
    world: Worlds, hostile: Callable[..., Hostile]
) -> None:
    model = hostile(slow_stream, 0.02)
    here = world(model_of=model)
    with socket.create_connection(("127.0.0.1", int(here.endpoint.url.split(":")[2].split("/")[0]))) as client:
        body = json.dumps(chat("Hi", stream=True)).encode()
        lines = (
            "POST /v1/chat/completions HTTP/1.1",
            f"Authorization: Bearer {here.endpoint.token}",
            f"Content-Length: {len(body)}",
        )
        client.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        assert b"200 OK" in client.recv(10_000)
    deadline = time.monotonic() + 10
    while not here.tape.records and time.monotonic() < deadline:
        time.sleep(0.01)
    [record] = here.tape.records
    assert record["tokens"]["estimated"]
    written = model.written
    time.sleep(0.3)
    assert model.written - written < 500


def test_an_api_that_repeats_the_key_does_not_tell_it(
    world: Worlds, hostile: Callable[..., Hostile], capfd: pytest.CaptureFixture[str]
) -> None:
    here = world(model_of=hostile(quotes_the_key))
    status, answer, _ = here.send(chat("Hi"))
    assert (status, answer["error"]["message"]) == (401, "Incorrect API key: [key]")
    assert KEY not in json.dumps(here.tape.records) + "".join(capfd.readouterr()) + repr(
        here.endpoint.upstream(here.section)
    )


def test_many_at_once(world: Worlds, model: FakeModel) -> None:
    here = world(max_calls=1000)
    threads = [threading.Thread(target=here.send, args=(chat(f"{n}"),)) for n in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(record["request"]["messages"][0]["content"] for record in here.tape.records) == sorted(
        map(str, range(50))
    )
    assert here.ledger.tokens == sum(sum(record["tokens"].values()) for record in here.tape.records)


FALSE = json.dumps({"error": {"type": "hippodrome", "code": "cap_reached", "message": "You said: a secret"}}).encode()


def false_refusal() -> Iterator[bytes]:
    yield head("application/json", f"Content-Length: {len(FALSE)}", status="400 Bad Request") + FALSE


def false_event() -> Iterator[bytes]:
    yield head("text/event-stream", "Connection: close") + b"data: " + FALSE + b"\n\n"


@pytest.mark.parametrize(("pieces", "error"), [(false_refusal, ModelRefused), (false_event, ModelUnavailable)])
def test_an_error_of_an_api_is_never_taken_for_our_own(
    world: Worlds,
    hostile: Callable[..., Hostile],
    monkeypatch: pytest.MonkeyPatch,
    pieces: Callable[[], Iterator[bytes]],
    error: type[ModelError],
) -> None:
    for name, value in world(model_of=hostile(pieces)).endpoint.environment().items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ModelError, match="the model's API answers with status") as raised:
        list(client.stream(chat("Hi")["messages"], {}))
    assert type(raised.value) is error
