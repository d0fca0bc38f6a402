"""The build context of a project's image: the same files give the same bundle."""

from __future__ import annotations

import os
import re
import shutil
import stat
import zipfile
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
    for made, name in ((first, "a.zip"), (second, "b.zip")):
        made.write_zip(tmp_path / name)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_every_part_of_the_image_changes_the_bundle(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = tmp_path / "hippodrome"
    for part in (
        "infra/Dockerfile",
        "requirements/trial.txt",
        "hippodrome/__init__.py",
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
    assert len(seen) == 9


def test_other_files_do_not_change_the_bundle(folder: Path) -> None:
    before = make_bundle(folder).hash
    write_study(folder, config="project: {}", steps__consent_DOT_html="other", data__x="1", _DOT_git__HEAD="x")
    (folder / "agent.py").write_text("class Agent:\n    pass\n")
    assert make_bundle(folder).hash == before


def test_the_zip_and_the_folder_hold_the_same_readable_files(folder: Path, tmp_path: Path) -> None:
    write_study(folder, tool="#!/bin/sh\n", private_DOT_txt="x")
    (folder / "tool").chmod(0o700)
    (folder / "private.txt").chmod(0o600)
    made = make_bundle(folder)
    made.write_folder(tmp_path / "context")
    made.write_zip(tmp_path / "context.zip")
    with zipfile.ZipFile(tmp_path / "context.zip") as archive:
        zipped = {
            info.filename: (info.external_attr >> 16, archive.read(info))
            for info in archive.infolist()
            if not info.is_dir()
        }
    there = [path for path in (tmp_path / "context").rglob("*") if path.is_file()]
    laid = {
        path.relative_to(tmp_path / "context").as_posix(): (path.stat().st_mode, path.read_bytes()) for path in there
    }
    assert zipped == laid
    assert stat.S_IMODE(laid["project/tool"][0]) == 0o755
    assert stat.S_IMODE(laid["project/private.txt"][0]) == 0o644
