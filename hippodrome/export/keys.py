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


_OF_PARTICIPANT = {
    "participant.json": (KeyKind.PARTICIPANT, ""),
    "session.json": (KeyKind.MEMBERSHIP, ""),
    "assignment.json": (KeyKind.ANSWER, ASSIGNED),
    "end.json": (KeyKind.ANSWER, ENDED),
}
_OF_SESSION = {"session.json": (KeyKind.SESSION, ""), "assignment.json": (KeyKind.ANSWER, ASSIGNED)}
"""A session's assignment is a copy of each member's."""


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
    in_sessions = listed.key.startswith(sessions_folder(project))
    owner, *parts = listed.key.removeprefix(sessions_folder(project) if in_sessions else prefix(project)).split("/")
    if not parts or not (is_session_id(owner) if in_sessions else ids.is_user_id(owner)):
        return Item(KeyKind.FOREIGN, listed, why=f"it is in no {'session' if in_sessions else 'participant'}'s folder")
    own = _OF_SESSION if in_sessions else _OF_PARTICIPANT
    why = "Hippodrome writes no such file"
    match parts:
        case [*_, name] if name.endswith((".part", ".new")):
            why = "it was still being written"
        case [name] if name in own:
            return Item(own[name][0], listed, owner, own[name][1])
        case ["answers", name] if name.endswith(".json") and not in_sessions:
            step, dot, number = name.removesuffix(".json").partition(".")
            if NAME.fullmatch(step) and step not in RESERVED and (not dot or _TRY.fullmatch(number)):
                return Item(KeyKind.ANSWER, listed, owner, f"{step}{dot}{number}")
            why = "no step can have that name"
        case ["trials", server, name] if name.endswith(_END) or _PIECE.fullmatch(name):
            piece = _PIECE.fullmatch(name)
            found = piece or _RECORDING.fullmatch(name.removesuffix(_END))
            if found and SERVER_NAME.fullmatch(server):
                kind = KeyKind.TAPE if piece else KeyKind.RECORDING
                return Item(kind, listed, owner, found["step"], server, found[0])
            why = "no recording has that name"
    return Item(KeyKind.FOREIGN, listed, owner, why=why)


def attempt(project: str, user: str, server: str) -> int | None:
    """Return the attempt of the server with this name; None if it is no server of this participant or session."""
    parsed = ids.parse_server_name(server)
    return parsed[1] if parsed and parsed[0] == ids.server_label(project, user) else None
