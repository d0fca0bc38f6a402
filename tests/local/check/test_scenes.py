"""`make check` of games that are drawn by objects: it plays them, and says what cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.config import read_project
from local.check import agent as agent_check
from testing import preloaded
from trial.server import process_group

AGENT = """
class Agent:
    def start(self, game):
        pass
    def reset(self, seed=None):
        self.t = 0
    def step(self, action):
        self.t += 1
        return None, 0.0, self.t >= 20, False, {}
    def render(self):
        return [OBJECTS]
    def close(self):
        pass
"""
CONFIG = """project: {id: drawn, steps: {1: game, finalStep: end}}
trial:
  game: drawn
  maxEpisodes: 2
  actionSpace: [noop, left, right]
  scene: {width: 300, height: 200}
"""
BALL = '{"id": "ball", "type": "circle", "x": 0.01 * self.t, "y": 0.5, "radius": 9}'


@pytest.fixture(autouse=True)
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_group, "Popen", preloaded.popen)


def tried(folder: Path, objects: str, config: str = CONFIG) -> list[str]:
    (folder / "steps").mkdir()
    (folder / "steps" / "end.html").write_text("<h1>The end</h1>")
    (folder / "agent.py").write_text(AGENT.replace("OBJECTS", objects))
    (folder / "config.yml").write_text(config)
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder))]


def test_a_game_that_is_drawn_by_objects_is_played(tmp_path: Path) -> None:
    assert tried(tmp_path, BALL) == []


def test_an_object_that_cannot_be_drawn_is_a_remark_said_once(tmp_path: Path) -> None:
    found = tried(tmp_path, f'{BALL}, {{"id": "box", "type": "box", "x": 0, "y": 0}}')
    assert len(found) == 1
    assert found[0].startswith("agent.py:10: remark: render(): the object 'box'")


def test_an_image_that_is_not_there_is_a_remark(tmp_path: Path) -> None:
    found = tried(tmp_path, '{"id": "cook", "type": "sprite", "image": "chef", "x": 0, "y": 0}')
    assert found == [
        "agent.py:10: remark: render(): the object 'cook' shows the image 'chef', which is not in assets/",
    ]


def test_an_image_that_cannot_be_shown_is_a_remark_at_scene(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "cook.png").write_text("no picture")
    found = tried(tmp_path, BALL)
    assert len(found) == 1
    assert found[0].startswith("config.yml:6: remark: trial.scene: assets/cook.png")


def test_objects_without_scene_are_a_mistake_that_says_what_to_write(tmp_path: Path) -> None:
    found = tried(tmp_path, BALL, CONFIG.replace("  scene: {width: 300, height: 200}\n", ""))
    assert len(found) == 1
    assert found[0].startswith("agent.py:10: render() ")
    assert "trial.scene" in found[0]
    assert "SceneError" not in found[0]
