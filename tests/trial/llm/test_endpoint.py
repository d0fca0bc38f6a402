"""The loopback address: it passes requests on, adds the key, counts, caps, records, and answers from the tape."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from hippodrome.local.fake_model import FakeModel, reply_to
from hippodrome.trial.llm import endpoint
from hippodrome.trial.llm.ledger import Moment
from tests.trial.llm.conftest import KEY, World, chat

Worlds = Callable[..., World]


def test_a_request_reaches_the_model_with_the_key_and_is_recorded(world: Worlds, model: FakeModel) -> None:
    here = world()
    here.moment = Moment(2, 17, line=5)
    status, answer, _ = here.send(chat("Hi", temperature=0.5))
    assert (status, answer["choices"][0]["message"]["content"]) == (200, reply_to("Hi"))
    [(path, request, headers)] = model.requests
    assert (path, request) == ("/chat/completions", chat("Hi", temperature=0.5))
    assert headers["Authorization"] == f"Bearer {KEY}"
    [record] = here.tape.records
    assert record["request"] == chat("Hi", temperature=0.5)
    assert record["answer"] == answer
    assert {name: record[name] for name in ("kind", "model", "status", "nth", "episode", "step", "line")} == {
        "kind": "call",
        "model": "small",
        "status": 200,
        "nth": 1,
        "episode": 2,
        "step": 17,
        "line": 5,
    }
    assert record["tokens"] == {
        "input": answer["usage"]["prompt_tokens"],
        "output": answer["usage"]["completion_tokens"],
    }
    assert KEY not in json.dumps(record)
    assert (here.ledger.calls, here.ledger.tokens) == (1, answer["usage"]["total_tokens"])


def test_a_stream_passes_with_its_tokens_counted(world: Worlds, model: FakeModel) -> None:
    here = world()
    status, text, response = here.send(chat("Hi", stream=True))
    assert (status, response.getheader("Content-Type")) == (200, "text/event-stream; charset=utf-8")
    assert model.requests[0][1]["stream_options"] == {"include_usage": True}
    pieces = [json.loads(line[6:]) for line in text.split("\n\n") if line.startswith("data: {")]
    assert "".join(piece["choices"][0]["delta"].get("content", "") for piece in pieces) == reply_to("Hi")
    assert text.endswith("data: [DONE]\n\n")
    [record] = here.tape.records
    assert record["request"] == chat("Hi", stream=True)
    assert record["tokens"]["output"] > 0
    assert "estimated" not in record["tokens"]


def test_a_client_that_asks_for_the_tokens_of_a_stream_gets_them(world: Worlds) -> None:
    _, text, _ = world().send(chat("Hi", stream=True, stream_options={"include_usage": True}))
    assert '"usage"' in text


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/responses", {"model": "large", "input": "Hi"}),
        ("/v1/responses", {"model": "large", "input": "Hi", "stream": True}),
        ("/v1/embeddings", {"model": "large", "input": ["a", "b"]}),
    ],
)
def test_other_paths_pass_too(world: Worlds, path: str, body: dict[str, Any]) -> None:
    here = world()
    status, _, _ = here.send(body, path)
    assert status == 200
    assert here.tape.records[0]["path"] == path.removeprefix("/v1")
    assert here.tape.records[0]["tokens"]["input"] > 0


def test_the_models_are_listed(world: Worlds) -> None:
    _, answer, _ = world().send(b"", "/v1/models", method="GET")
    assert [one["id"] for one in answer["data"]] == ["small", "large"]


@pytest.mark.parametrize(
    ("body", "path", "method", "status", "code"),
    [
        (chat("Hi"), "/v1/files", "POST", 404, "not_found"),
        (chat("Hi"), "/v1/../admin", "POST", 404, "not_found"),
        (chat("Hi"), "http://169.254.170.2/v2/credentials", "POST", 404, "not_found"),
        (b"", "/v1/chat/completions", "GET", 404, "not_found"),
        ({**chat("Hi"), "model": "huge"}, "/v1/chat/completions", "POST", 404, "model_not_found"),
        ({**chat("Hi"), "model": None}, "/v1/chat/completions", "POST", 404, "model_not_found"),
        ([1], "/v1/chat/completions", "POST", 400, "not_json"),
        (b"{" * 100_000, "/v1/chat/completions", "POST", 400, "not_json"),
    ],
)
def test_anything_else_is_refused_with_a_sentence(
    world: Worlds, model: FakeModel, body: Any, path: str, method: str, status: int, code: str
) -> None:
    here = world()
    found, answer, response = here.send(body, path, method=method)
    assert (found, answer["error"]["code"]) == (status, code)
    assert response.getheader("X-Should-Retry") == "false"
    assert (model.requests, here.tape.records) == ([], [])


def test_a_client_without_the_token_is_refused(world: Worlds, model: FakeModel) -> None:
    assert world().send(chat("Hi"), token="sk-other")[0] == 401
    assert model.requests == []


def test_a_request_that_is_too_large_is_refused(world: Worlds) -> None:
    here = world()
    for headers in ({"Content-Length": str(5 * 1024 * 1024)}, {"Transfer-Encoding": "chunked"}):
        status, answer, _ = here.send(b"", headers=headers)
        assert (status, answer["error"]["code"]) == (413, "too_large")


def test_no_call_is_made_beyond_the_caps(world: Worlds, model: FakeModel) -> None:
    here = world(max_calls=2)
    assert [here.send(chat(f"{n}"))[0] for n in range(3)] == [200, 200, 429]
    assert here.send(chat("x"))[1]["error"]["code"] == "cap_reached"
    costly = world(max_tokens=10)
    assert [costly.send(chat("x" * 100))[0] for _ in range(2)] == [200, 429]
    assert len(model.requests) == 3


def test_calls_of_earlier_servers_count(world: Worlds) -> None:
    first = world(max_calls=2)
    first.send(chat("Hi"))
    second = world(first.tape.records, max_calls=2)
    assert second.ledger.tokens == first.ledger.tokens
    second.moment = Moment(2)  # the next episode: nothing is answered from the tape
    assert [second.send(chat("Hi"))[0] for _ in range(2)] == [200, 429]


def test_what_an_earlier_server_asked_is_answered_from_its_tape(world: Worlds, model: FakeModel) -> None:
    first = world()
    first.moment = Moment(3, 10)
    answers = [first.send(body)[1] for body in (chat("a"), chat("b", stream=True), chat("a"))]
    before = len(model.requests)
    second = world(json.loads(json.dumps(first.tape.records)))
    second.moment = Moment(3, 0, replaying=True)
    # In another order, and with the keys of the request in another order
    turned = dict(reversed(chat("a").items()))
    assert [second.send(body)[1] for body in (turned, chat("a"), chat("b", stream=True))] == [
        answers[0],
        answers[2],
        answers[1],
    ]
    assert len(model.requests) == before
    assert second.tape.records == []  # the earlier server's tape has them


def test_a_failure_is_answered_from_the_tape_too(world: Worlds, model: FakeModel) -> None:
    model.behaviour = {"refuse": 1}
    first = world()
    refused = first.send(chat("a"))
    assert (refused[0], refused[1]["error"]["code"]) == (400, "content_filter")
    second = world(first.tape.records)
    assert second.send(chat("a"))[:2] == refused[:2]
    assert len(model.requests) == 1


def test_while_steps_are_repeated_nothing_new_is_paid_for(world: Worlds, model: FakeModel) -> None:
    first = world()
    first.moment = Moment(1, 20)
    first.send(chat("a"))
    second = world(first.tape.records)
    second.moment = Moment(1, 5, replaying=True)
    status, answer, _ = second.send(chat("other"))
    assert (status, answer["error"]["code"]) == (409, "not_on_tape")
    second.moment = Moment(1, 20, replaying=True)  # here the tape of the lost server may lack its last two seconds
    assert second.send(chat("lost"))[0] == 200
    assert len(model.requests) == 2


def test_equal_requests_of_earlier_episodes_are_not_taken_for_those_of_this_one(
    world: Worlds, model: FakeModel
) -> None:
    first = world()
    first.send(chat("hint"))
    first.moment = Moment(2)
    wanted = first.send(chat("hint", seed=1))
    second = world(first.tape.records)
    second.moment = Moment(2, replaying=True)
    assert second.send(chat("hint", seed=1))[1] == wanted[1]
    assert second.send(chat("hint"))[0] == 200
    assert len(model.requests) == 3


def test_requests_are_left_out_if_the_study_says_so(world: Worlds) -> None:
    here = world(record="hashes")
    here.send(chat("a secret"))
    assert "a secret" not in json.dumps({**here.tape.records[0], "answer": None})
    assert len(here.tape.records[0]["hash"]) == 64


def test_before_a_game_nothing_is_asked(world: Worlds) -> None:
    here = world()
    here.endpoint.play(None)
    status, answer, _ = here.send(chat("Hi"))
    assert (status, answer["error"]["code"]) == (409, "no_game")


def test_a_server_that_ends_waits_for_the_call_under_way(
    world: Worlds, model: FakeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(endpoint, "CLOSED_SECONDS", 0.1)
    model.behaviour = {"delay": 0.5}
    here = world()
    sending = threading.Thread(target=here.send, args=(chat("Hi"),))
    sending.start()
    while not model.requests:
        time.sleep(0.01)
    here.endpoint.close(10)
    assert [record["status"] for record in here.tape.records] == [200]
    assert here.send(chat("Hi"))[1]["error"]["code"] == "closed"
    sending.join()
