"""Fixtures: small projects, and studies that run with them in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.local.rehearsal.study_process import StudyProcess
from testing import ports
from testing.held_study import HeldStudy

AGENT = '''
"""A dot that walks over a small field; an episode lasts {length} steps."""
import numpy as np

class Agent:
    def start(self, game):
        {start}
    def reset(self, seed=None):
        self.t = self.place = 0
        return self.place, {{}}
    def step(self, action):
        self.t += 1
        self.place += action
        return self.place, 1.0, self.t >= {length}, False, {{"t": self.t}}
    def render(self):
        picture = np.zeros((24, 32, 3), np.uint8)
        picture[self.t % 24, :, 0] = 200
        picture[:, self.place % 32] = 255
        return picture
    def close(self):
        pass
'''

PAGES = {
    "consent": '<h1>Consent</h1><label><input type="checkbox" name="consent" value="yes" required> Yes</label>',
    "about": """<h1>About you</h1>
<label>Age <input type="number" name="age" min="18" max="99" required></label>
<label>Words <textarea name="words" required></textarea></label>
<label><input type="checkbox" name="likes" value="tea"> Tea</label>
<label><input type="checkbox" name="likes" value="milk"> Milk</label>
<button name="speed" value="slow">Slowly</button> <button name="speed" value="fast">Fast</button>""",
    "after": '<h1>After</h1><label>How was it? <input type="range" name="fun" min="0" max="10"></label>',
    "end": '<h1>The end</h1><p class="code">{{ completion_code }}</p>',
}

CONFIG: dict[str, Any] = {
    "project": {
        "id": "tiny",
        "live": True,
        "maxRuntime": 10,
        "steps": {1: "consent", 2: "about", 3: "game", 4: "after", "finalStep": "end"},
        "events": {"startServerStep": 2, "stopServerStep": 4},
    },
    "trial": {
        "game": "tiny",
        "maxEpisodes": 2,
        "betweenEpisodes": 0,
        "actionSpace": ["noop", "left", "right"],
        "startingFrameRate": 30,
        "ui": {"left": True, "right": True, "start": True, "pause": True},
    },
}

MakeProject = Callable[..., Path]
Hold = Callable[..., StudyProcess]


@pytest.fixture
def project(tmp_path: Path) -> MakeProject:
    """Write a project folder: `project(length=…, start="…", live=False, maxEpisodes=…)`."""

    def make(*, length: int = 45, start: str = "pass", live: bool = True, **trial: Any) -> Path:
        folder = tmp_path / "project"
        (folder / "steps").mkdir(parents=True)
        (folder / "agent.py").write_text(AGENT.format(length=length, start=start))
        for name, page in PAGES.items():
            (folder / "steps" / f"{name}.html").write_text(page)
        config = {"project": {**CONFIG["project"], "live": live}, "trial": {**CONFIG["trial"], **trial}}
        (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
        return folder

    return make


@pytest.fixture
def hold(tmp_path: Path) -> Iterator[Hold]:
    """Hold a study: `hold(folder)`. What is left of it afterwards is ended."""
    held: list[StudyProcess] = []

    def start(folder: Path, *, port: int = 0) -> StudyProcess:
        study = HeldStudy(folder, tmp_path / "run" / "data", port=port, log=tmp_path / "local.log")
        held.append(study)
        study.start()
        return study

    yield start
    for study in held:
        study.interrupt(20)
        study.clear()


@pytest.fixture
def free_port() -> int:
    """A free port."""
    return ports.free()
