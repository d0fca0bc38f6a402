"""The stores' contract: a folder, and the bucket behind presigned requests."""

from __future__ import annotations

import errno
import gzip
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pytest

from hippodrome.control.model import server
from hippodrome.protocol import disk
from hippodrome.trial.recordings.store import Store, open_store, store_file
from testing.strict_s3 import StrictS3
from testing.studies import study

FOLDER = "study/users/P1"
ANSWER = f"{FOLDER}/answers/3.json"


class OpenedStore(NamedTuple):
    """A store, a recording's key, and a function that reads stored bytes: a server may not read its own recordings."""

    store: Store
    recording: str
    kept: Callable[[str], bytes]


@pytest.fixture(params=["folder", "presigned"])
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[OpenedStore]:
    with StrictS3().serving() as bucket:
        project, now = study(id="study"), bucket.now()
        record = server.new_attempt(project, "P1", 1, settings=bucket.settings, now=now, nonce="n")
        recording = f"{FOLDER}/trials/{record.name}/3-episode-0001.jsonl.gz"
        if request.param == "folder":
            yield OpenedStore(open_store(str(tmp_path)), recording, lambda key: (tmp_path / key).read_bytes())
            return
        told = bucket.variables(bucket.keep(record))
        store = open_store(told["STORE"], told["SERVER"], told["CREDENTIAL"])
        yield OpenedStore(store, recording, lambda key: bucket.documents.kept[key][0])


def test_what_is_created_can_be_read(opened: OpenedStore, tmp_path: Path) -> None:
    store = opened.store
    assert store.get(ANSWER) is None
    assert store.create(ANSWER, b"{}") is True
    assert store.get(ANSWER) == store.look(ANSWER) == b"{}"
    lines = tmp_path / "lines"
    lines.write_bytes(gzip.compress(b"lines"))
    assert store.create(opened.recording, lines) is True
    assert gzip.decompress(opened.kept(opened.recording)) == b"lines"


def test_nothing_is_overwritten(opened: OpenedStore) -> None:
    assert opened.store.create(ANSWER, b"first") is True
    assert opened.store.create(ANSWER, b"second") is False
    assert opened.store.get(ANSWER) == b"first"


async def test_a_recording_is_stored_once_if_its_folder_cannot_be_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, recording, full = open_store(str(tmp_path / "data")), tmp_path / "recording", iter([True])
    assert store.create("k/other.jsonl.gz", b"so the folder is there") is True
    recording.write_bytes(b"the recording")
    sync = disk.sync_folder

    def fail_once(folder: Path) -> None:
        if next(full, False):
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(folder)

    monkeypatch.setattr(disk, "sync_folder", fail_once)
    await store_file(store, "k/3-trial.jsonl.gz", recording)
    assert sorted(path.name for path in (tmp_path / "data" / "k").iterdir()) == ["3-trial.jsonl.gz", "other.jsonl.gz"]
    assert not recording.exists()


def test_one_of_many_writers_creates_the_file(tmp_path: Path) -> None:
    store = open_store(str(tmp_path))
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda n: store.create("k/x.json", str(n).encode()), range(50)))
    assert won.count(True) == 1
    assert store.get("k/x.json") == str(won.index(True)).encode()
    assert [path.name for path in (tmp_path / "k").iterdir()] == ["x.json"]
