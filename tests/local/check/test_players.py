"""`make check` of environments with several players: whole episodes with the policies in their places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hippodrome.control.config import read_project
from hippodrome.local.check import agent as agent_check
from testing import onnx_files
from tests.local.conftest import write_study

AGENT = """
import numpy


class Agent:
    possible_agents = ["left", "right"]

    def start(self, game):
        pass

    def reset(self, seed=None):
        self.n = 0
        return self.seen(), {}

    def seen(self):
        return {"left": numpy.zeros(2, numpy.float32), "right": numpy.ones(2, numpy.float32)}

    def step(self, actions):
        self.n += 1
        return self.seen(), {"left": 1}, {"__all__": self.n == 20}, {}, {}

    def render(self):
        return numpy.zeros((8, 8, 3), numpy.uint8)

    def close(self):
        pass


class Partner:
    def act(self, observation, info):
        assert observation[0] == 1
        return 2

    def reset(self, seed):
        pass

    def resume(self, steps):
        pass
"""

TRIAL = """
trial:
  game: none
  maxEpisodes: 3
  actionSpace: [noop, up, down]
  players: {left: human, right: PLAYS}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    found = write_study(tmp_path / "study", start=2)
    (found / "agent.py").write_text(AGENT)
    return found


def tried(
    folder: Path, plays: str, old: str = "", new: str = "", said: list[str] | None = None, seconds: float = 60
) -> list[str]:
    """Return what is said of the study in which `plays` plays the right player, with a text of `trial` replaced."""
    file = folder / "config.yml"
    project = file.read_text().partition("\ntrial:")[0]
    assert old in TRIAL
    file.write_text(project + (TRIAL.replace(old, new) if old else TRIAL).replace("PLAYS", plays))
    say = (said if said is not None else []).append
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder), seconds, say)]


@pytest.mark.parametrize(
    "plays", ["agent:Partner", "random", "idle", "gym://learner", "policies/p.onnx", "sample:policies/p.onnx"]
)
def test_whole_episodes_are_played(folder: Path, plays: str) -> None:
    onnx_files.linear(folder / "policies/p.onnx", [[1, 0, 0], [0, 2, 1]])
    said: list[str] = []
    found = tried(folder, plays, "maxEpisodes", "gym: advise\n  maxEpisodes", said)
    assert (found, said) == ([], ["played: 3 of 3 episodes to the end, 60 steps"])


@pytest.mark.parametrize("limit", ["maxSteps: 12", "episodeSeconds: 0.4"])
def test_an_episode_ends_at_its_limit(folder: Path, limit: str) -> None:
    agent = folder / "agent.py"
    agent.write_text(agent.read_text().replace("self.n == 20", "False"))
    said: list[str] = []
    assert tried(folder, "random", "maxEpisodes", f"startingFrameRate: 30\n  {limit}\n  maxEpisodes", said) == []
    assert said == ["played: 3 of 3 episodes to the end, 36 steps"]


def test_one_end_for_all_players_is_written_as_a_map(folder: Path) -> None:
    agent = folder / "agent.py"
    agent.write_text(agent.read_text().replace('{"__all__": self.n == 20}', "self.n == 20"))
    (line,) = tried(folder, "random")
    assert line.endswith('its terminations are bool, and {"__all__": False} is for all players')


@pytest.mark.parametrize(("key", "between"), [("input: held", 2), ("input: single", 0), ("policyActions: single", 0)])
def test_between_two_choices_a_policy_does_what_it_does_on_a_server(folder: Path, key: str, between: int) -> None:
    agent = folder / "agent.py"
    takes = f'assert actions["right"] == (2 if self.n % 4 == 0 else {between}), actions\n        self.n += 1'
    agent.write_text(agent.read_text().replace("self.n += 1", takes))
    assert tried(folder, "agent:Partner", "maxEpisodes", f"frameSkip: 4\n  {key}\n  maxEpisodes") == []


def test_unknown_players_are_reported_with_those_of_the_environment(folder: Path) -> None:
    (line,) = tried(folder, "random", "right:", "rigth:")
    assert line.endswith('trial.players: names "rigth", but the environment has "left", "right"')
    assert line.startswith("config.yml:")
    (line,) = tried(folder, "random", ", right: PLAYS", "")
    assert line.endswith('trial.players: must say who plays "right"; the environment has "left", "right"')


def test_without_the_key_players_check_asks_who_plays_the_others(folder: Path) -> None:
    (line,) = tried(folder, "random", "  players: {left: human, right: PLAYS}\n", "")
    assert line.endswith('trial.players: must say who plays "right"; the environment has "left", "right"')


@pytest.mark.parametrize(
    ("plays", "said"),
    [
        ("policies/text.onnx", "policies/text.onnx is no ONNX file that onnxruntime can read: "),
        ("policies/wide.onnx", "policies/wide.onnx takes observations of 5 numbers (its input 'obs'); the environment gives 2 numbers"),
        ("policies/many.onnx", "policies/many.onnx returns 4 numbers as 'output'; expected 3, one for each action"),
        ("policies/nan.onnx", "policies/nan.onnx returned NaN instead of the actions' values"),
        ("agent:Partnr", "there is no class Partnr in agent.py; classes with act() there: Partner"),
    ],
)  # fmt: skip
def test_a_policy_that_cannot_play_is_reported_at_its_line_in_config_yml(folder: Path, plays: str, said: str) -> None:
    policies = folder / "policies"
    onnx_files.linear(policies / "wide.onnx", np.zeros((5, 3)))
    onnx_files.linear(policies / "many.onnx", np.zeros((2, 4)))
    onnx_files.constant(policies / "nan.onnx", np.full((1, 3), np.nan, np.float32))
    (policies / "text.onnx").write_text("text")
    (line,) = tried(folder, plays)
    assert f"trial.players.right: {said}" in line
    assert line.startswith("config.yml:")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("return 2", "return 7", "config.yml:12: trial.players.right: act() returned action 7; there are 0 to 2"),
        ("return 2", "return 1 / 0", "agent.py:32: act() of agent:Partner fails: ZeroDivisionError"),
        ("    def reset(self, seed):\n        pass", "    def reset(self, seed):\n        seed.x", "agent.py:35: reset() of agent:Partner fails: AttributeError"),
        ("steps):\n        pass", "steps):\n        steps.x", "agent.py:38: resume() of agent:Partner fails"),
        ("class Partner:", "class Partner:\n    def __init__(self):\n        self.y = x\n", "agent.py:31: making the policies fails: NameError"),
    ],
)  # fmt: skip
def test_a_policy_of_agent_py_that_fails_is_reported_at_its_line(folder: Path, old: str, new: str, said: str) -> None:
    (folder / "agent.py").write_text(AGENT.replace(old, new))
    (line,) = tried(folder, "agent:Partner")
    assert line.startswith(said)


def test_a_policy_that_loses_its_state_with_a_server_gets_a_remark(folder: Path) -> None:
    (folder / "agent.py").write_text(AGENT.replace("def resume", "def other"))
    (line,) = tried(folder, "agent:Partner")
    assert line.endswith(
        "remark: trial.players.right: agent:Partner has reset() but no resume(): if a server is lost, its state is lost "
        "within an episode; see docs/players.md#after-a-lost-server"
    )


def test_a_policy_file_that_takes_hours_is_reported_at_its_line_in_config_yml(folder: Path) -> None:
    onnx_files.endless(folder / "policies/p.onnx")
    (line,) = tried(folder, "policies/p.onnx", seconds=3)
    said = "trial.players.right: act() of policies/p.onnx has not come back within 3 s"
    assert (line.startswith("config.yml:"), line.endswith(said)) == (True, True), line


def test_each_group_is_tried_with_its_players(folder: Path) -> None:
    (folder / "steps" / "hello-0.html").write_text("<p>0</p>")
    (folder / "steps" / "hello-1.html").write_text("<p>1</p>")
    (folder / "steps" / "hello.html").unlink()
    new = "\n    0: {left: human, right: agent:Partner}\n    1: {left: human, right: policies/wide.onnx}"
    onnx_files.linear(folder / "policies/wide.onnx", np.zeros((5, 3)))
    said: list[str] = []
    (line,) = tried(folder, "random", " {left: human, right: PLAYS}", new, said)
    assert "trial.players.1.right: policies/wide.onnx takes observations of 5 numbers" in line
    assert line.endswith("group 1)")
    assert said == ["played in group 0: 3 of 3 episodes to the end, 60 steps"]


def test_values_for_unknown_players_are_reported(folder: Path) -> None:
    (folder / "agent.py").write_text(AGENT.replace('{"left": 1}', '{"lift": 1}'))
    (line,) = tried(folder, "random")
    assert line == "agent.py:18: step() returned something of 'lift'; the players are left, right"


ENV = AGENT.replace("class Agent:", "class Env:").replace(
    "def start(self, game):\n        pass\n",
    """
    def action_space(self, player):
        from gymnasium.spaces import Discrete
        return Discrete(2)
""",
)


def test_more_names_than_actions(folder: Path) -> None:
    leaves = "\nclass Agent:\n    def start(self, game):\n        return Env()\n"
    (folder / "agent.py").write_text(ENV + leaves)
    (line,) = tried(folder, "random")
    assert "trial.actionSpace: has 3 names, but the environment has 2 actions; take out" in line
    translates = f"{leaves}    def step(self, actions):\n        return Env.step(self, actions)\n"
    translates += "    seen = Env.seen\n    def reset(self, seed=None):\n        return Env.reset(self, seed)\n"
    (folder / "agent.py").write_text(ENV + translates)
    assert tried(folder, "random") == []


# ---- drawn by objects


def test_scenes_of_several_players_are_checked(folder: Path) -> None:
    objects = '[{"id": "a", "type": "circle", "x": 0.5, "y": 0.5, "radius": 4}, {"id": "b", "type": "sprite", "image": "cat", "x": 0, "y": 0}]'
    (folder / "agent.py").write_text(AGENT.replace("numpy.zeros((8, 8, 3), numpy.uint8)", objects))
    (line,) = tried(folder, "random")
    assert line.endswith("render() returned objects; say in config.yml how large the picture is, as trial.scene")
    (folder / "assets").mkdir()
    (folder / "assets" / "cat.svg").write_text("<svg/>")
    found = tried(folder, "random", "  game: none\n", "  game: none\n  scene: {width: 60, height: 40}\n")
    assert [line.partition("remark: ")[2] for line in found] == [
        "trial.scene: assets/cat.svg is no PNG, JPEG or WebP image; sprites show only these",
        "render(): the object 'b' shows the image 'cat', which is not in assets/",
    ]


def test_callbacks_get_the_values_of_all_players(folder: Path) -> None:
    (folder / "agent.py").write_text(
        AGENT.replace(
            "    def close(self):",
            "    def on_tick(self, session):\n"
            "        assert (session.players, session.humans) == (('left', 'right'), ('left',))\n"
            "        assert set(session.actions) == set(session.scores) == {'left', 'right'}\n\n"
            "    def close(self):",
        )
    )
    assert tried(folder, "random") == []
