"""Each player may have a view of their own: a `render` that takes a player, drawn by objects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.joint import JointAdapter, start
from hippodrome.trial.pictures.reader import PictureReader
from hippodrome.trial.pictures.scene import Scene

AGENT = """
class Agent:
    possible_agents = ["left", "right"]
    def start(self, game):
        pass
    def reset(self, seed=None):
        self.t = 0
        return {"left": 0, "right": 0}, {}
    def step(self, actions):
        self.t += 1
        return {"left": 0, "right": 0}, {}, {}, {}, {}
    def render(self, player):
        drawn = [{"id": player, "type": "circle", "x": self.t, "y": 0, "radius": 1}]
        if self.t == 0:
            drawn.append({"id": f"home of {player}", "type": "circle", "x": 0, "y": 0, "radius": 1, "permanent": True})
        return drawn
    def close(self):
        pass
"""


@pytest.fixture
def adapter(tmp_path: Path) -> JointAdapter:
    (tmp_path / "agent.py").write_text(AGENT)
    made = start(AgentAdapter(tmp_path, None, ("stay", "go"), PictureReader(SceneSection())), ("left", "right"))
    assert isinstance(made, JointAdapter)
    return made


def views(adapter: JointAdapter) -> dict[str, set[str]]:
    """Return the ids of the objects in each player's view."""
    pictures = adapter.pictures()
    assert isinstance(pictures, Mapping)
    found = {}
    for player, picture in pictures.items():
        assert isinstance(picture, Scene)
        found[player] = set(picture.objects)
    return found


def test_each_player_has_their_own_objects_and_permanent_ones(adapter: JointAdapter) -> None:
    adapter.reset(1)
    both = {"left": {"left", "home of left"}, "right": {"right", "home of right"}}
    assert views(adapter) == both
    adapter.step({"left": 0, "right": 1})
    assert views(adapter) == both


def test_an_episode_that_is_taken_up_again_without_pictures_has_its_permanent_objects(adapter: JointAdapter) -> None:
    adapter.reset(1)
    adapter.step({"left": 0, "right": 1})
    assert views(adapter)["right"] == {"right", "home of right"}


def test_permanent_objects_end_with_their_episode(adapter: JointAdapter) -> None:
    adapter.reset(1)
    adapter.views = ("left",)
    assert views(adapter) == {"left": {"left", "home of left"}}
    adapter.reset(2)
    adapter.step({"left": 0, "right": 1})
    assert views(adapter) == {"left": {"left", "home of left"}}
