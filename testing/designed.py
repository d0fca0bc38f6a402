"""Studies with a design, from the text of their config.yml to a platform on which people take part."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hippodrome.control import registry
from hippodrome.control.config import read_project
from hippodrome.control.model.project import Project, step_key
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache
from testing.fake_platform import FakePlatform
from testing.visitors import Browser

AGENT = "class Agent: pass\n"


def write(folder: Path, config: str, pages: Mapping[str, str]) -> Path:
    """Write a study with this config.yml and these pages, by their names without `.html`, into the folder."""
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(config, encoding="utf-8")
    (folder / "agent.py").write_text(AGENT, encoding="utf-8")
    for name, text in pages.items():
        (folder / "steps" / f"{name}.html").write_text(text, encoding="utf-8")
    return folder


class DesignedStudy:
    """A registered study on a platform in memory."""

    def __init__(self, folder: Path, platform: FakePlatform) -> None:
        self.platform = platform
        self.config = config = read_project(folder)
        self.id = config.project.id
        for file in {file for step in config.steps for file in step.files} | {*(folder / "steps").glob("*.html")}:
            platform.documents.keep(step_key(self.id, file.stem), file.read_bytes())
        registry.register(platform, json.loads(json.dumps(config.registration())))

    @property
    def project(self) -> Project:
        """The project as registered."""
        found = ProjectCache(self.platform, SecretCache(self.platform.documents)).project(self.id)
        assert found is not None
        return found

    def visitor(self, user: str) -> Browser:
        """A participant's browser."""
        return Browser(self.platform, f"projectId={self.id}&userId={user}")

    def stored(self, user: str, name: str) -> Any:
        """The JSON of a document in a participant's folder; None if there is none."""
        found = self.platform.documents.kept.get(f"{self.id}/users/{user}/{name}.json")
        return json.loads(found[0]) if found else None

    def answers(self, user: str) -> dict[str, Any]:
        """The answers of a participant, by the step's key; tries too."""
        prefix = f"{self.id}/users/{user}/answers/"
        keys = sorted(key for key in self.platform.documents.kept if key.startswith(prefix))
        return {
            key.removeprefix(prefix).removesuffix(".json"): json.loads(self.platform.documents.kept[key][0])["answers"]
            for key in keys
        }

    def play(self, user: str, step: str, **answers: Any) -> None:
        """Store the answer that the trial stores when the game of this step is over."""
        document = {
            "step": step,
            "page": "game",
            "answered": "2026-11-01T10:00:00Z",
            "answers": {"score": 0, "outcome": "finished", **answers},
        }
        self.platform.documents.put(f"{self.id}/users/{user}/answers/{step}.json", json.dumps(document).encode())
