"""Takes one participant out of a project's lobby: out of its entries, its decisions and the questions to `match`."""

from __future__ import annotations

from hippodrome.control.lobby import decisions, entries, rules
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.model import ids
from hippodrome.control.model.records import from_json, to_json
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.operate.storage import Note, Storage, newest, older, read_all
from hippodrome.protocol.keys import groups_folder, questions_folder


class LobbyEraser:
    """Takes one participant out of one project's lobby. May be interrupted anywhere and called again."""

    def __init__(self, storage: Storage, project: str, user: str) -> None:
        self._storage = storage
        self._project = project
        self._user = user
        self._label = ids.server_label(project, user)
        self._decisions = decisions.key(project)
        self.unreadable: list[str] = []
        """The keys of documents that name the participant and cannot be read."""

    def look(self) -> list[Version]:
        """Find the participant's entries, and the documents of decisions and of `match` that name them."""
        last = newest(self._storage, self._decisions)
        decided = [last] if last is not None and self._names(self._storage.read(last)) else []
        return [*self._entries(), *self._questions(), *decided]

    def erase(self, note: Note) -> None:
        """Take the participant out of the decisions, and delete their entries and the documents that name them."""
        self.unreadable = []
        last = newest(self._storage, self._decisions)
        if last is not None:
            if not self._take_out(self._storage.read(last)):
                return  # a function has written other decisions: the next round tries again
            self._storage.delete(older(self._storage, self._decisions), note)
        self._storage.delete(self._entries(), note)
        self._storage.delete(self._questions(), note)  # the lobby asks again, without the participant

    def _take_out(self, body: bytes) -> bool:
        """Write these decisions without the participant. Return False if other decisions were written meanwhile."""
        if not self._names(body):
            return True
        try:
            decided = from_json(body, Decisions)
        except ValueError:
            self.unreadable.append(self._decisions)
            return True
        after = decisions.next_version(decided, rules.without(decided, self._label))
        return self._storage.replace(self._decisions, body, to_json(after))

    def _entries(self) -> list[Version]:
        return [*self._storage.versions(entries.prefix_of(self._project, self._label))]

    def _questions(self) -> list[Version]:
        """Return all versions of questions to the function `match`, and of its answers, that name the participant."""
        folders = (questions_folder(self._project), groups_folder(self._project))
        versions = [version for folder in folders for version in self._storage.versions(folder) if not version.marker]
        bodies = read_all(self._storage, versions)
        return [version for version, body in zip(versions, bodies, strict=True) if self._names(body)]

    def _names(self, body: bytes) -> bool:
        return self._label.encode() in body or f'"{self._user}"'.encode() in body
