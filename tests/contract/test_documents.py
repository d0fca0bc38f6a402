"""The contract of `hippodrome.control.ports.Documents`."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest

from hippodrome.control.ports import Conflict, Documents, Platform
from tests.contract.backends import concurrent

KEY = "study/users/P_1-a/participant.json"


@pytest.fixture(autouse=True)
def restless_threads() -> Iterator[None]:
    """Let threads take turns as often as they can: otherwise a write that is not atomic could seem atomic."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.fixture
def documents(platform: Platform) -> Documents:
    return platform.documents


def test_a_document_comes_back_as_it_was_written(documents: Documents) -> None:
    etag = documents.create(KEY, b"one")
    found = documents.get(KEY)
    assert found is not None
    assert (found.body, found.etag) == (b"one", etag)


@pytest.mark.parametrize("body", [b"", bytes(range(256)), b"\r\n" * 200_000], ids=["empty", "binary", "large"])
def test_any_bytes_may_be_stored(documents: Documents, body: bytes) -> None:
    documents.create("study/users/P1/trials/1.jsonl.gz", body)
    found = documents.get("study/users/P1/trials/1.jsonl.gz")
    assert found is not None
    assert found.body == body


def test_get_of_a_missing_document_is_none(documents: Documents) -> None:
    assert documents.get(KEY) is None
    documents.create(KEY, b"one")
    assert documents.get("study/users/P_1-a") is None
    assert documents.get(KEY + "x") is None


def test_get_of_an_unchanged_document_returns_the_known_one(documents: Documents) -> None:
    documents.create(KEY, b"one")
    known = documents.get(KEY)
    assert documents.get(KEY, known) is known


def test_get_reads_a_changed_document_again(documents: Documents) -> None:
    documents.create(KEY, b"one")
    known = documents.get(KEY)
    assert known is not None
    etag = documents.replace(KEY, b"two", known.etag)
    assert documents.get(KEY, known) == (b"two", etag)
    documents.delete(KEY)
    assert documents.get(KEY, known) is None


def test_create_does_not_overwrite(documents: Documents) -> None:
    etag = documents.create(KEY, b"one")
    with pytest.raises(Conflict):
        documents.create(KEY, b"two")
    with pytest.raises(Conflict):
        documents.create(KEY, b"one")
    assert documents.get(KEY) == (b"one", etag)


def test_replace_needs_the_present_version(documents: Documents) -> None:
    first = documents.create(KEY, b"one")
    second = documents.replace(KEY, b"two", first)
    assert second != first
    with pytest.raises(Conflict):
        documents.replace(KEY, b"three", first)
    assert documents.get(KEY) == (b"two", second)
    documents.replace(KEY, b"three", second)


def test_replace_of_a_missing_document_raises_conflict(documents: Documents) -> None:
    etag = documents.create(KEY, b"one")
    with pytest.raises(Conflict):
        documents.replace(KEY + "x", b"two", etag)
    documents.delete(KEY)
    with pytest.raises(Conflict):
        documents.replace(KEY, b"two", etag)
    assert documents.get(KEY) is None


def test_put_writes_over_any_document(documents: Documents) -> None:
    documents.put(KEY, b"one")
    first = documents.get(KEY)
    assert first is not None
    assert first.body == b"one"
    documents.put(KEY, b"two")
    with pytest.raises(Conflict):
        documents.replace(KEY, b"three", first.etag)
    with pytest.raises(Conflict):
        documents.create(KEY, b"four")
    documents.delete(KEY)
    documents.put(KEY, b"five")
    found = documents.get(KEY)
    assert found is not None
    assert found.body == b"five"


def test_a_repeated_put_gives_a_newer_time_in_a_listing(documents: Documents, platform: Platform) -> None:
    """A document that is put again with the same bytes gets a new time: so the lobby sees that a participant still waits."""
    clock = getattr(platform, "wait", None)
    documents.put(KEY, b"here")
    [before] = documents.list(KEY)
    end = time.monotonic() + 10
    while time.monotonic() < end:  # times in a listing of S3 have whole seconds
        clock(seconds=0.3) if clock else time.sleep(0.3)
        documents.put(KEY, b"here")
        [after] = documents.list(KEY)
        if after.modified > before.modified:
            return
    raise AssertionError("its time stays")


@concurrent
def test_of_many_puts_at_once_one_is_stored_whole(documents: Documents) -> None:
    bodies = [b"%d" % n * 100_000 for n in range(8)]
    assert len(successful_at_once(8, lambda n: documents.put(KEY, bodies[n]))) == 8
    found = documents.get(KEY)
    assert found is not None
    assert found.body in bodies


def test_a_document_may_be_deleted_twice_and_created_again(documents: Documents) -> None:
    documents.create(KEY, b"one")
    documents.delete(KEY)
    documents.delete(KEY)
    documents.delete("never/was/here.json")
    documents.create(KEY, b"two")


@concurrent
def test_of_many_creates_at_once_one_succeeds(documents: Documents) -> None:
    won = successful_at_once(8, lambda n: documents.create(KEY, b"%d" % n))
    assert len(won) == 1
    found = documents.get(KEY)
    assert found is not None
    assert found.body == b"%d" % won[0]


@concurrent
def test_of_many_replaces_at_once_one_succeeds(documents: Documents) -> None:
    etag = documents.create(KEY, b"nobody")
    won = successful_at_once(8, lambda n: documents.replace(KEY, b"%d" % n, etag))
    assert len(won) == 1
    found = documents.get(KEY)
    assert found is not None
    assert found.body == b"%d" % won[0]


@concurrent
def test_no_change_is_lost_if_many_writers_try_again(documents: Documents) -> None:
    documents.create(KEY, b"0")

    def count_up(_: int) -> None:
        for _ in range(5):
            while True:
                found = documents.get(KEY)
                assert found is not None
                try:
                    documents.replace(KEY, b"%d" % (int(found.body) + 1), found.etag)
                except Conflict:
                    continue
                break

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(count_up, range(4)))
    found = documents.get(KEY)
    assert found is not None
    assert found.body == b"20"


def test_a_listing_has_every_document_with_the_prefix_in_key_order(documents: Documents) -> None:
    keys = [
        "study/steps/consent-0.html",
        "study/steps/consent.html",
        "study/steps/consent/more.html",
        "study/steps/consent2.html",
        "study/users/P1/participant.json",
        "study-2/steps/consent.html",
        "study.json",
    ]
    for key in keys:
        documents.create(key, key.encode())
    assert [entry.key for entry in documents.list("study/steps/consent")] == sorted(keys[:4])
    assert [entry.key for entry in documents.list("study/")] == sorted(keys[:5])
    assert [entry.key for entry in documents.list("study")] == sorted(keys)
    assert [entry.key for entry in documents.list("")] == sorted(keys)
    assert [entry.key for entry in documents.list("study/steps/consent.html")] == ["study/steps/consent.html"]
    assert list(documents.list("study/steps/x")) == []
    assert list(documents.list("other/")) == []


def test_a_listing_says_size_and_time(documents: Documents, platform: Platform) -> None:
    documents.create(KEY, b"four")
    [entry] = documents.list("study/")
    assert entry.size == 4
    assert entry.modified.utcoffset() == timedelta(0)
    assert abs(platform.now() - entry.modified) < timedelta(minutes=1)


@pytest.mark.explores
def test_a_listing_has_the_documents_of_all_pages(documents: Documents, pages: int) -> None:
    keys = [f"study/users/P{n}/participant.json" for n in range(1, 2 * pages + 6)]
    for key in keys:
        documents.create(key, b"{}")
    assert [entry.key for entry in documents.list("study/users/")] == sorted(keys)


def test_the_platforms_clock_is_in_utc(platform: Platform) -> None:
    assert platform.now().utcoffset() == timedelta(0)
    assert platform.now() > datetime(2026, 1, 1, tzinfo=UTC)


def successful_at_once(count: int, write: Callable[[int], object]) -> list[int]:
    """Run `count` threads at once; the numbers of those that did not meet a `Conflict`."""
    ready = threading.Barrier(count)

    def one(n: int) -> bool:
        ready.wait()
        try:
            write(n)
        except Conflict:
            return False
        return True

    with ThreadPoolExecutor(count) as threads:
        return [n for n, won in enumerate(threads.map(one, range(count))) if won]
