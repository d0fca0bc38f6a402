"""Files outlive a power cut, and no bytes are lost when the system writes only a part of them."""

from __future__ import annotations

import gzip
import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.protocol import disk
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recorder import Spool
from hippodrome.trial.recordings.recording import Recording, line
from hippodrome.trial.recordings.store import FolderStore

ROOT = Path(__file__).resolve().parents[3]


class PartialFile(io.FileIO):
    """A file that writes at once as many bytes as `takes` says; at 0 it fails, as a disk that is full for a moment."""

    takes: list[int]

    def write(self, data: Any, /) -> int:
        most = self.takes.pop(0) if self.takes else len(data)
        if most == 0:
            raise OSError(28, "No space left on device")
        return super().write(bytes(data)[:most])


@given(takes=st.lists(st.integers(0, 40), max_size=12), flushes=st.lists(st.booleans(), min_size=1, max_size=12))
def test_a_short_write_loses_nothing(takes: list[int], flushes: list[bool], tmp_path_factory: Any) -> None:
    path = tmp_path_factory.mktemp("recording") / "r.part"
    kept = Recording(path, "r")
    kept._file.close()
    kept._file = PartialFile(path, "w")  # type: ignore[assignment]
    kept._file.takes = list(takes)
    for number, flush in enumerate(flushes):
        kept.add(line("step", step=number))
        if flush:
            _until_it_works(kept.flush)
    _until_it_works(kept.close)
    lines = gzip.decompress(path.read_bytes()).splitlines()
    assert len(lines) == len(flushes)


def _until_it_works(act: Any) -> None:
    """Call it until it works, as the trial does."""
    while True:
        try:
            return act()
        except OSError:
            continue


def test_only_their_owner_may_read_the_files_of_a_trial(tmp_path: Path) -> None:
    """`main` sets the permissions first. They also hold for files that the agent's own programs write."""
    program = (
        "import os, subprocess, sys; from hippodrome.trial.__main__ import main; code = main()\n"
        "from hippodrome.trial.recordings.store import FolderStore; FolderStore(__import__('pathlib').Path(sys.argv[1])).create('a/b', b'')\n"
        "subprocess.run(['touch', sys.argv[1] + '/touched'], check=True); sys.exit(code)"
    )
    before = os.umask(0o022)
    try:
        ran = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)],
            cwd=ROOT,
            capture_output=True,
            check=False,
            env={"PATH": os.environ["PATH"]},
        )
    finally:
        os.umask(before)
    assert ran.returncode == 2, "it has no settings"
    made = sorted(tmp_path.rglob("*"))
    assert [path.name for path in made] == ["a", "b", "touched"]
    assert [path.name for path in made if path.stat().st_mode & 0o077] == []


def spool(folder: Path, *, keep: bool) -> Spool:
    made: Any = SimpleNamespace(spool=folder if keep else None, trial=SimpleNamespace(s3upload=not keep))
    return Spool(made, FolderStore(folder))


@pytest.mark.parametrize("keep", [True, False], ids=["kept in the spool", "stored in the same folder"])
def test_a_recording_never_takes_the_name_of_a_finished_one(tmp_path: Path, keep: bool) -> None:
    first = spool(tmp_path, keep=keep).open("p/3-trial.jsonl.gz")
    first.close()
    first.path.rename(first.path.with_suffix(""))
    second = spool(tmp_path, keep=keep).open("p/3-trial.jsonl.gz")
    assert second.key == "p/3-trial-2.jsonl.gz"
    second.close()
    second.path.rename(second.path.with_suffix(""))
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == ["3-trial-2.jsonl.gz", "3-trial.jsonl.gz"]


def test_a_recording_in_which_nothing_was_written_is_not_stored(tmp_path: Path) -> None:
    written = spool(tmp_path, keep=True)
    written.open("p/2-trial.jsonl.gz")
    recorded = written.open("p/3-trial.jsonl.gz")
    recorded.add(line("header"))
    recorded.flush()
    assert written.leftovers("p") == [("p/3-trial.jsonl.gz", recorded.path)]
    assert [path.name for path in (tmp_path / "p").iterdir()] == [recorded.path.name]


def test_an_open_recording_is_synced_every_few_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[tuple[float, int]] = []
    clock = [0.0]
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (synced.append((clock[0], os.fstat(handle).st_ino)), fsync(handle)))
    monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    kept = Recording(tmp_path / "r.part", "r")
    file, folder = (tmp_path / "r.part").stat().st_ino, tmp_path.stat().st_ino
    synced.clear()
    for half_seconds in range(1, 25):
        clock[0] = half_seconds / 2
        kept.add(line("step", step=half_seconds))
        kept.flush()
    assert synced == [(5.0, file), (5.0, folder), (10.0, file)], "twice in twelve seconds, and once its name"
    kept.close()
    assert synced[3:] == [(12.0, file)]
    clock[0] = 20.0
    kept.flush()
    kept.close()
    assert len(synced) == 4, "what is closed is on the disk"


def test_bytes_are_synced_before_they_get_their_name_and_the_name_before_it_is_promised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    fsync, link = os.fsync, os.link

    def name(handle: int) -> str:
        return Path(os.readlink(f"/proc/self/fd/{handle}")).name

    monkeypatch.setattr(os, "fsync", lambda handle: (told.append(f"sync {name(handle)}"), fsync(handle)))
    monkeypatch.setattr(os, "link", lambda source, path: (told.append(f"link {path.name}"), link(source, path)))
    assert FolderStore(tmp_path).create("p/answers/3.json", b"{}") is True
    assert [word for word in told if ".new" not in word] == [
        f"sync {tmp_path.name}",  # the folder p is new
        "sync p",  # and so is the folder answers in it
        "link 3.json",
        "sync answers",
    ]
    assert told[2].startswith("sync .")
    told.clear()
    assert FolderStore(tmp_path).create("p/answers/3.json", b"other") is False
    assert told[-1] == "sync answers", "another process may have been cut off before that"


def test_a_move_to_another_file_system_is_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = os.link

    def refuse(source: Any, path: Any) -> None:
        if Path(source).parent != Path(path).parent:
            raise OSError(18, "Invalid cross-device link")
        link(source, path)

    monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "here/r.part").write_bytes(b"half a game")
    disk.move(tmp_path / "here/r.part", tmp_path / "there/r")
    assert (tmp_path / "there/r").read_bytes() == b"half a game"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["r"]
