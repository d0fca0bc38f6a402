"""Helpers that make a mistake in a study and return what `make check` prints about it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from hippodrome.control.config import read_project
from hippodrome.local.check import agent as agent_check
from hippodrome.local.check.command import check_project
from testing import processes
from tests.local.conftest import ROOT


def page(folder: Path, text: str, name: str = "hello") -> None:
    """Write a page."""
    (folder / "steps" / f"{name}.html").write_text(text)


def config(folder: Path, old: str, new: str) -> None:
    """Replace this text of config.yml."""
    file = folder / "config.yml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def agent(folder: Path, old: str, new: str) -> None:
    """Replace this text of agent.py."""
    file = folder / "agent.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def looked(folder: Path) -> list[str]:
    """Return the findings without a try of the agent."""
    return [str(problem) for problem in check_project(folder, read_project(folder))]


def tried(folder: Path, seconds: float = 60) -> list[str]:
    """Return the findings of a try of the agent."""
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder), seconds)]


def run(folder: Path) -> tuple[int, list[str]]:
    """Return the exit status and the lines of the command."""
    said = folder.parent / "said.log"
    with said.open("w") as errors:
        done = processes.start(
            "hippodrome",
            ["check", str(folder)],
            cwd=folder.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=errors,
        )
    try:
        output = done.communicate(timeout=60)[0]
    finally:
        done.kill()
    assert "Traceback" not in said.read_text(), said.read_text()
    assert done.returncode is not None
    return done.returncode, output.splitlines()
