"""Whenever power fails: what was promised is on the disk, and no file is there in part (docs/data.md)."""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.ports import Conflict
from hippodrome.local.backend.documents import FolderDocuments
from hippodrome.trial.recordings.recording import Recording
from hippodrome.trial.recordings.store import FolderStore
from testing.power_cut import Disk

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the paths of handles are read from /proc")

STEPS = st.lists(st.tuples(st.sampled_from(["create", "replace", "record"]), st.integers(0, 2)), max_size=8)


class Study:
    """The writes of a study, and its promises, each from a moment of the disk's record on."""

    def __init__(self, root: Path, disk: Disk) -> None:
        self.disk = disk
        self.data, self.state = root / "data", root / "state"
        self.documents = FolderDocuments(self.data, self.state)
        self.store = FolderStore(self.data)
        self.promised: list[tuple[int, str, Any]] = []
        self.written: dict[str, list[bytes]] = {}  # by key, everything that a document may be

    def promise(self, kind: str, what: Any) -> None:
        self.promised.append((len(self.disk.record), kind, what))

    def do(self, what: str, number: int, count: int) -> None:
        key, body = f"p/users/u{number}/answers/1.json", f"{what} {count}".encode()
        if what == "create":
            self.written.setdefault(key, []).append(body)
            try:
                self.documents.create(key, body)
            except Conflict:
                self.written[key].pop()
            self.promise("document", (key, len(self.written[key])))
        elif what == "replace" and (found := self.documents.get(key)):
            self.written[key].append(body)
            self.documents.replace(key, body, found.etag)
            self.promise("document", (key, len(self.written[key])))
        elif what == "record":
            self._play(f"p/users/u{number}/trials/s-1/{count}.jsonl.gz", body)

    def _play(self, key: str, line: bytes) -> None:
        """Write a recording as the trial does: into the spool, then into the store, then removed from the spool."""
        kept = Recording(self.state / "spool" / f"{key}.part", key)
        kept.add(line + b"\n")
        kept.flush()
        kept.close()
        self.store.create(key, kept.path)
        self.promise("recording", (key, kept.path.read_bytes()))
        kept.path.unlink()


def cut(study: Study, root: Path, moment: int) -> list[str]:
    """Return the broken ones of the promises that were made before that moment."""
    broken = []
    documents = FolderDocuments(root / "data", root / "state")
    for key, bodies in study.written.items():
        found = documents.get(key)
        if found and found.body not in bodies:
            broken.append(f"{key} is {found.body!r}")
    for since, kind, what in study.promised:
        if since > moment:
            continue
        if kind == "document":
            key, version = what
            found = documents.get(key)
            if not found or found.body not in study.written[key][version - 1 :]:
                broken.append(f"{key}, version {version}")
        else:
            found = documents.get(what[0])
            if not found or found.body != what[1]:
                broken.append(f"recording {what[0]}")
    return broken


def play(steps: list[tuple[str, int]], place: Path, seed: int) -> list[str]:
    shutil.rmtree(place, ignore_errors=True)
    (place / "before").mkdir(parents=True)
    disk = Disk(place / "before")
    dice = random.Random(seed)
    with disk.recording():
        study = Study(disk.root, disk)
        for count, (what, number) in enumerate(steps):
            study.do(what, number, count)
    moment = dice.randint(0, len(disk.record))
    disk.after_cut(moment, lambda: dice.random() < 0.5, place / "after")
    return cut(study, place / "after", moment)


@given(steps=STEPS, seed=st.integers(0, 2**32))
def test_a_power_cut_breaks_no_promise(steps: list[tuple[str, int]], seed: int, tmp_path_factory: Any) -> None:
    place = Path(tmp_path_factory.getbasetemp()) / "power"
    assert play(steps, place, seed) == []


@pytest.mark.parametrize("lazy", ["sync_folder", "write_new"])
def test_without_a_sync_the_model_finds_a_broken_promise(
    lazy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same without one of the syncs breaks promises."""
    from hippodrome.protocol import disk

    without: dict[str, Callable[..., Any]] = {
        "sync_folder": lambda folder: None,
        "write_new": lambda path, data: path.write_bytes(data if isinstance(data, bytes) else data.read_bytes()),
    }
    monkeypatch.setattr(disk, lazy, without[lazy])
    steps = [("create", 0), ("create", 2), ("replace", 2), ("record", 1)]
    assert any(play(steps, tmp_path / "power", seed) for seed in range(20))
