"""A server that is forked (`testing/forked_servers.py`) is to the system, and to `local/`, what a started one is."""

from __future__ import annotations

import json
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from local.backend import processes
from local.backend.health import port_in
from local.backend.tasks import PYTHON_TRIAL
from testing import forked_servers, preloaded
from testing.waiting import until

SHOWN = ("PORT", "PROJECT_ID", "SERVER", "STORE", "TRIAL", "USER_ID")


class Server:
    """A server, and the process that waits for it."""

    def __init__(self, folder: Path, spawn: Any, **variables: str) -> None:
        self.state, self.log, self.notes = folder / "state", folder / "log", folder / "state" / "tasks" / "one"
        self.notes.parent.mkdir(parents=True)
        (folder / "agent").mkdir()
        environment = {
            **os.environ,
            "PYTHONPATH": str(preloaded.ROOT),
            "HOST": "127.0.0.1",
            "PORT": "0",
            "TLS": "off",
            "PROJECT_ID": "study",
            "USER_ID": "P1",
            "SERVER": "a1",
            "TOKEN": "secret",
            "GAME_STEPS": "3",
            "STORE": str(folder / "store"),
            "TRIAL": json.dumps({"game": "a game", "maxSteps": 70}),
            **variables,
        }
        self.mark = processes.mark_of(self.state, "one")
        self.shell = spawn(
            PYTHON_TRIAL, self.notes, self.log, mark=self.mark, folder=folder / "agent", environment=environment
        )

    def process(self) -> psutil.Process:
        """Return the server's process, once the server listens."""
        until(lambda: port_in(self.log), 60)
        found = processes.child_of(self.shell.pid, self.mark)
        assert found, self.log.read_text()
        return found

    def note(self, kind: str) -> str:
        return self.notes.with_name(f"one.{kind}").read_text()


@pytest.fixture(params=[processes.spawn, forked_servers.spawn], ids=["started", "forked"])
def spawn(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    if request.param is forked_servers.spawn and not hasattr(os, "pidfd_open"):
        pytest.skip("this system does not fork servers")
    yield request.param
    processes.end_everything(tmp_path / "state")


def test_the_system_shows_the_server_and_the_shell_that_waits_for_it(spawn: Any, tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        server = Server(tmp_path, spawn)
    finally:
        os.umask(before)
    command = [PYTHON_TRIAL[0], "-X", server.mark, *PYTHON_TRIAL[1:]]
    shell = psutil.Process(server.shell.pid)
    # `Popen` returns before the system has finished the start of the program: for a moment it shows no words.
    until(shell.cmdline, 60)
    seen = [word for word in shell.cmdline() if word.strip()]
    assert seen == ["/bin/sh", "-c", processes.SHELL, str(server.notes), *command]
    assert processes.is_shell(shell)
    process = server.process()
    assert [word for word in process.cmdline() if word.strip()] == command
    assert not processes.is_shell(process)
    assert {one.pid for one in processes.marked(server.state)["one"]} == {server.shell.pid, process.pid}
    assert [process.environ()[name] for name in SHOWN] == [
        *("0", "study", "a1", str(tmp_path / "store"), '{"game": "a game", "maxSteps": 70}', "P1")
    ]
    assert process.cwd() == str(tmp_path / "agent")
    assert os.getsid(process.pid) == os.getpgid(process.pid) == server.shell.pid
    assert until(lambda: server.note("pid"), 60) == f"{process.pid}\n"
    assert server.notes.with_name("one.pid").stat().st_mode & 0o777 == 0o640, "it has the caller's umask"
    if hasattr(process, "rlimit"):
        assert process.rlimit(resource.RLIMIT_NOFILE) == resource.getrlimit(resource.RLIMIT_NOFILE)
    assert server.shell.poll() is None
    process.send_signal(signal.SIGTERM)
    assert (server.shell.wait(), server.note("exit")) == (0, "0\n")
    assert (server.shell.wait(), server.shell.poll(), server.shell.returncode) == (0, 0, 0)


def test_a_server_that_was_killed_has_the_shells_exit_code(spawn: Any, tmp_path: Path) -> None:
    server = Server(tmp_path, spawn)
    server.process().kill()
    assert (server.shell.wait(), server.note("exit")) == (137, "137\n")


def test_the_group_of_the_shell_can_be_killed(spawn: Any, tmp_path: Path) -> None:
    server = Server(tmp_path, spawn)
    process = server.process()
    processes.kill_group(server.shell.pid)
    assert server.shell.wait() == -signal.SIGKILL
    process.wait(60)
    assert not server.notes.with_name("one.exit").exists()


def test_wrong_settings_have_their_sentence_in_the_log_and_their_exit_code(spawn: Any, tmp_path: Path) -> None:
    server = Server(tmp_path, spawn, TRIAL="no JSON")
    assert (server.shell.wait(), server.note("exit")) == (2, "2\n")
    (line,) = server.log.read_text().splitlines()
    assert line.startswith("trial: TRIAL")
