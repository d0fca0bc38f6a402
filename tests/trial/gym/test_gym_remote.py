"""RemoteEnv and RemoteVectorEnv against a real server: Gymnasium's own checks, and the same results as without it."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from websockets.sync.server import serve

from testing.gym_server import TextClient
from tests.trial.gym import remote_environments as odd
from tests.trial.gym.served import serving
from tests.trial.gym.space_strategies import same
from trial.gym import ConnectionLost, RemoteEnv, RemoteError, RemoteVectorEnv, spaces, values
from trial.gym import client as client_module
from trial.gym.limits import Limits
from trial.gym.spaces import CodecError

ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1", "Taxi-v4", "Acrobot-v1", "Everything-v0"]


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serving() as (address, _):
        yield address


def comparable(result: Any) -> Any:
    """Return a result of Gymnasium's as RemoteEnv has it: rewards are floats, and a number of a Discrete numpy's."""
    observation, reward, *rest = result
    return _numpy(observation), float(reward), *rest


def _numpy(observation: Any) -> Any:
    if isinstance(observation, tuple) and not hasattr(observation, "nodes"):
        return tuple(_numpy(part) for part in observation)
    return np.int64(observation) if type(observation) is int else observation


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
            found, expected = remote.reset(seed=seed), local.reset(seed=seed)
            assert same(found, (_numpy(expected[0]), expected[1]))
            remote.action_space.seed(episode)
            for _ in range(60):
                action = remote.action_space.sample()
                result = remote.step(action)
                assert same(result, comparable(local.step(action)))
                if result[2] or result[3]:
                    break


def test_every_kind_of_space_travels_as_json_too(url: str) -> None:
    space = odd.EVERYTHING
    read = values.decoder(space)
    space.seed(5)
    with TextClient(f"{url}gym?form=gymnasium") as client:
        made = client.ask("make", env_id="Everything-v0", length=100)["instance_id"]
        assert spaces.build(client.ask("action_space", instance_id=made)) == space
        client.ask("reset", instance_id=made)
        for _ in range(20):
            action = space.sample()
            request = values.to_text({"method": "step", "params": {"instance_id": made, "action": action}})
            (repeated, _), *_ = json.loads(client.say(request))
            assert same(read(repeated), action)


def test_the_clients_time_limit_is_longer_than_the_servers() -> None:
    assert Limits().seconds + 10 < client_module.TIMEOUT


@pytest.mark.parametrize("seeds", [[0, None, 0], [5, None, None]])
def test_seeds_are_gymnasiums_and_none_continues_the_random_numbers(url: str, seeds: list[int | None]) -> None:
    with RemoteEnv(url, "CartPole-v1") as remote, gymnasium.make("CartPole-v1") as local:
        for seed in seeds:
            assert same(remote.reset(seed=seed), local.reset(seed=seed))


@pytest.mark.parametrize("seeds", [[0, None, 0], [[0, None, 7], None], [[3, 0, 3]]])
def test_seeds_of_a_vector_are_gymnasiums(url: str, seeds: list[Any]) -> None:
    local = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3)
    with RemoteVectorEnv(url, "CartPole-v1", num_envs=3) as remote:
        local.reset(seed=1)
        remote.reset(seed=1)
        for seed in seeds:
            assert same(remote.reset(seed=seed)[0], local.reset(seed=seed)[0])
    local.close()


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


def test_text_is_drawn_too(url: str) -> None:
    with RemoteEnv(url, "Bad-v0", render_mode="ansi") as env:
        env.reset()
        assert env.render() == "drawn"


def test_the_render_mode_human_is_refused_before_the_server_is_asked() -> None:
    with pytest.raises(ValueError, match="HumanRendering"):
        RemoteEnv("ws://127.0.0.1:1/", "CartPole-v1", render_mode="human")


@pytest.mark.parametrize("env_id", ["CartPole-v1", "FrozenLake-v1", "Numbers-v0"])
def test_many_steps_in_one_message_are_those_of_a_vector_of_one(url: str, env_id: str) -> None:
    with RemoteEnv(url, env_id) as remote:
        local = SyncVectorEnv([lambda: gymnasium.make(env_id)])
        remote.reset(seed=5)
        local.reset(seed=5)
        remote.action_space.seed(2)
        actions = [remote.action_space.sample() for _ in range(100)]
        observations, rewards, terminated, truncated, infos = remote.step_many(actions)
        layout = remote._remote.observations
        rows = layout.rows(observations, 100)
        batches = gymnasium.vector.utils.concatenate
        for at, action in enumerate(actions):
            batch = batches(
                local.single_action_space,
                [action],
                gymnasium.vector.utils.create_empty_array(local.single_action_space, 1),
            )
            observation, reward, ends, cut, info = local.step(batch)
            assert same(rows[at], layout.rows(observation, 1)[0])
            assert (rewards[at], terminated[at], truncated[at]) == (reward[0], ends[0], cut[0])
            assert infos[at].keys() == {key for key in info if not key.startswith("_")}


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


def vector_of(env_id: str, mode: AutoresetMode, count: int = 3) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gymnasium.make(env_id)] * count, autoreset_mode=mode)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "FrozenLake-v1", "Numbers-v0", "Blackjack-v1", "Quiet-v0"])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_does_what_it_does_without_a_server(url: str, env_id: str, mode: AutoresetMode) -> None:
    with RemoteVectorEnv(url, env_id, 3, autoreset_mode=mode) as remote:
        local = vector_of(env_id, mode)
        assert (remote.num_envs, remote.metadata["autoreset_mode"]) == (3, mode)
        assert remote.single_observation_space == local.single_observation_space
        assert remote.observation_space == local.observation_space
        assert remote.action_space == local.action_space
        assert same(remote.reset(seed=4), local.reset(seed=4))
        remote.action_space.seed(3)
        for _ in range(60):
            actions = remote.action_space.sample()
            assert same(remote.step(actions), local.step(actions))
        assert same(remote.reset(seed=[9, None, 8]), local.reset(seed=[9, None, 8]))


def test_a_vector_resets_the_environments_of_a_mask(url: str) -> None:
    with RemoteVectorEnv(url, "CartPole-v1", 3, autoreset_mode="Disabled") as remote:
        local = vector_of("CartPole-v1", AutoresetMode.DISABLED)
        remote.reset(seed=4)
        local.reset(seed=4)
        mask = np.array([True, False, True])
        found = remote.reset(seed=[1, 2, 3], options={"reset_mask": mask})
        assert same(found, local.reset(seed=[1, 2, 3], options={"reset_mask": mask}))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Numbers-v0"])
def test_many_steps_of_a_vector_are_its_steps(url: str, env_id: str) -> None:
    with RemoteVectorEnv(url, env_id, 2) as many, RemoteVectorEnv(url, env_id, 2) as single:
        many.reset(seed=1)
        single.reset(seed=1)
        many.action_space.seed(1)
        actions = [many.action_space.sample() for _ in range(40)]
        observations, rewards, terminated, truncated, infos = many.step_many(actions)
        for at, action in enumerate(actions):
            observation, *rest = single.step(action)
            assert same(_part_of_step(observations, at), observation)
            assert same([rewards[at], terminated[at], truncated[at], infos[at]], rest)


def _part_of_step(batch: Any, step: int) -> Any:
    if isinstance(batch, dict):
        return {key: _part_of_step(part, step) for key, part in batch.items()}
    if isinstance(batch, tuple) and not isinstance(batch[0], tuple):
        return tuple(_part_of_step(part, step) for part in batch)
    return batch[step]


def test_a_vector_sends_the_pictures_of_its_environments(url: str) -> None:
    with RemoteVectorEnv(url, "CartPole-v1", 2, render_mode="rgb_array") as env:
        env.reset(seed=1)
        pictures = env.render()
        assert pictures is not None
        assert [picture.shape for picture in pictures] == [(400, 600, 3)] * 2


@pytest.mark.filterwarnings("ignore:.*HumanRendering")
def test_a_registered_id_is_drawn_in_a_window_of_the_clients(url: str) -> None:
    kwargs = {"url": url, "env_id": "CartPole-v1"}
    gymnasium.register("Remote/Drawn-v0", "trial.gym:RemoteEnv", kwargs=kwargs)
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


@pytest.mark.parametrize(
    ("env_id", "action", "shown"),
    [("CartPole-v1", 2, "2"), ("Pendulum-v1", np.array([np.nan], np.float32), "[nan]")],
)
def test_the_sentence_shows_the_wrong_action(url: str, env_id: str, action: Any, shown: str) -> None:
    with RemoteEnv(url, env_id) as env:
        env.reset(seed=1)
        with pytest.raises(RemoteError, match=re.escape(f"Action `{shown}` is wrong: The action ")):
            env.step(action)


@pytest.mark.parametrize("action", ["raise", "exit", "shape", "text", "three", "nothing"])
def test_an_environments_mistake_gets_a_sentence_and_the_connection_remains(url: str, action: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset(seed=1)
        with pytest.raises(RemoteError, match=r"\S \S") as caught:
            env.step(action)
        assert not isinstance(caught.value, ConnectionLost)
        assert env.step("a")[1] == 1.0


def test_an_observation_outside_its_space_arrives(url: str) -> None:
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset()
        assert same(env.step("outside")[0], np.array([np.nan, 7], np.float32))


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
            env.step("die")
        with pytest.raises(ConnectionLost, match="any more"):
            env.step("a")
        assert other.step(1)[1] == 1.0


def test_an_answer_that_does_not_come_in_time_ends_the_connection(url: str) -> None:
    with RemoteEnv(url, "Bad-v0", timeout=4) as env:
        env.reset()
        begun = time.monotonic()
        with pytest.raises(ConnectionLost, match="within 4 s"):
            env.step("sleep")
        assert time.monotonic() - begun < 10


def test_an_interrupted_request_ends_the_connection(url: str) -> None:
    """Its answer would be taken for that of the next request."""
    with RemoteEnv(url, "Bad-v0") as env:
        env.reset()
        timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            env.step("sleep")
        timer.join()
        with pytest.raises(ConnectionLost, match="interrupted"):
            env.reset()


def test_the_end_of_the_server_gets_a_sentence() -> None:
    with serving() as (address, process):
        env = RemoteEnv(address, "CartPole-v1")
        env.reset()
        process.terminate()
        process.wait()
        with pytest.raises(ConnectionLost, match=r"connection to ws://\S+ is lost"):
            env.reset()
        env.close()


def test_a_missing_server_gets_a_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    with pytest.raises(ConnectionLost, match=f"no connection to ws://127.0.0.1:{port}"):
        RemoteEnv(f"ws://127.0.0.1:{port}/", "CartPole-v1")


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


def test_no_message_contains_the_token() -> None:
    for address in ("ws://127.0.0.1:1/", "ws://127.0.0.1:1/gym?token=secret", "ws://me:secret@127.0.0.1:1/"):
        with pytest.raises(ConnectionLost) as caught:
            RemoteEnv(address, "CartPole-v1", token="secret")
        assert "secret" not in str(caught.value)
        assert caught.value.__cause__ is None


def test_a_token_is_sent_and_is_not_shown(url: str) -> None:
    asked = []
    with serve(lambda connection: asked.append(connection.request.path), "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with pytest.raises(ConnectionLost, match="does not speak"):
            RemoteEnv(f"ws://127.0.0.1:{server.socket.getsockname()[1]}/", "CartPole-v1", token="a&b=c d")
        server.shutdown()
        thread.join()
    assert asked == ["/gym?token=a%26b%3Dc%20d"]
    with RemoteEnv(url, "CartPole-v1", token="secret") as env:
        assert "secret" not in repr(env.spec)


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


def test_threads_take_turns(url: str) -> None:
    results: list[Any] = []
    with RemoteEnv(url, "FrozenLake-v1") as env:

        def play() -> None:
            for _ in range(50):
                results.append(env.reset())

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda _: play(), range(4)))
    assert len(results) == 200
