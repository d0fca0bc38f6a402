"""Fixtures: the loopback address of a game, and a fake model behind it."""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

import pytest

from hippodrome.local.fake_model import FakeModel
from hippodrome.protocol.trial_llm import LlmSection
from hippodrome.trial.llm.endpoint import Endpoint, Game
from hippodrome.trial.llm.ledger import Ledger, Moment

KEY = "sk-the-key-of-the-study"


class List:
    """A tape that is a list."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []

    def add(self, record: dict[str, Any]) -> None:
        self.records.append(record)


class World:
    """An endpoint with a game, the tape of the game, and the model that it asks."""

    def __init__(self, model: FakeModel, earlier: list[dict[str, Any]], **keys: Any) -> None:
        self.model = model
        self.tape = List()
        self.moment = Moment(1, 0)
        self.section = LlmSection(**{"url": model.url, "model": ("small", "large"), **keys})
        self.endpoint = Endpoint(KEY)
        self.ledger = Ledger.of(self.section, earlier)
        self.endpoint.play(Game(self.section, self.ledger, self.tape, lambda: self.moment))

    def send(
        self,
        body: Any,
        path: str = "/v1/chat/completions",
        *,
        method: str = "POST",
        token: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> tuple[int, Any, http.client.HTTPResponse]:
        """Send a request; return its status, its JSON or text, and the response."""
        address = urlsplit(self.endpoint.url)
        connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=30)
        shown = {"Authorization": f"Bearer {self.endpoint.token if token is None else token}", **(headers or {})}
        connection.request(method, path, body if isinstance(body, bytes) else json.dumps(body).encode(), shown)
        response = connection.getresponse()
        text = response.read().decode()
        connection.close()
        try:
            return response.status, json.loads(text), response
        except ValueError:
            return response.status, text, response


def chat(text: str, **more: Any) -> dict[str, Any]:
    """Return the request of a chat with one message."""
    return {"model": "small", "messages": [{"role": "user", "content": text}], **more}


@pytest.fixture
def model() -> Iterator[FakeModel]:
    made = FakeModel({})
    yield made
    made.stop()


@pytest.fixture
def world(model: FakeModel) -> Iterator[Callable[..., World]]:
    """Make worlds with `llm` as given, and records of earlier servers."""
    worlds: list[World] = []

    def make(earlier: list[dict[str, Any]] | None = None, **keys: Any) -> World:
        worlds.append(World(keys.pop("model_of", model), earlier or [], **keys))
        return worlds[-1]

    yield make
    for one in worlds:
        one.endpoint.stop()
