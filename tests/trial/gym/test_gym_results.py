"""Whatever an environment returns, raises or draws, the request gets a sentence or a value, and the connection stays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from testing.gym_server import TextClient, gym_server
from tests.trial.gym.odd_results import PICTURES, RESULTS
from trial.gym import ConnectionLost, RemoteEnv, RemoteError

REFUSED = {
    "exception without text": "WithoutText",
    "exception with odd text": "TextOfAnotherType",
    "three values": "step() must return five values",
    "nothing": "step() must return five values",
    "generator": "step() must return five values",
    "reward of text": "a reward that cannot be a float: str",
    "no reward": "a reward that cannot be a float: NoneType",
    "complex reward": "a reward that cannot be a float: complex",
    "huge reward": "a reward that cannot be a float: int",
    "info without end": "MemoryError",
}
ARRIVES: dict[str, tuple[Any, Any]] = {
    "reward in an array": (2.0, {}),
    "infinite reward": (math.inf, {}),
    "info of text": (1.0, {"info": "word"}),
    "no info": (1.0, {}),
    "info with odd keys": (1.0, {"Key": 4}),
    "list": (1.0, {}),
}


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with gym_server("--import", "tests.trial.gym.odd_results", "--megabytes", "300") as server:
        yield server.url


@pytest.fixture(scope="module")
def env(url: str) -> Iterator[RemoteEnv]:
    with RemoteEnv(url, "Odd/Results-v0") as found:
        yield found


@pytest.fixture(scope="module")
def asking(url: str) -> Iterator[TextClient]:
    with TextClient(f"{url}?form=gymnasium") as found:
        yield found


@pytest.fixture(scope="module")
def instance_id(asking: TextClient) -> Any:
    made = asking.ask("make", env_id="Odd/Results-v0")["instance_id"]
    asking.ask("reset", instance_id=made)
    return made


def action_named(name: str) -> int:
    return [*RESULTS, *PICTURES].index(name)


@pytest.mark.parametrize("name", REFUSED)
def test_a_result_that_cannot_be_sent_gets_a_sentence(env: RemoteEnv, name: str) -> None:
    env.reset()
    with pytest.raises(RemoteError) as caught:
        env.step(action_named(name))
    assert not isinstance(caught.value, ConnectionLost)
    assert REFUSED[name] in str(caught.value)
    assert env.step(action_named("calm"))[1] == 1.0


@pytest.mark.parametrize("name", REFUSED)
def test_a_result_that_cannot_be_sent_gets_a_sentence_in_json(asking: TextClient, instance_id: str, name: str) -> None:
    answer = asking.ask("step", instance_id=instance_id, action=action_named(name))
    assert REFUSED[name] in answer["error"]["message"]
    assert asking.ask("step", instance_id=instance_id, action=action_named("calm"))[1] == 1.0


@pytest.mark.parametrize("name", ARRIVES)
def test_a_result_that_can_be_sent_arrives(env: RemoteEnv, name: str) -> None:
    env.reset()
    observation, reward, terminated, truncated, info = env.step(action_named(name))
    assert (observation.tolist(), reward, terminated, truncated, info) == (
        [0, 0],
        ARRIVES[name][0],
        False,
        False,
        ARRIVES[name][1],
    )


@pytest.mark.parametrize("name", ARRIVES)
def test_a_result_that_can_be_sent_arrives_in_json(asking: TextClient, instance_id: str, name: str) -> None:
    observation, reward, terminated, truncated, info = asking.ask(
        "step", instance_id=instance_id, action=action_named(name)
    )
    assert (observation, reward, terminated, truncated, info) == (
        [0, 0],
        ARRIVES[name][0],
        False,
        False,
        ARRIVES[name][1],
    )


def test_an_info_arrives_to_some_depth(env: RemoteEnv) -> None:
    env.reset()
    info = env.step(action_named("info too deep"))[4]
    assert isinstance(info["deep"][0][0][0][0], list)


@pytest.mark.parametrize(
    ("name", "words"),
    [("raised", "WithoutText"), ("huge", "MemoryError")],
)
def test_a_picture_that_cannot_be_drawn_gets_a_sentence(env: RemoteEnv, name: str, words: str) -> None:
    env.reset()
    env.step(action_named(name))
    with pytest.raises(RemoteError, match=words) as caught:
        env.render()
    assert not isinstance(caught.value, ConnectionLost)


def test_an_error_in_the_only_step_of_a_request_has_no_number(env: RemoteEnv) -> None:
    env.reset()
    with pytest.raises(RemoteError, match=r": WithoutText$"):
        env.step(action_named("exception without text"))


def test_the_error_in_one_of_many_steps_has_its_number(env: RemoteEnv) -> None:
    env.reset()
    with pytest.raises(RemoteError, match=r"WithoutText \(step 2 of this request\)"):
        env.step_many(np.array([action_named("calm"), action_named("calm"), action_named("exception without text")]))
