"""RemoteEnv against a real server: Gymnasium's own checks, and the same results as without it."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

from hippodrome.gym import ConnectionLost, RemoteEnv, RemoteError
from hippodrome.trial.gym.spaces import CodecError
from testing.gym_server import TextClient, gym_server
from tests.trial.gym import remote_environments  # noqa: F401 - registers environments
from tests.trial.gym.comparing import same

ODD = ("--import", "tests.trial.gym.remote_environments", "--megabytes", "300")
ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1", "Taxi-v4", "Acrobot-v1", "Everything-v0"]


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with gym_server(*ODD) as server:
        yield f"ws://127.0.0.1:{server.port}/"


def comparable(result: Any) -> Any:
    """Return a result of Gymnasium's as RemoteEnv has it: with a reward of Python, and ends of Python."""
    observation, reward, terminated, truncated, info = result
    return observation, float(reward), bool(terminated), bool(truncated), info


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1"])
@pytest.mark.filterwarnings("ignore")
def test_gymnasiums_checker_finds_nothing(url: str, env_id: str) -> None:
    with RemoteEnv(url, env_id, render_mode="rgb_array") as env:
        check_env(env)


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
@pytest.mark.filterwarnings("ignore")
def test_an_environment_does_what_it_does_without_a_server(url: str, env_id: str) -> None:
    with RemoteEnv(url, env_id) as remote, gymnasium.make(env_id) as local:
        assert remote.observation_space == local.observation_space
        assert remote.action_space == local.action_space
        for episode in range(2):
            seed = 7 if episode == 0 else None
            assert same(remote.reset(seed=seed), local.reset(seed=seed))
            remote.action_space.seed(episode)
            for _ in range(60):
                action = remote.action_space.sample()
                result = remote.step(action)
                assert same(result, comparable(local.step(action)))
                if result[2] or result[3]:
                    break


@pytest.mark.parametrize("seeds", [[0, None, 0], [5, None, None]])
def test_seeds_are_gymnasiums_and_none_continues_the_random_numbers(url: str, seeds: list[int | None]) -> None:
    with RemoteEnv(url, "CartPole-v1") as remote, gymnasium.make("CartPole-v1") as local:
        for seed in seeds:
            assert same(remote.reset(seed=seed), local.reset(seed=seed))


def test_options_reach_the_environment(url: str) -> None:
    with RemoteEnv(url, "Everything-v0", length=1) as env:
        options = {"array": np.arange(3), "text": "x"}
        _, info = env.reset(seed=1, options=options)
        assert same(info["options"], options)
        *_, truncated, _ = env.step(env.action_space.sample())
        assert truncated


def test_the_specification_of_the_environment_is_known(url: str) -> None:
    with RemoteEnv(url, "CartPole-v1") as env:
        assert env.spec is not None
        assert (env.spec.id, env.spec.max_episode_steps, env.spec.reward_threshold) == ("CartPole-v1", 500, 475.0)
        assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 50}
        with env.spec.make(render_mode="rgb_array") as another:
            another.reset(seed=1)
            assert another.render().shape == (400, 600, 3)


def test_pictures_are_those_of_the_environment(url: str) -> None:
    with (
        RemoteEnv(url, "CartPole-v1", render_mode="rgb_array") as remote,
        gymnasium.make("CartPole-v1", render_mode="rgb_array") as local,
    ):
        remote.reset(seed=3)
        local.reset(seed=3)
        assert same(remote.render(), local.render())


def test_the_render_mode_human_is_refused_before_the_server_is_asked() -> None:
    with pytest.raises(ValueError, match="HumanRendering"):
        RemoteEnv("ws://127.0.0.1:1/", "CartPole-v1", render_mode="human")


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Numbers-v0"])
def test_many_steps_in_one_message_are_the_steps_one_by_one(url: str, env_id: str) -> None:
    with RemoteEnv(url, env_id) as many, RemoteEnv(url, env_id) as single:
        many.reset(seed=5)
        single.reset(seed=5)
        many.action_space.seed(2)
        actions = [many.action_space.sample() for _ in range(60)]
        results = []
        for action in actions:
            if results and results[-1][2]:
                observation, info = single.reset()
                results.append((observation, 0.0, False, False, info))
            else:
                results.append(single.step(action))
        rows, rewards, terminated, truncated, infos = zip(*results, strict=True)
        batch: Any = create_empty_array(single.observation_space, 60)
        expected = concatenate(single.observation_space, rows, batch)
        assert same(
            many.step_many(actions), (expected, np.array(rewards), *map(np.array, (terminated, truncated)), [*infos])
        )


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_many_steps_go_on_after_a_limit_of_time_as_in_a_vector_of_one(url: str, mode: AutoresetMode) -> None:
    actions = np.arange(60) % 2
    local = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1", max_episode_steps=7)], autoreset_mode=mode)
    with RemoteEnv(url, "CartPole-v1", max_episode_steps=7, autoreset_mode=mode.value) as remote:
        remote.reset(seed=5)
        local.reset(seed=5)
        observations, rewards, terminated, truncated, infos = remote.step_many(actions)
    assert truncated.sum() >= 6
    for at, action in enumerate(actions):
        observation, reward, ends, cut, info = local.step(np.array([action]))
        assert same(observations[at], observation[0])
        assert (rewards[at], terminated[at], truncated[at]) == (reward[0], ends[0], cut[0])
        if "final_obs" in info:
            assert same(infos[at]["final_obs"], info["final_obs"][0])
            assert infos[at]["final_info"] == {}
        else:
            assert "final_obs" not in infos[at]
    local.close()


def test_an_array_of_actions_is_the_same_as_a_list(url: str) -> None:
    actions = np.tile(np.array([0, 1]), 40)
    with RemoteEnv(url, "CartPole-v1") as env:
        env.reset(seed=1)
        one = env.step_many(actions)
        env.reset(seed=1)
        assert same(env.step_many(list(actions)), one)


def test_without_autoreset_the_steps_stop_at_the_end(url: str) -> None:
    with RemoteEnv(url, "CartPole-v1", autoreset_mode="Disabled") as env:
        env.reset(seed=1)
        observations, rewards, terminated, _, infos = env.step_many(np.ones(64, np.int64))
        assert len(observations) == len(rewards) == len(infos) < 64
        assert terminated.tolist() == [False] * (len(rewards) - 1) + [True]


@pytest.mark.filterwarnings("ignore:.*HumanRendering")
def test_a_registered_id_is_drawn_in_a_window_of_the_clients(url: str) -> None:
    kwargs = {"url": url, "env_id": "CartPole-v1"}
    gymnasium.register("Remote/Drawn-v0", "hippodrome.gym:RemoteEnv", kwargs=kwargs)
    with gymnasium.make("Remote/Drawn-v0", render_mode="human") as env:
        assert isinstance(env, gymnasium.wrappers.HumanRendering)
        assert env.unwrapped.render_mode == "rgb_array"
    with gymnasium.make("Remote/Drawn-v0", render_mode="rgb_array_list") as env:
        env.reset(seed=1)
        env.step(1)
        assert [picture.shape for picture in env.render()] == [(400, 600, 3)] * 2


def test_gymnasiums_wrappers_wrap_a_remote_env(url: str) -> None:
    env = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.wrappers.TimeLimit(RemoteEnv(url, "Pendulum-v1"), 5))
    env.reset(seed=1)
    results = [env.step(env.action_space.sample()) for _ in range(5)]
    assert results[-1][3]
    assert results[-1][4]["episode"]["l"] == 5
    env.close()


# --- what goes wrong ---


@pytest.mark.parametrize("env_id", ["Nothing-v7", "CartPole-v9", "", "no.such.module:X-v0", "../x"])
def test_an_unknown_environment_gets_a_sentence_and_leaves_no_connection(url: str, env_id: str) -> None:
    before = sockets()
    with pytest.raises(RemoteError):
        RemoteEnv(url, env_id)
    assert sockets() <= before


@pytest.mark.parametrize("action", [2, -1, np.array([1]), "1", None, 0.5, np.nan])
def test_a_wrong_action_gets_a_sentence_and_the_environment_goes_on(url: str, action: Any) -> None:
    with RemoteEnv(url, "CartPole-v1") as env:
        env.reset(seed=1)
        with pytest.raises((RemoteError, CodecError), match=r"\S \S"):
            env.step(action)
        assert env.step(1)[1] == 1.0


def test_the_sentence_shows_the_wrong_action(url: str) -> None:
    with RemoteEnv(url, "CartPole-v1") as env:
        env.reset(seed=1)
        with pytest.raises(RemoteError, match="Action `2` is wrong: The action is not in Discrete"):
            env.step(2)


@pytest.fixture(scope="module")
def asking(url: str) -> Iterator[TextClient]:
    with TextClient(f"{url}gym?form=gymnasium") as client:
        yield client


MISTAKES = {
    "raises": "RuntimeError: broken",
    "raises without text": "WithoutText",
    "exits": "SystemExit: 3",
    "three values": "step() must return five values",
    "nothing": "step() must return five values",
    "generator": "step() must return five values",
    "reward of text": "a reward that cannot be a float: str",
    "no reward": "a reward that cannot be a float: NoneType",
    "huge reward": "a reward that cannot be a float: int",
    "info without end": "MemoryError",
}


@pytest.mark.parametrize("action", MISTAKES)
def test_an_environments_mistake_gets_a_sentence_and_the_connection_remains(
    url: str, asking: TextClient, action: str
) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset(seed=1)
        with pytest.raises(RemoteError, match=re.escape(MISTAKES[action])) as caught:
            env.step(action)
        assert not isinstance(caught.value, ConnectionLost)
        assert env.step("calm")[1] == 1.0
    made = asking.make("Bad-v0")
    asking.ask("reset", instance_id=made)
    assert MISTAKES[action] in asking.ask("step", instance_id=made, action=action)["error"]["message"]
    assert asking.ask("step", instance_id=made, action="calm")[1] == 1.0


def test_the_error_in_one_of_many_steps_has_its_number(url: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset()
        with pytest.raises(RemoteError, match=r"WithoutText \(step 2 of this request\)"):
            env.step_many(["calm", "calm", "raises without text"])


def test_what_a_step_returns_arrives(url: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset()
        assert same(env.step("outside")[0], np.array([np.nan, 7], np.float32))
        assert same(env.step("another shape")[0], np.zeros(3, np.float32))
        assert env.step("text")[0] == "hello"
        assert env.step("reward in an array")[1] == 2.0
        assert env.step("info of text")[4] == {"info": "word"}
        assert env.step("no info")[4] == {}
        assert env.step("list")[1] == 1.0


def test_a_reset_that_raises_gets_a_sentence(url: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        with pytest.raises(RemoteError, match="no reset today"):
            env.reset(options={"raise": True})
        env.reset()


def test_an_environment_that_ends_its_process_ends_its_connection_alone(url: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env, RemoteEnv(url, "CartPole-v1") as other:
        env.reset()
        other.reset(seed=1)
        with pytest.raises(ConnectionLost):
            env.step("dies")
        with pytest.raises(ConnectionLost, match="any more"):
            env.step("calm")
        assert other.step(1)[1] == 1.0


def test_an_answer_that_does_not_come_in_time_ends_the_connection(url: str) -> None:
    with RemoteEnv(url, "Bad-v0", timeout=4) as env:
        env.reset()
        begun = time.monotonic()
        with pytest.raises(ConnectionLost, match="within 4 s"):
            env.step("sleeps")
        assert time.monotonic() - begun < 10


def test_an_interrupted_request_ends_the_connection(url: str) -> None:
    """Its answer would be taken for that of the next request."""
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset()
        timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            env.step("sleeps")
        timer.join()
        with pytest.raises(ConnectionLost, match="interrupted"):
            env.reset()


def test_the_end_of_the_server_gets_a_sentence() -> None:
    with gym_server() as server:
        env = RemoteEnv(server.url, "CartPole-v1")
        env.reset()
    with pytest.raises(ConnectionLost, match=r"connection to ws://\S+ is lost"):
        env.reset()
    env.close()


def test_a_missing_server_gets_a_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    with pytest.raises(
        ConnectionLost, match=f"no connection to ws://127.0.0.1:{port}/: no server listens .*`hippodrome gym`"
    ):
        RemoteEnv(f"ws://127.0.0.1:{port}/", "CartPole-v1")


def test_a_missing_file_of_certificates_is_named() -> None:
    with pytest.raises(ConnectionLost, match=r"absent\.pem cannot be read as certificates: No such file"):
        RemoteEnv("wss://127.0.0.1:1/", "CartPole-v1", ca="absent.pem")


def test_a_proxy_is_not_asked_for_this_machine(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    for name in ("http_proxy", "https_proxy", "HTTPS_PROXY"):
        monkeypatch.setenv(name, f"http://127.0.0.1:{port}")
    for address in (url, url.replace("127.0.0.1", "localhost")):
        RemoteEnv(address, "CartPole-v1").close()
    with pytest.raises(ConnectionLost):
        RemoteEnv("ws://gym.invalid/", "CartPole-v1")


@pytest.mark.parametrize("address", ["http://127.0.0.1:1/", "127.0.0.1:1", "", "ws://"])
def test_a_wrong_address_gets_a_sentence(address: str) -> None:
    with pytest.raises(ConnectionLost, match=r"no connection to .*: .*\."):
        RemoteEnv(address, "CartPole-v1")


def test_a_query_reaches_the_server_and_is_not_shown(url: str) -> None:
    with RemoteEnv(f"{url}gym?token=secret", "CartPole-v1") as env:
        env.reset()
    for address in ("ws://127.0.0.1:1/gym?token=secret", "ws://me:secret@127.0.0.1:1/"):
        with pytest.raises(ConnectionLost) as caught:
            RemoteEnv(address, "CartPole-v1")
        assert "secret" not in str(caught.value)
        assert caught.value.__cause__ is None


def sockets() -> set[str]:
    """Return the open sockets of this process by their inodes. Those of earlier tests may be closed at any time."""
    found = set()
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            found.add(os.readlink(f"/proc/self/fd/{fd}"))
    return {name for name in found if name.startswith("socket:")}


def test_no_socket_stays_open_whether_an_environment_is_closed_or_forgotten(url: str) -> None:
    gc.collect()
    threads, before = set(threading.enumerate()), sockets()
    for closed in (True, False):
        env = RemoteEnv(url, "CartPole-v1")
        env.reset()
        assert sockets() - before
        if closed:
            env.close()
            env.close()
        del env
        gc.collect()
        assert set(threading.enumerate()) <= threads
        assert sockets() <= before


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # a fork beside threads, as researchers' programs may do
def test_a_forked_process_neither_uses_nor_ends_the_connection_of_its_parent(url: str) -> None:
    with RemoteEnv(url, "CartPole-v1") as env:
        env.reset(seed=1)
        child = os.fork()
        if child == 0:
            status = 1
            try:
                env.step(1)
            except ConnectionLost as error:
                status = 0 if "another process" in str(error) else 2
            finally:
                env.close()
                os._exit(status)
        assert os.waitpid(child, 0)[1] == 0
        assert env.step(1)[1] == 1.0
