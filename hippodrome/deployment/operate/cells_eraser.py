"""Takes one participant out of the document with a study's cells. The numbers of people stay."""

from __future__ import annotations

from hippodrome.control.model.balance import Cells, cells_key
from hippodrome.control.model.records import from_json, to_json
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.operate.storage import Note, Storage, newest, older


class CellsEraser:
    """Takes one participant out of one project's cells. May be interrupted anywhere and called again."""

    def __init__(self, storage: Storage, project: str, user: str) -> None:
        self._storage = storage
        self._key = cells_key(project)
        self._user = user
        self.unreadable: list[str] = []
        """The key of the document, if it cannot be read."""

    def look(self) -> list[Version]:
        """Find the versions of the document that name the participant."""
        return [version for version in self._storage.versions_of(self._key) if self._names(version)]

    def erase(self, note: Note) -> None:
        """Write the document without the participant, and delete the older versions."""
        self.unreadable = []
        last = newest(self._storage, self._key)
        if last is None:
            return
        body = self._storage.read(last)
        try:
            cells = from_json(body, Cells)
        except ValueError:
            self.unreadable.append(self._key)
            return
        after = cells.without(self._user)
        if after != cells and not self._storage.replace(self._key, body, to_json(after)):
            return  # somebody was assigned meanwhile: the next round tries again
        self._storage.delete(older(self._storage, self._key), note)

    def _names(self, version: Version) -> bool:
        try:
            return self._user in from_json(self._storage.read(version), Cells).drawn
        except ValueError:
            return False  # a delete marker, or a document that `erase` reports
