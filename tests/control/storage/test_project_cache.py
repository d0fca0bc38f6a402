"""The list of projects that a function keeps, where its requests share it."""

from __future__ import annotations

import pytest

from hippodrome.control.model.project import MASTER_LIST, MasterList, write_list
from hippodrome.control.storage import project_cache
from hippodrome.control.storage.project_cache import ProjectCache
from testing.fake_platform import FakePlatform
from testing.studies import study

Parsed = tuple[str, MasterList]


class Raced(ProjectCache):
    """A cache in which, after each list that is kept, another thread at once keeps the list before it."""

    _before: Parsed = ("before", MasterList())
    _kept: Parsed | None = None

    @property
    def _parsed(self) -> Parsed | None:
        return self._kept

    @_parsed.setter
    def _parsed(self, parsed: Parsed | None) -> None:
        self._kept = parsed and self._before


def test_a_request_uses_the_list_that_it_has_read_even_if_another_request_keeps_an_older_one() -> None:
    platform = FakePlatform()
    platform.documents.put(MASTER_LIST, write_list(MasterList([study(id="new")])))
    assert Raced(platform).project("new") is not None


def test_the_cached_documents_take_no_more_than_the_memory_that_they_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    """A study with many large pictures must not fill a function's memory."""
    monkeypatch.setattr(project_cache, "MAX_BYTES", 100)
    platform = FakePlatform()
    for name in ("a", "b", "c"):
        platform.documents.put(f"maze/steps/{name}.png", bytes(40))
    get, asked = platform.documents.get, list[str]()
    monkeypatch.setattr(platform.documents, "get", lambda key, *known: asked.append(key[-5:]) or get(key, *known))
    cache = ProjectCache(platform)
    for name in ("a", "b", "a", "b", "c", "c", "a"):
        found = cache.document(f"maze/steps/{name}.png")
        assert found is not None
        assert found.body == bytes(40)
    assert asked == ["a.png", "b.png", "c.png", "a.png"]
