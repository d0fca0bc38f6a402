"""What the documents of a simulated installation say about its lobby: who still waits, and which sessions were formed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import datetime

from hippodrome.lobby import decisions, entries
from hippodrome.model.project import Project
from protocol import session as sessions
from protocol.keys import sessions_folder
from protocol.session import SessionDocument

Kept = Mapping[str, tuple[bytes, str, datetime]]  # what S3 holds


def left_over(kept: Kept, project: Project) -> list[str]:
    """What the lobby still remembers: entries, and what its document lists."""
    found = [key for key in kept if key.startswith(entries.folder(project.id))]
    if stored := kept.get(decisions.key(project.id)):
        document = json.loads(stored[0])
        found += [
            f"{what} {one}" for what in ("open", "proposed", "formed", "unmatched") for one in document.get(what) or ()
        ]
    return found


def formed(kept: Kept, project: Project) -> Iterator[SessionDocument]:
    """All sessions that were formed."""
    for key in sorted(kept):
        if key.startswith(sessions_folder(project.id)) and key.endswith("/session.json"):
            yield sessions.parse(kept[key][0])
