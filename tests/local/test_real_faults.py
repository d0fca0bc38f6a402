"""A real `hippodrome run` to which the system really refuses something: another file system, no more files, no room."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from hippodrome.local.backend.processes import end_everything
from hippodrome.local.rehearsal.study_process import servers_of
from hippodrome.trial.recordings import recording
from testing.waiting import until
from tests.local.conftest import ROOT, Local
from tests.local.test_run import _gone
from tests.local.walk import Walker, at_the_game

Make = Callable[..., Local]
OTHER = next(
    (
        place
        for place in (Path("/dev/shm"), Path("/var/tmp"))
        if place.is_dir() and place.stat().st_dev != Path(tempfile.gettempdir()).stat().st_dev
    ),
    None,
)
"""A folder on another file system than that of the temporary files."""
linux = pytest.mark.skipif(
    sys.platform != "linux", reason="the limits of a running process are changed with prlimit(2)"
)


@contextmanager
def limited(here: Local, what: int, to: int) -> Iterator[None]:
    """Lower a limit of the running process, as `ulimit` does, and raise it again."""
    assert here.process
    before = resource.prlimit(here.process.pid, what)
    resource.prlimit(here.process.pid, what, (to, before[1]))
    try:
        yield
    finally:
        with suppress(ProcessLookupError):  # the process may have been killed meanwhile
            resource.prlimit(here.process.pid, what, before)


def begun(here: Local) -> tuple[Walker, dict[str, Any]]:
    """Return a participant who has played for a while, and the server's state on their page."""
    walker = at_the_game(here.url)
    state = walker.until("ready")
    with walker.connect(state) as game:
        game.send(json.dumps({"command": "start"}))
        for _ in range(60):
            game.recv(timeout=60)
        (part,) = (here.state / "spool").rglob("*.part")
        until(lambda: any(line["kind"] == "step" for line in recording.read(part.read_bytes())))
    return walker, state


def kill_server(here: Local) -> None:
    for process in servers_of(here.data, {"P1"}):
        os.kill(process.pid, signal.SIGKILL)
    here.let_go_on()


def goes_on(here: Local, walker: Walker) -> None:
    """The participant gets another server and comes to the end; both recordings are where they belong."""
    walker.play(walker.until("ready", 60, attempt=2))
    walker.answer(word="two")
    assert "<h1>end</h1>" in walker.page()
    _gone(here)
    assert here.end() == 0
    assert not list((here.state / "spool").rglob("*.part"))
    folders = {path.parent.name[-2:] for path in here.data.rglob("*.jsonl.gz")}
    assert folders == {"-1", "-2"}
    assert {json.loads(path.read_text())["state"] for path in (here.data / "_servers").iterdir()} == {"closed"}


@pytest.mark.skipif(
    OTHER is None,
    reason="there is no other file system here",
)
def test_a_study_goes_on_with_its_state_on_another_file_system(local: Make) -> None:
    here = local(frames=240, holds=120)
    other = Path(tempfile.mkdtemp(dir=OTHER))
    try:
        (here.place / ".hippodrome").symlink_to(other)
        here.run()
        walker, _ = begun(here)
        kill_server(here)
        goes_on(here, walker)
    finally:
        end_everything(here.state)
        shutil.rmtree(other)


@linux
@pytest.mark.parametrize("restart", [pytest.param(False, marks=pytest.mark.hunt), True], ids=["", "killed meanwhile"])
def test_a_server_lost_while_no_files_can_be_opened_is_replaced(local: Make, restart: bool) -> None:
    here = local(frames=240, holds=120).run()
    walker, _ = begun(here)
    assert here.process
    used = len(os.listdir(f"/proc/{here.process.pid}/fd"))
    with limited(here, resource.RLIMIT_NOFILE, used):
        kill_server(here)
        here.wait_for_text("cannot open more files")
        time.sleep(1)
        if restart:
            here.kill()
    if restart:
        here.run("--port", here.url.rpartition(":")[2])
    assert here.text().count("cannot open more files") <= 1
    goes_on(here, walker)


@linux
def test_silent_connections_that_use_up_all_files_do_not_stop_the_study(local: Make) -> None:
    here = local().run()
    port = int(here.url.rpartition(":")[2])
    assert here.process
    used = len(os.listdir(f"/proc/{here.process.pid}/fd"))
    with limited(here, resource.RLIMIT_NOFILE, used + 40), ExitStack() as silent:
        for _ in range(200):
            silent.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5))
        until(lambda: _well(here))
    assert "Traceback" not in here.text()
    assert here.text().count("cannot open more files") <= 1
    assert here.end() == 0


def _well(here: Local) -> bool:
    try:
        return httpx.get(f"{here.url}/healthz", timeout=2).status_code == 200
    except httpx.HTTPError:
        return False


@linux
@pytest.mark.parametrize("restart", [False, pytest.param(True, marks=pytest.mark.hunt)], ids=["", "killed meanwhile"])
def test_a_server_lost_while_nothing_can_be_written_is_replaced(local: Make, restart: bool) -> None:
    """No file may grow (RLIMIT_FSIZE is 0), as on a full disk."""
    here = local(frames=240, holds=120)
    here.through_pipe = True
    here.run()
    walker, _ = begun(here)
    with limited(here, resource.RLIMIT_FSIZE, 0):
        kill_server(here)
        here.wait_for_text("it is tried again until it works")
        time.sleep(1)
        if restart:
            here.kill()
    if restart:
        here.run("--port", here.url.rpartition(":")[2])
    assert "Traceback" not in here.text()
    goes_on(here, walker)


@linux
def test_a_start_where_nothing_can_be_written_is_reported_in_a_sentence(local: Make) -> None:
    here = local()
    command = f"ulimit -f 0; exec {sys.executable} -m hippodrome run {here.folder} --port 0"
    made = subprocess.run(
        ["/bin/sh", "-c", command],
        cwd=here.place,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert made.returncode == 1
    assert f"The study cannot run with the data in {here.folder}/data: File too large." in made.stderr
    assert "Traceback" not in made.stdout + made.stderr
