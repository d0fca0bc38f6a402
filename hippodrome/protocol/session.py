"""A session: the participants who play together on one server (`project.players`).

Its document is `{projectId}/sessions/{session id}/session.json`. The control plane creates it once, when the session is
formed. The trial server reads it, and lets in only the members:

    {"schema": 1, "id": "s.…", "players": 2, "group": null, "formed": "…",
     "members": [{"userId": "…", "group": null, "seat": 0}, …]}

The human players of the environment are numbered from 0, in the environment's order. A member plays the human
player whose number is their seat. `trial.substitute` plays in the seats that no member has.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
from dataclasses import dataclass
from typing import Any, TypeGuard

from hippodrome.protocol.keys import NAME, participant_folder, session_folder

SCHEMA = 1
MAX_PLAYERS = 16
"""The most participants of one session."""
ASSIGNMENT = "assignment.json"
"""The name of the document with a participant's, or a session's, levels and games (`protocol/assignment.py`)."""
SESSION_ID = re.compile(r"s\.[0-9a-f]{20}")
"""The id of a session. No participant's id has a dot (`hippodrome.protocol.keys.NAME`)."""


class BadSession(ValueError):
    """The document is not a valid session. The message quotes nothing from the document."""


@dataclass(frozen=True, slots=True)
class Member:
    """A participant of a session. `seat` counts the environment's human players from 0.

    `user_id` is "" if the participant's data were erased.
    """

    user_id: str
    group: int | None
    seat: int


@dataclass(frozen=True, slots=True)
class SessionDocument:
    """A session's document. `players` is the number of seats; `formed` is when the session was formed (`time_text`)."""

    id: str
    players: int
    members: tuple[Member, ...]
    group: int | None = None
    formed: str = ""

    def member(self, user_id: str) -> Member | None:
        """Return the member with this id; None if the participant is no member."""
        return next((member for member in self.members if user_id and member.user_id == user_id), None)

    @property
    def user_ids(self) -> list[str]:
        """The ids of the members whose data were not erased."""
        return [member.user_id for member in self.members if member.user_id]

    def to_json(self) -> bytes:
        """Return the bytes of the document, JSON."""
        members = [{"userId": member.user_id, "group": member.group, "seat": member.seat} for member in self.members]
        document = {"schema": SCHEMA, "id": self.id, "players": self.players, "group": self.group}
        return json.dumps({**document, "formed": self.formed, "members": members}, indent=1).encode()


def is_session_id(text: object) -> bool:
    """Return whether this is the id of a session."""
    return isinstance(text, str) and SESSION_ID.fullmatch(text) is not None


def owner_folder(project_id: str, owner: str) -> str:
    """Return the folder of all documents of a server's owner: of a session if `owner` is the id of one, otherwise of
    the participant with this id."""
    folder = session_folder if is_session_id(owner) else participant_folder
    return folder(project_id, owner)


def assignment_key(project_id: str, owner: str) -> str:
    """Return the key of the assignment of a participant, or of a session: levels, orders and games."""
    return f"{owner_folder(project_id, owner)}{ASSIGNMENT}"


def member_token(token: str, user_id: str) -> str:
    """Return the token that a member's page sends to the trial server: 48 hex digits, derived from the server's token.

    A member does not know the tokens of the others, so no member can play in the place of another.
    """
    return hmac.new(token.encode(), f"member\0{user_id}".encode(), hashlib.sha256).hexdigest()[:48]


def parse(body: bytes) -> SessionDocument:
    """Read the bytes of a session's document. Raises BadSession and no other exception."""
    try:
        parsed = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise BadSession("its document is not JSON") from error
    if not isinstance(parsed, dict) or parsed.get("schema", SCHEMA) != SCHEMA:
        raise BadSession("its document has a schema that this version cannot read")
    players, members = parsed.get("players"), parsed.get("members")
    if not is_session_id(parsed.get("id")):
        raise BadSession("its document names no session")
    if not (_is_number(players) and 1 <= players <= MAX_PLAYERS and isinstance(members, list)):
        raise BadSession("its document does not say who plays")
    formed = parsed.get("formed", "")
    session = SessionDocument(
        parsed["id"],
        players,
        tuple(_member(member) for member in members),
        _group(parsed.get("group")),
        formed if isinstance(formed, str) else "",
    )
    seats = [member.seat for member in session.members]
    ids = session.user_ids
    if not seats or len(set(seats)) < len(seats) or max(seats) >= players or len(set(ids)) < len(ids):
        raise BadSession("its document gives a seat or an id twice, or has a seat that does not exist")
    return session


def _member(written: Any) -> Member:
    if not isinstance(written, dict):
        raise BadSession("its document has a member that is no object")
    user_id, seat = written.get("userId"), written.get("seat")
    if not isinstance(user_id, str) or (user_id and not NAME.fullmatch(user_id)):
        raise BadSession("its document has a member without an id")
    if not (_is_number(seat) and seat >= 0):
        raise BadSession("its document has a member without a seat")
    return Member(user_id, _group(written.get("group")), seat)


def _group(value: Any) -> int | None:
    if not is_group(value):
        raise BadSession("its document has a group that is no number")
    return value


def is_group(value: object) -> TypeGuard[int | None]:
    """Return whether this is the number of a group, or None for a study without groups."""
    return value is None or (_is_number(value) and value >= 0)


def _is_number(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)
