"""The parts of docs/first-hour.md for which servers have to run: in a running installation, with the example study.

The commands are those that make runs for what the page says. The rest of the page is walked in `tests/ministack`.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model import ids
from hippodrome.control.model.server import Reason, ServerState
from hippodrome.deployment.core.participants import registered_projects
from tests import first_hour
from tests.deployment.installation import ROOT
from tests.deployment.running_installation import RunningInstallation, held

REHEARSE = 'make doctor ARGS="--rehearse"'
PLAY = 'make doctor ARGS="--rehearse --play 2 --transcript transcript.json"'
STATUS, DATA, COST = "make status", "make data ARGS=--aws", "make cost ARGS=--spent"
WITH_SERVERS = (REHEARSE, PLAY, STATUS, DATA, COST)
STUDY = "ms-pacman"


class Terminal(io.StringIO):
    """A terminal at which a person types this."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def running() -> Iterator[RunningInstallation]:
    """The installation after `make deploy`."""
    with pytest.MonkeyPatch.context() as patch, held(ROOT, patch, play=4.0, email="you@example.org") as world:
        yield world


def arguments(command: str) -> list[str]:
    """Return the arguments that make passes to `hippodrome`."""
    line = subprocess.run(
        ["make", "-n", *shlex.split(command)[1:]], cwd=ROOT, capture_output=True, text=True, check=True
    )
    (run,) = [one for one in line.stdout.splitlines() if "-m hippodrome" in one]
    words = shlex.split(run.partition("||")[0])
    return words[words.index("hippodrome") + 1 :]


def types(running: RunningInstallation, capsys: Any, command: str, answer: str = "") -> None:
    """Run a command of the page, and check that it prints what the page shows."""
    # Gap: there is no Internet that could be asked for the site and the zone.
    more = ["--only-aws"] if command.startswith("make doctor") else []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdin", Terminal(f"{answer}\n"))
        ran = running.run(capsys, *arguments(command), *more)
    assert ran.code == Exit.DONE, ran.err + ran.out
    said = ran.err.replace("Begin? [y/N] ", f"Begin? [y/N] {answer}\n") + ran.out  # a terminal echoes what is typed
    # This installation has a domain, the page's has none.
    said = said.replace(f"https://study.{running.root_domain}", "https://x.execute-api.ca-central-1.amazonaws.com")
    said = re.sub(r"(?m)^Certificate: .*\n", "", said)
    assert first_hour.differs(first_hour.shown()[command], said, running.root_domain) == "", said


def test_the_rehearsal_with_one_server_prints_what_the_page_shows(running: RunningInstallation, capsys: Any) -> None:
    types(running, capsys, REHEARSE)


def test_the_rehearsal_with_bots_prints_what_the_page_shows(
    running: RunningInstallation, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    types(running, capsys, PLAY, answer="y")
    assert json.loads((tmp_path / "transcript.json").read_text())["schema"] == 1


@pytest.fixture
def played(running: RunningInstallation) -> None:
    """A participant has taken part, and their server is gone."""
    (project,) = registered_projects(running.platform.documents)
    running.participant("me", answered=5, project=project)
    now = datetime.now(UTC)
    # Today, as the page shows.
    then = max(now - timedelta(minutes=5), now.replace(hour=0, minute=0, second=0, microsecond=0))
    running.record("me", ServerState.CLOSED, project, closed=then, reason=Reason.STOPPED)
    lines = [{"kind": "header", "v": 1}, {"kind": "reset"}, {"kind": "step", "reward": 10.0}]
    name = ids.server_name(ids.server_label(STUDY, "me"), 1)
    body = gzip.compress("".join(f"{json.dumps(line)}\n" for line in lines).encode())
    running.put(f"{STUDY}/users/me/trials/{name}/3-episode-0001.jsonl.gz", body)


@pytest.mark.parametrize("command", [STATUS, DATA, COST])
def test_the_results_are_shown_as_the_page_says(
    running: RunningInstallation,
    played: None,
    capsys: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    for name in ("config.yml", "agent.py"):  # in a folder of its own: `make data` writes into it
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "steps", tmp_path / "steps")
    monkeypatch.chdir(tmp_path)
    types(running, capsys, command)
