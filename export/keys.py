"""What lies under which key of a study's participants and sessions, as `docs/data.md` has it.

Keys may be anything: only parts that fit are used.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import NamedTuple

from hippodrome.model import ids
from protocol.keys import NAME, SERVER_NAME, sessions_folder
from protocol.session import is_session_id

RESERVED = {"answered", "link", "page"}  # names that the tables use before a dot themselves
_RECORDING = re.compile(r"(?P<step>[A-Za-z0-9_-]{1,64}?)-(?P<rest>(?:trial|episode-[0-9]{1,9})(?:-[0-9]{1,4})?)")
_END = ".jsonl.gz"


class KeyKind(StrEnum):
    PARTICIPANT = "participant"
    ANSWER = "answer"
    RECORDING = "recording"
    MEMBERSHIP = "membership"  # in which session a participant plays
    SESSION = "session"  # who plays in it
    FOREIGN = "foreign"  # nothing that Hippodrome writes there


class Listed(NamedTuple):
    """One line of a listing: the key, its version (an ETag, or what stands for one) and its size in bytes."""

    key: str
    version: str
    size: int


class Item(NamedTuple):
    """A listed file, and what its key says. `server` and `name` are for recordings, `step` for them and answers.

    `user` is whose file it is: a participant's id, or a session's, which no participant can have.
    """

    kind: KeyKind
    listed: Listed
    user: str = ""
    step: str = ""
    server: str = ""
    name: str = ""
    why: str = ""  # of a foreign file: what is wrong with it


def prefix(project: str) -> str:
    """Where everything of a study's participants lies."""
    return f"{project}/users/"


def read(project: str, listed: Listed) -> Item:
    """What a key stands for, below `prefix` or the sessions' folder.

    Only parts that fit are ever made part of a path of ours.
    """
    if listed.key.startswith(sessions_folder(project)):
        return _read_session(project, listed)
    parts = listed.key.removeprefix(prefix(project)).split("/")
    user = parts[0] if len(parts) > 1 and ids.is_user_id(parts[0]) else ""
    if not user:
        return Item(KeyKind.FOREIGN, listed, why="it is in no participant's folder")

    def foreign(why: str) -> Item:
        return Item(KeyKind.FOREIGN, listed, user, why=why)

    if listed.key.endswith((".part", ".new")):
        return foreign("it was still being written")
    match parts[1:]:
        case [("participant.json" | "session.json") as name]:
            return Item(KeyKind.PARTICIPANT if name == "participant.json" else KeyKind.MEMBERSHIP, listed, user)
        case ["answers", name] if name.endswith(".json"):
            step = name.removesuffix(".json")
            if not NAME.fullmatch(step) or step in RESERVED:
                return foreign("no step can have that name")
            return Item(KeyKind.ANSWER, listed, user, step)
        case ["trials", server, name] if name.endswith(_END):
            return _recording(listed, user, server, name) or foreign("no recording has that name")
    return foreign("Hippodrome writes no such file")


def _read_session(project: str, listed: Listed) -> Item:
    parts = listed.key.removeprefix(sessions_folder(project)).split("/")
    session = parts[0] if len(parts) > 1 and is_session_id(parts[0]) else ""
    why = "Hippodrome writes no such file"
    if not session:
        why = "it is in no session's folder"
    elif listed.key.endswith((".part", ".new")):
        why = "it was still being written"
    elif parts[1:] == ["session.json"]:
        return Item(KeyKind.SESSION, listed, session)
    elif len(parts) == 4 and parts[1] == "trials" and parts[3].endswith(_END):
        if found := _recording(listed, session, parts[2], parts[3]):
            return found
        why = "no recording has that name"
    return Item(KeyKind.FOREIGN, listed, session, why=why)


def _recording(listed: Listed, user: str, server: str, name: str) -> Item | None:
    found = _RECORDING.fullmatch(name.removesuffix(_END))
    if not found or not SERVER_NAME.fullmatch(server):
        return None
    return Item(KeyKind.RECORDING, listed, user, found["step"], server, found[0])


def attempt(project: str, user: str, server: str) -> int | None:
    """Which of the servers of a participant or a session this is; None for a name that is not of our making."""
    parsed = ids.parse_server_name(server)
    return parsed[1] if parsed and parsed[0] == ids.server_label(project, user) else None
