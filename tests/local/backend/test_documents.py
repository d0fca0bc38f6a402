"""Documents in a folder: what the contract does not say, and several processes at once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hippodrome.control.ports import Conflict
from hippodrome.local.backend.documents import FolderDocuments
from hippodrome.trial.recordings.store import FolderStore
from tests.local.conftest import ROOT

COUNT_UP = """
import sys
from pathlib import Path
from hippodrome.control.ports import Conflict
from hippodrome.local.backend.documents import FolderDocuments
documents = FolderDocuments(Path(sys.argv[1]), Path(sys.argv[2]))
for _ in range(int(sys.argv[3])):
    while True:
        found = documents.get("count.json")
        try:
            documents.replace("count.json", b"%d" % (int(found.body) + 1), found.etag)
            break
        except Conflict:
            pass
"""
WRITE_FOR_EVER = """
import sys
from pathlib import Path
from hippodrome.local.backend.documents import FolderDocuments
documents = FolderDocuments(Path(sys.argv[1]), Path(sys.argv[2]))
found, n = documents.get("big.json"), 0
etag = found.etag
print("ready", flush=True)
while True:
    n += 1
    etag = documents.replace("big.json", bytes([97 + n % 26]) * 3_000_000, etag)
    documents.create(f"new/{n}.json", b"x" * 100_000)
"""


@pytest.fixture
def documents(tmp_path: Path) -> FolderDocuments:
    return FolderDocuments(tmp_path / "data", tmp_path / "state")


def _python(code: str, *arguments: object, **options: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, **options)  # type: ignore[call-overload, no-any-return]


def test_changes_of_several_processes_are_all_kept(documents: FolderDocuments, tmp_path: Path) -> None:
    documents.create("count.json", b"0")
    workers = [_python(COUNT_UP, tmp_path / "data", tmp_path / "state", 50) for _ in range(4)]
    assert [worker.wait(60) for worker in workers] == [0] * 4
    assert documents.get("count.json").body == b"200"  # type: ignore[union-attr]


def test_only_one_of_a_trial_and_a_function_creates_a_document(documents: FolderDocuments) -> None:
    store = FolderStore(documents.folder)
    for n in range(50):
        key, won = f"study/users/P1/answers/{n}.json", []
        ready = threading.Barrier(2)

        def by_function(key: str = key, ready: threading.Barrier = ready, won: list[bytes] = won) -> None:
            ready.wait()
            try:
                documents.create(key, b"function")
                won.append(b"function")
            except Conflict:
                pass

        def by_trial(key: str = key, ready: threading.Barrier = ready, won: list[bytes] = won) -> None:
            ready.wait()
            if store.create(key, b"trial"):
                won.append(b"trial")

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda create: create(), (by_function, by_trial)))
        assert [documents.get(key).body] == won  # type: ignore[union-attr]


def test_documents_are_whole_after_a_kill_during_writing(documents: FolderDocuments, tmp_path: Path) -> None:
    documents.create("big.json", b"_" * 3_000_000)
    for _ in range(5):
        writer = _python(WRITE_FOR_EVER, tmp_path / "data", tmp_path / "state", stdout=subprocess.PIPE)
        assert writer.stdout
        writer.stdout.readline()
        time.sleep(0.15)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        body = documents.get("big.json").body  # type: ignore[union-attr]
        assert len(body) == 3_000_000
        assert len(set(body)) == 1
        new = list(documents.list("new/"))
        assert {entry.size for entry in new} <= {100_000}
        for entry in new:
            documents.delete(entry.key)
        documents.tidy()
        assert not list(tmp_path.rglob("*.new"))


@pytest.mark.parametrize(
    "key",
    ["", "/etc/passwd", "../x", "a/../../x", "a/..", "a//b", "a/", "a\\b", "a\0b", ".hidden", "a/.b/c", "x" * 300],
)
def test_no_key_leads_out_of_the_folder(documents: FolderDocuments, tmp_path: Path, key: str) -> None:
    (tmp_path / "x").write_text("outside")
    documents.create("a/b", b"here")
    with pytest.raises(ValueError):
        documents.create(key, b"evil")
    with pytest.raises(ValueError):
        documents.replace(key, b"evil", '"etag"')
    assert documents.get(key) is None
    documents.delete(key)
    if key:
        assert list(documents.list(key)) == ([] if key != "a/" else list(documents.list("a")))
    assert (tmp_path / "x").read_text() == "outside"
    assert [entry.key for entry in documents.list("")] == ["a/b"]


def test_listings_are_in_the_order_of_s3(documents: FolderDocuments) -> None:
    keys = ["a", "b/c", "b-d", "b.e", "b0", "b/c.d/e", "b/cé", "b/cz", "B", "é", "b/c0/x"]
    keys.remove("b/c")  # a folder and a file cannot have the same name, which S3 would allow
    for key in keys:
        documents.create(key, b"")
    assert [entry.key for entry in documents.list("")] == sorted(keys, key=str.encode)


def test_unfinished_files_of_a_trial_are_no_documents(documents: FolderDocuments) -> None:
    documents.create("study/users/P1/answers/1.json", b"{}")
    (documents.folder / "study" / "users" / "P1" / "answers" / ".abc.new").write_bytes(b"half")
    assert [entry.key for entry in documents.list("study/")] == ["study/users/P1/answers/1.json"]
    assert documents.get("study/users/P1/answers/.abc.new") is None


def test_listeners_are_called_after_the_write(tmp_path: Path) -> None:
    told: list[tuple[str, bytes, bytes]] = []

    def written(key: str, body: bytes) -> None:
        told.append((key, body, documents.get(key).body))  # type: ignore[union-attr]

    documents = FolderDocuments(tmp_path / "data", tmp_path / "state", written)
    etag = documents.create("a.json", b"1")
    with pytest.raises(Conflict):
        documents.create("a.json", b"2")
    documents.replace("a.json", b"3", etag)
    assert told == [("a.json", b"1", b"1"), ("a.json", b"3", b"3")]


def test_a_folder_is_no_document(documents: FolderDocuments) -> None:
    documents.create("a/b", b"x")
    assert documents.get("a") is None
    documents.delete("a")
    assert documents.get("a/b") is not None
    assert documents.get("a/b/c") is None
    assert list(documents.list("a/b/")) == []


def test_two_hundred_participants_at_once(documents: FolderDocuments) -> None:
    """Each answers five steps, and looks before each: no conflict, nothing lost."""

    def one(user: int) -> None:
        folder = f"study/users/P{user}/"
        for step in range(5):
            assert len(list(documents.list(folder))) == step
            documents.create(f"{folder}answers/{step}.json", json.dumps({"user": user}).encode())

    with ThreadPoolExecutor(200) as pool:
        list(pool.map(one, range(200)))
    assert len(list(documents.list("study/users/"))) == 1000
    assert not os.listdir(documents.folder.parent / "state" / "scratch")
