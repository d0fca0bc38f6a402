"""`import gym` where Gym is not installed: its old interface over Gymnasium (hippodrome/trial/agent/old_gym)."""

from __future__ import annotations

import importlib
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.joint import start

OLD_GYM = Path(__file__).parents[3] / "hippodrome/trial/agent/old_gym"


@pytest.fixture(scope="module")
def gym() -> Iterator[Any]:
    sys.path.append(str(OLD_GYM))
    try:
        module = importlib.import_module("gym")
    finally:
        sys.path.remove(str(OLD_GYM))
    assert module.__file__ is not None
    assert Path(module.__file__).is_relative_to(OLD_GYM), "these tests are for a machine without Gym"
    yield module
    for name in [name for name in sys.modules if name.partition(".")[0] == "gym"]:
        del sys.modules[name]


# ---- make


def test_an_environment_has_the_old_interface(gym: Any) -> None:
    env = gym.make("CartPole-v0")
    assert env.seed(3) == [3]
    first = env.reset()
    assert isinstance(first, np.ndarray)
    assert first.shape == (4,)
    env.seed(3)
    assert np.array_equal(env.reset(), first)
    assert np.array_equal(gymnasium.make("CartPole-v0").reset(seed=3)[0], first), "the same as Gymnasium's"
    assert np.array_equal(env.reset(seed=3), first), "as later versions take it"
    observation, reward, done, info = env.step(env.action_space.sample())
    assert (observation.shape, reward, done, info) == ((4,), 1.0, False, {})
    assert env.render("rgb_array").shape == env.render(mode="rgb_array").shape == (400, 600, 3)
    assert env.render().dtype == np.uint8, "a server has no screen"
    env.close()


def test_an_end_by_the_time_limit_is_marked_in_info(gym: Any) -> None:
    env = gym.make("MountainCar-v0")
    assert env._max_episode_steps == env.spec.max_episode_steps == 200
    env._max_episode_steps = 3  # as many scripts do
    env.reset()
    results = [env.step(1) for _ in range(3)]
    assert [done for _, _, done, _ in results] == [False, False, True]
    assert results[2][3] == {"TimeLimit.truncated": True}
    env.reset()
    assert not env.step(1)[2]
    assert gym.make("MountainCar-v0", max_episode_steps=7)._max_episode_steps == 7


def test_the_wrapped_environment_can_be_reached(gym: Any) -> None:
    env = gym.make("CartPole-v1")
    env.reset()
    assert env.unwrapped.gravity == env.env.gravity == env.gravity == 9.8
    env.env.state = (0.0, 0.0, 0.1, 0.0)
    assert env.step(0)[0][2] == pytest.approx(0.1)
    env.unwrapped.gravity = 1.0
    assert env.gravity == 1.0
    assert env.observation_space == gymnasium.make("CartPole-v1").observation_space
    assert not hasattr(env, "no_such_thing")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("MsPacman-v0", (210, 160, 3)),
        ("Breakout-v0", (210, 160, 3)),
        ("BreakoutNoFrameskip-v4", (210, 160, 3)),
        ("BreakoutDeterministic-v4", (210, 160, 3)),
        ("ALE/MsPacman-v5", (210, 160, 3)),
    ],
)
def test_atari_games_are_made_by_their_old_ids(gym: Any, name: str, shape: tuple[int, ...]) -> None:
    env = gym.make(name)
    env.seed(0)
    assert env.reset().shape == env.observation_space.shape == shape
    assert env.env.get_action_meanings()[0] == env.unwrapped.get_action_meanings()[0] == "NOOP"
    assert env.ale.lives() == env.unwrapped.ale.lives() == env.env.ale.lives() > 0
    _, _, done, info = env.step(0)
    assert (done, info["lives"]) == (False, env.ale.lives())
    assert env.render("rgb_array").shape == (210, 160, 3)
    env.close()


def test_an_old_id_makes_gymnasiums_newer_version(gym: Any) -> None:
    with pytest.warns(UserWarning, match=r"no Pendulum-v0 any more; Pendulum-v1 is used instead"):
        env = gym.make("Pendulum-v0")
    assert env.spec.id == "Pendulum-v1"
    with pytest.raises(gym.error.UnregisteredEnv):
        gym.make("NoSuchThing-v0")


def test_an_unwrapped_environment_has_the_old_interface_without_a_time_limit(gym: Any) -> None:
    env = gym.make("MountainCar-v0").unwrapped
    env.seed(1)
    env.reset()
    assert not any(env.step(1)[2] for _ in range(250))


def test_with_a_render_mode_an_environment_has_the_interface_of_gym_026(gym: Any) -> None:
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    observation, info = env.reset(seed=1)
    assert (observation.shape, info) == ((4,), {})
    assert len(env.step(0)) == 5
    assert env.render().shape == (400, 600, 3)
    assert env.unwrapped.gravity == 9.8


# ---- environments of one's own

ENV = """
import gym
from gym import spaces, Env, Wrapper
from gym.utils import seeding
from gym.spaces import Discrete
from gym.spaces.box import Box
import gym.wrappers
import gym.error, gym.core
import numpy as np

class Corridor(gym.Env):
    metadata = {"render.modes": ["human", "rgb_array"]}
    def __init__(self, length=5):
        self.action_space = spaces.Discrete(2)
        self.observation_space = spaces.Box(low=0, high=length, shape=(1,), dtype=np.float32)
        self.length = length
        self.seed()
    def seed(self, seed=None):
        self.np_random, seed = seeding.np_random(seed)
        return [seed]
    def reset(self):
        self.at = self.np_random.randint(2)
        self.luck = self.np_random.rand()
        return np.array([self.at], np.float32)
    def step(self, action):
        self.at += 1 if action else -1
        done = self.at >= self.length
        return np.array([self.at], np.float32), float(done), done, {"luck": self.luck}
    def render(self, mode="human"):
        assert mode == "rgb_array"
        return np.full((4, 4, 3), max(self.at, 0), np.uint8)
"""


@pytest.fixture
def corridor(gym: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / "my_corridor.py").write_text(ENV)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_corridor", raising=False)
    return importlib.import_module("my_corridor")


def test_an_agents_own_environment_keeps_the_old_interface(gym: Any, corridor: Any) -> None:
    env = corridor.Corridor()
    assert isinstance(env, gym.Env)
    assert env.seed(4) == [4]
    first = env.reset()
    luck = env.luck
    env.seed(4)
    assert np.array_equal(env.reset(), first)
    assert env.luck == luck
    assert env.unwrapped is env


def test_registered_environments_are_made(gym: Any, corridor: Any) -> None:
    gym.envs.registration.register(
        id="Corridor-v7", entry_point="my_corridor:Corridor", max_episode_steps=4, kwargs={"length": 50}
    )
    env = gym.make("Corridor-v7")
    assert (env.length, env.spec.id, env.unwrapped.spec.id) == (50, "Corridor-v7", "Corridor-v7")
    env.reset()
    assert [env.step(1)[2] for _ in range(4)] == [False, False, False, True]
    assert env.render(mode="rgb_array").shape == (4, 4, 3)
    assert gym.make("Corridor-v7", length=2).length == 2


def test_a_module_may_register_environments_when_it_is_imported(
    gym: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = ENV + "gym.register(id='Hall-v0', entry_point=Corridor)\n"
    (tmp_path / "my_hall.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert gym.make("my_hall:Hall-v0").length == 5


def test_an_agents_own_wrappers_work(gym: Any, corridor: Any) -> None:
    class Half(gym.ObservationWrapper):
        def observation(self, observation: Any) -> Any:
            return observation / 2

    class Ten(gym.RewardWrapper):
        def reward(self, reward: float) -> float:
            return 10 * reward

    class Flip(gym.ActionWrapper):
        def action(self, action: int) -> int:
            return 1 - action

    env = Flip(Ten(Half(corridor.Corridor(length=1))))
    env.seed(0)
    start = env.reset()
    observation, reward, done, _ = env.step(0)
    assert observation == start + 0.5
    assert (reward, done) == (10.0, True)
    assert env.unwrapped.length == env.length == 1
    assert env.render("rgb_array").shape == (4, 4, 3)


def test_a_time_limit_ends_an_agents_own_environment(gym: Any, corridor: Any) -> None:
    env = gym.wrappers.TimeLimit(corridor.Corridor(), 3)
    env.reset()
    results = [env.step(1) for _ in range(3)]
    assert [done for _, _, done, _ in results] == [False, False, True]
    assert results[2][3]["TimeLimit.truncated"]
    env.reset()
    assert not env.step(1)[2]


def test_the_names_that_agents_import_exist() -> None:
    names = """
    import gym, gym.spaces, gym.wrappers, gym.envs, gym.envs.registration, gym.utils, gym.utils.seeding, gym.error
    import gym.core, gym.spaces.utils, gym.version
    from gym import Env, Wrapper, ObservationWrapper, ActionWrapper, RewardWrapper, Space, spaces, error, utils
    from gym.core import Env, Wrapper
    from gym.envs.registration import register, make
    from gym.spaces import Box, Discrete, Dict, Tuple, MultiBinary, MultiDiscrete
    from gym.spaces.discrete import Discrete
    from gym.utils import EzPickle
    from gym.version import VERSION
    from gym.wrappers import TimeLimit
    assert VERSION == gym.__version__ < "0.26"
    import gymnasium, gymnasium.spaces
    assert gym.spaces is gymnasium.spaces and gymnasium.spaces.__spec__.name == "gymnasium.spaces"
    """
    code = f"import sys; sys.path.append({str(OLD_GYM)!r})\n{textwrap.dedent(names)}"
    subprocess.run([sys.executable, "-W", "error::ImportWarning", "-c", code], check=True, timeout=60)


# ---- in a trial


def test_an_installed_gym_is_imported_instead(tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site/gym.py").write_text("REAL = True\n")
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent/agent.py").write_text(
        "import gym\nassert gym.REAL\n"
        + "".join(f"def {name}(*a): pass\n" for name in ("start", "step", "render", "reset", "close"))
    )
    code = f"""
import sys; sys.path[:0] = [{str(OLD_GYM.parents[3])!r}, {str(tmp_path / "site")!r}]
from pathlib import Path; from hippodrome.trial.agent.agent import load
load(Path({str(tmp_path / "agent")!r}))
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


SAMPLE = """
import gym
class Agent():
    def start(self, game:str):
        self.env = gym.make(game)
        return
    def step(self, action:int):
        observation, reward, done, info = self.env.step(action)
        envState = {'observation': observation, 'reward': reward, 'done': done, 'info': info}
        return envState
    def render(self):
        return self.env.render('rgb_array')
    def reset(self):
        self.env.reset()
    def close(self):
        self.env.close()
"""
"""As HIPPO's sample agent is written."""


def test_an_agent_like_hippos_sample_plays(tmp_path: Path) -> None:
    (tmp_path / "agent.py").write_text(SAMPLE)
    player = AgentAdapter(tmp_path, "MsPacman-v0", None)
    start(player)
    assert player.action_space[:2] == ("noop", "up")
    player.reset(1)
    result = player.step(0)
    assert (result.terminated, result.info["lives"]) == (False, 3)
    assert player.render().shape == (210, 160, 3)
    player.close()
