"""`register`, from a folder to a link, over an account on moto."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deploy.problem import Exit
from tests.deploy.registering import CONFIG, Town, folder, town, write_study

__all__ = ["folder", "town"]
LINK = "https://study.example.org/next?projectId=maze"


def config(folder: Path, **changes: str) -> None:
    text = CONFIG
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "config.yml").write_text(text)


def test_a_folder_becomes_a_link(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert LINK in ran.out.split()
    project = town.project()
    assert project is not None
    assert project.live
    assert (project.aws_setup.bucket, project.aws_setup.region) == (town.env["BUCKET"], "us-east-1")
    assert project.aws_setup.root_domain == "example.org"
    assert town.keys("maze/") == [f"maze/steps/{name}" for name in ("consent.html", "maze.png", "thanks.html")]
    assert [project.task_definition] == town.revisions()
    (tag,) = town.image_tags()
    assert tag.startswith("maze-")
    assert town.builds[0].env["IMAGE"] == f"{town.repository}:{tag}"
