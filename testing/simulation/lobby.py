"""Reads from the documents of a simulated installation what is left in its lobby, and which sessions were formed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import datetime

from hippodrome.control.lobby import decisions, entries
from hippodrome.control.model.project import Project
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.session import SessionDocument

StoredDocuments = Mapping[str, tuple[bytes, str, datetime]]  # by key: a document's body, ETag and time


def left_over(documents: StoredDocuments, project: Project) -> list[str]:
    """Return the entries of the lobby that are left, and what its document still lists, as texts."""
    found = [key for key in documents if key.startswith(entries.folder(project.id))]
    if stored := documents.get(decisions.key(project.id)):
        document = json.loads(stored[0])
        found += [
            f"{name} {one}" for name in ("open", "proposed", "formed", "unmatched") for one in document.get(name) or ()
        ]
    return found


def formed(documents: StoredDocuments, project: Project) -> Iterator[SessionDocument]:
    """Yield all sessions that were formed."""
    for key in sorted(documents):
        if key.startswith(sessions_folder(project.id)) and key.endswith("/session.json"):
            yield sessions.parse(documents[key][0])
