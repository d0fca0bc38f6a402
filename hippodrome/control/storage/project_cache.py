"""Caches projects and step pages. When a cached document is too old, it is read again, by its ETag."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, NamedTuple

from hippodrome.control.log import logger
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project, read_list
from hippodrome.control.ports import Document, Platform

if TYPE_CHECKING:
    from hippodrome.control.storage.secret import SecretCache

FRESH = timedelta(seconds=10)  # the age at which the cached master list is read again
PAGE_FRESH = timedelta(minutes=5)  # the age at which a cached page is read again; at once after a registration
MAX_DOCUMENTS = 200  # if the cache has so many, it is emptied
MAX_BYTES = 100_000_000  # of all documents: the function has 1 GB, and a study may have many large pictures


class _Cached(NamedTuple):
    document: Document
    read: datetime
    version: str


class ProjectCache:
    """The cache of one running function, which all its requests share."""

    def __init__(self, platform: Platform, secrets: SecretCache | None = None) -> None:
        """With `secrets`, the methods that return one project fill in its secret."""
        self._platform = platform
        self._secrets = secrets
        self._cached: dict[str, _Cached] = {}
        self._parsed: tuple[str, MasterList] | None = None

    def project(self, project_id: str, fresh: timedelta = FRESH) -> Project | None:
        """Return the registered project, live or not, from a list at most `fresh` old; None if it has no readable
        entry.
        """
        registration = self._list(fresh).find(project_id)
        return self._secrets.with_secret(registration) if registration and self._secrets else registration

    def projects(self, fresh: timedelta = FRESH) -> list[Project]:
        """Return all registered projects, without their secrets, from a list at most `fresh` old."""
        return self._list(fresh).projects

    def ids(self) -> list[str]:
        """Return the ids of all registered projects, also of those whose entries cannot be read."""
        listed = self._list(FRESH)
        return sorted({project.id for project in listed.projects} | {e.id for e in listed.unreadable if e.id})

    def _list(self, fresh: timedelta) -> MasterList:
        document = self.document(MASTER_LIST, fresh)
        if document is None:
            return MasterList()
        parsed = self._parsed  # read from the attribute once, since another thread may replace it
        if parsed is None or parsed[0] != document.etag:
            listed = read_list(document.body)
            for entry in listed.unreadable:
                logger.error("a project cannot be read and counts as closed", extra={"project": entry.id})
            parsed = self._parsed = (document.etag, listed)
        return parsed[1]

    def is_unreadable(self, project_id: str) -> bool:
        """Return whether the project is registered but its entry cannot be read, so that it counts as closed."""
        return self._list(FRESH).is_unreadable(project_id)

    def live_project(
        self, project_id: str, fresh: timedelta = FRESH, *, fits: Callable[[Project], object] | None = None
    ) -> Project | None:
        """Return the project if it is live, from a list at most `fresh` old; None if it is closed or not registered.

        `fits` says whether a message or a request can belong to the project as it is listed. If not, the cached list
        may be older than the message: then the list is read again, and the project is returned even if it does not fit.
        """
        project = self.project(project_id, fresh)
        if fits and not (project and project.live and fits(project)):
            project = self.project(project_id, timedelta(0))
        return project if project and project.live else None

    def page(self, project: Project, file: str) -> str | None:
        """Return the source of a step page; None if the file is missing. `file` is its name without `.html`."""
        document = self.document(project.page_key(file), PAGE_FRESH, project.version)
        return None if document is None else document.body.decode("utf-8", "replace")

    def document(self, key: str, fresh: timedelta = FRESH, version: str = "") -> Document | None:
        """Return the document, at most `fresh` old and read for this version of its project; None if it is missing."""
        now = self._platform.now()
        cached = self._cached.get(key)
        if cached and cached.version == version and now < cached.read + fresh:
            return cached.document
        document = self._platform.documents.get(key, cached.document if cached else None)
        if document is None:
            self._cached.pop(key, None)  # a missing document is not cached
            return None
        size = sum(len(entry.document.body) for entry in list(self._cached.values()))  # other threads change the cache
        if len(self._cached) >= MAX_DOCUMENTS or size + len(document.body) > MAX_BYTES:
            self._cached.clear()
        self._cached[key] = _Cached(document, now, version)
        return document
