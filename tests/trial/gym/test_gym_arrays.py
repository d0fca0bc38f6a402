"""The server's side of the subprotocol `hippodrome.gym.1`, with requests made by `arrays.py`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from testing.gym_server import GymServerProcess, TextClient
from trial.gym import arrays, spaces


@pytest.fixture
def client(server: GymServerProcess) -> Iterator[TextClient]:
    with TextClient(server.url, arrays=True) as found:
        yield found


class Made:
    """An environment made over the subprotocol."""

    def __init__(self, client: TextClient, env_id: str, **params: Any) -> None:
        self.client = client
        self.said = client.ask("make", env_id=env_id, **params)
        self.handle = self.said["handle"]
        self.observations = arrays.layout(spaces.build(self.said["observation_space"]))
        self.actions = arrays.layout(spaces.build(self.said["action_space"]), action=True)
        self.num_envs = self.said["num_envs"] or 1

    def reset(self, seed: Any = None) -> Any:
        return arrays.read_reset_reply(
            self.client.say(arrays.reset_request(self.handle, seed, None)), self.observations
        )

    def steps(self, actions: Any, kind: int = arrays.STEP_MANY) -> arrays.StepRows:
        count = len(actions) // self.num_envs
        request = arrays.step_request(
            kind, self.handle, count, self.actions, arrays.batch_of(self.actions, actions), num_envs=self.num_envs
        )
        return arrays.read_steps(self.client.say(request), self.observations)


def test_make_describes_the_environment(client: TextClient) -> None:
    said = Made(client, "CartPole-v1").said
    assert said["spec"] == {
        "id": "CartPole-v1",
        "max_episode_steps": 500,
        "reward_threshold": 475.0,
        "nondeterministic": False,
    }
    assert (said["num_envs"], said["autoreset_mode"], said["render_mode"]) == (0, "NextStep", None)


def test_a_step_answers_with_arrays(client: TextClient) -> None:
    made = Made(client, "Odd/Calm-v0")
    observation, infos = made.reset(seed=4)
    assert (observation.tolist(), infos) == ([[0.0, 0.5]], [(0, {"seed": 4})])
    steps = made.steps([np.int64(2)], arrays.STEP)
    assert steps.observations.tolist() == [[1.0, 0.5]]
    assert (steps.rewards.tolist(), steps.terminated.tolist(), steps.truncated.tolist()) == ([1.0], [False], [False])
    assert steps.infos == [(0, {"action": 2})]


def test_steps_give_the_same_results_as_in_json(server: GymServerProcess, client: TextClient) -> None:
    made = Made(client, "CartPole-v1")
    actions = [np.int64(at % 3 == 0) for at in range(64)]
    first, _ = made.reset(seed=11)
    steps = made.steps(actions)
    with TextClient(server.url + "?form=gymnasium") as other:
        same = other.make("CartPole-v1", seed=11)
        assert other.ask("reset", instance_id=same)[0] == first[0].tolist()
        columns = other.ask("step_many", instance_id=same, actions=[int(action) for action in actions])
    assert [steps.observations.tolist(), steps.rewards.tolist(), steps.terminated.tolist()] == columns[:3]
    assert steps.terminated.any()


def test_a_vector_answers_for_all_its_environments(client: TextClient) -> None:
    made = Made(client, "Odd/Calm-v0", num_envs=3)
    observations, _ = made.reset(seed=[1, 2, 3])
    assert observations.tolist() == [[0.0, 0.5]] * 3
    steps = made.steps([np.int64(1)] * 6)
    assert steps.rewards.tolist() == [1, 1, 1, 2, 2, 2]
    assert steps.observations[:, 0].tolist() == [1, 1, 1, 2, 2, 2]
    assert [step for step, _ in steps.infos] == [0, 1]
    assert steps.infos[0][1]["action"].tolist() == [1, 1, 1]


def test_a_vector_takes_continuous_actions(client: TextClient) -> None:
    made = Made(client, "Odd/Continuous-v0", num_envs=2)
    made.reset()
    steps = made.steps([np.array([0.25, 0.5], np.float32), np.array([-1, 1], np.float32)])
    assert steps.infos[0][1]["action"].tolist() == [[0.25, 0.5], [-1.0, 1.0]]


def test_with_disabled_the_answer_ends_with_the_episode(client: TextClient) -> None:
    made = Made(client, "Odd/Calm-v0", autoreset_mode="Disabled")
    made.reset()
    assert len(made.steps([np.int64(0)] * 9).rewards) == 5


@pytest.mark.parametrize(
    ("request_", "shown"),
    [
        (b"\x02\x00\x01\x00\x03\x00\x00\x00" + bytes(8) + (7).to_bytes(8, "little") + bytes(8), "7"),
        (b"\x01\x00\x01\x00\x01\x00\x00\x00" + bytes(3), "3 bytes"),
        (b"\x01\x00\x01\x00\x01\x00\x00\x00" + bytes(9), "9 bytes"),
    ],
)
def test_the_sentence_about_a_wrong_action_shows_it_or_its_length(
    client: TextClient, request_: bytes, shown: str
) -> None:
    Made(client, "Odd/Calm-v0").reset()
    assert json.loads(client.say(request_))["error"]["message"].startswith(f"Action `{shown}` is wrong: The ")


@pytest.mark.parametrize(
    ("request_", "kind"),
    [
        (b"", "InvalidMessage"),
        (b"\xff" * 40, "InvalidMessage"),
        (arrays.reset_request(9999, None, None), "InstanceNotFound"),
        (arrays.reset_request(1, None, None) + b"x", "WrongParameters"),
        (arrays.reset_request(1, [1, 2], None), "WrongParameters"),
        (b"\x01\x00\x01\x00\x01\x00\x00\x00", "WrongAction"),
        (b"\x01\x00\x01\x00\x01\x00\x00\x00" + (7).to_bytes(8, "little"), "WrongAction"),
        (b"\x02\x00\x01\x00\xff\xff\x00\x00" + bytes(8), "WrongAction"),
    ],
)
def test_a_wrong_request_gets_a_sentence(client: TextClient, request_: bytes, kind: str) -> None:
    made = Made(client, "Odd/Calm-v0")
    assert made.handle == 1
    made.reset()
    assert json.loads(client.say(request_))["error"]["type"] == kind
    assert made.steps([np.int64(0)]).rewards.tolist() == [1.0]
