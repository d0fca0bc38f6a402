"""Output and options of all commands: progress, JSON, the study's name, and the targets of make that run them."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from hippodrome.cli import main
from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.core import options
from hippodrome.deployment.core.study_selection import StudySelection, selected

ROOT = Path(__file__).resolve().parents[2]


def run_make(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `make` as from a shell. Variables of a `make test` around it are removed, or make would print its folders."""
    told = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    return subprocess.run(["make", *arguments], cwd=ROOT, capture_output=True, text=True, check=False, env=told)


def make(*arguments: str) -> str:
    """Return the last command that `make -n` would run."""
    return run_make("-n", *arguments).stdout.splitlines()[-1]


def test_progress_is_a_line_without_a_terminal(capsys: Any) -> None:
    with screen.ProgressBars() as bar:
        bar.advance(bar.add_task("Uploading", total=3), 3)
    assert capsys.readouterr().err == "Uploading …\n"


def test_progress_is_a_bar_on_a_terminal(monkeypatch: Any) -> None:
    file = io.StringIO()
    monkeypatch.setattr(screen, "err", Console(file=file, force_terminal=True, width=80))
    with screen.ProgressBars() as bar:
        bar.advance(bar.add_task("Uploading", total=3), 3)
    assert "3/3" in file.getvalue()
    assert "Uploading …" not in file.getvalue()


def test_times_in_json_are_iso_8601(capsys: Any) -> None:
    screen.result_json({"at": datetime(2026, 11, 21, 18, 30, tzinfo=UTC)})
    assert json.loads(capsys.readouterr().out) == {"at": "2026-11-21T18:30:00+00:00"}


def study_here(folder: Path, project_id: str) -> None:
    folder.mkdir()
    (folder / "config.yml").write_text(f"project:\n  id: {project_id}\n  nonsense: true\n")


def test_a_study_is_named_by_its_id_or_its_folder(tmp_path: Path, monkeypatch: Any) -> None:
    folder = tmp_path / "maze"
    study_here(folder, "labyrinth")
    monkeypatch.chdir(tmp_path)
    assert selected("forest") == StudySelection("forest", None)
    for named in ("maze/", "./maze", str(folder)):
        assert selected(named) == StudySelection("labyrinth", Path(named))
    assert selected("labyrinth").folder is None
    monkeypatch.chdir(folder)
    assert selected(None) == selected(".") == selected("labyrinth") == StudySelection("labyrinth", Path())
    with pytest.raises(Problem, match=r"has no config\.yml"):
        selected("..")


def test_a_word_that_is_a_folder_and_may_be_another_studys_id_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    """Else `hippodrome stop maze` would stop the servers of another study than was meant."""
    study_here(tmp_path / "maze", "labyrinth")
    study_here(tmp_path / "forest", "forest")
    monkeypatch.chdir(tmp_path)
    assert selected("forest") == StudySelection("forest", Path("forest"))
    with pytest.raises(Problem, match="may be the folder maze/ here, whose study is labyrinth") as refused:
        selected("maze")
    assert refused.value.advice.startswith("Write maze/ for the folder")


@pytest.mark.parametrize("command", ["status", "doctor", "logs", "stop", "cost --spent"])
def test_no_command_takes_all_studies_by_itself(command: str, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == Exit.MISUSE
    assert "Name one, by its folder or its id; or add --all" in capsys.readouterr().err
    assert main([*command.split(), "maze", "--all"]) == Exit.MISUSE


@pytest.mark.parametrize("name", ["", "a b", "1x", "x" * 31, "pilot-", "pilot_2", "ärger"])
def test_the_name_of_a_stack_must_fit_its_bucket(name: str) -> None:
    assert options.stack_name("x" * 30)
    assert options.stack_name("pilot-2") == "pilot-2"
    with pytest.raises(Problem, match="cannot be the name"):
        options.stack_name(name)


@pytest.mark.parametrize("name", ["default", "Default", "xn--pilot", "sthree-x", "amzn-s3-demo-x"])
def test_names_that_aws_reserves_are_refused(name: str) -> None:
    assert options.stack_name("default-2") == "default-2"
    with pytest.raises(Problem, match="AWS reserves that name"):
        options.stack_name(name)


@pytest.mark.parametrize("target", ["status", "data", "logs", "stop", "doctor", "cost", "register", "deploy"])
def test_make_passes_the_study_on(target: str) -> None:
    words = " ".join(make(target, "PROJECT=../my maze", "ARGS=--json").split())
    assert f'hippodrome {target} "../my maze/" --json' in words
    assert ("--all" in make(target)) is (target in ("status", "logs", "stop", "doctor"))


def test_make_destroy_passes_no_study() -> None:
    assert "maze" not in make("destroy", "PROJECT=../maze")


def test_make_help_is_aligned_in_columns() -> None:
    shown = run_make("help").stdout.splitlines()
    assert len(shown) > 15
    assert {line.index(line[18:].lstrip()) for line in shown} == {20}


@pytest.mark.parametrize(("code", "ends"), [(0, 0), (3, 0), (1, 2), (4, 2)])
def test_make_plan_with_changes_is_no_error(tmp_path: Path, code: int, ends: int) -> None:
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text(f"#!/bin/sh\nexit {code}\n")
    python.chmod(0o755)
    for ready in ("local", "deploy"):
        (tmp_path / ready).touch()
    ran = run_make("plan", f"VENV={tmp_path}", f"BIN={tmp_path}/bin")
    assert ran.returncode == ends
    assert (f"Error {code}" in ran.stderr) is bool(ends)


def test_deploy_in_a_python_without_packages_continues_in_that_of_make(tmp_path: Path) -> None:
    """`-S` hides the packages, as in another Python of the machine."""
    for package in ("deploy", "hippodrome"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-I", "-S", "-c", "import sys; sys.path.insert(0, '.'); import deploy.__main__"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr.startswith("✗ The packages")
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text('#!/bin/sh\necho "$@"\n')
    python.chmod(0o755)
    (tmp_path / ".venv" / "deploy").touch()
    ran = subprocess.run([*command, "status", "--json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.stdout == "-m deploy status --json\n"


def test_the_end_of_the_input_declines(monkeypatch: pytest.MonkeyPatch) -> None:
    def ends() -> str:
        raise EOFError

    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", ends)
    with pytest.raises(Problem, match="Nothing was changed") as declined:
        screen.confirm("Go on?")
    assert declined.value.exit_code == Exit.DECLINED
