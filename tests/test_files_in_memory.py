"""Temporary files of a whole run of the tests, in memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests import files_in_memory


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that counts as memory."""
    monkeypatch.setenv("TMPDIR", tempfile.gettempdir())
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(files_in_memory, "ROOM", 1)
    (tmp_path / "memory").mkdir()
    return tmp_path / "memory"


def test_this_process_and_those_that_it_starts_have_their_temporary_files_there(memory: Path) -> None:
    folder = files_in_memory.use(memory)
    assert folder is not None
    assert folder.parent == memory
    script = "import tempfile; print(tempfile.gettempdir())"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()
    assert tempfile.gettempdir() == told == str(folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("name", ["_free", "_available"])
def test_with_little_room_or_little_memory_the_files_stay_where_they_are(
    memory: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    before = tempfile.gettempdir()
    monkeypatch.setattr(files_in_memory, "ROOM", 1000)
    monkeypatch.setattr(files_in_memory, name, lambda *_: 999)
    assert files_in_memory.use(memory) is None
    assert tempfile.gettempdir() == before
    assert list(memory.iterdir()) == []


def test_where_programs_cannot_run_the_files_stay_where_they_are(memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "chmod", lambda *_: None)  # the program is no program, as with the option `noexec`
    assert files_in_memory.use(memory) is None
    assert list(memory.iterdir()) == []


def test_without_such_a_file_system_nothing_changes(memory: Path) -> None:
    assert files_in_memory.use(memory / "missing") is None


def test_the_folder_of_a_killed_run_is_removed_and_that_of_another_run_stays(memory: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for process in (ended.pid, os.getppid()):
        (memory / f"hippodrome-tests-{process}-abc").mkdir()
        (memory / f"hippodrome-tests-{process}-abc" / "file").touch()
    (memory / "others").mkdir()
    folder = files_in_memory.use(memory)
    assert folder is not None
    assert {path.name for path in memory.iterdir()} == {f"hippodrome-tests-{os.getppid()}-abc", "others", folder.name}
