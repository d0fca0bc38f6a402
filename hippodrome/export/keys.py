"""Reads the keys of a study's participants and sessions (`docs/data.md`).

A key can be any text. Only its valid parts are used.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import NamedTuple

from hippodrome.control.model import ids
from hippodrome.protocol.keys import NAME, SERVER_NAME, sessions_folder
from hippodrome.protocol.session import is_session_id

RESERVED = {"answered", "header", "link", "page"}  # the tables have own columns with these names before a dot
ASSIGNED, ENDED = "_assignment", "_end"
"""Stand for a participant's assignment and end among the documents of their answers. No step has such a name."""
_TRY = re.compile(r"[1-9][0-9]{0,3}")
_RECORDING = re.compile(r"(?P<step>[A-Za-z0-9_-]{1,64}?)-(?P<rest>(?:trial|episode-[0-9]{1,9})(?:-[0-9]{1,4})?)")
_END = ".jsonl.gz"
_PIECE = re.compile(r"(?P<step>[A-Za-z0-9_-]{1,64})-talk-[0-9]{4,6}\.json")


class KeyKind(StrEnum):
    """The kind of the file with a key."""

    PARTICIPANT = "participant"
    ANSWER = "answer"
    RECORDING = "recording"
    TAPE = "tape"  # a piece of what was said in a game
    MEMBERSHIP = "membership"  # names a participant's session
    SESSION = "session"  # a session's document
    FOREIGN = "foreign"  # a file that Hippodrome does not write


_OWN = {
    "participant.json": (KeyKind.PARTICIPANT, ""),
    "session.json": (KeyKind.MEMBERSHIP, ""),
    "assignment.json": (KeyKind.ANSWER, ASSIGNED),
    "end.json": (KeyKind.ANSWER, ENDED),
}


class Listed(NamedTuple):
    """A file in a listing: its key, its version (in a bucket the ETag) and its size in bytes."""

    key: str
    version: str
    size: int


class Item(NamedTuple):
    """A listed file, and the parts of its key. Recordings have `server`, `name` and `step`; answers have `step`.

    `user` is the id of the file's participant or session. (No participant's id is a valid id of a session.)
    """

    kind: KeyKind
    listed: Listed
    user: str = ""
    step: str = ""
    server: str = ""
    name: str = ""
    why: str = ""  # says why the file is foreign


def prefix(project: str) -> str:
    """Return the prefix of the keys of all participants of a study."""
    return f"{project}/users/"


def read(project: str, listed: Listed) -> Item:
    """Read a key below `prefix` or the sessions' folder.

    All parts of the result are valid, so they can be used in paths of the export folder.
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
        case [name] if name in _OWN:
            return Item(_OWN[name][0], listed, user, _OWN[name][1])
        case ["answers", name] if name.endswith(".json"):
            step, dot, number = name.removesuffix(".json").partition(".")
            if not NAME.fullmatch(step) or step in RESERVED or (dot and not _TRY.fullmatch(number)):
                return foreign("no step can have that name")
            return Item(KeyKind.ANSWER, listed, user, f"{step}{dot}{number}")
        case ["trials", server, name] if name.endswith(_END) or _PIECE.fullmatch(name):
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
    elif parts[1:] == ["assignment.json"]:  # each member has a copy
        return Item(KeyKind.ANSWER, listed, session, ASSIGNED)
    elif len(parts) == 4 and parts[1] == "trials" and (parts[3].endswith(_END) or _PIECE.fullmatch(parts[3])):
        if found := _recording(listed, session, parts[2], parts[3]):
            return found
        why = "no recording has that name"
    return Item(KeyKind.FOREIGN, listed, session, why=why)


def _recording(listed: Listed, user: str, server: str, name: str) -> Item | None:
    piece = _PIECE.fullmatch(name)
    found = piece or _RECORDING.fullmatch(name.removesuffix(_END))
    if not found or not SERVER_NAME.fullmatch(server):
        return None
    return Item(KeyKind.TAPE if piece else KeyKind.RECORDING, listed, user, found["step"], server, found[0])


def attempt(project: str, user: str, server: str) -> int | None:
    """Return the attempt of the server with this name; None if it is no server of this participant or session."""
    parsed = ids.parse_server_name(server)
    return parsed[1] if parsed and parsed[0] == ids.server_label(project, user) else None
