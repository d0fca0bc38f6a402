"""What `make check` says of games that are drawn by objects."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from PIL import Image

from hippodrome.control.config import read_project
from hippodrome.local.check import agent as agent_check
from tests.local.conftest import ROOT, write_study

DOCS = (ROOT / "docs" / "objects.md").read_text()
EXAMPLE = re.findall(r"```python\n(.*?)```", DOCS, re.DOTALL)[0]
"""The agent of docs/objects.md."""
SECTION = re.findall(r"```yaml\n(.*?)```", DOCS, re.DOTALL)[0]
"""Its section `trial`."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = write_study(tmp_path / "study", start=2)
    (made / "agent.py").write_text(EXAMPLE)
    config = made / "config.yml"
    config.write_text(config.read_text().partition("trial:\n")[0] + SECTION + "  maxEpisodes: 1\n")
    return made


def image() -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (8, 8)).save(out, "PNG")
    return out.getvalue()


def tried(folder: Path) -> list[str]:
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder), 60)]


def changed(folder: Path, old: str, new: str) -> None:
    file = folder / "agent.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def shorten(folder: Path) -> None:
    """The game is over when the first ball has landed: what is wrong with its pictures is wrong from the first one on."""
    changed(folder, "self.caught >= 10", "landed")


def line_of_render(folder: Path) -> int:
    lines = (folder / "agent.py").read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if "def render" in line)


def test_the_example_of_the_docs_plays_without_a_remark(folder: Path) -> None:
    assert tried(folder) == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('{"id": "ball", ', "{", "object 2 of render() (circle) has no id; give each object an id that it keeps"),
        ('{"id": "ball"', '{"id": "ground"', "two objects have the id 'ground'; the later one counts"),
        ('"x": self.x,', '"x": float("nan"),', "the object 'ball' cannot be drawn: its x is no finite number (nan)"),
        (
            '"type": "circle"',
            '"type": "sprite", "image": "bal"',
            "the object 'ball' shows the image 'bal', which is not in assets/",
        ),
    ],
)
def test_scenes_that_cannot_be_drawn_are_remarked_at_render(folder: Path, old: str, new: str, said: str) -> None:
    (folder / "assets").mkdir()
    (folder / "assets" / "ball.png").write_bytes(image())
    changed(folder, old, new)
    shorten(folder)
    remarks = tried(folder)
    assert f"agent.py:{line_of_render(folder)}: remark: render(): {said}" in remarks
    assert all(": remark: " in remark for remark in remarks), remarks


def test_an_image_that_cannot_be_used_is_remarked(folder: Path) -> None:
    (folder / "assets").mkdir()
    (folder / "assets" / "ball.svg").write_text("<svg/>")
    shorten(folder)
    (remark,) = tried(folder)
    assert remark.endswith("trial.scene: assets/ball.svg is no PNG, JPEG or WebP image; sprites show only these"), (
        remark
    )
    assert "remark" in remark


def test_objects_without_a_scene_are_a_mistake(folder: Path) -> None:
    config = folder / "config.yml"
    config.write_text(re.sub(r"  scene:\n(    .*\n)+", "", config.read_text()))
    (mistake,) = tried(folder)
    assert mistake == (
        f"agent.py:{line_of_render(folder)}: render() returned objects; say in config.yml how large the picture is, "
        "as trial.scene"
    )


def test_too_many_objects_are_a_mistake(folder: Path) -> None:
    changed(folder, "[self.ground(), self.ball(), self.stick()]", "[self.ball()] * 3000")
    (mistake,) = tried(folder)
    assert mistake == (f"agent.py:{line_of_render(folder)}: render() returned 3000 objects; a scene has at most 2000")


def test_an_info_that_is_too_large_for_the_recording_is_remarked(folder: Path) -> None:
    shorten(folder)
    changed(folder, "False, {}", 'False, {"seen": "x" * 2_000_000}')
    (remark,) = tried(folder)
    assert remark.endswith(
        ": remark: 'seen' in info is too large for the recording (2000002 bytes; all values of a step may have a "
        "megabyte as JSON): its size is recorded instead"
    )
    assert remark.startswith("agent.py:")
