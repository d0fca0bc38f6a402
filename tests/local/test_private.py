"""Answers are personal data: on one machine the files of a study are their owner's alone; and a start that fails says why."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.local.conftest import Local
from tests.local.walk import at_the_game

Make = Callable[..., Local]


@pytest.fixture(autouse=True)
def usual_umask() -> Iterator[None]:
    """Set the umask of most machines, under which everybody may read new files."""
    before = os.umask(0o022)
    yield
    os.umask(before)


def open_to_others(*folders: Path) -> list[str]:
    found = []
    for path in (path for folder in folders for path in (folder, *folder.rglob("*"))):
        with suppress(FileNotFoundError):  # this message has been delivered meanwhile
            mode = path.stat().st_mode
            found += [f"{path} {mode:o}"] if mode & 0o077 else []
    return found


def test_only_the_owner_may_read_the_files_of_a_study(local: Make) -> None:
    here = local(frames=30).run()
    walker = at_the_game(here.url)
    assert walker.play(walker.until("ready"))["score"] == 30
    walker.answer(word="two")
    here.wait_for_text(r"server gone \(stopped\)")
    made = {path.name for path in here.data.rglob("*")} | {path.name for path in here.state.rglob("*")}
    assert {"2.json", "2-episode-0001.jsonl.gz", "functions.log", "spool"} <= made
    assert open_to_others(here.data, here.state.parent) == []


def test_a_data_folder_that_others_can_read_is_reported_and_left_as_it_is(local: Make) -> None:
    here = local()
    here.data.mkdir()
    here.run()
    here.wait_for_text("Other users of this machine can read the folder data. To change that: chmod -R go-rwx data")
    assert here.data.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("where", ["file/data", "file/deep/data"])
def test_a_place_where_nothing_can_be_written_is_reported_in_a_sentence(local: Make, where: str) -> None:
    here = local()
    (here.place / "file").write_text("no folder")
    assert here.begin("--data", where).wait(60) == 1
    assert f"The study cannot run with the data in {where}: Not a directory." in here.text()
    assert "--data FOLDER" in here.text()
    assert "Traceback" not in here.text()
