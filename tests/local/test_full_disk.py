"""What one machine does when the disk is full."""

from __future__ import annotations

import errno
import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.ports import Topic
from hippodrome.local.backend import bus as bus_module
from hippodrome.local.backend.bus import FolderBus
from hippodrome.local.backend.retry import Retry
from testing.waiting import until
from tests.local.backend.test_tasks import FAKE, NAME, Here, here, request  # noqa: F401 - a fixture


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "RETRY", (0.02, 0.02, 0.02, 0.02))


def test_refusals_of_the_machine_make_no_dead_letters(tmp_path: Path) -> None:
    retry, tries = Retry(lambda text: None), list[int]()

    def handler(event: Any, context: object) -> Any:
        tries.append(1)
        if len(tries) < 12:
            retry.report(OSError(errno.ENOSPC, "No space left on device"))
            raise OSError

    bus = FolderBus(tmp_path, {"start": handler}, lambda text: None, retry)
    bus.publish(Topic.START, {})
    bus.start()
    until(lambda: len(tries) == 12 and not list((tmp_path / "queue/start").iterdir()))
    bus.close(2)
    assert not (tmp_path / "dead").exists()


def test_an_exit_status_that_could_not_be_written_is_still_known(here: Here) -> None:  # noqa: F811
    """On a full disk the shell cannot write the exit status."""
    tasks = here.tasks()
    tasks.run(request(FAKE_STATUS="3"))
    here.wait("RUNNING")
    (here.state / "tasks" / f"{NAME}.exit").mkdir()
    os.kill(int((here.state / "tasks" / f"{NAME}.pid").read_text()), signal.SIGTERM)
    until(lambda: [event for event in here.events if event["detail"]["lastStatus"] == "STOPPED"] or _free(here))
    assert here.wait("STOPPED")["containers"][0]["exitCode"] == 3


def _free(here: Here) -> None:  # noqa: F811
    """Remove the folder that blocks the write once the server has ended."""
    if not here.processes():
        with suppress(FileNotFoundError):
            (here.state / "tasks" / f"{NAME}.exit").rmdir()
