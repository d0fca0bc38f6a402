"""The copy of a project that bots walk through, and the study that runs it."""

from __future__ import annotations

import errno
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.deployment.core.study_selection import selected
from hippodrome.local.rehearsal.command import _how_to_read
from hippodrome.local.rehearsal.study_process import StudyNotStarted, StudyProcess, copy_of
from hippodrome.trial.policies.places import _file

CONFIG = """
project: {id: pair, name: Pair, steps: {1: hello, 2: game, finalStep: bye}}
trial:
  game: pair
  players: {0: {a: human, b: policies/one.onnx}, 1: {a: human, b: "sample:two.onnx"}}
"""


def test_the_policies_of_the_copy_can_be_read(tmp_path: Path) -> None:
    project, copy = tmp_path / "mine", tmp_path / "copy"
    for name in ("policies/one.onnx", "two.onnx", "steps/hello.html", "steps/bye.html"):
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        (project / name).write_text(name)
    (project / "config.yml").write_text(CONFIG)
    copy_of(project, copy)
    for name in ("policies/one.onnx", "two.onnx"):
        assert _file(copy, name).read_text() == name
    assert yaml.safe_load((copy / "config.yml").read_text())["trial"]["ui"]["stop"]


def test_no_bot_waits_for_the_least_time_of_a_page(tmp_path: Path) -> None:
    project, copy = tmp_path / "mine", tmp_path / "copy"
    project.mkdir()
    steps = [
        {"hello": {"minSeconds": 60}},
        {"each": {"kind": ["a", "b"]}, "steps": [{"ask": {"minSeconds": 9}}]},
        "bye",
    ]
    (project / "config.yml").write_text(yaml.safe_dump({"project": {"id": "slow", "steps": steps}}))
    assert "no page has `minSeconds`" in copy_of(project, copy)
    assert "minSeconds" not in (copy / "config.yml").read_text()


def test_the_line_that_makes_tables_works_if_the_folder_is_not_named_as_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "config.yml").write_text("project: {id: maze}\n")
    monkeypatch.chdir(tmp_path)
    line = _how_to_read(Path("s"), Path("s/data-try/try-1"))
    assert line.endswith("hippodrome data s/ --from s/data-try/try-1")
    assert selected("s/").id == "maze"


def test_a_study_that_cannot_start_on_a_full_disk_says_that_it_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(**_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(StudyProcess, "_begin", lambda *_, **options: subprocess.Popen(["true"], **options))
    study = StudyProcess(tmp_path, tmp_path / "data")
    with pytest.raises(StudyNotStarted, match="printed nothing into"):
        study.start()
    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(StudyNotStarted, match=r"cannot be stored in .*/data: No space left on device\. Make room"):
        study.start()
