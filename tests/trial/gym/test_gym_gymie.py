"""The messages of Gymie's client, word by word as in its source (Commander.ts, Env.ts, Gymie.ts), and their answers."""

from __future__ import annotations

import json
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from testing.gym_server import GymServerProcess, TextClient


class GymieClient:
    """Gymie's client: JSON.stringify of `{method, params}`, and the id as the last of the parameters."""

    def __init__(self, client: TextClient) -> None:
        self._client = client
        self.instance_id = ""

    def make(self, env_id: str) -> str:
        self.instance_id = self._client.say(f'{{"method":"make","params":{{"env_id":"{env_id}"}}}}')
        return self.instance_id

    def command(self, method: str, **params: Any) -> Any:
        said = json.dumps(
            {"method": method, "params": {**params, "instance_id": self.instance_id}}, separators=(",", ":")
        )
        return json.loads(self._client.say(said), parse_constant=pytest.fail)  # as JSON.parse, no NaN and no Infinity


@pytest.fixture
def gymie(client: TextClient) -> GymieClient:
    return GymieClient(client)


def close_reason(client: TextClient, message: str) -> tuple[int, str]:
    """Send this message; return the code and the reason with which the server closes the connection."""
    with pytest.raises(ConnectionClosed) as found:
        client.say(message)
    assert found.value.rcvd is not None
    return found.value.rcvd.code, found.value.rcvd.reason


def test_make_answers_the_bare_id(gymie: GymieClient) -> None:
    assert re.fullmatch("[0-9a-f]{32}", gymie.make("CartPole-v1"))


def test_an_episode_is_played_to_its_end(gymie: GymieClient) -> None:
    gymie.make("CartPole-v1")
    state = gymie.command("reset")
    assert len(state) == 4
    assert all(isinstance(number, float) for number in state)
    for _ in range(100):
        state, reward, done, info = gymie.command("step", action=1)
        assert (len(state), reward, info) == (4, 1.0, {})
        if done:
            break
    assert done is True
    assert gymie.command("close") is True


def test_spaces_have_gymies_form(gymie: GymieClient) -> None:
    gymie.make("CartPole-v1")
    found = gymie.command("action_space")
    assert (found["name"], found["n"]) == ("Discrete", 2)
    found = gymie.command("observation_space")
    assert (found["name"], found["shape"]) == ("Box", [4])
    assert all(low < 0 < high for low, high in zip(found["low"], found["high"], strict=True))


def test_bounds_that_are_infinite_are_json(gymie: GymieClient) -> None:
    gymie.make("CartPole-v1")
    assert gymie.command("observation_space")["high"][1] == float("inf")


@pytest.mark.parametrize(("env_id", "kind"), [("CartPole-v1", int), ("MountainCarContinuous-v0", list)])
def test_an_action_is_sampled(gymie: GymieClient, env_id: str, kind: type) -> None:
    gymie.make(env_id)
    assert isinstance(gymie.command("action_sample"), kind)


def test_a_continuous_action_is_taken(gymie: GymieClient) -> None:
    gymie.make("MountainCarContinuous-v0")
    gymie.command("reset")
    state, reward, done, _ = gymie.command("step", action=[0.5])
    assert (len(state), done) == (2, False)
    assert reward < 0


def test_the_same_seed_gives_the_same_episode(client: TextClient) -> None:
    ids = [client.make("CartPole-v1", seed=7) for _ in range(2)]
    first, second = (client.ask("reset", instance_id=one) for one in ids)
    assert first == second
    assert client.ask("reset", instance_id=ids[0]) != first


@pytest.mark.parametrize("seeds", [[None, None], [3, None], [0, None, None], [None, 0, None]])
def test_the_seed_of_make_is_for_the_first_reset_alone(client: TextClient, seeds: list[int | None]) -> None:
    made = client.make("CartPole-v1", seed=7)
    found = [client.ask("reset", instance_id=made, seed=seed) for seed in seeds]
    with gymnasium.make("CartPole-v1") as local:
        first, *others = seeds
        expected = [local.reset(seed=7 if first is None else first)] + [local.reset(seed=seed) for seed in others]
    assert found == [observation.tolist() for observation, _ in expected]


def test_info_says_that_done_is_by_the_time_limit(client: TextClient) -> None:
    made = client.make("Odd/Calm-v0", max_episode_steps=2)
    client.ask("reset", instance_id=made)
    client.ask("step", instance_id=made, action=1)
    _, _, done, info = client.ask("step", instance_id=made, action=1)
    assert (done, info["TimeLimit.truncated"]) == (True, True)


@pytest.mark.parametrize(
    ("message", "code", "sentence"),
    [
        ("Wrong JSON", 1003, "Message `Wrong JSON` is invalid"),
        ('{"prop": "value"}', 1003, "Message keys ['prop'] are missing or invalid"),
        ('{"method": "make"}', 1003, "Message keys ['method'] are missing or invalid"),
        ('{"method": "invalid_method", "params": {}}', 1007, "Method `invalid_method` not found"),
        ('{"method": "make", "params": {}}', 1007, "Parameters `{}` are wrong"),
        ('{"method": "make", "params": {"env_id": "NotFound-v1"}}', 1007, "Environment `NotFound-v1` not found"),
        (
            '{"method": "make", "params": {"env_id": "malformed"}}',
            1007,
            "Environment `malformed` is malformed: NameNotFound: Environment `malformed` doesn't exist.",
        ),
        ('{"method": "reset", "params": {"instance_id": "none"}}', 1007, "Instance `none` not found"),
    ],
)
def test_an_error_closes_with_gymies_code_and_sentence(
    client: TextClient, message: str, code: int, sentence: str
) -> None:
    """gymie/tests/test_gymie.py, `test_message_handle`."""
    closed_with, reason = close_reason(client, message)
    assert closed_with == code
    assert reason.startswith(sentence)


def test_the_close_names_the_package_that_an_environment_lacks(client: TextClient) -> None:
    """Gymie's sentence alone, "is malformed", names no package. A close frame has room for 123 bytes."""
    code, sentence = close_reason(client, '{"method": "make", "params": {"env_id": "Odd/Lacking-v0"}}')
    assert code == 1007
    assert sentence == (
        "Environment `Odd/Lacking-v0` is malformed: DependencyNotInstalled: Box2D is not installed, you can install it "
        "by run `pi…"
    )


def test_a_step_before_the_first_reset_closes_with_the_reason(client: TextClient) -> None:
    step = json.dumps({"method": "step", "params": {"instance_id": client.make("CartPole-v1"), "action": 1}})
    code, sentence = close_reason(client, step)
    assert code == 1007
    assert sentence.startswith("Action `1` is wrong: ResetNeeded: ")


def test_a_wrong_action_closes_with_gymies_sentence_and_the_reason(client: TextClient) -> None:
    made = client.make("CartPole-v1")
    client.ask("reset", instance_id=made)
    step = json.dumps({"method": "step", "params": {"instance_id": made, "action": -123}})
    assert close_reason(client, step) == (1007, "Action `-123` is wrong: The action is not in Discrete(2).")


def test_after_close_the_environment_is_gone(client: TextClient) -> None:
    made = client.make("CartPole-v1")
    client.ask("close", instance_id=made)
    reset = json.dumps({"method": "reset", "params": {"instance_id": made}})
    assert close_reason(client, reset) == (1007, f"Instance `{made}` not found")


def test_an_environment_of_gyms_old_kind(client: TextClient) -> None:
    made = client.make("Odd/Old-v0")
    assert client.ask("reset", instance_id=made) == [0.0, 0.5]
    for _ in range(5):
        state, reward, done, info = client.ask("step", instance_id=made, action=2)
    assert (state, reward, done, info) == ([5.0, 0.5], 5.0, True, {"action": 2})


def test_an_environment_of_gyms_old_kind_is_seeded_by_its_own_method(client: TextClient) -> None:
    made = client.make("Odd/OldSeeded-v0", seed=7)
    expected = np.random.default_rng(7)
    for _ in range(2):
        assert client.ask("reset", instance_id=made) == expected.random(2).tolist()
    assert client.ask("reset", instance_id=made, seed=0) == np.random.default_rng(0).random(2).tolist()


def test_infinity_is_sent_although_json_has_no_such_number(gymie: GymieClient) -> None:
    gymie.make("Odd/Infinite-v0")
    assert gymie.command("reset") == [float("inf"), None]


# The other forms


def test_answers_have_the_documented_form(server: GymServerProcess) -> None:
    with TextClient(server.url + "?form=documented") as client:
        said = client.ask("make", env_id="CartPole-v1")
        assert list(said) == ["instance_id"]
        client.ask("reset", **said)
        assert len(client.ask("step", **said, action=0)) == 4


def test_answers_have_gymnasiums_form(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0", cut=2)
    assert asking.ask("reset", instance_id=made, seed=3, options={"a": 1}) == [[0.0, 0.5], {"seed": 3, "a": 1}]
    assert asking.ask("step", instance_id=made, action=1) == [[1.0, 0.5], 1.0, False, False, {"action": 1}]
    assert asking.ask("step", instance_id=made, action=1)[2:4] == [False, True]


def test_an_unknown_form_is_refused(server: GymServerProcess) -> None:
    with pytest.raises(InvalidStatus) as found, connect(server.url + "?form=other"):
        pass
    assert found.value.response.body == b"form must be one of gymie, documented, gymnasium.\n"


# More than Gymie has


def test_step_many_begins_the_next_episode(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0")
    asking.ask("reset", instance_id=made)
    observations, rewards, terminated, truncated, infos = asking.ask(
        "step_many", instance_id=made, actions=[0, 1, 2, 0, 1, 2, 0]
    )
    assert [counted for counted, _ in observations] == [1, 2, 3, 4, 5, 0, 1]
    assert rewards == [1, 2, 3, 4, 5, 0, 1]
    assert terminated == [False] * 4 + [True, False, False]
    assert truncated == [False] * 7
    assert infos[4:6] == [{"action": 1}, {"seed": None}]


def test_step_many_in_the_mode_same_step(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0", autoreset_mode="SameStep")
    asking.ask("reset", instance_id=made)
    observations, rewards, terminated, _, infos = asking.ask("step_many", instance_id=made, actions=[0] * 6)
    assert [counted for counted, _ in observations] == [1, 2, 3, 4, 0, 1]
    assert rewards == [1, 2, 3, 4, 5, 1]
    assert terminated == [False] * 4 + [True, False]
    assert infos[4] == {"seed": None, "final_obs": [5.0, 0.5], "final_info": {"action": 0}}


def test_step_many_in_the_mode_disabled_stops_at_the_end(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0", autoreset_mode="Disabled")
    asking.ask("reset", instance_id=made)
    assert [len(column) for column in asking.ask("step_many", instance_id=made, actions=[0] * 9)] == [5] * 5


def test_a_picture_is_answered(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0", render_mode="rgb_array")
    asking.ask("reset", instance_id=made)
    assert asking.ask("render", instance_id=made)["shape"] == [4, 6, 3]


def test_the_error_without_a_picture_names_render_mode(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0")
    assert "render_mode" in asking.ask("render", instance_id=made)["error"]["message"]
