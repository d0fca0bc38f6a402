"""Ids of gym 0.17 make their successors in Gymnasium and ALE."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.gym import RemoteEnv, RemoteError
from hippodrome.trial.agent.environments import registered_id
from testing.gym_server import gym_server


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with gym_server() as server:
        yield server.url


@pytest.mark.parametrize(
    ("old", "now"),
    [
        ("CartPole-v0", "CartPole-v0"),
        ("CartPole-v1", "CartPole-v1"),
        ("FrozenLake-v0", "FrozenLake-v1"),
        ("Pendulum-v0", "Pendulum-v1"),
        ("Taxi-v2", "Taxi-v4"),
        ("Breakout-v0", "Breakout-v0"),
        ("PongNoFrameskip-v4", "PongNoFrameskip-v4"),
        ("PongDeterministic-v4", "Pong-v4"),
        ("ALE/Pong-v5", "ALE/Pong-v5"),
    ],
)
def test_an_old_id_makes_its_successor(url: str, old: str, now: str) -> None:
    assert registered_id(old)[0] == now
    with RemoteEnv(url, old) as env:
        env.reset(seed=1)
        env.step(env.action_space.sample())


@pytest.mark.parametrize(
    ("old", "options"),
    [
        ("PongDeterministic-v4", {"frameskip": 4}),
        ("Pong-ramDeterministic-v4", {"frameskip": 4, "obs_type": "ram"}),
        ("Pong-ram-v0", {"obs_type": "ram"}),
        ("Pong-ramNoFrameskip-v4", {"obs_type": "ram"}),
    ],
)
def test_an_old_name_of_an_atari_game_becomes_options(old: str, options: dict[str, Any]) -> None:
    assert registered_id(old)[1] == options


@pytest.mark.parametrize(
    "env_id", ["CartPole-v7", "CartPole", "Nothing-v0", "NothingDeterministic-v4", "", "-v0", "ALE/"]
)
def test_an_unknown_id_stays_as_it_is(env_id: str) -> None:
    assert registered_id(env_id) == (env_id, {})


def test_a_version_that_does_not_exist_yet_remains_an_error(url: str) -> None:
    with pytest.raises(RemoteError, match="CartPole-v7"):
        RemoteEnv(url, "CartPole-v7")
