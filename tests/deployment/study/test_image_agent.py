"""A project's agent is tried while its image is built."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hippodrome.deployment.study.image.bundle import make_bundle
from testing.waiting import until
from tests.deployment.recipe import Container, Recipe, stages
from tests.deployment.registering import write_study
from tests.trial.conftest import grid_agent


def tried(recipe: Recipe, folder: Path, tmp_path: Path, seconds: str = "150", **trial: Any) -> tuple[int, str]:
    """Return the exit status and output of the step that tries the agent, where the image's files are."""
    make_bundle(folder, trial=trial).write_folder(tmp_path / "context")
    (command,) = (json.loads(step) for step in stages()[1].all("RUN"))
    assert command[3:] == ["/hippodrome/check.json", "60"]
    command[3:] = [str(tmp_path / "context/check.json"), seconds]
    container = Container(recipe, tmp_path / "context", tmp_path / "root", {}, command)
    said, wrong = container.process.communicate(timeout=170)
    assert wrong == ""
    assert container.files() == container.before
    assert len(said.splitlines()) == 1
    return container.process.returncode, said


WELL = "The agent was tried in the image: it starts, draws and takes a step.\n"


def test_an_agent_that_plays_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py="print('much', 'more', sep='\\n')\n" + grid_agent(20))
    assert tried(recipe, folder, tmp_path, game="grid") == (0, WELL)


DRAWN = """
class Agent:
    def start(self, game): pass
    def reset(self, seed=None): pass
    def step(self, action): return None, 0.0, False, False, {}
    def render(self): return [{"id": "ball", "type": "circle", "x": 0.5, "y": 0.5, "radius": 9}]
    def close(self): pass
"""


def test_an_agent_that_draws_objects_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=DRAWN)
    assert tried(recipe, folder, tmp_path, game="ball", scene={"width": 300, "height": 200}) == (0, WELL)


OLD_GYM_AGENT = """
import gym

class Agent:
    def start(self, game):
        self.env = gym.make(game)
    def step(self, action):
        observation, reward, done, info = self.env.step(action)
        return {"observation": observation, "reward": reward, "done": done, "info": info}
    def render(self):
        return self.env.render("rgb_array")
    def reset(self):
        self.env.reset()
    def close(self):
        self.env.close()
"""


def test_an_agent_that_imports_gym_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=OLD_GYM_AGENT)
    assert tried(recipe, folder, tmp_path, game="MsPacman-v0") == (0, WELL)


def test_an_agents_own_modules_win_over_installed_ones(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py="import responses\nassert responses.MINE\n" + grid_agent(20))
    (folder / "responses.py").write_text("MINE = True\n")  # a package of this name is installed here
    assert tried(recipe, folder, tmp_path, game="grid") == (0, WELL)


def test_the_agent_is_told_its_game_and_options(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    said = "import json, os\nassert json.loads(os.environ['TRIAL']) == {'game': 'grid', 'options': {'speed': 3}}\n"
    write_study(folder, agent_DOT_py=said + grid_agent(20))
    found = tried(recipe, folder, tmp_path, game="grid", options={"speed": 3}, maxEpisodes=4)
    assert found == (0, WELL)


def test_a_project_without_an_agent_is_tried_with_its_game(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    (folder / "agent.py").unlink()
    status, said = tried(recipe, folder, tmp_path, game="nosuch/Game-v1")
    assert (status, "NamespaceNotFound" in said, "(module:Id-v0), or correct its name" in said) == (1, True, True)


DRAWS = "        return self.env.render()\n"
LIBRARY = "libGL.so.1: cannot open shared object file: No such file or directory"
LATE = """try:
            import pygame_of_nobody
        except ImportError as error:
            raise gymnasium.error.DependencyNotInstalled("not there") from error"""


@pytest.mark.parametrize(
    ("first", "drawing", "what", "remedy"),
    [
        ("import nosuch.part", "", "agent.py:1: ModuleNotFoundError: No module named 'nosuch'",
         "write the package that brings nosuch into requirements.txt beside agent.py"),
        ("", "import nosuch.part", "ModuleNotFoundError: No module named 'nosuch'",
         "write the package that brings nosuch into requirements.txt beside agent.py"),
        ("import ctypes; ctypes.CDLL('libnosuch.so.1')", "", "agent.py:1: OSError: libnosuch.so.1: cannot open",
         "libnosuch.so.1 is a system library"),
        ("", f"raise ImportError({LIBRARY!r})", f"ImportError: {LIBRARY}", "libGL.so.1 is a system library"),
        ("from json import nosuch", "", "agent.py:1: ImportError: cannot import name 'nosuch'",
         "correct the packages and versions in requirements.txt"),
        ("import gymnasium", LATE, "DependencyNotInstalled: not there",
         "write the package that brings pygame_of_nobody into requirements.txt"),
        ("import gymnasium; gymnasium.make('NoSuch-v0')", "", "agent.py:1: NameNotFound", "write the package with this game"),
    ],
)  # fmt: skip
def test_an_agent_that_cannot_run_in_the_image_ends_the_build(
    recipe: Recipe, folder: Path, tmp_path: Path, first: str, drawing: str, what: str, remedy: str
) -> None:
    agent = grid_agent(20)
    assert agent.count(DRAWS) == 1
    write_study(folder, agent_DOT_py=f"{first}\n" + agent.replace(DRAWS, f"        {drawing or 'pass'}\n{DRAWS}"))
    status, said = tried(recipe, folder, tmp_path, game="grid")
    assert status == 1, said
    assert said.startswith("MISSING IN THE IMAGE: agent.py:")
    told, _, do = said.partition(" => ")
    assert what in told
    assert do.startswith(remedy)


SEVERAL = """
class Agent:
    possible_agents = ["left", "right"]
    def start(self, game):
        pass
    def reset(self, seed=None):
        return {"left": [1, 0], "right": [0, 1]}, {}
    def step(self, actions):
        return {"left": [1, 0], "right": [0, 1]}, {}, {}, {}, {}
    def render(self):
        import numpy
        return numpy.zeros((4, 4, 3), numpy.uint8)
    def close(self):
        pass

class Partner:
    def act(self, observation, info):
        assert observation == [0, 1]
        return 1

class Lost:
    def __init__(self):
        import nosuch
    def act(self, observation, info):
        return 0
"""


@pytest.mark.parametrize(
    ("plays", "file", "status", "words"),
    [
        ("agent:Partner", "", 0, WELL),
        ("random", "", 0, WELL),
        ("agent:Lost", "", 1, "No module named 'nosuch' => write the package that brings nosuch into requirements.txt"),
        (
            "policies/p.onnx",
            "",
            1,
            "right cannot be played by policies/p.onnx: there is no file policies/p.onnx => put the file there",
        ),
        ("policies/p.onnx", "no ONNX", 0, "right cannot be played by policies/p.onnx: policies/p.onnx is no ONNX file"),
    ],
)
def test_policies_are_tried_too(
    recipe: Recipe, folder: Path, tmp_path: Path, plays: str, file: str, status: int, words: str
) -> None:
    write_study(folder, agent_DOT_py=SEVERAL)
    if file:
        (folder / "policies").mkdir()
        (folder / "policies/p.onnx").write_text(file)
    team = {"left": "human", "right": plays}
    for name, players in {"all": team, "by group": {"0": {"left": "human", "right": "idle"}, "1": team}}.items():
        (tmp_path / name).mkdir()
        found, said = tried(recipe, folder, tmp_path / name, game="grid", players=players, actionSpace=["stay", "go"])
        assert (found, words in said) == (status, True), said


@pytest.mark.parametrize(
    ("first", "seconds", "words"),
    [
        ("import os; os.environ['nosuch']", "150", "agent.py:1: KeyError: 'nosuch'"),
        ("open('model.bin')", "150", "agent.py:1: FileNotFoundError"),
        ("import urllib.error; raise urllib.error.URLError('no network')", "150", "agent.py:1: URLError"),
        ("raise SystemExit(1)", "150", "agent.py:1: RuntimeError: SystemExit(1)"),
        ("import os; os._exit(7)", "150", "ended Python itself (status 7)"),
        ("import time; time.sleep(600)", "10", "has not come back within 10 s, and is in agent.py:1"),
        ("import re; re.match('(a|a)*b', 'a' * 50)", "1", "it has not come back within 1 s"),
        ("def f(:", "150", "SyntaxError"),
    ],
)
def test_a_failure_that_only_a_build_may_have_is_a_warning(
    recipe: Recipe, folder: Path, tmp_path: Path, first: str, seconds: str, words: str
) -> None:
    write_study(folder, agent_DOT_py=f"{first}\n" + grid_agent(20))
    status, said = tried(recipe, folder, tmp_path, seconds, game="grid")
    assert status == 0
    assert said.startswith("Warning: the agent could not be tried in the image, which is built all the same: ")
    assert words in said


def test_processes_of_the_agent_end_with_the_step(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    started = "import subprocess, pathlib\nchild = subprocess.Popen(['/bin/sleep', '600'])\n"
    started += f"pathlib.Path({str(tmp_path / 'child')!r}).write_text(str(child.pid))\n"
    write_study(folder, agent_DOT_py=started + grid_agent(20))
    assert tried(recipe, folder, tmp_path, game="grid") == (0, WELL)
    child = Path("/proc", (tmp_path / "child").read_text(), "stat")
    until(lambda: not child.exists() or child.read_text().rpartition(")")[2].split()[0] == "Z", 10)


def test_only_settings_of_the_agents_trial_change_the_image(folder: Path) -> None:
    names = [
        make_bundle(folder, trial=trial).hash
        for trial in (
            {"game": "a"},
            {"game": "b"},
            {"game": "a", "options": {"x": 1}},
            {"maxEpisodes": 2, "game": "a", "options": {}, "actionSpace": ["x"]},
            {"game": "a", "players": {"p": "random"}},
            {"game": "a", "players": {"p": "random"}, "actionSpace": ["x"]},
        )
    ]
    assert len(set(names)) == 5
    assert names[0] == names[3]
