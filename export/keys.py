"""What lies under which key of a study's participants, as `docs/data.md` has it, out of keys that may be anything."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import NamedTuple

from hippodrome.model import ids

STEP = re.compile(r"[A-Za-z0-9_-]{1,64}")
RESERVED = {"answered", "link"}  # names that the tables use before a dot themselves
_SERVER = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
_RECORDING = re.compile(r"(?P<step>[A-Za-z0-9_-]{1,64}?)-(?P<rest>(?:trial|episode-[0-9]{1,9})(?:-[0-9]{1,4})?)")
_END = ".jsonl.gz"


class Kind(StrEnum):
    PARTICIPANT = "participant"
    ANSWER = "answer"
    RECORDING = "recording"
    FOREIGN = "foreign"  # nothing that Hippodrome writes there


class Listed(NamedTuple):
    """One line of a listing: the key, its version (an ETag, or what stands for one) and its size in bytes."""

    key: str
    version: str
    size: int


class Item(NamedTuple):
    """A listed file, and what its key says. `server` and `name` are for recordings, `step` for them and answers."""

    kind: Kind
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
    """What a key below `prefix` stands for. Only parts that fit are ever made part of a path of ours."""
    parts = listed.key.removeprefix(prefix(project)).split("/")
    user = parts[0] if len(parts) > 1 and ids.is_user_id(parts[0]) else ""

    def foreign(why: str) -> Item:
        return Item(Kind.FOREIGN, listed, user, why=why)

    if not user:
        return foreign("it is in no participant's folder")
    if listed.key.endswith((".part", ".new")):
        return foreign("it was still being written")
    match parts[1:]:
        case ["participant.json"]:
            return Item(Kind.PARTICIPANT, listed, user)
        case ["answers", name] if name.endswith(".json"):
            step = name.removesuffix(".json")
            if not STEP.fullmatch(step) or step in RESERVED:
                return foreign("no step can have that name")
            return Item(Kind.ANSWER, listed, user, step)
        case ["trials", server, name] if name.endswith(_END):
            found = _RECORDING.fullmatch(name.removesuffix(_END))
            if not found or not _SERVER.fullmatch(server):
                return foreign("no recording has that name")
            return Item(Kind.RECORDING, listed, user, found["step"], server, found[0])
    return foreign("Hippodrome writes no such file")


def attempt(project: str, user: str, server: str) -> int | None:
    """Which of the participant's servers this is; None for a name that is not of our making."""
    parsed = ids.parse_server_name(server)
    return parsed[1] if parsed and parsed[0] == ids.server_label(project, user) else None
