"""`ask` and a stream of words: what the model says, and the errors by their names."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from hippodrome.llm import CapReached, ModelError, ModelRefused, ModelUnavailable, ask
from hippodrome.local.fake_model import FakeModel, reply_to
from hippodrome.trial.llm import client
from tests.trial.llm.conftest import World

Worlds = Callable[..., World]


@pytest.fixture
def here(world: Worlds, monkeypatch: pytest.MonkeyPatch) -> Callable[..., World]:
    """Make a world whose address clients find, and in which nobody pauses."""

    def make(**keys: Any) -> World:
        made = world(**keys)
        for name, value in made.endpoint.environment().items():
            monkeypatch.setenv(name, value)
        return made

    monkeypatch.setattr(client, "_PAUSES", (0.0, 0.0))
    return make


def test_a_question_is_answered_by_the_first_model(here: Worlds, model: FakeModel) -> None:
    here()
    assert ask("Hi", system="Be brief.", temperature=0.5) == reply_to("Hi")
    assert model.requests[0][1] == {
        "model": "small",
        "messages": [{"role": "system", "content": "Be brief."}, {"role": "user", "content": "Hi"}],
        "temperature": 0.5,
    }


def test_another_model_may_be_asked(here: Worlds, model: FakeModel) -> None:
    here()
    ask("Hi", model="large")
    assert model.requests[0][1]["model"] == "large"


def test_a_stream_yields_the_words_as_they_come(here: Worlds) -> None:
    here()
    pieces = list(client.stream([{"role": "user", "content": "Hi"}], {}))
    assert len(pieces) > 3
    assert "".join(pieces) == reply_to("Hi")


@pytest.mark.parametrize(
    ("behaviour", "keys", "error", "requests"),
    [
        ({"refuse": 1}, {}, ModelRefused, 1),
        ({"fail": 1}, {}, ModelUnavailable, 3),
        ({"limit": 0}, {}, ModelUnavailable, 3),
        ({"delay": 2}, {"seconds": 0.3}, ModelUnavailable, 1),
        ({}, {"max_tokens": 0}, CapReached, 0),
    ],
)
def test_a_failure_has_a_name_and_a_busy_model_is_asked_again(
    here: Worlds, model: FakeModel, behaviour: dict[str, float], keys: Any, error: type[ModelError], requests: int
) -> None:
    here(**keys)
    model.behaviour = behaviour
    began = time.monotonic()
    with pytest.raises(error):
        ask("Hi")
    assert len(model.requests) == requests
    assert time.monotonic() - began < 5


def test_a_model_that_fails_once_answers_at_the_second_try(here: Worlds, model: FakeModel) -> None:
    here()
    model.behaviour = {"fail": 3}
    assert [ask(f"{n}") for n in range(4)] == [reply_to(f"{n}") for n in range(4)]
    assert len(model.requests) == 5


def test_another_model_than_those_of_the_study_is_refused(here: Worlds) -> None:
    here()
    with pytest.raises(ModelRefused, match=r"this model is not in llm\.model, which has small, large"):
        ask("Hi", model="huge")


def test_without_a_game_and_without_an_address_a_sentence_says_so(
    here: Worlds, monkeypatch: pytest.MonkeyPatch
) -> None:
    here().endpoint.play(None)
    with pytest.raises(ModelUnavailable, match=r"no game with trial\.llm is played"):
        ask("Hi")
    with pytest.raises(ModelUnavailable, match=r"no game with trial\.llm is played"):
        ask("Hi", model="small")
    monkeypatch.delenv("OPENAI_BASE_URL")
    with pytest.raises(ModelUnavailable, match="there is no address of a model here; write llm into trial"):
        ask("Hi")
