"""What the repository tells strangers and runs for them: workflows, citation, where to report."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.cli import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
MAKEFILE = (ROOT / "Makefile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
JOBS: dict[str, Any] = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text())["jobs"]


@pytest.mark.parametrize("job", JOBS)
def test_a_job_runs_commands_that_exist(job: str) -> None:
    lines = [line for step in JOBS[job]["steps"] for line in step.get("run", "").splitlines()]
    ours = [
        words for words in map(shlex.split, lines) if words[0] in {"make", "hippodrome"} or words[0].startswith(".ci/")
    ]
    assert ours
    for program, *arguments in ours:
        if program == "make":
            assert re.search(rf"^{arguments[0]}:.* ## ", MAKEFILE, re.M), arguments
        elif program == "hippodrome":
            assert arguments[0] in COMMANDS
        else:
            assert (ROOT / program).stat().st_mode & 0o111


@pytest.mark.parametrize("name", ["bug.yml", "study.yml"])
def test_the_forms_of_issues_name_commands_that_exist(name: str) -> None:
    named = re.findall(r"`hippodrome ([\w-]+)", (ROOT / ".github/ISSUE_TEMPLATE" / name).read_text())
    assert set(named) <= {*COMMANDS, "--version"}


def test_each_hook_runs_what_make_lint_installs() -> None:
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    tools = {hook["entry"].split()[0].removeprefix(".venv/bin/") for hook in repository["hooks"]}
    pinned = {line.partition("==")[0] for line in (ROOT / "requirements/dev.txt").read_text().splitlines()}
    assert tools <= pinned


def test_jobs_run_on_each_python_that_is_promised() -> None:
    (newest,) = set(re.findall(r"Python 3\.11 to 3\.(\d+)", (ROOT / "README.md").read_text()))
    promised = [f"3.{minor}" for minor in range(11, int(newest) + 1)]
    assert PROJECT["requires-python"] == f">={promised[0]}"
    assert [JOBS[job]["strategy"]["matrix"]["python"] for job in ("quick", "wheel")] == [promised, promised]


def test_the_citation_names_the_licence_and_leaves_the_version_to_pyproject() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["license"] == PROJECT["license"]
    assert "version" not in citation
