"""The build context of a project's image: the same files give the same bundle."""

from __future__ import annotations

import os
import re
import shutil
import stat
from pathlib import Path

import pytest

from hippodrome import places
from hippodrome.deployment.study.image.bundle import make_bundle
from tests.deployment.registering import write_study

ROOT = Path(__file__).resolve().parents[3]


def test_the_same_files_in_another_folder_give_the_same_bundle(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere"
    shutil.copytree(folder, other)
    os.utime(other / "agent.py", (1, 1))
    first, second = make_bundle(folder), make_bundle(other)
    assert first.hash == second.hash
    assert re.fullmatch("[0-9a-f]{12}", first.hash)


def test_every_part_of_the_image_changes_the_bundle(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = tmp_path / "hippodrome"
    for part in (
        "infra/Dockerfile",
        "requirements/trial.txt",
        "hippodrome/__init__.py",
        "hippodrome/llm.py",
        "hippodrome/protocol/trial.py",
        "hippodrome/trial/server/server.py",
    ):
        (here / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / part, here / part)
    monkeypatch.setattr(places, "ROOT", here)
    monkeypatch.setattr(places, "PACKAGES", here)
    seen = {make_bundle(folder).hash}
    for file in (
        here / "infra/Dockerfile",
        here / "requirements/trial.txt",
        here / "hippodrome/llm.py",
        here / "hippodrome/protocol/trial.py",
        here / "hippodrome/trial/server/server.py",
        folder / "agent.py",
    ):
        file.write_text(file.read_text() + "\n")
        seen.add(make_bundle(folder).hash)
    write_study(folder, requirements_DOT_txt="numpy", agent_DOT_py="class Agent: pass")
    seen.add(make_bundle(folder).hash)
    (folder / "agent.py").rename(folder / "agent2.py")
    seen.add(make_bundle(folder).hash)
    (folder / "agent2.py").chmod(0o755)
    seen.add(make_bundle(folder).hash)
    assert len(seen) == 10


def test_other_files_do_not_change_the_bundle(folder: Path) -> None:
    before = make_bundle(folder).hash
    write_study(folder, config="project: {}", steps__consent_DOT_html="other", data__x="1", _DOT_git__HEAD="x")
    (folder / "agent.py").write_text("class Agent:\n    pass\n")
    assert make_bundle(folder).hash == before


def test_the_files_of_the_context_are_readable_for_all(folder: Path, tmp_path: Path) -> None:
    write_study(folder, tool="#!/bin/sh\n", private_DOT_txt="x")
    (folder / "tool").chmod(0o700)
    (folder / "private.txt").chmod(0o600)
    make_bundle(folder).write_folder(tmp_path / "context")
    assert stat.S_IMODE((tmp_path / "context/project/tool").stat().st_mode) == 0o755
    assert stat.S_IMODE((tmp_path / "context/project/private.txt").stat().st_mode) == 0o644
