"""The ports together: `start` delivers and cleans up, `close` ends."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.ports import TaskRequest, Topic
from hippodrome.functions import installed
from hippodrome.local.backend import platform as platform_module
from hippodrome.local.backend.platform import LocalPlatform
from testing.waiting import until
from tests.local.conftest import write_study

FAKE = (sys.executable, str(Path(__file__).parents[1] / "fake_trial.py"))
NAME = "saaaaaaaaaaaaaaaaaaaa-1"


def test_messages_timers_and_events_reach_their_functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform_module, "SWEEP_FIRST", 0.1)
    before = set(threading.enumerate())
    came: dict[str, list[Any]] = {"start": [], "stop": [], "task": [], "sweep": []}
    handlers = {name: lambda event, context, events=events: events.append(event) for name, events in came.items()}
    platform = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers=handlers, command=FAKE)
    platform.tasks.add_project("study", tmp_path)
    platform.start()
    try:
        assert installed.platform() is platform
        platform.bus.publish(Topic.START, {})
        platform.timers.set(NAME, platform.now(), {})
        platform.tasks.run(TaskRequest(NAME, "h", "h", 1, 2, {"TOKEN": "x", "PROJECT_ID": "study"}))
        until(lambda: all(came.values()))
    finally:
        platform.close(1)
    bodies = "".join(record["body"] for event in came["task"] for record in event["Records"])
    assert '"lastStatus":"STOPPED"' in bodies, "the functions see the end of the servers before they end themselves"
    for thread in set(threading.enumerate()) - before:
        if thread.name.startswith(("queue", "timers", "task", "end")):
            thread.join(60)
            assert not thread.is_alive(), thread.name


@pytest.mark.parametrize("kept", [True, False])
def test_recordings_of_a_study_that_is_not_served_any_more_are_kept_if_it_keeps_any(tmp_path: Path, kept: bool) -> None:
    folder = write_study(tmp_path / "study")
    config = (folder / "config.yml").read_text()
    if not kept:
        (folder / "config.yml").write_text(config.replace("trial:\n", "trial:\n  s3upload: false\n"))
    data, state, recording = tmp_path / "data", tmp_path / "state", f"quick/users/ada/trials/{NAME}/2-trial.jsonl.gz"
    first = LocalPlatform(data, state, project_folder=folder, handlers={})
    installed.use(first)
    first.publish()
    part = state / "spool" / f"{recording}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"half a game")
    (folder / "config.yml").write_text(config.replace("id: quick", "id: another"))
    later = LocalPlatform(data, state, project_folder=folder, handlers={})
    installed.use(later)
    later.publish()
    later.start()
    later.close()
    assert (data / recording).exists() is kept


def test_unfinished_files_of_a_killed_process_are_deleted(tmp_path: Path) -> None:
    first = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers={})
    left = [tmp_path / "state" / place / ".abc.new" for place in ("scratch", "tasks")]
    for path in left:
        path.write_bytes(b"half")
    first.start()
    first.close()
    assert not any(path.exists() for path in left)
