"""The list of projects that a function keeps, where its requests share it."""

from __future__ import annotations

from hippodrome.model.project import MASTER_LIST, MasterList, write_list
from hippodrome.storage.project_cache import ProjectCache
from testing.fake_platform import FakePlatform
from testing.studies import study

Parsed = tuple[str, MasterList]


class Raced(ProjectCache):
    """Whenever a list is kept, another thread, which has read the one before it, keeps that at once."""

    _before: Parsed = ("before", MasterList())
    _kept: Parsed | None = None

    @property
    def _parsed(self) -> Parsed | None:
        return self._kept

    @_parsed.setter
    def _parsed(self, parsed: Parsed | None) -> None:
        self._kept = parsed and self._before


def test_a_request_gets_the_list_that_it_has_read_whatever_other_requests_keep() -> None:
    platform = FakePlatform()
    platform.documents.put(MASTER_LIST, write_list(MasterList([study(id="new")])))
    assert Raced(platform).project("new") is not None
