"""Projects and step pages, read through a small cache: fresh for a few seconds, then asked for again by ETag."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import TYPE_CHECKING, NamedTuple

from hippodrome.log import logger
from hippodrome.model.project import MASTER_LIST, MasterList, Project, read_list, step_key
from hippodrome.ports import Document, Platform

if TYPE_CHECKING:
    from hippodrome.storage.secret import Secrets

FRESH = timedelta(seconds=10)  # how long a closed project may still be seen
PAGE_FRESH = timedelta(minutes=5)  # how long a page may be seen that was replaced without registering its project anew
MAX_DOCUMENTS = 200  # documents kept


class _Cached(NamedTuple):
    document: Document
    read: datetime
    version: str


class ProjectCache:
    """One per running function: what all its requests share."""

    def __init__(self, platform: Platform, secrets: Secrets | None = None) -> None:
        """With `secrets`, projects come with theirs."""
        self._platform = platform
        self._secrets = secrets
        self._cached: dict[str, _Cached] = {}
        self._parsed: tuple[str, MasterList] | None = None

    def project(self, project_id: str, fresh: timedelta = FRESH) -> Project | None:
        """The registered project, live or not, as it was at most so long ago; None if there is none of that id."""
        found = self._list(fresh).find(project_id)
        return self._secrets.with_secret(found) if found and self._secrets else found

    def projects(self, fresh: timedelta = FRESH) -> list[Project]:
        """All of them, without their secrets."""
        return self._list(fresh).projects

    def _list(self, fresh: timedelta) -> MasterList:
        found = self.document(MASTER_LIST, fresh)
        if found is None:
            return MasterList()
        if self._parsed is None or self._parsed[0] != found.etag:
            listed = read_list(found.body)
            for entry in listed.unreadable:
                logger.error("a project cannot be read and counts as closed", extra={"project": entry.id})
            self._parsed = (found.etag, listed)
        return self._parsed[1]

    def is_unreadable(self, project_id: str) -> bool:
        """Whether the project is registered, but its entry cannot be read: it counts as closed."""
        return self._list(FRESH).is_unreadable(project_id)

    def live_project(self, project_id: str, fresh: timedelta = FRESH) -> Project | None:
        """The project if participants may see it, as it was at most so long ago."""
        project = self.project(project_id, fresh)
        return project if project and project.live else None

    def page(self, project: Project, file: str) -> str | None:
        """The source of a step page; None if it is missing."""
        found = self.document(step_key(project.id, file), PAGE_FRESH, project.version)
        return None if found is None else found.body.decode("utf-8", "replace")

    def document(self, key: str, fresh: timedelta = FRESH, version: str = "") -> Document | None:
        """Any shared document, at most `fresh` old and kept since its project had this version."""
        now = self._platform.now()
        kept = self._cached.get(key)
        if kept and kept.version == version and now < kept.read + fresh:
            return kept.document
        found = self._platform.documents.get(key, kept.document if kept else None)
        if found is None:
            self._cached.pop(key, None)  # what is missing now may be there in a moment
            return None
        if len(self._cached) >= MAX_DOCUMENTS:
            self._cached.clear()
        self._cached[key] = _Cached(found, now, version)
        return found
