"""One call is refused: what each part of local mode does then. A sample of all calls: `test_faults.py`."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.ports import DnsRecord, Topic
from hippodrome.local import watch as watch_module
from hippodrome.local.backend import bus as bus_module
from hippodrome.local.backend import platform as platform_module
from hippodrome.local.backend import retry as retry_module
from hippodrome.local.backend import timers as timers_module
from hippodrome.local.backend.bus import FolderBus
from hippodrome.local.backend.dns import FileDns
from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.backend.retry import Retry
from hippodrome.local.backend.timers import FolderTimers
from hippodrome.local.publish import publish
from hippodrome.local.watch import Watch
from testing.os_faults import OsCall, OsFault, OsFaultInjector, OsReach
from testing.waiting import until
from tests.local.backend.test_tasks import FAKE, NAME, Here, here, request  # noqa: F401 - a fixture
from tests.local.conftest import write_study

MESSAGE = "queue/start/MESSAGE.json"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "RETRY", (0.02, 0.02, 0.02, 0.02))
    monkeypatch.setattr(timers_module, "AGAIN", 0.05)
    monkeypatch.setattr(retry_module, "LONGEST", 0.1)
    for module in (platform_module, watch_module):
        monkeypatch.setattr(module, "LOOK", 0.05)


@pytest.fixture
def refusing(tmp_path: Path) -> Iterator[Callable[..., OsFaultInjector]]:
    """Makes calls for files below the folder fail with the given fault."""
    injector = OsFaultInjector(tmp_path)
    with injector.installed():

        def begin(
            operation: str, place: str, number: int = 1, reach: OsReach = OsReach.ONCE, error: int = errno.EMFILE
        ) -> OsFaultInjector:
            injector.calls.clear()
            injector.struck = 0
            injector.fault = OsFault(OsCall(operation, place), number, reach, error)
            return injector

        yield begin


@pytest.mark.parametrize(("operation", "error"), [("rename", errno.ENOSPC), ("unlink", errno.EIO)])
def test_a_message_whose_file_cannot_be_changed_is_delivered(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector], operation: str, error: int
) -> None:
    came: list[Any] = []
    bus = FolderBus(tmp_path, {"start": lambda event, context: came.append(event)}, lambda text: None)
    bus.publish(Topic.START, {})
    injector = refusing(operation, MESSAGE, error=error)
    bus.start()
    until(lambda: came and not list((tmp_path / "queue/start").iterdir()))
    bus.close(2)
    assert injector.struck == 1


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


def test_a_message_that_cannot_be_read_stops_the_start_and_is_kept(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector]
) -> None:
    FolderBus(tmp_path, {}).publish(Topic.START, {"n": 1})
    refusing("open", MESSAGE)
    with pytest.raises(OSError, match="Too many open files"):
        FolderBus(tmp_path, {})
    assert FolderBus(tmp_path, {}).take("start") == [{"n": 1}]


def test_a_timer_that_cannot_be_read_when_it_is_due_fires_later(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector]
) -> None:
    fired: list[Any] = []
    timers = FolderTimers(tmp_path, fired.append, lambda text: None)
    timers.start()
    injector = refusing("open", "timers/soon.json")
    timers.set("soon", datetime.now(UTC) - timedelta(seconds=1), {"n": 1})
    until(lambda: fired)
    timers.close()
    assert fired == [{"n": 1}]
    assert injector.struck == 1


def test_names_that_cannot_be_read_are_not_overwritten(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector]
) -> None:
    names = FileDns(tmp_path)
    one, two = (DnsRecord(f"s{'a' * 20}-{n}.localhost", "127.0.0.1") for n in (1, 2))
    names.change(add=[one])
    refusing("open", "names.json")
    with pytest.raises(OSError, match="Too many open files"):
        names.change(add=[two])
    names.change(add=[two])
    assert list(names.list()) == [one, two]


@pytest.mark.parametrize(
    "call", [OsCall("list", "data"), OsCall("stat", "data/_servers"), OsCall("open", "data/project_master_list.json")]
)
def test_data_that_cannot_be_listed_do_not_count_as_deleted(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector], call: OsCall
) -> None:
    told: list[str] = []
    others = set(threading.enumerate())
    platform = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers={}, say=told.append)
    platform.documents.create("_servers/one.json", b"{}")
    platform.documents.create("project_master_list.json", b"{}")
    platform.start()
    try:
        time.sleep(0.2)
        injector = refusing(*call, reach=OsReach.SPELL, error=errno.EIO)
        until(lambda: injector.struck)
        until(lambda: [line for line in told if "Input/output error" in line])
        time.sleep(0.6)  # longer than the fault lasts, and for several looks
    finally:
        platform.close(1)
    assert not [line for line in told if "DELETED" in line]
    assert [line for line in told if "Input/output error" in line]
    assert len(set(threading.enumerate()) - others) < 50


def test_files_of_a_project_that_cannot_be_listed_do_not_count_as_deleted(
    tmp_path: Path, refusing: Callable[..., OsFaultInjector]
) -> None:
    study = write_study(tmp_path / "study")
    platform = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers={}, say=lambda text: None)
    platform_module.installed.use(platform)
    told: list[str] = []
    watch = Watch(
        study,
        publish(study, platform.documents),
        lambda: publish(study, platform.documents),
        lambda config: None,
        told.append,
    )
    watch.start()
    try:
        injector = refusing("list", "study/steps", reach=OsReach.SPELL)
        until(lambda: injector.struck)
        time.sleep(0.6)
        assert not [line for line in told if "gone" in line or "changed" in line]
        injector = refusing("rename", "data/quick/steps/hello.html", error=errno.ENOSPC)
        (study / "steps/hello.html").write_text("<h1>Good day</h1>")
        until(lambda: b"Good day" in (tmp_path / "data/quick/steps/hello.html").read_bytes())
    finally:
        watch.close()
        platform_module.installed.use(None)
    assert injector.struck == 1
    assert [line for line in told if "goes on as it was. The disk is full" in line]


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
